"""Tests that logs cause a warning only if they contradict the scene, the radio or physics."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mmwave_env.localization.contradictions import contradictions
from mmwave_env.localization.starts import deviations_of
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import RADIOS, TUNED_RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.mobility import MOBILITIES
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import sampled
from tests.localization.test_diagnosis import doubts
from tests.logs.by_hand import write_log

WORLDS = list(product([RADIOS[name] for name in TUNED_RADIOS], SCENES.values(), MOBILITIES))
SCENE = SCENES["street"]
RADIO = RADIOS["standard"]
# figures of a group (an anchor's link or the Doppler shift) that fits the track
FINE = {"seen": 200, "rejected_share": 0.1, "nis_per_dof": 1.0}


def log_of(folder, scene, radio, kind, seed):
    """Write a simulated log and read it back."""
    episode = sampled(SimulatedSource(scene, radio, kind), seed)
    write_log(folder / "log.csv", episode)
    return read_log(folder / "log.csv", scene).whole()


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    return log_of(folder, SCENE, RADIO, "vehicle", 0)


def doubts_of(block):
    """Return the warnings about a block that fits the track; the NIS of "all" must be ignored."""
    groups = {"anchor 1": FINE, "all": FINE | {"nis_per_dof": 1e9}}
    return [str(doubt) for doubt in contradictions(block, SCENE, RADIO, groups)]


def shifted(log, doppler_hz):
    """Return the log with other Doppler shifts."""
    measurement = log.measurement.copy()
    measurement[:, log.layout.doppler] = doppler_hz
    return replace(log, measurement=measurement)


def shifts(block):
    """Return the Doppler shifts (T,) of a log."""
    return block.measurement[:, block.layout.doppler]


@pytest.mark.parametrize("world", WORLDS[::4], ids=lambda w: f"{w[0].name}-{w[1].name}-{w[2]}")
def test_a_correct_log_causes_no_warning(tmp_path, world):
    radio, scene, kind = world
    assert not doubts(log_of(tmp_path, scene, radio, kind, 0), scene, radio)


@pytest.mark.slow
def test_at_most_ten_of_a_thousand_correct_logs_cause_a_warning(tmp_path):
    wrong = {}
    for n in range(1000):
        radio, scene, kind = WORLDS[n % len(WORLDS)]
        if said := doubts(log_of(tmp_path, scene, radio, kind, n), scene, radio):
            wrong[radio.name, scene.name, kind, n] = said
    assert len(wrong) <= 10, wrong


@pytest.mark.parametrize(
    ("name", "group", "value"),
    [
        ("anchor 1", {}, None),
        ("anchor 1", {"nis_per_dof": 0.19}, "NIS / dof 0.19"),
        ("anchor 1", {"nis_per_dof": 2078.4}, "NIS / dof 2.08e+03"),
        ("anchor 1", {"nis_per_dof": 2078.4, "seen": 19}, None),
        ("anchor 1", {"nis_per_dof": 6.0, "nis_in_bounds": 0.9}, None),
        ("anchor 1", {"nis_per_dof": 6.0, "nis_in_bounds": 0.5}, "NIS / dof 6"),
        ("anchor 1", {"rejected_share": 0.34}, "34 % rejected"),
        ("anchor 1", {"rejected_share": 0.34, "seen": 99}, None),
        ("anchor 1", {"rejected_share": 1.0, "nis_per_dof": None}, "100 % rejected"),
        ("anchor 1", {"rejected_share": 1.0, "seen": 50}, "100 % rejected"),
        ("anchor 1", {"seen": 0, "rejected_share": None, "nis_per_dof": None}, None),
        # a Doppler shift may fit better, but not worse than its noise predicts
        ("Doppler", {"nis_per_dof": 0.01}, None),
        ("Doppler", {"nis_per_dof": 5.1}, "NIS / dof 5.1"),
    ],
)
def test_a_group_that_does_not_fit_the_track_causes_a_warning(block, name, group, value):
    doubts = contradictions(block, SCENE, RADIO, {name: FINE | group})
    assert [(d.group, d.found) for d in doubts] == ([(name, value)] if value else [])


def test_impossible_measurements_cause_a_warning(block):
    snr = block.snr_db.copy()
    measurement = block.measurement.copy()
    snr[5, 1] = 120.0
    measurement[:, 2] *= -1.0  # the user seems to be above the base station
    for changes, group in (
        ({"snr_db": snr}, "anchor 2"),
        ({"time_s": 1e3 * block.time_s}, "time"),
        ({"measurement": measurement}, "anchor 1"),
    ):
        assert doubts_of(replace(block, **changes))[0].startswith(f"{group}: ")


@pytest.mark.parametrize("factor", [-1.0, 1e-3, 1.0 / SCENE.hz_per_mps, 3.0])
def test_a_doppler_shift_that_contradicts_the_range_causes_a_warning(block, factor):
    wrong = shifted(block, factor * shifts(block))
    wrong.measurement[::20, 0] = np.nan  # as in a partial log
    (line,) = doubts_of(wrong)
    grows = float(line.split("grows by ")[1].split(" m")[0])
    assert grows == pytest.approx(1.0 / factor, rel=0.1)


def test_a_doppler_shift_that_is_never_measured_causes_a_warning_if_the_user_moves(block):
    (line,) = doubts_of(shifted(block, 17.0))
    assert "grows by inf m" in line


def test_a_doppler_shift_is_checked_without_snr_if_the_log_states_deviations(block):
    wrong = shifted(block, -shifts(block))
    sigma = deviations_of(block, SCENE, RADIO)
    without = np.full_like(block.snr_db, -np.inf)
    (line,) = doubts_of(replace(wrong, sigma=sigma, snr_db=without))
    assert "grows by -1" in line


@pytest.mark.parametrize(
    ("factor", "noise_hz"), [(1.0, 5.0), (1.0, 20.0), (1.0, 40.0), (-1.0, 10.0)]
)
def test_the_doppler_shift_of_a_steady_walk_causes_a_warning_only_if_it_is_wrong(
    block, factor, noise_hz
):
    rng = np.random.default_rng(0)
    walk = block.part(slice(180))
    x = 0.9 * walk.time_s - 10.0
    range_m = np.hypot(x, 20.0)
    measured_m = range_m + 0.3 * rng.standard_normal(180)
    shift = factor * SCENE.hz_per_mps * 0.9 * x / range_m
    walk = shifted(walk, shift + noise_hz * rng.standard_normal(180))
    walk.measurement[:, 0] = measured_m
    assert bool(doubts_of(walk)) == (factor < 0.0)


@pytest.mark.parametrize("factor", [-1.0, 0.0, 1e-3, 1.0])
def test_the_doppler_shift_of_a_user_at_rest_causes_no_warning(block, factor):
    rng = np.random.default_rng(0)
    range_m = 50.0 + 0.2 * rng.standard_normal(len(block))
    still = shifted(block, factor * 10.0 * rng.standard_normal(len(block)))
    still.measurement[:, 0] = range_m
    assert not doubts_of(still)
