"""mmwave-loc localize, as it is typed: the speed, the figures, the files, and what goes wrong."""

import csv
import gzip
import json
import os
import pty
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from experiments.console.main import run
from experiments.evaluation.contenders import imm_banks
from mmwave_env.datasets.log_writer import write_log
from mmwave_env.filters.bank import best_bank
from mmwave_env.filters.mode_files import default_modes
from mmwave_env.localization.localizer import localize
from mmwave_env.logs.log import read_log
from mmwave_env.logs.tum import COLUMNS, read_tum, tum_lines
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, read_scene
from mmwave_env.world.simulated import SimulatedSource
from tests.cli import assert_one_clear_line, command, environment
from tests.localization.mistakes import MISTAKES, read_columns, write_columns
from tests.marks import representative
from tests.paths import LOGS

WALK, RIDE = LOGS / "canyon28_pedestrian", LOGS / "canyon28_vehicle"
EPOCHS = {WALK: 400, RIDE: 120}
OLD = f"# {' '.join(COLUMNS)}; mmwave-loc localize\n"  # a track that may be replaced
PROMPT = "Enter current speed (m/s): "


def options(log, *more, folder=WALK):
    return [str(v) for v in (log, "--scene", folder / "scene.json", *more)]


def figures(folder, *more, log=None, truth=True):
    """Run the command on a sample; what it wrote as JSON."""
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "figures.json"
        scored = ("--truth", folder / "truth.tum") if truth else ()
        run("localize", options(log or folder / "log.csv", *scored, "--json", file, *more,
                                folder=folder))  # fmt: skip
        return json.loads(file.read_text())


def refused(capsys, arguments):
    """Run a command that ends with exit code 2; what it printed, and the line of the error."""
    with pytest.raises(SystemExit) as stop:
        run("localize", [str(a) for a in arguments])
    assert stop.value.code == 2
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert line.startswith("mmwave-loc localize: ")
    return shown.out, line


def child(arguments, **more):
    words = [sys.executable, "-m", "experiments.console", "localize", *map(str, arguments)]
    return subprocess.Popen(words, env=environment(), text=True, **more)


# --- the speed (Algorithm 1)


@pytest.mark.parametrize("folder", [WALK, RIDE], ids=["walk", "ride"])
@pytest.mark.parametrize(
    ("speed", "mode"), [("0", "ekf"), ("1.4", "ekf"), ("2", "ekf"), ("2.01", "ukf"), ("2e1", "ukf")]
)
def test_a_speed_chooses_the_pipeline(folder, speed, mode):
    found = figures(folder, "--speed", speed, "--radio", "standard")
    assert found["modes"] == {mode: EPOCHS[folder]} and found["switches"] == 0
    assert found["truth"]["scored"] == EPOCHS[folder]
    filtered, smoothed = (found["truth"]["tracks"][t] for t in ("filtered", "smoothed"))
    assert smoothed["ate_m"] < filtered["ate_m"] < 0.3
    assert smoothed["rmse_m"] < 0.1 and filtered["in_bounds"] > 0.85


def test_above_the_design_window_the_ukf_runs_with_a_warning():
    done = command("localize", *options(RIDE / "log.csv", "--speed", "25", folder=RIDE))
    assert done.returncode == 0 and "ukf 100.0 %" in done.stdout
    assert re.fullmatch(
        r"warning: speed 25 m/s is outside the design window \(up to 20.*\n", done.stderr
    )


def test_above_the_design_window_the_command_may_stop(capsys, tmp_path):
    out = tmp_path / "track.tum"
    _, line = refused(
        capsys,
        options(RIDE / "log.csv", "--speed", "25", "--outside", "abort", "--out", out, folder=RIDE),
    )
    assert "found 25 m/s, outside the design window (up to 20 m/s)" in line
    assert list(tmp_path.iterdir()) == []
    assert figures(WALK, "--speed", "20", "--outside", "abort")["modes"] == {"ukf": 400}


def test_auto_decides_in_every_epoch(tmp_path):
    found = figures(RIDE, "--speed", "auto", "--out", tmp_path / "track.tum")
    assert found["modes"] == {"ekf": 1, "ukf": 119} and found["switches"] == 1
    with (tmp_path / "track.csv").open(newline="") as file:
        assert [row["mode"] for row in csv.DictReader(file)] == ["ekf"] + 119 * ["ukf"]


@pytest.mark.parametrize("word", ["fast", "-1", "nan", "inf", "", "1,4", "1_0", "AUTO"])
def test_what_is_no_speed_is_refused(capsys, word):
    _, line = refused(capsys, options(WALK / "log.csv", "--speed", word))
    assert f"speed: found {word!r}, expected a number of m/s, at least 0" in line


def test_without_a_terminal_the_mode_is_chosen_in_every_epoch(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    told, asked = (command("localize", *options(WALK / "log.csv", *more))
                   for more in ((), ("--speed", "auto")))  # fmt: skip
    assert told.returncode == 0 and told.stdout == asked.stdout
    done = command("localize", *options(WALK / "log.csv", "--outside", "abort"))
    assert_one_clear_line(done, "outside: found abort with --speed auto, expected a speed in m/s")


def session(answers, seconds=60.0):
    """Answer the prompt on a pseudo-terminal, one answer a prompt; exit code and screen."""
    ours, theirs = pty.openpty()
    process = child(options(WALK / "log.csv"), stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    screen, asked, end = b"", 0, time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            piece = os.read(ours, 4096)
        except OSError:  # the other side is closed
            break
        if not piece:
            break
        screen += piece
        if screen.count(PROMPT.encode()) > asked < len(answers):
            os.write(ours, answers[asked])
            asked += 1
    os.close(ours)
    return process.wait(timeout=seconds), screen.decode().replace("\r\n", "\n")


@pytest.mark.slow
def test_on_a_terminal_the_prompt_asks_until_the_answer_is_a_speed():
    wrong = ["walking", "-1", "nan", "inf", "", "auto"]
    code, screen = session([f"{word}\n".encode() for word in [*wrong, "1.4"]])
    assert code == 0 and "ekf 100.0 %" in screen and "NIS" in screen
    assert screen.count(PROMPT) == len(wrong) + 1
    for word in wrong:
        assert f"speed: found {word!r}, expected a number of m/s, at least 0" in screen


@pytest.mark.slow
def test_the_first_answer_may_be_right():
    code, screen = session([b"10\n"])
    assert code == 0 and screen.count(PROMPT) == 1 and "ukf 100.0 %" in screen


@pytest.mark.slow
@pytest.mark.parametrize(
    "answers", [pytest.param([b"\x04"], marks=pytest.mark.slow), [b"slow\n", b"\x04"]]
)
def test_the_end_of_the_input_ends_the_command(answers):
    code, screen = session(answers)
    assert code == 2 and "speed: found the end of the input, expected a number of m/s" in screen
    assert "Traceback" not in screen


def test_files_are_looked_at_before_the_question():
    done = command("localize", *options("missing.csv"))
    assert done.returncode == 2 and "missing.csv" in done.stderr and "speed" not in done.stderr


# --- the figures


def evo_figures(truth, track, delta):
    """ATE, RMSE and RPE as evo computes them from two files."""
    metrics = pytest.importorskip("evo.core.metrics")
    sync = pytest.importorskip("evo.core.sync")
    read = pytest.importorskip("evo.tools.file_interface").read_tum_trajectory_file
    pair = sync.associate_trajectories(read(str(truth)), read(str(track)))
    translation, of = metrics.PoseRelation.translation_part, metrics.StatisticsType
    absolute = metrics.APE(translation)
    absolute.process_data(pair)
    relative = metrics.RPE(translation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
    relative.process_data(pair)
    return [absolute.get_statistic(of.mean), absolute.get_statistic(of.rmse),
            relative.get_statistic(of.mean)]  # fmt: skip


@pytest.mark.parametrize("track", ["filtered", "smoothed"])
@pytest.mark.parametrize("known", [slice(None), slice(30, 95)])
def test_the_figures_are_evos(tmp_path, track, known):
    truth = read_tum(RIDE / "truth.tum")
    part, out = tmp_path / "part.tum", tmp_path / "track.tum"
    part.write_text(tum_lines(truth.time_s[known], truth.position_m[known]))
    switch = [] if track == "smoothed" else ["--no-smoothing"]
    found = figures(
        RIDE, "--speed", "10", "--truth", part, "--out", out, *switch, truth=False
    )["truth"]  # fmt: skip
    assert found["rpe_s"] == pytest.approx(1.0)
    assert found["scored"] == len(truth.time_s[known])
    row = found["tracks"][track]
    expected = evo_figures(part, out, 10)
    assert [row["ate_m"], row["rmse_m"], row["rpe_m"]] == pytest.approx(expected, abs=1e-6)
    assert list(found["tracks"]) == (["filtered", "smoothed"] if not switch else ["filtered"])


def at_another_rate(folder, path, rate_hz, late_s=0.0):
    """A truth of a sample with other poses than one an epoch."""
    truth = read_tum(folder / "truth.tum")
    time = np.arange(truth.time_s[0] + 0.003, truth.time_s[-1], 1.0 / rate_hz)
    position = CubicSpline(truth.time_s, truth.position_m)(time)
    path.write_text(tum_lines(time + late_s, position))
    return path


@pytest.mark.parametrize("rate_hz", [1.0, 7.0, 30.0, 100.0])
def test_the_error_is_the_same_whatever_the_rate_of_the_truth(capsys, tmp_path, rate_hz):
    truth = at_another_rate(RIDE, tmp_path / "truth.tum", rate_hz)
    found = figures(RIDE, "--speed", "10", "--radio", "standard", "--truth", truth, truth=False)
    assert found["truth"]["tracks"]["smoothed"]["ate_m"] == pytest.approx(0.0625, abs=0.0025)
    between, away = found["truth"]["interpolated"], 1e3 * found["truth"]["nearest_pose_s"]
    assert between > 105 and away < 0.25 * 1e3 / rate_hz + 3.0
    shown = capsys.readouterr()
    assert f"{between} of them between poses, {away:.1f} ms from the nearest pose" in shown.out
    assert shown.err == ""


def test_a_truth_with_another_clock_is_warned_of(tmp_path):
    truth, file = tmp_path / "truth.tum", tmp_path / "figures.json"
    at_another_rate(RIDE, truth, 30.0, late_s=0.1)
    more = ("--speed", "10", "--radio", "standard", "--truth", truth, "--json", file)
    shown = command("localize", *options(RIDE / "log.csv", *more, folder=RIDE))
    found = json.loads(file.read_text())
    clock = found["truth"]["clock"]
    assert clock["ahead_s"] == pytest.approx(0.1, abs=0.02) and clock["deviation_s"] < 0.02
    assert f"The truth's clock is {1e3 * clock['ahead_s']:.0f} ± " in shown.stdout
    assert "ms ahead of the log's." in shown.stdout
    assert f"{truth}: found its clock {1e3 * clock['ahead_s']:.0f} ± " in shown.stderr
    assert found["truth"]["tracks"]["smoothed"]["ate_m"] > 0.7  # nothing was moved


def test_what_is_printed_is_what_json_holds(capsys, tmp_path):
    out = tmp_path / "track.tum"
    found = figures(WALK, "--speed", "auto", "--out", out, "--radio", "standard")
    shown = capsys.readouterr().out
    assert f"{out} (smoothed track)" in shown and f"{tmp_path / 'track.csv'} (its" in shown
    assert "400 epochs, 0 to 39.9 s" in shown and "skipped" not in shown
    for name, row in found["truth"]["tracks"].items():
        numbers = [value for value in row.values() if isinstance(value, float)]
        assert len(numbers) == 5 and " | ".join(f"{value:.3f}" for value in numbers) in shown
        for kind in ("horizontal", "vertical"):
            cells = " | ".join(f"{v:#.3g}" for v in row[kind]["percentiles_m"].values())
            assert f"| {name}, {kind} | {cells} |" in shown
    groups = found["groups"]
    assert list(groups) == ["anchor 1", "anchor 2", "anchor 3", "Doppler", "all"]
    for name, g in groups.items():
        line = next(line for line in shown.splitlines() if line.startswith(f"| {name} "))
        assert f"| {g['seen']} | {g['rejected']} ({100 * g['rejected_share']:.1f} %)" in line
        assert f"{g['nis_per_dof']:.3f} | {g['nis_in_bounds']:.3f}" in line
    assert groups["anchor 1"]["seen"] == 399  # one gave the prior
    assert found["error"] is None
    assert all(abs(groups[f"anchor {a}"]["nis_in_bounds"] - 0.95) < 0.03 for a in (1, 2, 3))


def test_percentiles_are_those_of_the_files(tmp_path):
    truth, out = read_tum(RIDE / "truth.tum"), tmp_path / "track.tum"
    found = figures(RIDE, "--speed", "auto", "--out", out, "--risk", "0.2")
    error = read_tum(out).position_m - truth.position_m
    row = found["truth"]["tracks"]["smoothed"]
    across, upwards = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    shares = [0.5, 0.67, 0.8, 0.9, 0.95]
    for kind, sizes in (("horizontal", across), ("vertical", upwards)):
        expected = np.quantile(sizes, shares)
        assert [*row[kind]["percentiles_m"].values()] == pytest.approx(expected, abs=1e-9)
    sigma = np.loadtxt(tmp_path / "track.csv", delimiter=",", skiprows=1, usecols=6)
    levels = 1.2815515655446004 * sigma  # the normal distribution leaves 0.1 on each side
    assert found["truth"]["risk"] == 0.2
    assert row["vertical"]["median_level_m"] == pytest.approx(np.median(levels), rel=1e-5)
    assert row["vertical"]["exceeded"] == (upwards > levels).sum()


def test_figures_say_how_to_make_them_again(tmp_path):
    """But for the outputs; a sample has no log to name."""
    file, again = tmp_path / "figures.json", tmp_path / "again.json"
    words = ["--sample", RIDE.name, "--speed", "9", "--no-gating"]
    run("localize", [*words, "--json", str(file), "--out", str(tmp_path / "track.tum")])
    found = json.loads(file.read_text())
    program, name, *made = shlex.split(found["command"])
    assert (program, name, sorted(made)) == ("mmwave-loc", "localize", sorted(words))
    assert {"mmwave-loc", "python", "numba"} <= set(found["versions"])
    run(name, [*made, "--json", str(again)])
    assert json.loads(again.read_text()) == found | {"written": {}}


def test_truth_is_for_scores_alone(tmp_path):
    with_truth, without = tmp_path / "a.tum", tmp_path / "b.tum"
    figures(RIDE, "--speed", "auto", "--out", with_truth)
    found = figures(RIDE, "--speed", "auto", "--out", without, truth=False)
    assert with_truth.read_bytes() == without.read_bytes() and "truth" not in found


def test_a_truth_of_few_epochs_is_warned_of(tmp_path):
    truth, few = read_tum(RIDE / "truth.tum"), tmp_path / "few.tum"
    few.write_text(tum_lines(truth.time_s[:20], truth.position_m[:20]))
    given = options(RIDE / "log.csv", "--speed", "10", "--truth", few, folder=RIDE)
    said = command("localize", *given).stderr
    assert "few.tum: found a true position for 20 of the log's 120 epochs" in said


def test_truth_of_another_time_is_an_error_that_names_both(capsys, tmp_path):
    truth, out = tmp_path / "truth.tum", tmp_path / "track.tum"
    truth.write_text(tum_lines(np.array([1000.0, 1002.5]), np.zeros((2, 3))))
    more = ("--speed", "1", "--truth", truth, "--out", out)
    shown, line = refused(capsys, options(WALK / "log.csv", *more))
    assert "found times from 1000.0 to 1002.5 s, expected some within 0.01 s" in line
    assert "from 0.0 to 39.9 s; 400 epochs are written" in line
    assert len(read_tum(out).time_s) == 400 and "ATE" not in shown


def test_epochs_before_the_first_line_of_sight_are_counted(capsys, tmp_path):
    log = tmp_path / "late.csv"
    lines = (WALK / "log.csv").read_text().splitlines()
    log.write_text(
        "\n".join([lines[0], *(l for l in lines[1:] if not re.match(r"[01]\.\d,1,", l))])
    )
    found = figures(WALK, "--speed", "1", log=log)
    assert "20 epochs before the first line of sight were skipped" in capsys.readouterr().out
    assert found["skipped"] == 20 and found["epochs"] == 380 == found["truth"]["scored"]


def gapped(folder, first, last, rows=""):
    """The walk at a tenth of its rate, without the epochs from ``first`` up to ``last`` s."""
    log = folder / "gap.csv"
    header, *lines = [
        re.sub(r"^(\d+)\.(\d),", lambda m: f"{m[1]}{m[2]}.0,", line) for line in lines_of()
    ]
    kept = [line for line in lines if not first <= float(line.split(",")[0]) < last]
    log.write_text("\n".join([header, *kept]) + "\n")
    return log


@pytest.mark.filterwarnings("ignore:Doppler")  # a tenth of the speed that it says
def test_after_a_long_gap_the_track_begins_anew(capsys, tmp_path):
    out = tmp_path / "track.tum"
    found = figures(WALK, "--speed", "1", "--out", out, truth=False, log=gapped(tmp_path, 100, 130))
    shown = capsys.readouterr().out
    assert "restarted once after a gap of more than 15 s; 0 epochs skipped" in shown
    assert found["restarts"] == 1 and found["dropped"] == 0 and found["epochs"] == 370
    figures(WALK, "--speed", "1", "--plot", tmp_path / "track.png", truth=False,
            log=gapped(tmp_path, 100, 130))  # fmt: skip
    found = figures(WALK, "--speed", "1", truth=False, log=gapped(tmp_path, 100, 110))
    assert found["restarts"] == 0 and "restarted" not in capsys.readouterr().out.split("once")[-1]


@pytest.mark.filterwarnings("ignore:Doppler")  # a tenth of the speed that it says
def test_epochs_skipped_after_a_gap_are_counted(capsys, tmp_path):
    log = gapped(tmp_path, 100, 130)
    lines = log.read_text().splitlines()
    sight = [line for line in lines if not re.match(r"1[34]\d\.0,1,", line)]
    log.write_text("\n".join(sight) + "\n")
    found = figures(WALK, "--speed", "1", truth=False, log=log)
    assert found["restarts"] == 1 and found["dropped"] == 20 and found["epochs"] == 350
    log.write_text("\n".join(line for line in sight if not re.match(r"\d*\.0,1,", line)
                             or float(line.split(",")[0]) < 100) + "\n")  # fmt: skip
    capsys.readouterr()
    found = figures(WALK, "--speed", "1", truth=False, log=log)
    assert "ended at a gap of more than 15 s; 270 epochs skipped" in capsys.readouterr().out
    assert found["restarts"] == 0 and found["dropped"] == 270 and found["epochs"] == 100


# --- the options


def test_the_track_is_the_localizers(tmp_path):
    out = tmp_path / "track.tum"
    more = ("--no-gating", "--no-adaptive", "--window", "50", "--radio", "high")
    figures(RIDE, "--speed", "10", "--out", out, *more)
    scene = read_scene(RIDE / "scene.json")
    mode = default_modes("high")[1]
    mode = type(mode)(**{**vars(mode), "gate": None, "adaptive": False})
    blocks = localize(
        read_log(RIDE / "log.csv", scene), scene, RADIOS["high"], [mode], window=50
    )  # fmt: skip
    x = np.concatenate([block.smooth_x for block in blocks])
    np.testing.assert_array_equal(read_tum(out).position_m, x[:, :3])


@pytest.mark.slow
def test_every_switch_changes_the_track():
    tracks = {}
    for switch in ([], ["--no-gating"], ["--no-adaptive"], ["--no-smoothing"], ["--robust"],
                   ["--window", "20"], ["--height", "1.5"], ["--radio", "handset"]):  # fmt: skip
        found = figures(WALK, "--speed", "1.4", "--radio", "standard", *switch)
        tracks[" ".join(switch)] = json.dumps(found["truth"]["tracks"])
        if switch == ["--no-gating"]:
            assert found["groups"]["all"]["rejected"] == 0
        if switch == ["--robust"]:
            assert list(found["modes"]) == ["ekf-robust"]
        if switch == ["--height", "1.5"]:
            assert found["truth"]["nees_expected"] == 2
    assert len(set(tracks.values())) == len(tracks)


def test_modes_may_come_from_a_file(capsys, tmp_path):
    file = tmp_path / "modes.json"
    modes = [{"name": "calm"}, {"name": "wild", "algorithm": "ckf", "sigma_v": 2.0}]
    file.write_text(json.dumps({"modes": modes}))
    assert figures(RIDE, "--speed", "10", "--modes", file)["modes"] == {"wild": 120}
    file.write_text(json.dumps({"modes": modes[:1]}))
    _, line = refused(capsys, options(RIDE / "log.csv", "--speed", "1", "--modes", file))
    assert "found 1 modes, expected 2, for low and for high mobility" in line
    _, line = refused(capsys, options(RIDE / "log.csv", "--speed", "1", "--modes", "ekf-robust"))
    assert "modes: found 'ekf-robust', expected a mode file (.json)" in line


@pytest.mark.parametrize("folder", [WALK, RIDE], ids=["walk", "ride"])
@pytest.mark.slow
def test_an_imm_is_smoothed_to_less_than_the_filtered_error(tmp_path, folder):
    out = tmp_path / "track.tum"
    found = figures(folder, "--imm", "imm-best", "--radio", "standard", "--out", out)
    bank, scene = best_bank("standard"), read_scene(folder / "scene.json")
    assert list(found["modes"]) == [mode.name for mode in bank.modes] and found["imm"] == "imm-best"
    assert sum(found["modes"].values()) == EPOCHS[folder]
    filtered, smoothed = (found["truth"]["tracks"][t] for t in ("filtered", "smoothed"))
    for metric in ("ate_m", "rmse_m", "rpe_m"):
        assert smoothed[metric] < filtered[metric]
    assert 0.8 < found["groups"]["all"]["nis_per_dof"] < 1.2 and smoothed["in_bounds"] > 0.85
    blocks = list(localize(read_log(folder / "log.csv", scene), scene, RADIOS["standard"], bank))
    x, mode = (np.concatenate([getattr(b, name) for b in blocks]) for name in ("smooth_x", "mode"))
    np.testing.assert_array_equal(read_tum(out).position_m, x[:, :3])
    with (tmp_path / "track.csv").open(newline="") as file:
        said = [row["mode"] for row in csv.DictReader(file)]
    assert said == [bank.modes[m].name for m in mode]


@pytest.mark.slow
def test_the_modes_of_an_imm_are_told_and_drawn(capsys, tmp_path):
    picture = tmp_path / "track.png"
    figures(RIDE, "--imm", "imm-best", "--radio", "standard", "--plot", picture, "--no-smoothing")
    shown = capsys.readouterr().out
    assert re.search(r"modes of imm-best by their probability: stand \d.*brake .*switched", shown)
    assert "smoothed" not in shown and picture.stat().st_size > 20_000


@pytest.mark.slow
def test_an_imm_may_come_from_a_bank_s_file_or_by_any_name_of_the_project(tmp_path):
    file = tmp_path / "bank.json"
    modes = [{"name": "calm"}, {"name": "wild", "algorithm": "ckf", "sigma_v": 2.0}]
    bank = {"modes": modes, "transition": [[0.9, 0.1], [0.2, 0.8]], "nis_quantile": 0.99}
    file.write_text(json.dumps(bank))
    assert list(figures(RIDE, "--radio", "standard", "--imm", file)["modes"]) == ["calm", "wild"]
    robust = figures(RIDE, "--radio", "standard", "--imm", file, "--robust", "--no-gating")
    assert list(robust["modes"]) == ["calm-robust", "wild-robust"]
    assert robust["groups"]["all"]["rejected"] == 0
    for name in imm_banks("standard"):
        found = figures(RIDE, "--radio", "standard", "--imm", name)["truth"]["tracks"]
        assert found["smoothed"]["ate_m"] < found["filtered"]["ate_m"] < 0.5


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """A log with odometry."""
    folder = tmp_path_factory.mktemp("driven")
    run("simulate", ["--scenario", "walk-ride", "--odometry", "--seed", "2", "--out", str(folder)])
    return folder


@pytest.mark.slow
def test_odometry_is_used_where_the_log_has_it(capsys, driven):
    used = figures(driven, "--speed", "auto")
    ignored = figures(driven, "--speed", "auto", "--no-odometry")
    followed = figures(driven, "--speed", "auto", "--follow", "odometry")
    assert "odometry" in used["groups"] and "odometry" not in ignored["groups"]
    assert used["truth"]["tracks"]["filtered"]["ate_m"] != pytest.approx(
        ignored["truth"]["tracks"]["filtered"]["ate_m"]
    )
    assert followed["modes"] != used["modes"] and followed["modes"]["ukf"] > 20
    capsys.readouterr()
    for log, more in ((driven, ["--no-odometry"]), (RIDE, [])):
        words = ["--speed", "auto", "--follow", "odometry", *more]
        _, line = refused(capsys, options(log / "log.csv", *words, folder=log))
        assert "follow: found odometry, but no speed in" in line


CONTRADICTIONS = {
    "auto and abort": (["--speed", "auto", "--outside", "abort"], "outside: found abort"),
    "odometry and a speed": (["--speed", "1", "--follow", "odometry"], "follow: found odometry"),
    "an imm and a speed": (["--imm", "imm", "--speed", "1"], "speed: found 1 with --imm, expected"),
    "an imm and modes": (["--imm", "imm", "--modes", "m.json"], "modes: found m.json with --imm"),
    "an imm and abort": (["--imm", "imm", "--outside", "abort"], "outside: found abort with --imm"),
    "imm": (["--imm", "imm-bets"], "imm: found 'imm-bets', did you mean imm-best"),
    "no imm": (["--imm", "guided"], "imm: found 'guided', expected one of imm, imm-best"),
    "bank": (["--imm", "missing.json"], "missing.json"),
    "window": (["--speed", "1", "--window", "1"], "window: found 1, expected 2 to 20000 epochs"),
    "long window": (["--speed", "1", "--window", "20001"], "window: found 20001"),
    "height": (["--speed", "1", "--height", "nan"], "height: found nan"),
    "plot": (["--speed", "1", "--plot", "track.gif"], "plot: found track.gif, expected.*png"),
    "radio": (["--speed", "1", "--radio", "lab"], "'lab'.*handset, standard, high"),
    "truth": (["--speed", "1", "--truth", "missing.tum"], "missing.tum"),
    "modes": (["--speed", "1", "--modes", "missing.json"], "missing.json"),
    "table": (["--speed", "1", "--out", "track.csv"], "out: found track.csv, expected a TUM file"),
    "twice": (["--speed", "1", "--out", "a.tum", "--plot", "a.tum"], "plot: found a.tum"),
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_what_contradicts_itself_is_refused(capsys, monkeypatch, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    more, message = CONTRADICTIONS[name]
    _, line = refused(capsys, options(WALK / "log.csv", *more))
    assert re.search(message, line), line


def test_a_folder_in_place_of_a_log_is_refused_by_naming_its_files(capsys):
    _, line = refused(capsys, [str(WALK)])
    files = f"{WALK / 'log.csv'} --scene {WALK / 'scene.json'} --truth {WALK / 'truth.tum'}"
    assert line.endswith(f"log: found the folder {WALK}, expected files, such as {files}")


def test_a_table_does_not_take_the_place_of_a_file_of_the_users(capsys, tmp_path):
    (tmp_path / "trip.csv").write_text("t,x,y,z\n")
    _, line = refused(
        capsys, options(WALK / "log.csv", "--speed", "1", "--out", tmp_path / "trip.tum")
    )
    assert "trip.csv, which is no table of a track" in line
    assert [path.name for path in tmp_path.iterdir()] == ["trip.csv"]
    assert (tmp_path / "trip.csv").read_text() == "t,x,y,z\n"


def test_a_track_does_not_take_the_place_of_a_truth(capsys, tmp_path):
    """Not even of one that the command was not told of."""
    truth = tmp_path / "truth.tum"
    truth.write_bytes((WALK / "truth.tum").read_bytes())
    _, line = refused(capsys, options(WALK / "log.csv", "--speed", "1", "--out", truth))
    assert f"out: found {truth}, which is no track of mmwave-loc localize" in line
    assert [path.name for path in tmp_path.iterdir()] == ["truth.tum"]
    assert truth.read_bytes() == (WALK / "truth.tum").read_bytes()


@pytest.mark.parametrize("out", ["log.tum", "truth.tum"])
def test_no_output_takes_the_place_of_an_input(capsys, tmp_path, out):
    for name in ("log.csv", "truth.tum", "scene.json"):
        (tmp_path / name).write_bytes((RIDE / name).read_bytes())
    more = ("--speed", "9", "--truth", tmp_path / "truth.tum", "--out", tmp_path / out)
    _, line = refused(capsys, options(tmp_path / "log.csv", *more, folder=tmp_path))
    assert "which is also" in line and "expected another file" in line
    for name in ("log.csv", "truth.tum"):
        assert (tmp_path / name).read_bytes() == (RIDE / name).read_bytes()


# --- the files


def test_a_picture_is_drawn(tmp_path):
    figures(RIDE, "--speed", "auto", "--plot", tmp_path / "new" / "track.png")
    figures(RIDE, "--speed", "auto", "--plot", tmp_path / "plain.png", truth=False)
    for path in (tmp_path / "new" / "track.png", tmp_path / "plain.png"):
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG") and len(content) > 20_000


def test_a_dollar_in_a_name_costs_neither_the_picture_nor_the_figures(tmp_path):
    folder = tmp_path / "a$b_{^$ | \x1b[31m\n"
    shutil.copytree(RIDE, folder)
    picture = folder / "track.svg"
    done = command("localize", folder / "log.csv", "--scene", folder / "scene.json",
                   "--speed", "9", "--plot", picture)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert picture.read_text().startswith("<?xml")
    assert all(line.isprintable() for line in (done.stdout + done.stderr).splitlines())


def test_folders_are_made_and_what_cannot_be_written_is_named(capsys, tmp_path):
    figures(RIDE, "--speed", "9", "--out", tmp_path / "a" / "b" / "track.tum")
    assert sorted(p.name for p in (tmp_path / "a" / "b").iterdir()) == ["track.csv", "track.tum"]
    blocked = tmp_path / "file"
    blocked.write_text("")
    capsys.readouterr()
    for option, name in (("--out", "t.tum"), ("--plot", "t.png"), ("--json", "t.json")):
        more = ("--speed", "9", option, blocked / name)
        out, line = refused(capsys, options(RIDE / "log.csv", *more, folder=RIDE))
        assert str(blocked) in line and out == ""
    (tmp_path / "a.tum").mkdir()
    _, line = refused(
        capsys, options(RIDE / "log.csv", "--speed", "9", "--out", tmp_path / "a.tum")
    )
    assert "found a folder, expected a file" in line


buffered_or_not = pytest.mark.parametrize(
    "unbuffered", ["", pytest.param("1", marks=pytest.mark.slow)]
)


@buffered_or_not
@pytest.mark.slow
def test_figures_are_written_when_nobody_reads_what_is_shown(tmp_path, unbuffered):
    file, (ours, theirs) = tmp_path / "figures.json", os.pipe()
    os.close(ours)
    words = [sys.executable, "-m", "experiments.console", "localize",
             *options(WALK / "log.csv", "--speed", "1", "--json", file)]  # fmt: skip
    done = subprocess.run(words, env=environment() | {"PYTHONUNBUFFERED": unbuffered},
                          stdout=theirs, stderr=subprocess.PIPE, text=True)  # fmt: skip
    os.close(theirs)
    assert (done.returncode, done.stderr) == (141, "")
    assert json.loads(file.read_text())["epochs"] == 400


@pytest.mark.slow
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_an_error_is_told_when_nobody_reads_what_is_shown(monkeypatch, tmp_path, unbuffered):
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    log, (ours, theirs) = tmp_path / "log.csv", os.pipe()
    os.close(ours)
    log.write_text(with_line(602, lambda l: cell(l, 2, "far")))
    done = child(options(log, "--speed", "1"), stdout=theirs, stderr=subprocess.PIPE)
    os.close(theirs)
    err = done.communicate(timeout=100)[1]
    assert done.returncode == 2 and "line 602" in err and len(err.splitlines()) == 1


def lines_of(name="log.csv"):
    return (WALK / name).read_text().splitlines()


def with_line(number, change):
    """The sample with one line (counted from 1) changed."""
    lines = lines_of()
    lines[number - 1] = change(lines[number - 1])
    return "\n".join(lines) + "\n"


def cell(line, place, word):
    cells = line.split(",")
    cells[place] = word
    return ",".join(cells)


HALF_WAY = {  # line 602 is the first of epoch 201, whose first 200 epochs are whole
    "no number": (with_line(602, lambda l: cell(l, 2, "far")), "line 602, column 'toa_s'", 200),
    "infinite": (with_line(603, lambda l: cell(l, 3, "inf")), "line 603, column 'aoa_azim", 200),
    "wrong anchor": (with_line(604, lambda l: cell(l, 1, "7")), "line 604, column 'anchor'", 200),
    "one anchor twice": (with_line(603, lambda l: cell(l, 1, "1")), "line 603, column 'anc", 200),
    "backwards": (with_line(602, lambda l: cell(l, 0, "3.5")), "line 602, column 'time_s'", 200),
    "no time": (with_line(602, lambda l: cell(l, 0, "")), "line 602, column 'time_s'", 200),
    "few cells": (with_line(602, lambda l: l[:30]), "line 602: found", 200),
    "negative range": (with_line(602, lambda l: cell(l, 2, "-1")), "line 602, column 'toa_s", 200),
    "nanoseconds": (
        with_line(602, lambda l: cell(l, 2, "303.2")),
        "303.2, which is 9.09e+10 m",
        200,
    ),
    "at the end": (with_line(1199, lambda l: l[:20]), "line 1199: found", 399),
    "early": (with_line(6, lambda l: cell(l, 2, "far")), "line 6, column 'toa_s'", 1),
}


@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gz"])
@pytest.mark.parametrize("name", representative(HALF_WAY, "no number", "at the end"))
def test_a_log_damaged_half_way_gives_the_track_up_to_there(capsys, tmp_path, name, zipped):
    content, message, epochs = HALF_WAY[name]
    log, out = tmp_path / ("log.csv.gz" if zipped else "log.csv"), tmp_path / "track.tum"
    log.write_bytes(gzip.compress(content.encode()) if zipped else content.encode())
    out.write_text(OLD)
    more = ("--speed", "1", "--no-smoothing", "--truth", WALK / "truth.tum", "--out", out)
    shown, line = refused(capsys, options(log, *more, "--json", tmp_path / "found.json"))
    assert message in line and str(log) in line and f"; {epochs} epochs are written" in line
    whole = tmp_path / "whole.tum"
    figures(WALK, "--speed", "1", "--no-smoothing", "--out", whole)
    assert out.read_text() == "".join(whole.read_text().splitlines(keepends=True)[: epochs + 1])
    assert len((tmp_path / "track.csv").read_text().splitlines()) == epochs + 1
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["epochs"] == epochs and message in found["error"]
    assert f"{epochs} of {epochs} epochs have a true position" in shown


def test_the_last_window_before_the_damage_is_smoothed(capsys, tmp_path):
    log, out = tmp_path / "log.csv", tmp_path / "track.tum"
    log.write_text(with_line(752, lambda l: cell(l, 2, "far")))
    _, line = refused(capsys, options(log, "--speed", "1", "--out", out))
    assert "; 250 epochs are written" in line
    cut = tmp_path / "cut.csv"
    cut.write_text("\n".join(lines_of()[:751]) + "\n")
    figures(WALK, "--speed", "1", "--out", tmp_path / "short.tum", log=cut)
    assert out.read_bytes() == (tmp_path / "short.tum").read_bytes()


def test_a_truncated_archive_gives_the_track_up_to_there(capsys, tmp_path):
    log, out = tmp_path / "log.csv.gz", tmp_path / "track.tum"
    content = gzip.compress((WALK / "log.csv").read_bytes())
    log.write_bytes(content[: len(content) // 2])
    _, line = refused(capsys, options(log, "--speed", "1", "--out", out))
    epochs = int(re.search(r"line \d+.*broken gzip.*; (\d+) epochs are written", line).group(1))
    assert len(read_tum(out).time_s) == epochs > 100


def test_damaged_parquet_gives_the_track_up_to_there(capsys, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    log, out = tmp_path / "log.parquet", tmp_path / "track.tum"
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], "pedestrian", epochs=12_000)
    write_log(log, source.sample(np.random.default_rng(0)))
    table = parquet.read_table(log)
    parquet.write_table(table, log, row_group_size=3000, write_page_checksum=True)
    content = bytearray(log.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 50] = bytes(50)
    log.write_bytes(content)
    _, line = refused(capsys, [log, "--scene", "street", "--speed", "1", "--out", out])
    row, epochs = re.search(r"row (\d+): found broken.*; (\d+) epochs are written", line).groups()
    assert len(read_tum(out).time_s) == int(epochs) == (int(row) - 1) // 3 >= 100


HEADER = lines_of()[0]
NOTHING = {
    "empty": ("log.csv", b"", "empty file"),
    "header alone": ("log.csv", f"{HEADER}\n".encode(), "a header and no rows"),
    "unknown column": ("log.csv", f"{HEADER},mood\n".encode(), "column 'mood'"),
    "no unit": ("log.csv", HEADER.replace("toa_s", "toa").encode(), "column 'toa'"),
    "no SNR": ("log.csv", HEADER.replace(",snr_db", "").encode(), "no snr"),
    "another kind": ("log.txt", HEADER.encode(), "expected a name in .csv"),
    "rubbish": ("log.csv", bytes(range(256)) * 40, "line 1"),
    "rubbish in gzip": ("log.csv.gz", bytes(range(256)) * 40, "gzip"),
    "rubbish in Parquet": ("log.parquet", b"PAR1" + bytes(range(256)) * 40, "Parquet"),
    "first row": ("log.csv", with_line(2, lambda l: cell(l, 2, "x")).encode(), "line 2, column"),
    "no measurement": ("log.csv", f"{HEADER}\n0.0,1,,,,,,,\n1.0,1,,,,,,,\n".encode(),
                       "2 rows without a measurement"),
    "no line of sight": (
        "log.csv", "\n".join(l for l in lines_of() if ",1," not in l[:7]).encode(),
        "400 epochs without a line of sight",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NOTHING)
def test_a_log_without_a_track_leaves_the_output_alone(capsys, tmp_path, name):
    file, content, message = NOTHING[name]
    if file.endswith("parquet"):
        pytest.importorskip("pyarrow")
    log, out = tmp_path / file, tmp_path / "track.tum"
    log.write_bytes(content)
    out.write_text(OLD)
    _, line = refused(
        capsys, options(log, "--speed", "1", "--out", out, "--plot", tmp_path / "a.png")
    )
    assert message in line and "written" not in line
    assert out.read_text() == OLD
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([file, "track.tum"])


def test_truth_damaged_half_way_leaves_the_output_alone(capsys, tmp_path):
    truth, out = tmp_path / "truth.tum", tmp_path / "track.tum"
    truth.write_text((WALK / "truth.tum").read_text().replace("\n20.0 ", "\ntwenty "))
    out.write_text(OLD)
    more = ("--speed", "1", "--truth", truth, "--out", out)
    _, line = refused(capsys, options(WALK / "log.csv", *more))
    assert "truth.tum, line 202, t: found 'twenty'" in line and out.read_text() == OLD


# --- long logs


def long_log(path, rows):
    """The walk, there again and again."""
    lines = lines_of()
    rest = [line.split(",", 1)[1] for line in lines[1:]]
    with path.open("w") as file:
        file.write(f"{lines[0]}\n")
        for lap in range(rows // len(rest)):
            times = (400 * lap + np.arange(400).repeat(3)) / 10.0
            file.write("".join(f"{t},{r}\n" for t, r in zip(times.tolist(), rest, strict=True)))


def written_beside(folder):
    """Bytes so far of the files that will take the place of others."""
    sizes = 0
    for path in folder.iterdir():
        with suppress(FileNotFoundError):
            sizes += path.stat().st_size if path.name.startswith(".") else 0
    return sizes


@pytest.mark.parametrize(
    "sent", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)]
)
@pytest.mark.slow
def test_a_run_cut_short_leaves_the_output_alone(tmp_path, sent):
    log, out = tmp_path / "log.csv", tmp_path / "track.tum"
    long_log(log, 400_000)
    out.write_text(OLD)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    # A shell in the background ignores SIGINT, and so would its children's children.
    heeds = {"preexec_fn": partial(signal.signal, signal.SIGINT, signal.SIG_DFL)}
    process = child(options(log, "--speed", "1", "--out", out), **pipes, **heeds)
    end = time.monotonic() + 60.0
    # Until a block is written: a signal that arrives while a filter is compiled may be lost.
    while not written_beside(tmp_path) and time.monotonic() < end:
        time.sleep(0.01)
    process.send_signal(sent)
    shown, err = process.communicate(timeout=60)
    assert out.read_text() == OLD and shown == ""
    if sent == signal.SIGINT:
        assert process.returncode == 130 and err == "mmwave-loc localize: interrupted\n"
        assert sorted(p.name for p in tmp_path.iterdir()) == ["log.csv", "track.tum"]


# Not ru_maxrss: a child inherits that of its parent.
PEAK = """
import sys
from experiments.console.main import run
run("localize", sys.argv[1:])
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no procfs")
def test_memory_does_not_grow_with_the_log(tmp_path):
    log, truth = tmp_path / "log.csv", tmp_path / "truth.tum"
    walk, peaks = read_tum(WALK / "truth.tum").position_m, []
    more = ("--speed", "auto", "--truth", truth, "--out", tmp_path / "track.tum",
            "--plot", tmp_path / "track.png")  # fmt: skip
    for rows in (500_000, 2_000_000):
        long_log(log, rows)
        with truth.open("w") as file:
            for lap in range(rows // 1200):
                file.write(tum_lines((400 * lap + np.arange(400)) / 10.0, walk))
        words = [sys.executable, "-c", PEAK, *options(log, *more)]
        done = subprocess.run(words, env=environment(), capture_output=True, text=True, check=True)
        assert f"{rows // 1200 * 400} epochs" in done.stdout
        peaks.append(int(done.stdout.split()[-1]) / 1024)
    assert peaks[1] < 500 and peaks[1] < peaks[0] + 30, peaks


# --- a log that contradicts its scene


@pytest.fixture(scope="module")
def downlink(tmp_path_factory):
    """The ride as a downlink receiver reports it: the other end's angles."""
    log = tmp_path_factory.mktemp("downlink") / "log.csv"
    mistake = MISTAKES["arrival is at the user, as in a downlink"]
    write_columns(log, mistake(read_columns(RIDE / "log.csv")))
    return log


def test_a_contradiction_is_a_warning_each_and_in_the_json_file(tmp_path, downlink):
    given = options(downlink, "--speed", "auto", "--radio", "standard", folder=RIDE)
    done = command("localize", *given, "--json", tmp_path / "found.json")
    assert done.returncode == 0 and "NIS / dof" in done.stdout
    lines = done.stderr.splitlines()
    assert re.fullmatch(
        r"warning: anchor 1: found .*, expected .*; --diagnose tries likely mistakes",
        lines[0],
    )
    said = json.loads((tmp_path / "found.json").read_text())["contradictions"]
    assert len(said) == len(lines)
    for line, one in zip(lines, said, strict=True):
        assert f"{one['group']}: found {one['found']}, expected {one['expected']};" in line


def test_a_diagnosis_names_the_mistake_and_writes_no_track(tmp_path, downlink):
    before, file = downlink.read_bytes(), tmp_path / "found.json"
    given = options(downlink, "--radio", "standard", "--diagnose", "--json", file, folder=RIDE)
    done = command("localize", *given)
    assert done.returncode == 0 and done.stderr == "" and downlink.read_bytes() == before
    name = "arrival is at the user, as in a downlink"
    assert f"\nThe log is consistent if {name}." in done.stdout
    cure = "exchange the columns of aoa_azimuth and aod_azimuth, negate aoa_elevation"
    assert f"To mend it, {cure} (docs/data.md)." in done.stdout
    found = json.loads(file.read_text())
    assert "--diagnose" in found["command"] and "numba" in found["versions"]
    first, *others = found["hypotheses"]
    assert first["hypothesis"] == name and first["contradictions"] == []
    assert all(other["contradictions"] for other in others)
    possible = [one for one in (first, *others) if one["nis_per_dof"]]
    assert all(hypothesis["hypothesis"] in done.stdout for hypothesis in possible)
    left = len(found["hypotheses"]) - len(possible)
    assert not left or f"{left} other mistakes allow no track" in done.stdout


def test_a_log_that_is_refused_can_be_diagnosed(tmp_path):
    log = tmp_path / "log.csv"
    write_columns(log, MISTAKES["angles are in degrees"](read_columns(RIDE / "log.csv")))
    given = options(log, "--radio", "standard", folder=RIDE)
    refusal = command("localize", *given, "--speed", "auto")
    assert refusal.returncode == 2
    assert "if it is in degrees, name the column aoa_azimuth_deg; mmwave-loc loc" in refusal.stderr
    done = command("localize", *given, "--diagnose")
    assert "\nThe log is consistent if angles are in degrees." in done.stdout


@pytest.mark.slow
def test_a_diagnosis_of_a_right_log_and_of_one_that_nothing_explains():
    given = options(RIDE / "log.csv", "--radio", "standard", "--diagnose", folder=RIDE)
    assert "\nThe log is consistent as it is." in command("localize", *given).stdout
    other = [*map(str, (RIDE / "log.csv", "--scene", "street", "--diagnose"))]
    assert "\nNone of these makes the log consistent." in command("localize", *other).stdout


def test_a_diagnosis_tells_the_facts_of_a_log(tmp_path):
    file = tmp_path / "facts.json"
    given = options(RIDE / "log.csv", "--radio", "standard", folder=RIDE)
    done = command("localize", *given, "--truth", RIDE / "truth.tum", "--diagnose", "--json", file)
    columns = read_columns(RIDE / "log.csv")
    times, facts = np.unique(columns["time_s"]), json.loads(file.read_text())["facts"]
    assert facts["epochs"] == len(times) and facts["problems"] == []
    assert (facts["first_s"], facts["last_s"]) == (times[0], times[-1])
    assert facts["step_s"] == pytest.approx(np.median(np.diff(times)))
    for anchor, told in enumerate(facts["anchors"], start=1):
        of = columns["anchor"] == anchor  # a row without numbers was not seen
        assert told["seen"] == np.isfinite(columns["snr_db"][of]).sum()
    poses = read_tum(RIDE / "truth.tum")
    moved = np.linalg.norm(np.diff(poses.position_m, axis=0), axis=1) / np.diff(poses.time_s)
    assert facts["speed_mps"]["max"] == pytest.approx(moved.max(), rel=0.05)
    assert "no problems found" in done.stdout and "m/s on average" in done.stdout


def test_a_diagnosis_tells_what_is_odd_and_where_a_log_is_damaged(tmp_path):
    columns, log = read_columns(RIDE / "log.csv"), tmp_path / "log.csv"
    kept = columns["anchor"] != 3
    columns = {name: values[kept] for name, values in columns.items()}
    late = columns["time_s"] >= 6.0
    columns["time_s"] = columns["time_s"] + 20.0 * late
    write_columns(log, columns)
    with log.open("a") as file:
        file.write("text,1\n")
    done = command("localize", *options(log, "--radio", "standard", "--diagnose", folder=RIDE))
    for said in ("- 1 gaps of more than 15 s", "- anchor 3 was never seen"):
        assert said in done.stdout
    (line,) = done.stderr.splitlines()
    assert (
        done.returncode == 2 and f"{log}, line " in line and line.split(": ", 1)[1] in done.stdout
    )


def test_a_diagnosis_makes_no_track(capsys, tmp_path):
    _, line = refused(
        capsys, options(WALK / "log.csv", "--diagnose", "--out", tmp_path / "track.tum")
    )
    assert "diagnose: found with --out or --plot, expected no track" in line
