"""Tests of ``mmwave-loc list``, which lists names and copies samples."""

import pytest

from experiments.evaluation.contenders import contenders
from mmwave_env.datasets.samples import log_names, sample_names
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


def test_all_samples_or_one_can_be_copied(tmp_path):
    said = succeed("list", "samples", "--out", tmp_path / "all")
    logs, recordings = (tmp_path / "all" / kind for kind in ("logs", "recordings"))
    assert [folder.name for folder in sorted(recordings.iterdir())] == list(sample_names())
    assert [folder.name for folder in sorted(logs.iterdir())] == list(log_names())
    count = sum(path.is_file() for path in (tmp_path / "all").rglob("*"))
    assert said == f"copied to {tmp_path / 'all'}/: {count} files\n"
    succeed("list", "samples", "--copy", "canyon28_pedestrian", "--out", tmp_path / "walk")
    for file in (logs / "canyon28_pedestrian").iterdir():
        assert (tmp_path / "walk" / file.name).read_bytes() == file.read_bytes()
    (tmp_path / "walk" / "log.csv").unlink()  # a second copy must not add it again
    done = command("list", "samples", "--copy", "canyon28_pedestrian", "--out", tmp_path / "walk")
    assert_one_clear_line(done, "scene.json: found a file, expected a folder without it")
    assert not (tmp_path / "walk" / "log.csv").exists()


def test_copying_an_unknown_sample_or_naming_no_folder_is_refused(tmp_path):
    for words in (["--out", tmp_path], ["samples", "--copy", "canyon28_vehicle"]):
        assert_one_clear_line(command("list", *words), "expected: list samples --copy NAME --out")
    done = command("list", "samples", "--copy", "canyon29", "--out", tmp_path / "new")
    assert_one_clear_line(done, "sample: found 'canyon29', expected one of canyon28_")
    assert not list(tmp_path.iterdir())
