"""Tests of statements on the noise of a log: steps, jumps of the clock, factors, correlation."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmwave_env.localization.log_noise import clock_jumps, noise_notes, with_range_steps
from mmwave_env.localization.readings import RANGE
from mmwave_env.localization.starts import deviations_of
from mmwave_env.models.radio import RADIOS
from tests.localization.errors import STREET, only, readings

READING = readings(1)[0]
LOG = READING.log
RANGES = LOG.measurement[:, RANGE]
RADIO = READING.radio
SIGMA = deviations_of(LOG, STREET, RADIO)


def with_ranges(ranges):
    z = LOG.measurement.copy()
    z[:, RANGE] = ranges
    return replace(LOG, measurement=z)


def rounded(step):
    return with_ranges(step * np.round(RANGES / step))


@pytest.mark.parametrize("step", [0.3, 0.7, 2.44])
def test_the_step_of_ranges_is_known_and_its_noise_added(step):
    log, known = with_range_steps(rounded(step), STREET, RADIO)
    assert known == pytest.approx(step, rel=1e-3)
    variance = deviations_of(log, STREET, RADIO)[:, RANGE] ** 2
    assert_allclose(variance - SIGMA[:, RANGE] ** 2, step**2 / 12.0, rtol=2e-3)


def test_standard_deviations_of_the_receiver_get_the_noise_of_rounding_too():
    own = np.full(SIGMA.shape, 0.4)
    log, _ = with_range_steps(replace(rounded(0.7), sigma=own), STREET, RADIO)
    assert_allclose(log.sigma[:, RANGE], np.sqrt(0.16 + 0.49 / 12.0), rtol=1e-3)
    assert (log.sigma[:, 1] == 0.4).all()


@pytest.mark.parametrize(
    "log",
    [LOG, rounded(0.01), with_ranges(np.nan), with_ranges(15.0 * LOG.time_s[:, None])],
    ids=["unrounded", "too short to matter", "without ranges", "at a constant speed"],
)
def test_other_ranges_keep_their_noise(log):
    assert with_range_steps(log, STREET, RADIO) == (log, None)


def test_jumps_that_all_ranges_share_are_those_of_a_clock():
    rng = np.random.default_rng(8)
    clock = np.where(rng.random(len(LOG)) < 0.3, rng.uniform(500.0, 5000.0, len(LOG)), 0.0)
    share, jump_m = clock_jumps(with_ranges(RANGES + clock[:, None]), SIGMA)
    assert 0.3 < share < 0.6 and 1000.0 < jump_m < 4000.0
    assert clock_jumps(LOG, SIGMA) is None
    single = RANGES + np.array([1.0, 0.0, 0.0]) * clock[:, None]
    assert clock_jumps(with_ranges(single), SIGMA) is None


def notes(log, step_m=None):
    return list(noise_notes(READING._replace(log=log), step_m))


def test_a_correct_log_needs_no_note():
    assert notes(LOG) == []


@pytest.mark.parametrize(
    ("name", "rows", "stated", "columns"),
    [
        ("azimuths", slice(1, -1, 2), 1 / 3, "aoa_azimuth_sigma and aod_azimuth_sigma"),
        ("ranges", RANGE, 3.0, "range_sigma"),
    ],
)
def test_noise_that_is_not_as_stated_is_noted(name, rows, stated, columns):
    sigma = SIGMA.copy()
    sigma[:, rows] *= stated
    (note,) = notes(replace(LOG, sigma=sigma))
    words = f"the noise of {name} is (.*) times as large as stated: correct {columns} in the log"
    assert 0.8 < stated * float(re.fullmatch(words, note)[1]) < 1.3


def test_another_radio_is_advised_only_if_the_log_states_no_deviations():
    advice = list(noise_notes(READING._replace(radio=RADIOS["high"]), None))
    assert advice and all(note.endswith("or use another --radio") for note in advice)


def test_correlated_errors_of_angles_are_noted():
    rng = np.random.default_rng(9)
    slow = np.repeat(rng.standard_normal((len(LOG) // 10 + 1, 13)), 10, axis=0)[: len(LOG)]
    slow[:, [0, 4, 8, 12]] = 0.0
    log = replace(LOG, measurement=LOG.measurement + 1.5 * SIGMA * slow)
    assert "--correlation" in notes(log)[-1]
    known = list(noise_notes(READING._replace(log=log), None, correlation_s=5.0))
    assert not any("--correlation" in note for note in known)


def test_measurements_in_every_other_epoch_have_no_correlation():
    visible = LOG.visible & (np.arange(len(LOG)) % 2 == 0)[:, None]
    assert notes(replace(LOG, visible=visible)) == []


def test_a_log_too_short_for_shared_errors_is_noted():
    (note,) = notes(LOG.part(slice(50)))
    assert note.startswith("errors that all links share were not looked for")


def test_jumps_are_noted_alone_and_steps_even_if_no_track_can_begin():
    clock = 3000.0 * (np.arange(len(LOG)) % 3 == 0)
    jumping = READING._replace(log=with_ranges(RANGES + clock[:, None]))
    partial = only(jumping, [0, 4, 8]).log
    (jumps,) = notes(partial, step_m=2.5)
    assert re.match("the user's clock jumps in 6[67]% of the epochs, by 3e[+]03 m", jumps)
    free = replace(partial, layout=replace(partial.layout, clock="free"))
    steps, *others = notes(free, step_m=2.5)
    assert steps.startswith("ranges come in steps of 2.5 m")
    assert not any("jumps" in note for note in others)
