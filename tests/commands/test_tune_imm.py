"""Tuning an IMM finds how often its modes change, and writes what is shipped."""

import json
import shlex

import numpy as np
import pytest
from scipy.special import logit

from experiments.evaluation.seeds import draw_episodes
from experiments.tune_imm import imm_space, rewards, tune
from experiments.tuning.search_space import transition_of
from mmwave_env.episodes.episode import EpisodeBatch
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.filters.bank import bank_from
from mmwave_env.filters.imm import stay_matrix
from mmwave_env.filters.mode_files import as_written, modes_from
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from tests.cli import assert_one_clear_line, command

SOURCE = SimulatedSource(SCENES["street"], RADIOS["handset"], epochs=60)


def test_a_mode_is_left_for_the_others_in_their_proportions():
    stay, enter = np.array([0.9, 0.5, 0.2]), np.array([1.0, 3.0, 6.0])
    found = transition_of(logit(stay), np.log(enter))
    expected = [
        [0.9, 0.1 * 3 / 9, 0.1 * 6 / 9],
        [0.5 * 1 / 7, 0.5, 0.5 * 6 / 7],
        [0.8 * 1 / 4, 0.8 * 3 / 4, 0.2],
    ]
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize("names", [("ekf", "ukf"), ("ekf", "ukf", "ckf"), ("extended",)])
def test_the_search_starts_from_the_default_imm(names):
    modes = modes_from(names)
    start, bounds, build = imm_space(modes, noise=True)
    assert len(start) == len(bounds) == (6 if len(modes) == 2 else 2 * len(modes) - 1)
    assert (bounds[:, 0] <= start).all() and (start <= bounds[:, 1]).all()
    found, transition = build(start)
    assert found == modes
    np.testing.assert_allclose(transition, stay_matrix(len(modes)))


def test_every_point_is_a_transition_and_the_noise_of_two_modes():
    modes = modes_from(["ekf", "ukf"])
    _, bounds, build = imm_space(modes, noise=True)
    for point in np.random.default_rng(0).uniform(*bounds.T, (20, len(bounds))):
        found, transition = build(point)
        assert (transition >= 0.0).all()
        np.testing.assert_allclose(transition.sum(axis=1), 1.0)
        for i, mode in enumerate(found):
            assert as_written(mode).keys() == as_written(modes[i]).keys()
            noise = np.exp(point[2 + 2 * i : 4 + 2 * i])
            np.testing.assert_allclose([mode.sigma_p, mode.sigma_v], noise, rtol=0.005)


def test_the_transition_alone_is_two_numbers_of_two_modes():
    modes = modes_from(["ekf", "ukf"])
    start, _, build = imm_space(modes, noise=False)
    assert len(start) == 2 and build(start)[0] == modes


def test_tuning_earns_more():
    episodes = EpisodeBatch.of(draw_episodes(SOURCE, range(5_000_000, 5_000_032)))
    modes = modes_from(["ekf", "ukf"])
    found, transition = tune(modes, True, episodes, 60)
    before, after = (
        rewards(modes, None, 0.999, episodes),
        rewards(found, transition, 0.999, episodes),
    )
    assert after.mean() > before.mean() + 0.01


@pytest.mark.slow
def test_the_command_writes_a_file_as_it_is_shipped(tmp_path):
    file = tmp_path / "imms.json"
    options = ["--radios", "high", "--imms", "imm-robust-limited", "imm-extended", "--episodes", 2,
               "--held-out", 3, "--evaluations", 2, "--json", file]  # fmt: skip
    file.write_text(json.dumps({"high": {"other": {}}}))
    done = command("tune-imm", *options)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("high imm-robust-limited: reward -")
    imms = json.loads(file.read_text())["high"]
    assert list(imms) == ["other", "imm-robust-limited", "imm-extended"]
    for name in list(imms)[1:]:
        imm = imms[name]
        words = shlex.split(imm["command"])
        assert words[:2] == ["mmwave-loc", "tune-imm"]
        assert words[2:6] == ["--radios", "high", "--imms", name]
        assert np.shape(imm["transition"]) == (len(imm["modes"]),) * 2
        assert imm["nis_quantile"] == (0.999 if name.endswith("limited") else 1.0)
        low, high = imm["held_out_gain"]["ci95"]
        assert low <= imm["held_out_gain"]["mean"] <= high


@pytest.mark.slow
def test_banks_are_tuned_on_every_scene_and_written_as_they_are_shipped(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- table: high -->\n<!-- end -->\n")
    options = ["--radios", "high", "--banks", "two", "--scenes", "street", "o1", "--steps", 0.5,
               "--episodes", 6, "--held-out", 4, "--evaluations", 20]  # fmt: skip
    done = command("tune-imm", *options, "--out", tmp_path, "--docs", page)
    assert done.returncode == 0, done.stderr
    written = json.loads((tmp_path / "high.json").read_text())
    assert shlex.split(written["command"])[2:] == [str(option) for option in options]
    bank = bank_from(tmp_path / "high.json")
    assert [mode.name for mode in bank.modes] == ["stand", "turn"]
    figures = written["held_out"]
    low, high = figures["minus imm-robust-limited"]["ci95"]
    assert low <= figures["minus imm-robust-limited"]["mean"] <= high
    assert figures["minus the first"]["mean"] == 0.0
    (row,) = [line for line in page.read_text().splitlines() if line.startswith("| two")]
    assert f"{figures['reward']['mean']:.3f}" in row and row in done.stdout


@pytest.mark.slow
def test_a_bank_goes_by_the_name_of_its_radios_file(tmp_path):
    radio = tmp_path / "phone.json"
    radio.write_text("{}")
    options = ["--radios", radio, "--banks", "two", "--scenes", "street", "--steps", 1,
               "--episodes", 3, "--held-out", 2, "--evaluations", 10]  # fmt: skip
    done = command("tune-imm", *options, "--out", tmp_path / "banks")
    assert done.returncode == 0, done.stderr
    assert "### phone\n" in done.stdout
    assert [path.name for path in (tmp_path / "banks").iterdir()] == ["phone.json"]
    assert radio.read_text() == "{}"


BANK_MISTAKES = {
    "unknown bank": (("--banks", "eleven"), "banks: found 'eleven', expected one of maneuvers"),
    "two banks of a file": (("--banks", "two", "three", "--out", "banks"), "found 2, expected one"),
    "too few episodes": (("--banks", "two", "--episodes", "8"),
                         "found 1 for each scene and step, expected 3 or more, 18 in all"),
    "unknown scene": (("--banks", "two", "--scenes", "moon"), "'moon'.*street, o1"),
    "no scene": (("--banks", "two", "--scenes"), "scenes: found none, expected one or more"),
    "no step": (("--banks", "two", "--steps"), "steps: found none, expected one or more"),
    "no rate": (("--banks", "two", "--steps", "0"), "dt: found 0"),
    "radios of a name": (("--banks", "two", "--radios", "a/my.json", "b/my.json"),
                         "radios: found two that go by 'my', expected one of them"),
    "the radio's own file": (("--banks", "two", "--radios", "my.json", "--out", "."),
                             "out: found my.json, which is the radio my.json, expected another"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", BANK_MISTAKES)
def test_mistakes_about_banks_end_with_one_clear_line(mistake, tmp_path):
    words, message = BANK_MISTAKES[mistake]
    assert_one_clear_line(command("tune-imm", "--radios", "high", *words, cwd=tmp_path), message)
    assert not list(tmp_path.iterdir())
