"""Tests of ``mmwave-loc list``."""

import pytest

from experiments.evaluation.contenders import contenders
from mmwave_env.datasets.samples import sample_names
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
    "samples": [*sample_names(), "street_paths"],
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
