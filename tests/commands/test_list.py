"""Tests of ``mmwave-loc list``, which lists names and copies samples."""

import pytest

from experiments.evaluation.contenders import contenders
from mmwave_env.datasets.samples import sample_folder, sample_names
from mmwave_env.filters.bank import named_modes
from mmwave_env.interface.reward import REWARDS
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RANDOM
from mmwave_env.models.scene import SCENES
from mmwave_env.world import mobility
from tests.cli import assert_one_clear_line, command, succeed

NAMES = {
    "policies": [*contenders("handset"), "clairvoyant"],
    "scenarios": mobility.SCENARIOS,
    "radios": RADIOS,
    "scenes": [*SCENES, RANDOM],
    "modes": named_modes(),
    "samples": sample_names(),
    "rewards": REWARDS,
}


@pytest.mark.parametrize("kind", NAMES)
def test_every_name_of_a_kind_has_a_line(kind):
    title, *lines = succeed("list", kind).splitlines()
    assert title == f"{kind}:"
    assert [line.split()[0] for line in lines] == list(NAMES[kind])
    assert all(len(line.split()) > 1 for line in lines)


def test_without_a_kind_all_kinds_are_listed():
    assert succeed("list") == "".join(succeed("list", kind) for kind in NAMES)


def test_an_unknown_kind_or_radio_is_refused():
    assert_one_clear_line(command("list", "polices"), "polices.*what.*policies")
    assert_one_clear_line(command("list", "modes", "--radio", "lab"), "radio: found 'lab'")


def test_a_sample_can_be_copied(tmp_path):
    folders = {"canyon28_pedestrian": "log", "canyon28_stop_and_go": "recording"}
    for name, kind in folders.items():
        said = succeed("list", "samples", "--copy", name, "--out", tmp_path / name)
        files = list(sample_folder(name, kind).iterdir())
        assert said == f"copied to {tmp_path / name}/: {len(files)} files\n"
        for file in files:
            assert (tmp_path / name / file.name).read_bytes() == file.read_bytes()


def test_copying_a_sample_replaces_no_file(tmp_path):
    succeed("list", "samples", "--copy", "canyon28_pedestrian", "--out", tmp_path / "walk")
    (tmp_path / "walk" / "log.csv").unlink()  # the refused second copy must not add this file
    done = command("list", "samples", "--copy", "canyon28_pedestrian", "--out", tmp_path / "walk")
    assert_one_clear_line(done, "scene.json: found a file of this name, expected none")
    assert not (tmp_path / "walk" / "log.csv").exists()


def test_copying_needs_a_known_sample_and_a_folder(tmp_path):
    for words in (["samples", "--out", tmp_path], ["samples", "--copy", "canyon28_vehicle"]):
        assert_one_clear_line(command("list", *words), "expected: list samples --copy NAME --out")
    done = command("list", "samples", "--copy", "canyon29", "--out", tmp_path / "new")
    assert_one_clear_line(done, "sample: found 'canyon29', expected one of canyon28_")
    assert not list(tmp_path.iterdir())
