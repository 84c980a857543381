"""Tests of modes and banks given as names, files and objects, and of errors in mode files."""

import json
from dataclasses import replace

import gymnasium as gym
import pytest

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.filters import Mode, ekf
from mmwave_env.filters.bank import (
    Bank,
    as_written,
    bank_as_written,
    bank_from,
    bank_in,
    best_bank,
    default_modes,
    modes_from,
    named_modes,
    shipped_modes,
)
from mmwave_env.models.radio import TUNED_RADIOS, Radio, radio_from
from tests.paths import write_json
from tests.refusals import refuses

THREE = [
    Mode("slow", "ekf", sigma_v=0.2, gate=None, recovery=None, coupling=False),
    Mode("fast", "ukf", sigma_v=2.0, robust=True, adaptive=False, cost=3.0),
    Mode("plain"),
]


def test_names_files_and_mode_objects_can_be_mixed_in_a_list(tmp_path):
    own = Mode("own", "ckf")
    content = {"command": "by hand", "modes": [as_written(m) for m in THREE]}
    path = write_json(tmp_path / "three.json", content)
    assert modes_from(["ukf", str(path), own]) == (named_modes()["ukf"], *THREE, own)
    untuned = Radio("unheard-of")  # the list names no tuned mode, so there is no warning
    assert modes_from([str(path)], untuned) == tuple(THREE)


@pytest.mark.parametrize("radio", TUNED_RADIOS)
def test_every_tuned_radio_has_tuned_modes(radio):
    low, high = default_modes(radio)
    assert (low.name, low.algorithm, high.name, high.algorithm) == ("ekf", "ekf", "ukf", "ukf")
    assert low.sigma_v < high.sigma_v and low.coupling and high.coupling
    assert not any(mode.coupling for mode in shipped_modes(radio, coupling=False))


def test_a_radio_that_was_not_tuned_gets_modes_and_bank_of_its_base_with_one_warning(
    tmp_path, recwarn
):
    file = write_json(tmp_path / "phone.json", {"base": "handset", "ue_elements": 4})
    assert default_modes(radio_from(file)) == default_modes("handset")
    assert default_modes(str(file)) == default_modes("handset") != default_modes("standard")
    assert gym.make("MmWaveLoc-v0", radio=str(file)).unwrapped.modes == default_modes("handset")
    env = gym.make("MmWaveLoc-v0", radio=str(file), beliefs="per-mode").unwrapped
    assert env.modes == best_bank("handset").modes
    (warning,) = recwarn
    assert "'phone'" in str(warning.message) and "'handset'" in str(warning.message)


def test_robust_modes_are_tuned_like_the_plain_modes_but_do_not_adapt():
    named = named_modes("high")
    assert named["ekf-robust"] == replace(
        named["ekf"], name="ekf-robust", robust=True, blockage_aware=True, adaptive=False
    )
    assert named["ukf-robust"].tuning == named["ukf"].tuning == named["ckf"].tuning


@pytest.mark.parametrize("modes", [["ekf", {"name": "own"}], "ekf", 3, ["pf"]])
def test_arguments_that_do_not_name_modes_are_refused(modes):
    with refuses("mode"):
        modes_from(modes)


PLAIN_MODE = {"name": "a"}  # as files have it


@pytest.mark.parametrize(
    ("content", "fields"),
    [
        ([], []),
        ({}, ["modes"]),
        ({"modes": [PLAIN_MODE] * 33}, ["modes"]),
        ({"modes": [PLAIN_MODE, PLAIN_MODE]}, ["modes"]),
        ({"modes": [PLAIN_MODE | {"key": 1}]}, ["modes[0]", "key"]),
        ({"modes": [PLAIN_MODE | {"algorithm": ["ekf"]}]}, ["modes[0]", "algorithm"]),
        ({"modes": [PLAIN_MODE], "transitions": [[1.0]]}, ["key"]),
    ],
)
def test_a_wrong_mode_file_is_refused_with_the_name_of_the_field(tmp_path, content, fields):
    path = write_json(tmp_path / "bad.json", content)
    for read in (bank_from, modes_from):
        with refuses("bad.json", *fields):
            read(path)


def test_a_mode_whose_algorithm_is_a_function_cannot_be_written_to_a_file():
    with refuses("algorithm of mode 'own'"):
        as_written(Mode("own", ekf))


BANK = Bank((Mode("slow", "ckf", sigma_v=0.1 + 0.2), Mode("fast")), ((0.9, 0.1), (0.3, 0.7)), 0.99)


@pytest.mark.parametrize("bank", [BANK, Bank(BANK.modes), best_bank("standard")])
def test_a_bank_read_from_json_equals_the_bank_that_was_written(bank):
    written = bank_as_written(bank)
    assert json.loads(json.dumps(written)) == written  # a resumed training relies on this
    assert bank_in(written) == bank


def test_the_transition_in_a_mode_file_is_used_if_no_other_modes_are_given(tmp_path):
    path = write_json(tmp_path / "bank.json", bank_as_written(BANK))
    for source in (path, str(path), [path], (str(path),)):
        assert bank_from(source) == BANK
    assert bank_from([path, "ekf"]).transition is None  # the file's matrix is for two modes


def test_the_parsed_content_of_a_mode_file_is_accepted_instead_of_the_file():
    content = bank_as_written(BANK)
    assert bank_from(content) == BANK and modes_from(content) == BANK.modes
    with refuses("key"):
        bank_from({"mode": content["modes"]})
