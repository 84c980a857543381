"""Worlds of one's own: what docs/own-world.md shows works as shown, in commands and in Python."""

import re
import shlex
import warnings

import numpy as np
import pytest

from experiments.training.places import place_from
from mmwave_env.episodes.trajectory import read_trajectory
from mmwave_env.filters.mode_files import read_modes, shipped_modes
from mmwave_env.logs.tum import read_tum
from mmwave_env.task import task_from
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "own-world.md").read_text(encoding="utf-8")
FILES = re.findall(r"`(\w+\.(?:json|csv))`[^`]*\n\n```(?:json|csv)\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = re.findall(r"^mmwave-loc (.*)$", PAGE, re.MULTILINE)
BY_FILES, BY_OBJECTS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the page's files."""
    folder = tmp_path_factory.mktemp("own")
    for name, text in FILES:
        (folder / name).write_text(text)
    return folder


def run(folder, line):
    """A command, in the folder, on two episodes; it succeeds and warns of what it should."""
    words = shlex.split(line)
    if "--episodes" in words:
        words[words.index("--episodes") + 1] = "2"
    elif words[0] != "simulate":
        words += ["--episodes", "2"]
    done = command(*words, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done


def find(what):
    (line,) = [line for line in COMMANDS if what in line]
    return line


def test_the_page_has_all_five_files():
    assert [name for name, _ in FILES] == [
        "scooter.json", "ride.csv", "market.json", "phone.json", "two.json"
    ]  # fmt: skip


@pytest.mark.slow
def test_a_kind_of_user_is_compared_on(folder):
    done = run(folder, find("compare --policies fixed-ekf fixed-ukf imm --scenario scooter.json"))
    assert "### scooter, handset, 2 episodes" in done.stdout and done.stderr == ""


def test_a_way_is_evaluated_on_and_becomes_a_log(folder):
    assert "### ride.csv, handset, 2 episodes" in run(folder, find("evaluate")).stdout
    run(folder, find("simulate"))
    truth, way = read_tum(folder / "ride" / "truth.tum"), read_trajectory(folder / "ride.csv")
    np.testing.assert_allclose(truth.position_m, way.position_m, atol=1e-9)


@pytest.mark.slow
def test_a_street_is_compared_on(folder):
    assert "### pedestrian on market, handset" in run(folder, find("--scene market.json")).stdout


def test_the_street_may_be_trained_on(folder):
    streets = [name for name, text in FILES if "base_station_m" in text]
    found = [place_from(f"{folder / name}:handset").source("mixed").scene.name for name in streets]
    assert found == ["market"]


def test_a_longer_way_says_which_seconds_were_written(folder):
    shown = succeed("simulate", "--scenario", "ride.csv", "--episode-steps", 3, "--seed", 1,
                    "--out", "part", cwd=folder)  # fmt: skip
    begin, end, name = re.search(r"seconds (\d) to (\d) of (.*)$", shown).groups()
    way, truth = read_trajectory(folder / "ride.csv"), read_tum(folder / "part" / "truth.tum")
    assert name == "ride.csv"
    np.testing.assert_allclose(
        truth.position_m, way.position_m[int(begin) : int(end) + 1], atol=1e-9
    )


def test_so_few_epochs_that_rpe_is_none_are_warned_of(folder):
    assert run(folder, find("evaluate")).stderr.splitlines() == [
        "warning: episodes of 7 epochs: metrics leave out the first 10; 1 left, RPE needs more "
        "than 1 and is 0"
    ]


@pytest.mark.slow
def test_policies_with_modes_of_their_own_say_so(folder):
    done = command("compare", "--policies", "ppo-handset", "imm", "--modes", "two.json",
                   "--episodes", 2, cwd=folder)  # fmt: skip
    assert done.stderr.splitlines() == [
        "warning: ppo-handset brings its own modes; --modes is not for it"
    ]


@pytest.mark.slow
def test_a_radio_that_was_not_tuned_says_so_and_can_be(folder):
    shipped_modes.cache_clear()  # as in a new process: it is said once
    untuned = find("--modes modes.json").replace("--modes modes.json", "")
    done = run(folder, untuned)
    (line,) = done.stderr.splitlines()
    assert "phone" in done.stdout and "mmwave-loc tune --radio phone.json" in line
    shipped_modes.cache_clear()
    done = run(folder, f"{find('tune')} --free sigma_v")
    assert done.stderr == "" and "### ekf on pedestrian, phone:" in done.stdout
    assert [mode.name for mode in read_modes(folder / "modes.json")] == ["ekf", "ukf"]
    shipped_modes.cache_clear()
    assert run(folder, find("--modes modes.json")).stderr == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--scenario none.csv", "none.csv: found no such file"),
        ("--scenario phone.json", "phone.json: not a mobility file: key: found 'base'"),
        ("--radio two.json", "two.json: not a radio file: key: found 'modes', expected one of"),
        ("--scene scooter.json", "scooter.json: not a scene file: found neither base_station_m"),
        ("--scenario ride.csv --data canyon28_vehicle", "scenario: found 'ride.csv', but recorded"),
    ],
)
def test_files_in_the_wrong_place_are_refused_in_a_line(folder, words, message):
    assert_one_clear_line(command("evaluate", *words.split(), cwd=folder), message)


@pytest.mark.slow
def test_the_python_of_the_page_runs(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # modes of one's own: no word of untuned ones
        exec(compile(BY_FILES, "own-world.md", "exec"), {})
        exec(compile(BY_OBJECTS, "own-world.md", "exec"), {})
    assert capsys.readouterr().out == "scooter Discrete(2)\n"


def test_more_epochs_than_a_way_has_are_refused(folder):
    with pytest.raises(ValueError, match="episode_steps: found 50, expected at most 7, .*ride.csv"):
        task_from(scenario=folder / "ride.csv", episode_steps=50)
    assert task_from(scenario=folder / "ride.csv", episode_steps=3).source.epochs == 3
