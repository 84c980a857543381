"""Tests of the argument ``clock``, for a user's clock that is not synchronized."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.samples import sample_folder
from mmwave_env.engines.engine import run_imm
from mmwave_env.filters.bank import best_bank
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.radio import BIAS_SIGMA_M
from mmwave_env.models.scene import SCENES
from mmwave_env.task import task_from
from mmwave_env.world.keys import keys_of
from tests.cli import assert_refused, command, succeed
from tests.environment.test_measurements import NOISY
from tests.filters.tracks import assert_same_fields, replay, sampled, seeded, street_source
from tests.localization.mistakes import linear, renamed, wrong_log
from tests.refusals import refuses

STREET = SCENES["street"]
SIGMA_M = 1e-7 * SPEED_OF_LIGHT
SOURCES = NOISY | {
    "some measurements": {"measurements": ["range", "azimuth", "doppler"]},
    "fast": {"dt": 0.1},
}


def tasks(clock, **arguments):
    """Return two tasks: the user's clock is synchronized in the first and not in the second."""
    return [task_from(clock=name, **arguments) for name in ("synchronized", clock)]


def pair(clock="offset", **arguments):
    """Return one episode twice: with a synchronized clock and with another one."""
    both = tasks(clock, episode_steps=40, radio="standard", **arguments)
    return [sampled(task.source, 4) for task in both]


def bias_of(synchronized, offset):
    """Return the difference (T,) between two episodes' ranges in m; NaN in epochs without a link.

    Check that all ranges of an epoch differ by the same amount.
    """
    ranges = slice(0, offset.layout.doppler, 4)
    change = (offset.measurement - synchronized.measurement)[:, ranges]
    measured = synchronized.usable[:, : offset.layout.anchors] & np.isfinite(change)
    largest = np.where(measured, change, -np.inf).max(axis=1)
    assert_allclose(change[measured], np.broadcast_to(largest[:, None], measured.shape)[measured])
    return np.where(measured.any(axis=1), largest, np.nan)


@pytest.mark.parametrize("clock", BIAS_SIGMA_M)
@pytest.mark.parametrize("arguments", SOURCES.values(), ids=SOURCES)
def test_all_ranges_get_the_same_bias_and_nothing_else_changes(arguments, clock):
    synchronized, offset = pair(clock, **arguments)
    bias = bias_of(synchronized, offset)
    layout = offset.layout
    sigma_m = BIAS_SIGMA_M[clock]
    assert 0.01 * sigma_m < abs(bias[np.isfinite(bias)][0]) < 5.0 * sigma_m
    changes = np.diff(bias[np.isfinite(bias)]).std()
    assert changes > 0.5 * sigma_m if clock == "free" else changes < 0.1 * sigma_m
    others = np.setdiff1d(np.arange(layout.size), np.arange(0, layout.doppler, 4))
    known = np.isfinite(offset.measurement)[:, others]  # a partial layout has NaN in lost links
    assert known.any()
    for field in ("measurement", "sigma"):
        pairs = (getattr(episode, field)[:, others][known] for episode in (offset, synchronized))
        assert_array_equal(*pairs)
    fields = ("visible", "snr_db", "truth_position_m", "doppler_spread_hz")
    assert_same_fields(offset, synchronized, *fields)
    assert_array_equal(offset.prior_mean, [*synchronized.prior_mean, 0.0])
    P = np.diag([*np.diag(synchronized.prior_covariance), sigma_m**2])
    assert_allclose(offset.prior_covariance, P)


def test_no_offset_is_added_to_the_ranges_of_a_log():
    synchronized, offset = pair(episodes=sample_folder("canyon28_vehicle"))
    assert_array_equal(offset.measurement, synchronized.measurement)
    assert_array_equal(offset.prior_mean, [*synchronized.prior_mean, 0.0])


def biases(n, **arguments):
    """Return the range biases (n, T) in m of n episodes with a clock offset, and the episodes."""
    plain, shifted = (
        task.simulated.episodes(keys_of(range(n))) for task in tasks("offset", **arguments)
    )
    return np.array([bias_of(*pair) for pair in zip(plain, shifted, strict=True)]), shifted


def unexplained(episode):
    """Return the Doppler shift (T,) in m/s that motion does not explain; NaN if not measured."""
    away = episode.truth_position_m - episode.scene_anchors_m[0]
    rate = (away * episode.truth_velocity_mps).sum(axis=1) / np.linalg.norm(away, axis=1)
    doppler = episode.measurement[:, episode.layout.doppler] / episode.hz_per_mps
    return np.where(episode.usable[:, 3], doppler - rate, np.nan)


def test_the_offset_is_drawn_and_the_oscillator_drives_it():
    """Compare the growth of the range bias with the oscillator's part of the Doppler shift."""
    bias, shifted = biases(400, radio="standard", episode_steps=60, scenario="pedestrian")
    first = bias[:, 0][np.isfinite(bias[:, 0])]
    assert abs(first.mean()) < 4.0 * SIGMA_M / 20.0
    assert first.std() == pytest.approx(SIGMA_M, rel=0.15)
    by_oscillator = 59.0 * np.nanmean([unexplained(episode) for episode in shifted], axis=1)
    grown = bias[:, -1] - bias[:, 0]
    left = (grown - by_oscillator)[np.isfinite(grown)]
    assert left.std() < 0.15 * grown[np.isfinite(grown)].std()


@pytest.mark.slow  # runs many episodes
def test_the_offset_is_estimated_with_a_correct_standard_deviation():
    bias, episodes = biases(120, radio="high")
    task = task_from(radio="high", clock="offset")
    bank = best_bank("high")
    run = run_imm(bank, task.reward, episodes, "x", "P", "nees")
    late = np.isfinite(bias) & (np.arange(200) >= 20)
    error = (run["x"][..., 7] - bias)[late]
    sigma = np.sqrt(run["P"][..., 35])[late]
    assert np.sqrt(np.median(error**2)) < 0.5
    assert 0.93 < (abs(error) < 1.96 * sigma).mean() < 0.97
    assert np.median(run["nees"][:, 20:]) == pytest.approx(2.37, rel=0.2)  # chi2(3).median()


def test_an_invalid_clock_and_a_clock_that_cannot_be_estimated_are_refused():
    for arguments in (
        {"clock": "late"},
        {"clock": "offset", "measurements": ["azimuth", "doppler"]},
        {"clock": "offset", "episodes": replay(street_source().episode(1))},
    ):
        with refuses("clock"):
            task_from(**arguments)


@pytest.fixture(scope="module")
def ride(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ride")
    succeed("simulate", "--seed", 2, "--radio", "standard", "--clock", "offset", "--out", folder)
    return folder


def words_of(folder):
    """Return the arguments by which a command gets a simulated log, its scene and its radio."""
    return folder / "log.csv", "--scene", folder / "scene.json", "--radio", "standard"


def close_track(folder, log):
    """Return what localize says about a simulated log whose track it finds."""
    more = ("--truth", folder / "truth.tum", "--speed", "auto", "--clock", "offset")
    out = succeed("localize", log, *words_of(folder)[1:], *more)
    smoothed = next(line for line in out.splitlines() if line.startswith("| smoothed |"))
    assert float(smoothed.split("|")[2]) < 1.0
    return out


def test_localize_follows_an_oscillator_that_is_wrong_by_0_1_ppm(tmp_path, ride):
    def drifting(c):
        return {
            **c,
            "toa_s": c["toa_s"] + 1e-7 * c["time_s"],
            "doppler_hz": c["doppler_hz"] + 1e-7 * STREET.carrier_hz,
        }

    close_track(ride, wrong_log(tmp_path, ride, drifting))


def test_localize_estimates_the_offset(ride):
    out = close_track(ride, ride / "log.csv")
    episodes = [seeded(2, radio="standard", clock=clock) for clock in ("synchronized", "offset")]
    said = next(line for line in out.splitlines() if "clock is" in line)
    ns, deviation = map(float, re.search(r"([\d.]+) ± ([\d.]+)", said).groups())
    true_ns = bias_of(*episodes)[-1] / SPEED_OF_LIGHT * 1e9
    assert ns * (-1.0 if "behind" in said else 1.0) == pytest.approx(true_ns, abs=4.0 * deviation)


def test_ranges_below_zero_are_accepted_if_the_clock_may_be_behind(tmp_path, ride):
    log = wrong_log(tmp_path, ride, linear(1.0, "toa_s", offset=-1e-6))
    words = log, *words_of(ride)[1:], "--speed", "auto"
    assert_refused("'toa_s'.* expected a number from -1 ", "localize", *words)
    assert "behind" in succeed("localize", *words, "--clock", "offset")


def test_logs_that_do_not_determine_the_clock_are_refused(tmp_path, ride):
    for own in ("rtt_s", "aoa_azimuth_sigma_deg"):
        log = wrong_log(tmp_path, ride, renamed({"toa_s": own}))
        words = log, *words_of(ride)[1:], "--clock", "offset"
        done = command("localize", *words)
        assert done.returncode == 2 and "clock: found the setting 'offset'" in done.stderr
    done = command("localize", *words_of(ride), "--clock", "offset", "--associate")
    assert done.returncode == 2 and done.stderr.count("clock: cannot") == 1
