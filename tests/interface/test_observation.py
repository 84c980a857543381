"""Tests that each feature of the observation has the value that its name promises."""

from dataclasses import replace
from itertools import accumulate
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.engines.engine import Engine
from mmwave_env.engines.epoch import with_expected_spread
from mmwave_env.filters import Pipeline
from mmwave_env.filters.bank import modes_from
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.envelope import DOPPLER_SPREAD_HZ
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, blank_site
from mmwave_env.models.radio import RADIOS, doppler_spread
from tests.filters.tracks import drawn, replay

# group of measurements -> degrees of freedom; the groups are in the order of the layout
GROUPS = {"anchor 1": 4, "anchor 2": 4, "anchor 3": 4, "Doppler": 1}
DOF = np.array([*GROUPS.values()])


def blinded(episode, first, last):
    """Return the episode without the measurements of the epochs ``first`` to ``last`` - 1."""
    visible = episode.visible.copy()
    visible[first:last] = False
    return replace(episode, visible=visible)


def absurd(episode):
    """Return the episode with absurd measurements, SNRs and Doppler spreads, and a wrong prior."""
    measurement = episode.measurement.copy()
    measurement[::7] *= 1e6
    return replace(
        episode,
        measurement=measurement,
        snr_db=np.where(np.arange(len(episode))[:, None] % 5, episode.snr_db, 1e9),
        doppler_spread_hz=np.full(len(episode), DOPPLER_SPREAD_HZ.most),
        prior_mean=episode.prior_mean * 1e3,
    )


def test_values_are_within_their_finite_bounds_even_in_absurd_episodes():
    episodes = [drawn(seed) for seed in range(12)]
    episodes += [blinded(drawn(seed), first, 200) for seed, first in ((12, 0), (13, 0), (14, 50))]
    episodes += [blinded(drawn(15), 50, 190), absurd(drawn(16)), absurd(blinded(drawn(17), 0, 9))]
    engine = Engine(Pipeline(modes_from(None), Layout()), len(episodes), TrackingReward())
    engine.load(episodes)
    engine.step()
    space = engine.observation.space
    rng = np.random.default_rng(0)
    for _ in range(200):
        observations = engine.observations()
        assert observations.dtype == np.float32
        assert all(space.contains(row) for row in observations)
        engine.step(rng.integers(2, size=len(episodes)))


class Rollout(NamedTuple):
    """An episode of 200 epochs, a step ``dt`` apart, that was played with random actions.

    Observations and infos have 201 entries: one from ``reset`` and one from every step.
    """

    episode: object
    table: Observation
    observations: np.ndarray
    infos: list

    @property
    def dt(self):
        return self.episode.time_s[1]

    def read(self, name):
        """Return a feature (201,) in its own unit."""
        return self.table.read(self.observations, name)

    def info(self, key):
        """Return an entry of the infos of all steps (200, ...)."""
        return np.array([info[key] for info in self.infos[1:]])

    def limited(self, name, values):
        """Clip values to the feature's limits and to ten standard deviations from its mean."""
        i = self.table.names.index(name)
        feature = self.table.features[i]
        mean = feature.mean
        deviation = feature.deviation
        reach = 10.0 * deviation
        return np.clip(np.clip(values, feature.low, feature.high), mean - reach, mean + reach)


@pytest.fixture(scope="module", params=["as drawn", "2 Hz, with a gap"])
def rollout(request):
    return roll(drawn(0) if request.param == "as drawn" else blinded(drawn(0, dt=0.5), 60, 130))


def roll(episode, **kwargs):
    env = gym.make("MmWaveLoc-v0", episodes=replay(episode), **kwargs)
    observation, info = env.reset(seed=0)
    observations = [observation]
    infos = [info]
    rng = np.random.default_rng(0)
    for _ in range(len(episode)):
        observation, _, _, _, info = env.step(rng.integers(env.action_space.n))
        observations.append(observation)
        infos.append(info)
    return Rollout(episode, env.unwrapped.observation, np.array(observations), infos)


def close(values, expected, tolerance=1e-5):
    """Assert equality up to the rounding of float32."""
    assert_allclose(values, expected, rtol=tolerance, atol=tolerance)


def assert_feature(rollout, name, values, tolerance=1e-5, at=slice(None)):
    """Assert that a feature has these values ``at`` entries, clipped as by Rollout.limited."""
    close(rollout.read(name)[at], rollout.limited(name, values), tolerance)


def test_predicted_speed_is_the_speed_of_the_estimate(rollout):
    speed = [np.linalg.norm(info["estimate"][3:6]) for info in rollout.infos]
    assert_feature(rollout, "predicted speed", speed)


def test_nis_and_verdicts_describe_the_last_epoch(rollout):
    verdicts = rollout.info("accepted").astype(int) - rollout.info("rejected")
    assert_array_equal(verdicts != 0, rollout.episode.usable)
    for g, name in enumerate(GROUPS):
        nis = np.minimum(np.log1p(rollout.info("nis")[:, g]), 10.0)
        assert_feature(rollout, f"NIS {name}", nis, at=slice(1, None))
        assert_array_equal(rollout.read(f"verdict {name}")[1:], verdicts[:, g])
    assert rollout.read("NIS Doppler")[0] == 0.0 == rollout.read("verdict Doppler")[0]


def test_snr_describes_the_coming_epoch(rollout):
    for a in range(3):
        visible = rollout.episode.usable[:, a]
        snr = rollout.episode.snr_db[:, a]
        coming = np.clip(np.where(visible, snr, -20.0), -20.0, 80.0)
        close(rollout.read(f"SNR anchor {a + 1}"), [*coming, -20.0])


def averages(values, keep):
    """Return exponential averages that begin at zero."""
    return list(accumulate(values, lambda a, now: keep * a + (1.0 - keep) * now, initial=0.0))


def test_doppler_spread_describes_the_coming_epoch_and_is_averaged(rollout):
    spread = np.append(rollout.episode.doppler_spread_hz / rollout.episode.hz_per_mps, 0.0)
    close(rollout.read("Doppler spread"), np.minimum(spread, 50.0))
    close(rollout.read("Doppler spread average"), averages(spread, 0.8)[1:])


@pytest.mark.parametrize("speed_mps", [0.0, 2.0, 15.0])
def test_a_missing_doppler_spread_is_replaced_by_the_mean_at_the_estimated_speed(speed_mps):
    site = blank_site(Layout())._replace(hz_per_mps=93.4)
    velocity = [0.6 * speed_mps, 0.8 * speed_mps, 0.0]
    speeds = np.full(100_000, speed_mps)
    spreads = doppler_spread(RADIOS["handset"], 93.4, speeds, np.random.default_rng(0))
    for visible, measured_hz, expected in (
        (1.0, 0.0, spreads.mean()),
        (1.0, 7.0, 7.0),
        (0.0, 0, 0),
    ):
        epoch = Epoch(1.0, [], [], [0.0, visible], [], measured_hz)
        spread_hz = with_expected_spread(epoch, velocity, site).doppler_spread_hz
        assert spread_hz == pytest.approx(expected, rel=0.03)


def test_an_snr_drop_is_how_far_the_snr_is_below_its_slow_mean(rollout):
    for a in range(3):
        mean = None
        expected = []
        visible = rollout.episode.usable[:, a]
        snr = rollout.episode.snr_db[:, a]
        for measured, now in zip(visible, snr, strict=True):
            if measured:
                mean = now if mean is None else 0.95 * mean + 0.05 * now
            expected.append(np.clip(mean - now, -20.0, 40.0) if measured else 0.0)
        close(rollout.read(f"SNR drop anchor {a + 1}")[:-1], expected)


def predictions(rollout):
    """Yield each epoch and the state predicted for it."""
    for t, info in enumerate(rollout.infos[:-1]):
        x = info["estimate"].copy()
        if t:
            x[:3] += x[3:6] * rollout.dt
        yield t, x


def test_distances_are_measured_from_the_predicted_position(rollout):
    predicted = np.array([x[:3] for _, x in predictions(rollout)])
    for a, anchor in enumerate(rollout.episode.scene_anchors_m):
        distance = np.minimum(np.linalg.norm(predicted - anchor, axis=1), 1000.0)
        close(rollout.read(f"distance anchor {a + 1}")[:-1], distance)


def test_the_doppler_innovation_is_the_measured_minus_the_predicted_radial_velocity(rollout):
    episode = rollout.episode
    for t, x in predictions(rollout):
        expected = 0.0
        if episode.usable[t, 3]:
            step = x[:3] - episode.scene_anchors_m[0]
            radial = x[3:6] @ step / np.linalg.norm(step)
            expected = (episode.measurement[t, 12] - x[6]) / episode.hz_per_mps - radial
        assert_feature(rollout, "coming Doppler innovation", expected, 1e-4, at=t)


def ratios(rollout):
    """Yield, for each epoch, NIS / dof of all accepted groups, or None if no group was accepted."""
    for used, nis in zip(rollout.info("accepted"), rollout.info("nis"), strict=True):
        yield nis[used].sum() / DOF[used].sum() if used.any() else None


def test_gamma_is_the_windowed_mean_of_nis_over_dof(rollout):
    window = [1.0] * 10
    expected = [1.0]
    for ratio in ratios(rollout):
        if ratio is not None:
            window = [*window[1:], ratio]
        expected.append(np.clip(np.mean(window), 0.5, 2.0))
    close(rollout.read("gamma"), expected)
    close(rollout.info("gamma"), expected[1:], 1e-12)


def test_nis_averages_forget_exponentially(rollout):
    for pace, keep in (("fast", 0.6), ("slow", 0.9)):
        average = 1.0
        expected = [1.0]
        for ratio in ratios(rollout):
            if ratio is not None:
                average = keep * average + (1.0 - keep) * ratio
            expected.append(average)
        assert_feature(rollout, f"NIS {pace} average", expected)


def test_the_previous_mode_is_marked(rollout):
    ran = rollout.info("mode")
    for mode, name in enumerate(("ekf", "ukf")):
        assert_array_equal(rollout.read(f"previous mode {name}")[1:], ran == mode)


def test_lock_out_and_time_since_fix_grow_until_a_link_is_accepted(rollout):
    lockout = [0.0]
    unfixed_s = [0.0]
    for t, info in enumerate(rollout.infos[1:]):
        links = info["accepted"][:3]
        visible = rollout.episode.usable[t, :3].any()
        fixed = links.any()
        passed = (links & (info["nis"][:3] <= chi2.ppf(0.99, 4))).any()
        lockout.append(0.0 if passed else lockout[-1] + visible)
        unfixed_s.append(0.0 if fixed else unfixed_s[-1] + (rollout.dt if t else 0.0))
    assert_feature(rollout, "lock-out", lockout)
    assert_feature(rollout, "time since fix", unfixed_s)


def corrections(rollout):
    """Yield, for each epoch, how the update changed position and velocity.

    A change has two components: along and across (to the left of) the predicted motion.
    """
    for (_, x), info in zip(predictions(rollout), rollout.infos[1:], strict=True):
        velocity = x[3:5]
        ahead = velocity / np.sqrt(velocity @ velocity + 1e-6)
        axes = np.array([ahead, [-ahead[1], ahead[0]]])
        yield axes @ (info["estimate"][:2] - x[:2]), axes @ (info["estimate"][3:5] - velocity)


def test_coming_features_equal_the_results_of_the_chosen_mode_in_the_next_step(rollout):
    variance = rollout.read("position variance")[1:]
    for t, changes in enumerate(corrections(rollout)):
        info = rollout.infos[t + 1]
        visible = rollout.episode.usable[t]
        name = ("ekf", "ukf")[info["mode"]]
        mean_nis = info["nis"][visible].sum() / max(DOF[visible].sum(), 1)
        expected = {"NIS": np.log1p(mean_nis)}
        if name == "ukf":  # only the last mode has an NIS feature for each group
            expected |= {f"NIS {group}": np.log1p(info["nis"][g]) for g, group in enumerate(GROUPS)}
        for part, value in expected.items():
            assert_feature(rollout, f"coming {part} {name}", value, at=t)
        assert rollout.read(f"coming rejected {name}")[t] == info["rejected"][:3].sum()
        coming = f"coming variance {name}"
        both = rollout.limited("position variance", rollout.read(coming)[t])
        close(both, rollout.limited(coming, variance[t]), 1e-4)
        for of, change in zip(("position", "velocity"), changes, strict=True):
            for way, value in zip(("along", "across"), change, strict=True):
                feature = f"coming {of} correction {way} {name}"
                assert_feature(rollout, feature, value, 1e-4, at=t)


def test_corrections_are_exponential_averages(rollout):
    steps = np.array([position for position, _ in corrections(rollout)])
    for way, values in zip(("along", "across"), steps.T, strict=True):
        assert_feature(rollout, f"correction {way}", averages(values, 0.8), 1e-4)


def test_preferences_are_averages_of_the_log_likelihood_difference(rollout):
    difference = rollout.read("coming log-likelihood ekf")  # clipped at 30 nats
    for pace, keep in (("fast", 0.6), ("slow", 0.85)):
        close(rollout.read(f"preference {pace} ekf"), averages(difference, keep)[1:], 1e-4)
    assert (np.abs(difference) <= 30.0).all() and (difference != 0.0).any()


def test_odometry_speed_is_measured_if_visible_and_otherwise_predicted():
    done = roll(drawn(0, odometry=True), modes=["ekf"])
    visible = done.episode.usable[:, -1]
    speed = done.episode.measurement[:, 13]
    assert visible.any() and not visible.all()
    predicted = done.read("predicted speed")
    expected = np.clip(np.where(visible, speed, predicted[:-1]), 0.0, 50.0)
    close(done.read("odometry speed"), [*expected, predicted[-1]])
