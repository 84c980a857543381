"""Tests of random radios, which differ randomly from a profile, and of wide random streets."""

from dataclasses import fields

import numpy as np

from mmwave_env.models.radio import RADIOS, Radio, RandomRadio
from mmwave_env.models.random_scene import WIDE_SCENE
from mmwave_env.task import task_from
from mmwave_env.world.simulated import SimulatedSource

HANDSET = RADIOS["handset"]


def test_floors_and_rates_differ_from_the_profile_by_at_most_the_factor():
    rng = np.random.default_rng(0)
    drawn = [RandomRadio(HANDSET, 2.0, 3.0).draw(rng) for _ in range(200)]
    for name in ("aoa_floor_rad", "range_floor_m", "multipath_rate_hz", "blockage_mean_s"):
        values = np.array([np.ravel(getattr(radio, name)) for radio in drawn])
        ratios = values / np.ravel(getattr(HANDSET, name))
        assert 0.5 <= ratios.min() < 0.55 and 1.8 < ratios.max() <= 2.0
        assert abs(np.log(ratios[:, 0]).mean()) < 0.1
    budgets = np.array([radio.link_budget_db - HANDSET.link_budget_db for radio in drawn])
    assert -3.0 <= budgets.min() < -2.5 and 2.5 < budgets.max() <= 3.0
    assert {radio.base for radio in drawn} == {"handset"}


def test_a_factor_of_one_gives_the_profile():
    same = RandomRadio(HANDSET, 1.0, 0.0).draw(np.random.default_rng(0))
    assert all(getattr(same, f.name) == getattr(HANDSET, f.name) for f in fields(Radio))


def test_every_random_radio_is_within_the_limits_of_simulations():
    rng = np.random.default_rng(1)
    for profile in RADIOS.values():
        for _ in range(20):
            SimulatedSource(WIDE_SCENE, RandomRadio(profile, 4.0, 10.0).draw(rng))


def test_wide_streets_are_a_scene_of_the_environment():
    source = task_from(scene="wide").simulated
    heights = [source.scene_of(key).anchors_m[0, 2] for key in range(100)]
    assert min(heights) < 6.0 and max(heights) > 20.0
