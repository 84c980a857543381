"""Tests that commands and environments name a missing extra (a group of optional packages)."""

import importlib
import sys

import gymnasium as gym
import pytest

from tests.cli import assert_one_clear_line, command


@pytest.mark.parametrize(
    ("package", "extra", "file", "words"),
    [
        ("matplotlib", "plot", "new.png", ["localize", "--sample", "canyon28_vehicle", "--plot"]),
        ("filterpy", "filterpy", "new.json", ["speed", "--json"]),
        ("pygame", "render", "new.gif", ["watch", "--out"]),
    ],
)
def test_a_command_names_the_missing_extra_and_writes_nothing(
    package, extra, file, words, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    assert_one_clear_line(
        command(*words, tmp_path / file), rf"needs {package}: pip install 'mmwave-loc\[{extra}\]'"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("package", "extra", "arguments"),
    [
        ("filterpy", "filterpy", {"backend": "filterpy"}),
        ("pygame", "render", {"render_mode": "rgb_array"}),
    ],
)
def test_an_environment_names_the_missing_extra(package, extra, arguments, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"needs {package}.*mmwave-loc\[{extra}\]"):
        gym.make("MmWaveLoc-v0", **arguments)


def test_the_vector_environment_for_stable_baselines3_names_the_missing_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.delitem(sys.modules, "mmwave_env.sb3", raising=False)
    with pytest.raises(ImportError, match=r"needs stable_baselines3.*mmwave-loc\[train\]"):
        importlib.import_module("mmwave_env.sb3")
