"""Modes by name, by file and as objects."""

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
    read_bank,
    shipped_modes,
)
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.update import ekf
from mmwave_env.models.radio import RADIOS, Radio

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


def test_a_mode_file_gives_back_what_was_written(mode_file):
    assert read_bank(mode_file).modes == tuple(THREE)


@pytest.mark.parametrize("as_type", [str, lambda path: path, lambda path: [str(path)]])
def test_a_mode_file_is_a_list_of_modes(mode_file, as_type):
    assert modes_from(as_type(mode_file)) == tuple(THREE)


def test_names_files_and_modes_mix(mode_file):
    own = Mode("own", "ckf")
    found = modes_from(["ukf", str(mode_file), own])
    assert [mode.name for mode in found] == ["ukf", "slow", "fast", "plain", "own"]


@pytest.mark.parametrize("radio", RADIOS)
def test_every_profile_has_its_tuning(radio):
    low, high = default_modes(radio)
    assert (low.name, low.algorithm, high.name, high.algorithm) == ("ekf", "ekf", "ukf", "ukf")
    assert low.sigma_v < high.sigma_v and low.coupling and high.coupling
    assert not any(mode.coupling for mode in shipped_modes(radio, coupling=False))


def test_a_profile_that_was_not_tuned_says_so_once(recwarn):
    lab = Radio("lab", base="high")
    assert default_modes(lab) == default_modes("high") == default_modes(lab)
    assert best_bank(lab) == best_bank("high")
    (said,) = recwarn
    assert "'lab': found no modes tuned for it, took those of 'high'" in str(said.message)
    assert "mmwave-loc tune --radio lab.json" in str(said.message)


def test_a_radio_file_has_the_modes_and_the_bank_of_its_base(tmp_path, recwarn):
    file = tmp_path / "phone.json"
    file.write_text('{"base": "handset", "ue_elements": 4}')
    assert default_modes(str(file)) == default_modes("handset") != default_modes("standard")
    assert gym.make("MmWaveLoc-v0", radio=str(file)).unwrapped.modes == default_modes("handset")
    env = gym.make("MmWaveLoc-v0", radio=str(file), beliefs="per-mode").unwrapped
    assert env.modes == best_bank("handset").modes
    assert len(recwarn) == 1


def test_modes_of_ones_own_need_no_tuned_profile(mode_file):
    assert modes_from([str(mode_file)], Radio("unheard-of")) == tuple(THREE)


def test_robust_modes_are_the_same_tuning_without_adaptation():
    named = named_modes("high")
    assert named["ekf-robust"] == replace(
        named["ekf"], name="ekf-robust", robust=True, blockage_aware=True, adaptive=False
    )
    assert named["ukf-robust"].tuning == named["ukf"].tuning == named["ckf"].tuning


def test_what_is_no_mode_is_refused():
    with pytest.raises(ValueError, match="found {'name': 'own'}, expected a name, a mode file or"):
        modes_from(["ekf", {"name": "own"}])


def test_a_name_alone_is_no_list():
    with pytest.raises(ValueError, match="found the string 'ekf', expected a list .*mode file"):
        modes_from("ekf")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a modes file"),
        ("[]", "found list, expected an object"),
        ("{}", "modes: found none"),
        ('{"modes": [{"algorithm": "ekf"}]}', "modes.0..name: found none"),
        ('{"modes": [{"name": "a", "sigma_q": 1}]}', "'sigma_q'.*sigma_p, sigma_v"),
        ('{"modes": [{"name": "a", "sigma_v": -1}]}', "sigma_v of mode 'a': found -1"),
        (
            '{"modes": [{"name": "a", "sigma_v": "much"}]}',
            "found 'much', expected a number of",
        ),
        ('{"modes": [{"name": "a", "algorithm": "pf"}]}', "'pf'.*ekf, ukf, ckf"),
        (
            '{"modes": [{"name": "a"}, {"name": "a"}]}',
            "modes: found .*a.*a.*, expected no name",
        ),
        (
            json.dumps({"modes": [{"name": "a"}] * 33}),
            "modes: found 33, expected a list of 1 to",
        ),
        ('{"modes": 3}', "modes: found 3, expected a list of 1 to 32"),
        ('{"modes": {"ekf": {}}}', "modes: found .*expected a list of 1 to 32"),
        ('{"modes": [null]}', "modes.0.: found None, expected an object"),
        ('{"modes": [{"name": 7}]}', "name of mode 7: found 7, expected 1 to 80 printable letters"),
        (
            '{"modes": [{"name": "a", "robust": "false"}]}',
            "robust of mode 'a': found 'false', .*bool",
        ),
        ('{"modes": [{"name": "a", "coupling": 1}]}', "coupling of mode 'a': found 1, .*bool"),
        (
            '{"modes": [{"name": "a", "recovery": 2.5}]}',
            "recovery .*found 2.5, expected an integer of 1 to 1000000 or None",
        ),
        ('{"modes": [{"name": "a", "sigma_v": true}]}', "sigma_v of mode 'a': found True"),
        ('{"modes": [{"name": "a", "algorithm": ["ekf"]}]}', "algorithm of mode 'a': found"),
    ],
)
def test_a_damaged_mode_file_is_named(tmp_path, text, message):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"(?s)bad.json: .*{message}"):
        modes_from(path)


def test_no_file_can_hold_a_function():
    with pytest.raises(ValueError, match="algorithm of mode 'own': found a function"):
        as_written(Mode("own", ekf))


def test_a_missing_mode_file_is_named():
    with pytest.raises(FileNotFoundError, match="nowhere.json"):
        modes_from("nowhere.json")
