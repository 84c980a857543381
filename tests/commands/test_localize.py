"""Tests of ``mmwave-loc localize``: its modes, its figures (errors and statistics), its options."""

import re
import shlex

import numpy as np
import pytest

from experiments.console.main import run
from mmwave_env.filters.bank import best_bank, default_modes, robust
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.localizer import localize
from mmwave_env.logs.log import read_log
from mmwave_env.logs.tum import read_tum
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import read_scene
from tests.cli import succeed
from tests.commands.localizing import EPOCHS, RIDE, WALK, figures, lines_of, options, refused
from tests.localization.mistakes import wrong_log
from tests.paths import json_in, write_json

# --- the speed (Algorithm 1 of the paper)


@pytest.mark.parametrize(
    ("folder", "speed", "mode"), [(WALK, "2", "ekf"), (RIDE, "2.01", "ukf"), (WALK, "20", "ukf")]
)
def test_a_speed_chooses_the_mode(folder, speed, mode):
    results = figures(folder, "--speed", speed, "--radio", "standard", "--outside", "abort")
    assert results["modes"] == {mode: EPOCHS[folder]} and results["switches"] == 0
    assert results["truth"]["scored"] == EPOCHS[folder]
    filtered = results["truth"]["tracks"]["filtered"]
    smoothed = results["truth"]["tracks"]["smoothed"]
    assert smoothed["ate_m"] < filtered["ate_m"] < 0.3
    assert smoothed["rmse_m"] < 0.1 and filtered["in_bounds"] > 0.85


@pytest.mark.parametrize("word", ["fast", "-1", "nan", "", "1_0"])
def test_an_invalid_speed_is_refused(word):
    _, line = refused(options(WALK / "log.csv", "--speed", word))
    assert f"speed: found {word!r}, expected a speed in m/s, 0 or more" in line


@pytest.mark.slow  # compiles large programs
def test_the_corrector_is_the_default():
    log = WALK / "log.csv"
    choices = ((), ("--policy", "corrector"), ("--speed", "auto"))
    default, learned, auto = (succeed("localize", *options(log, *choice)) for choice in choices)
    assert default == learned != auto


@pytest.mark.slow  # compiles large programs
@pytest.mark.parametrize("missing", [["doppler_spread_hz"], ["doppler_spread_hz", "doppler_hz"]])
def test_corrections_do_no_harm_if_the_log_has_no_doppler_spread(tmp_path, missing):
    log = wrong_log(tmp_path, RIDE, lambda c: {n: v for n, v in c.items() if n not in missing})
    corrected, plain = [
        figures(RIDE, "--policy", policy, log=log)["truth"]["tracks"]["filtered"]
        for policy in ("corrector", "guided")
    ]
    assert corrected["ate_m"] < 1.05 * plain["ate_m"]


# --- the figures


def test_the_printed_figures_equal_those_in_the_json_file(capsys, tmp_path):
    results = figures(WALK, "--speed", "auto", "--radio", "standard")
    shown = capsys.readouterr().out
    for row in results["truth"]["tracks"].values():
        numbers = [value for value in row.values() if isinstance(value, float)]
        assert len(numbers) == 5 and " | ".join(f"{value:.3f}" for value in numbers) in shown
    groups = results["groups"]
    assert list(groups) == ["anchor 1", "anchor 2", "anchor 3", "Doppler", "all"]
    assert groups["anchor 1"]["seen"] == 399  # the first of the 400 epochs only gave the prior
    assert results["error"] is None
    assert all(abs(groups[f"anchor {a}"]["nis_in_bounds"] - 0.95) < 0.03 for a in (1, 2, 3))


def test_the_json_file_records_a_command_that_reproduces_the_figures(tmp_path):
    """Run the recorded command again; the record leaves out the options for output files."""
    file = tmp_path / "figures.json"
    again = tmp_path / "again.json"
    words = ["--sample", RIDE.name, "--speed", "9", "--robust"]
    run("localize", [*words, "--json", str(file), "--out", str(tmp_path / "track.tum")])
    results = json_in(file)
    program, name, *made = shlex.split(results["command"])
    assert (program, name, sorted(made)) == ("mmwave-loc", "localize", sorted(words))
    assert {"mmwave-loc", "python", "numba"} <= set(results["versions"])
    run(name, [*made, "--json", str(again)])
    assert json_in(again) == results | {"written": {}}


@pytest.mark.filterwarnings("ignore:Doppler")  # stretched times contradict the Doppler shifts
def test_a_late_start_a_restart_and_an_end_at_a_long_gap_are_reported(capsys, tmp_path):
    """Use the walk at a tenth of its rate, without the epochs from 100 to 129 s.

    Nothing is measured in the first 20 s. In the second case, nothing is measured after the gap
    either, so the track ends at the gap.
    """
    log = tmp_path / "gap.csv"
    gap = range(100, 130)
    header, *lines = lines_of()
    rows = [(round(10 * float(time)), rest) for time, _, rest in (l.partition(",") for l in lines)]
    for visible_s, said, counts in (
        (range(20, 400), r"restarted once after gaps .*; 0 epochs", (1, 0, 350)),
        (range(20, 100), "ended at gaps .*; 270 epochs", (0, 270, 80)),
    ):
        nothing = "," * (header.count(",") - 1)
        kept = [
            f"{t},{rest}" if t in visible_s else f"{t},{rest.partition(',')[0]}{nothing}"
            for t, rest in rows
            if t not in gap
        ]
        log.write_text("\n".join([header, *kept]) + "\n")
        results = figures(WALK, "--speed", "1", "--plot", tmp_path / "t.png", truth=False, log=log)
        assert (results["restarts"], results["dropped"], results["epochs"]) == counts
        shown = capsys.readouterr().out
        assert re.search(f"{said} skipped", shown) and results["skipped"] == 20
        assert "20 epochs before the first position were skipped" in shown


def test_the_track_equals_the_result_of_the_python_function_localize(tmp_path):
    out = tmp_path / "track.tum"
    more = ("--window", "50", "--radio", "high", "--robust", "--height", "1.5")
    more += ("--risk", "0.2", "--levels", "gaussian")
    results = figures(RIDE, "--speed", "10", "--out", out, *more)
    assert list(results["modes"]) == ["ukf-robust"] and results["truth"]["nees_expected"] == 2
    assert results["truth"]["risk"] == 0.2
    scene = read_scene(RIDE / "scene.json")
    modes = (robust(default_modes("high")[1]),)
    log = read_log(RIDE / "log.csv", scene)
    track = localize(log, scene, RADIOS["high"], Switching(modes), window=50, height_m=1.5)
    np.testing.assert_array_equal(read_tum(out).position_m, track.smooth_x[:, :3])


MODES = [{"name": "calm"}, {"name": "wild", "algorithm": "ckf", "sigma_v": 2.0}]


def test_modes_can_be_read_from_a_file(tmp_path):
    file = write_json(tmp_path / "modes.json", {"modes": MODES})
    assert figures(RIDE, "--speed", "10", "--modes", file)["modes"] == {"wild": 120}
    write_json(file, {"modes": MODES[:1]})
    _, line = refused(options(RIDE / "log.csv", "--speed", "1", "--modes", file))
    assert "found 1 modes, expected 2, for low and for high mobility" in line
    _, line = refused(options(RIDE / "log.csv", "--speed", "1", "--modes", "ekf-robust"))
    assert "modes: found 'ekf-robust', expected a mode file (.json)" in line


@pytest.mark.slow
def test_an_imm_can_be_given_by_its_name_or_by_a_bank_file(tmp_path):
    named = figures(RIDE, "--radio", "standard", "--imm", "imm-best")
    assert list(named["modes"]) == [mode.name for mode in best_bank("standard").modes]
    assert 0.8 < named["groups"]["all"]["nis_per_dof"] < 1.2
    bank = {"modes": MODES, "transition": [[0.9, 0.1], [0.2, 0.8]], "nis_quantile": 0.99}
    file = write_json(tmp_path / "bank.json", bank)
    assert list(figures(RIDE, "--radio", "standard", "--imm", file)["modes"]) == ["calm", "wild"]
    robust = figures(RIDE, "--radio", "standard", "--imm", file, "--robust")
    assert list(robust["modes"]) == ["calm-robust", "wild-robust"]
    assert robust["groups"]["all"]["rejected"] == 0


@pytest.mark.slow
def test_odometry_is_used_if_the_log_has_it(tmp_path):
    walk_ride = ("--scenario", "walk-ride", "--odometry", "--seed", 2)
    succeed("simulate", *walk_ride, "--out", tmp_path)
    used = figures(tmp_path, "--speed", "auto")
    ignored = figures(tmp_path, "--speed", "auto", "--no-odometry")
    followed = figures(tmp_path, "--speed", "auto", "--follow", "odometry")
    assert "odometry" in used["groups"] and "odometry" not in ignored["groups"]
    errors = [f["truth"]["tracks"]["filtered"]["ate_m"] for f in (used, ignored)]
    assert errors[0] != pytest.approx(errors[1])
    assert followed["modes"] != used["modes"] and followed["modes"]["ukf"] > 20


MISTAKES = {  # name -> options, expected message
    "too fast": (["--speed", "25", "--outside", "abort"], "found 25 m/s, outside .*up to 20 m/s"),
    "auto and abort": (["--speed", "auto", "--outside", "abort"], "outside: abort needs"),
    "odometry and a speed": (["--speed", "1", "--follow", "odometry"], "follow: odometry needs"),
    "no odometry": (["--speed", "auto", "--follow", "odometry"], "follow: odometry needs speeds"),
    "an imm and a speed": (["--imm", "imm", "--speed", "1"], "speed: cannot be combined"),
    "an imm and modes": (["--imm", "imm", "--modes", "m.json"], "modes: cannot be combined"),
    "--write without --diagnose": (["--write", "s.json"], "write: found s.json without --diagnose"),
    "--write of another kind": (["--diagnose", "--write", "s.txt"], "write: found s.txt, expected"),
    "a negative prior speed": (["--prior-speed", "-1"], "prior-speed: start_velocity_mps"),
    "a diagnosis with --out": (["--diagnose", "--out", "t.tum"], "out: cannot be combined"),
    "--diagnose with --associate": (["--diagnose", "--associate"], "associate: .* with --diagnose"),
    "two logs": ([str(RIDE / "log.csv")], "log: found 2 logs without --map learn, expected one"),
    "an unknown clock": (["--clock", "jump"], "clock: found 'jump', expected one of"),
    "a mistyped imm": (["--imm", "imm-bets"], "imm: found 'imm-bets', did you mean imm-best"),
    "a missing bank file": (["--imm", "missing.json"], "missing.json"),
    "window": (["--speed", "1", "--window", "1"], "window: found 1, expected 2 to 20000 epochs"),
    "height": (["--speed", "1", "--height", "nan"], "height: found nan"),
    "two ways and a height": (["--two-way", "--height", "1.5"], "height: cannot be combined"),
    "two ways and correlation": (["--two-way", "--correlation", "1"], "correlation: cannot be"),
    "two ways and one filter": (["--two-way", "--speed", "1"], "two-way: found modes with"),
    "plot": (["--speed", "1", "--plot", "track.gif"], "plot: found track.gif, expected.*png"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_conflicting_options_and_invalid_values_are_refused(tmp_path, name):
    more, message = MISTAKES[name]
    _, line = refused(options(WALK / "log.csv", *more), cwd=tmp_path)
    assert re.search(message, line) and not list(tmp_path.iterdir()), line
