"""Tests of modes given as names, files and objects, and of errors in mode files."""

import json
from dataclasses import replace

import gymnasium as gym
import pytest

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.filters.bank import (
    as_written,
    best_bank,
    default_modes,
    modes_from,
    named_modes,
    shipped_modes,
)
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.update import ekf
from mmwave_env.models.radio import TUNED_RADIOS, Radio
from tests.refusals import refuses

THREE = [
    Mode("slow", "ekf", sigma_v=0.2, gate=None, recovery=None, coupling=False),
    Mode("fast", "ukf", sigma_v=2.0, robust=True, adaptive=False, cost=3.0),
    Mode("plain"),
]


@pytest.fixture
def mode_file(tmp_path):
    path = tmp_path / "three.json"
    path.write_text(json.dumps({"command": "by hand", "modes": [as_written(m) for m in THREE]}))
    return path


@pytest.mark.parametrize("as_type", [str, lambda path: path, lambda path: [str(path)]])
def test_a_mode_file_is_accepted_as_text_as_a_path_and_in_a_list(mode_file, as_type):
    assert modes_from(as_type(mode_file)) == tuple(THREE)


def test_names_files_and_mode_objects_can_be_mixed_in_a_list(mode_file):
    own = Mode("own", "ckf")
    modes = modes_from(["ukf", str(mode_file), own])
    assert [mode.name for mode in modes] == ["ukf", "slow", "fast", "plain", "own"]


@pytest.mark.parametrize("radio", TUNED_RADIOS)
def test_every_tuned_radio_has_tuned_modes(radio):
    low, high = default_modes(radio)
    assert (low.name, low.algorithm, high.name, high.algorithm) == ("ekf", "ekf", "ukf", "ukf")
    assert low.sigma_v < high.sigma_v and low.coupling and high.coupling
    assert not any(mode.coupling for mode in shipped_modes(radio, coupling=False))


def test_modes_of_a_radio_that_was_not_tuned_come_from_its_base_with_one_warning(recwarn):
    lab = Radio("lab", base="high")
    assert default_modes(lab) == default_modes("high") == default_modes(lab)
    assert best_bank(lab) == best_bank("high")
    (warning,) = recwarn
    assert "'lab'" in str(warning.message) and "'high'" in str(warning.message)


def test_a_radio_file_gets_the_modes_and_the_bank_of_its_base(tmp_path, recwarn):
    file = tmp_path / "phone.json"
    file.write_text('{"base": "handset", "ue_elements": 4}')
    assert default_modes(str(file)) == default_modes("handset") != default_modes("standard")
    assert gym.make("MmWaveLoc-v0", radio=str(file)).unwrapped.modes == default_modes("handset")
    env = gym.make("MmWaveLoc-v0", radio=str(file), beliefs="per-mode").unwrapped
    assert env.modes == best_bank("handset").modes
    assert len(recwarn) == 1


def test_custom_modes_do_not_need_a_tuned_radio(mode_file):
    assert modes_from([str(mode_file)], Radio("unheard-of")) == tuple(THREE)


def test_robust_modes_have_the_tuning_of_the_plain_modes_without_adaptation():
    named = named_modes("high")
    assert named["ekf-robust"] == replace(
        named["ekf"], name="ekf-robust", robust=True, blockage_aware=True, adaptive=False
    )
    assert named["ukf-robust"].tuning == named["ukf"].tuning == named["ckf"].tuning


@pytest.mark.parametrize("modes", [["ekf", {"name": "own"}], "ekf", 3, ["pf"]])
def test_arguments_that_do_not_name_modes_are_refused(modes):
    with refuses("mode"):
        modes_from(modes)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "bad.json"),
        ("[]", "bad.json"),
        ("{}", "modes"),
        ('{"modes": {"ekf": {}}}', "modes"),
        (json.dumps({"modes": [{"name": "a"}] * 33}), "modes"),
        ('{"modes": [{"name": "a"}, {"name": "a"}]}', "modes"),
        ('{"modes": [null]}', "modes[0]"),
        ('{"modes": [{"algorithm": "ekf"}]}', "modes[0].name"),
    ],
)
def test_a_damaged_mode_file_is_refused_with_the_name_of_the_field(tmp_path, text, field):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with refuses("bad.json", field):
        modes_from(path)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("key", 1),
        ("sigma_v", -1),
        ("sigma_v", "much"),
        ("algorithm", ["ekf"]),
        ("robust", "false"),
        ("recovery", 2.5),
    ],
)
def test_a_mode_with_a_wrong_value_is_refused_with_the_name_of_the_field(tmp_path, field, value):
    path = tmp_path / "bad.json"
    path.write_text(json.dumps({"modes": [{"name": "a", field: value}]}))
    with refuses("bad.json", "modes[0]", field):
        modes_from(path)


def test_a_mode_whose_algorithm_is_a_function_cannot_be_written_to_a_file():
    with refuses("algorithm of mode 'own'"):
        as_written(Mode("own", ekf))
