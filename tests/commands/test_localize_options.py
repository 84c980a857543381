"""Tests that options of ``mmwave-loc localize`` change the track and that conflicts are refused."""

import json
import re

import numpy as np
import pytest

from experiments.console.main import run
from mmwave_env.filters.bank import best_bank, default_modes
from mmwave_env.localization.localizer import Switching, localize
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import read_scene
from tests.commands.localizing import EPOCHS, RIDE, WALK, figures, options, refused
from tests.logs.writing import read_tum


def test_the_track_equals_that_of_the_python_function(tmp_path):
    out = tmp_path / "track.tum"
    more = ("--window", "50", "--radio", "high")
    figures(RIDE, "--speed", "10", "--out", out, *more)
    scene = read_scene(RIDE / "scene.json")
    mode = default_modes("high")[1]
    log = read_log(RIDE / "log.csv", scene, partial=True)
    blocks = localize(log, scene, RADIOS["high"], Switching((mode,)), window=50)
    x = np.concatenate([block.smooth_x for block in blocks])
    np.testing.assert_array_equal(read_tum(out).position_m, x[:, :3])


@pytest.mark.slow
def test_every_option_changes_the_track():
    tracks = {}
    flags = ([], ["--no-smoothing"], ["--robust"])
    for switch in (*flags, ["--window", "20"], ["--height", "1.5"], ["--radio", "handset"]):
        radio = () if "--radio" in switch else ("--radio", "standard")
        results = figures(WALK, "--speed", "1.4", *radio, *switch)
        tracks[" ".join(switch)] = json.dumps(results["truth"]["tracks"])
        if switch == ["--robust"]:
            assert list(results["modes"]) == ["ekf-robust"]
        if switch == ["--height", "1.5"]:
            assert results["truth"]["nees_expected"] == 2
    assert len(set(tracks.values())) == len(tracks)


def test_modes_can_be_read_from_a_file(capsys, tmp_path):
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
def test_smoothing_reduces_the_error_of_an_imm(folder):
    results = figures(folder, "--imm", "imm-best", "--radio", "standard")
    assert list(results["modes"]) == [mode.name for mode in best_bank("standard").modes]
    assert sum(results["modes"].values()) == EPOCHS[folder]
    filtered, smoothed = (results["truth"]["tracks"][t] for t in ("filtered", "smoothed"))
    for metric in ("ate_m", "rmse_m", "rpe_m"):
        assert smoothed[metric] < filtered[metric]
    assert 0.8 < results["groups"]["all"]["nis_per_dof"] < 1.2 and smoothed["in_bounds"] > 0.85


@pytest.mark.slow
def test_an_imm_can_be_given_by_a_bank_file(tmp_path):
    file = tmp_path / "bank.json"
    modes = [{"name": "calm"}, {"name": "wild", "algorithm": "ckf", "sigma_v": 2.0}]
    bank = {"modes": modes, "transition": [[0.9, 0.1], [0.2, 0.8]], "nis_quantile": 0.99}
    file.write_text(json.dumps(bank))
    assert list(figures(RIDE, "--radio", "standard", "--imm", file)["modes"]) == ["calm", "wild"]
    robust = figures(RIDE, "--radio", "standard", "--imm", file, "--robust")
    assert list(robust["modes"]) == ["calm-robust", "wild-robust"]
    assert robust["groups"]["all"]["rejected"] == 0


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """Return the folder of a log with odometry."""
    folder = tmp_path_factory.mktemp("driven")
    run("simulate", ["--scenario", "walk-ride", "--odometry", "--seed", "2", "--out", str(folder)])
    return folder


@pytest.mark.slow
def test_odometry_is_used_if_the_log_has_it(capsys, driven):
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
        assert "follow: odometry needs speeds" in line


CONTRADICTIONS = {
    "auto and abort": (["--speed", "auto", "--outside", "abort"], "outside: abort needs"),
    "odometry and a speed": (["--speed", "1", "--follow", "odometry"], "follow: odometry needs"),
    "an imm and a speed": (["--imm", "imm", "--speed", "1"], "speed: cannot be combined"),
    "an imm and modes": (["--imm", "imm", "--modes", "m.json"], "modes: cannot be combined"),
    "an imm and abort": (["--imm", "imm", "--outside", "abort"], "outside: abort needs"),
    "a track of a diagnosis": (["--diagnose", "--out", "t.tum"], "diagnose: cannot be combined"),
    "imm": (["--imm", "imm-bets"], "imm: found 'imm-bets', did you mean imm-best"),
    "no imm": (["--imm", "guided"], "imm: found 'guided', expected one of imm, imm-best"),
    "bank": (["--imm", "missing.json"], "missing.json"),
    "window": (["--speed", "1", "--window", "1"], "window: found 1, expected 2 to 20000 epochs"),
    "long window": (["--speed", "1", "--window", "20001"], "window: found 20001"),
    "height": (["--speed", "1", "--height", "nan"], "height: found nan"),
    "plot": (["--speed", "1", "--plot", "track.gif"], "plot: found track.gif, expected.*png"),
    "table": (["--speed", "1", "--out", "track.xls"], "out: found track.xls, expected a name"),
    "twice": (["--speed", "1", "--out", "a.tum", "--plot", "a.tum"], "plot: found a.tum"),
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_conflicting_options_and_invalid_values_are_refused(capsys, monkeypatch, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    more, message = CONTRADICTIONS[name]
    _, line = refused(capsys, options(WALK / "log.csv", *more))
    assert re.search(message, line), line
