"""The observation: one table makes space and values, and the values say what they promise."""

import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from scipy.stats import chi2

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env import observation
from mmwave_env.engines.env_engine import Engine
from mmwave_env.env import MmWaveLocEnv
from mmwave_env.filters.bank import best_bank
from mmwave_env.filters.mode_files import modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.envelope import DOPPLER_SPREAD_HZ
from mmwave_env.models.measurement import Layout
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.observation import BELIEFS, Observation, feature_scales
from mmwave_env.reward import TrackingReward
from mmwave_env.world.simulated import SimulatedSource

PIPELINES = {
    "default": Pipeline(modes_from(None), Layout()),
    "odometry": Pipeline(modes_from(None), Layout(odometry=True)),
    "one anchor": Pipeline(modes_from(["ukf"]), Layout(1)),
    "three modes": Pipeline(modes_from(["ekf", "ukf", "ckf"]), Layout(5, True), planar=True),
}
COMING = ("coming ", "preference ")

every_pipeline = pytest.mark.parametrize("pipeline", PIPELINES.values(), ids=PIPELINES)
every_kind = pytest.mark.parametrize("kind", ["full", "prior"])


def names(table):
    return [feature.name for feature in table.features]


def draw(seed, radio="handset", **changes):
    source = SimulatedSource(SCENES["street"], RADIOS[radio], **changes)
    return source.sample(np.random.default_rng(seed))


def replay(episode):
    """An episode source that knows one episode."""
    return SimpleNamespace(
        layout=episode.layout, epochs=len(episode), name=episode.name, sample=lambda rng: episode
    )


def blinded(episode, first, last):
    """The same with nothing measured from epoch ``first`` to before ``last``."""
    visible = episode.visible.copy()
    visible[first:last] = False
    return replace(episode, visible=visible)


# --- the table


@every_kind
@every_pipeline
def test_names_are_unique(pipeline, kind):
    table = Observation(pipeline, kind)
    assert len(set(names(table))) == len(table) == len(table.features)


@every_kind
@every_pipeline
def test_the_table_makes_the_space(pipeline, kind):
    table = Observation(pipeline, kind)
    space = table.space
    assert isinstance(space, spaces.Box) and space.dtype == np.float32
    assert space.shape == (len(table),)
    mean, deviation = np.array(table.scales).T
    limits = np.array([(f.low, f.high) for f in table.features]).T
    bounds = np.clip((limits - mean) / deviation, -10.0, 10.0)
    np.testing.assert_allclose([space.low, space.high], bounds, rtol=1e-6)
    assert (space.low < space.high).all() and space.is_bounded()
    assert (deviation > 0.0).all() and all(f.meaning for f in table.features)


@every_pipeline
def test_prior_leaves_out_how_modes_see_the_coming_epoch(pipeline):
    full, prior = names(Observation(pipeline)), names(Observation(pipeline, "prior"))
    assert prior == [name for name in full if not name.startswith(COMING)]
    assert len(prior) < len(full)


@every_kind
@every_pipeline
def test_the_documented_table_lists_every_feature_in_order(pipeline, kind):
    table = Observation(pipeline, kind)
    head, rule, *rows = table.table().splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [(int(number), name) for number, name, *_ in cells] == list(enumerate(names(table)))
    assert all(len(row) == 8 == head.count("|") - 1 == rule.count("|") - 1 for row in cells)


def test_the_environment_s_docstring_holds_the_table():
    documented = MmWaveLocEnv.__doc__.replace("\n    ", "\n")
    assert Observation(PIPELINES["default"]).table() in documented


def observed(table, values):
    """Observations (n, features) that show these values of every feature (n,)."""
    mean, deviation = np.array(table.scales).T
    return ((np.asarray(values)[:, None] - mean) / deviation).astype(np.float32)


@every_pipeline
@pytest.mark.parametrize("beliefs", BELIEFS)
def test_reading_a_feature_inverts_its_standardization(pipeline, beliefs):
    table = Observation(pipeline, beliefs=beliefs)
    values = np.random.default_rng(0).uniform(-40.0, 40.0, 1000)
    observations = observed(table, values)
    for i, feature in enumerate(table.features):
        read = table.read(observations, feature.name)
        assert read.dtype == np.float64
        known = np.spacing(np.abs(observations[:, i])) * table.scales[i].deviation
        assert (np.abs(read - values) <= 2.0 * known + 1e-12).all()
        assert table.read(observations[0], feature.name) == read[0]


@pytest.mark.parametrize("beliefs", BELIEFS)
def test_whole_numbers_read_exactly(beliefs):
    table = Observation(PIPELINES["odometry"], beliefs=beliefs)
    whole = np.arange(-30.0, 31.0)
    for feature in table.features:
        read = table.read(observed(table, whole), feature.name)
        np.testing.assert_array_equal(read, whole, err_msg=feature.name)


# --- the constants

OWN = {
    "one anchor": Pipeline(modes_from(["ukf"]), Layout(1)),
    "five anchors and odometry": Pipeline(modes_from(None), Layout(5, True)),
    "five modes": Pipeline(best_bank().modes, Layout()),
    "names of one's own": Pipeline((Mode("slow feet"), Mode("fast wheels")), Layout(2), True),
}


@pytest.mark.parametrize("beliefs", BELIEFS)
@pytest.mark.parametrize("pipeline", OWN.values(), ids=OWN)
def test_every_feature_of_whatever_task_is_of_a_kind_in_the_table(pipeline, beliefs):
    table = Observation(pipeline, beliefs=beliefs)
    kinds = {feature.kind for feature in table.features}
    assert kinds <= feature_scales().keys()
    assert all(math.isfinite(mean) and deviation > 0.0 for mean, deviation in table.scales)
    assert all("1" not in kind and "feet" not in kind and "ukf" not in kind for kind in kinds)


def test_the_table_has_no_kind_that_no_feature_is_of():
    tables = [Observation(PIPELINES["odometry"], beliefs=beliefs) for beliefs in BELIEFS]
    kinds = {feature.kind for table in tables for feature in table.features}
    assert kinds == feature_scales().keys()


def test_a_kind_that_was_not_measured_is_refused(monkeypatch):
    known = {kind: scale for kind, scale in feature_scales().items() if kind != "gamma"}
    monkeypatch.setattr(observation, "feature_scales", lambda: known)
    with pytest.raises(KeyError, match="'gamma'.*feature_scales.json"):
        Observation(PIPELINES["default"])


def test_an_unknown_feature_lists_the_valid_ones():
    table = Observation(PIPELINES["default"], "prior")
    with pytest.raises(KeyError, match="'color'.*predicted speed.*time since fix"):
        table.read(np.zeros((1, len(table)), np.float32), "color")


def test_an_unknown_kind_lists_the_valid_ones():
    with pytest.raises(ValueError, match="'none'.*full.*prior"):
        Observation(PIPELINES["default"], "none")


# --- the digest


@every_kind
@every_pipeline
def test_tables_alike_have_one_digest(pipeline, kind):
    table = Observation(pipeline, kind)
    assert table.digest == Observation(replace(pipeline), kind).digest
    assert (table.kind, table.modes) == (kind, pipeline.modes)
    retuned = tuple(replace(mode, sigma_v=mode.sigma_v + 1.0) for mode in pipeline.modes)
    assert table.digest == Observation(replace(pipeline, modes=retuned), kind).digest


def test_tables_that_differ_have_other_digests():
    tables = [Observation(p, kind) for p in PIPELINES.values() for kind in ("full", "prior")]
    renamed = [replace(mode, name=f"my {mode.name}") for mode in PIPELINES["default"].modes]
    tables.append(Observation(replace(PIPELINES["default"], modes=tuple(renamed))))
    assert len({table.digest for table in tables}) == len(tables)


@pytest.mark.parametrize("place", [0, 7, -1])
@pytest.mark.parametrize("attribute", ["name", "meaning", "unit", "low", "high"])
def test_every_attribute_of_every_feature_counts(place, attribute):
    table = Observation(PIPELINES["default"])
    before, feature = table.digest, table.features[place]
    table.features[place] = replace(feature, **{attribute: getattr(feature, attribute) * 2 or 3.0})
    assert (table.digest == before) == (table.features[place] == feature)
    table.features[place] = feature
    assert table.digest == before


@pytest.mark.parametrize("place", [0, 7, -1])
@pytest.mark.parametrize("constant", ["mean", "deviation"])
def test_the_constants_of_every_feature_count(place, constant):
    table = Observation(PIPELINES["default"])
    before, scale = table.digest, table.scales[place]
    table.scales[place] = scale._replace(**{constant: getattr(scale, constant) + 1.0})
    assert table.digest != before


# --- the values


def absurd(episode):
    """Measurements, SNR and spread that no radio gives, and a prior from another planet."""
    measurement = episode.measurement.copy()
    measurement[::7] *= 1e6
    return replace(
        episode,
        measurement=measurement,
        snr_db=np.where(np.arange(len(episode))[:, None] % 5, episode.snr_db, 1e9),
        doppler_spread_hz=np.full(len(episode), DOPPLER_SPREAD_HZ.most),
        prior_mean=episode.prior_mean * 1e3,
    )


def test_values_are_finite_and_within_their_bounds_whatever_happens():
    episodes = [draw(seed) for seed in range(12)]
    episodes += [blinded(draw(seed), first, 200) for seed, first in ((12, 0), (13, 0), (14, 50))]
    episodes += [blinded(draw(15), 50, 190), absurd(draw(16)), absurd(blinded(draw(17), 0, 9))]
    engine = Engine(PIPELINES["default"], len(episodes), TrackingReward())
    engine.reset(episodes)
    space = engine.observation.space
    rng = np.random.default_rng(0)
    for _ in range(200):
        observations = engine.observations()
        assert observations.dtype == np.float32
        assert np.isfinite(observations).all()
        assert all(space.contains(one) for one in observations)
        engine.step(rng.integers(2, size=len(episodes)))


class Rollout(NamedTuple):
    """An episode in the default environment, modes at random.

    Observations and infos have 201 entries: what ``reset`` and every step returned.
    """

    episode: object
    table: Observation
    observations: np.ndarray
    infos: list

    def read(self, name):
        return self.table.read(self.observations, name)

    def limited(self, name, values):
        """Values of a feature as it shows them: within its limits, and ten deviations."""
        i = names(self.table).index(name)
        feature, (mean, deviation) = self.table.features[i], self.table.scales[i]
        reach = 10.0 * deviation
        return np.clip(np.clip(values, feature.low, feature.high), mean - reach, mean + reach)


@pytest.fixture(scope="module", params=["as drawn", "with a gap"])
def rollout(request):
    episode = draw(0)
    if request.param == "with a gap":
        episode = blinded(episode, 60, 130)
    return roll(episode)


def roll(episode, **kwargs):
    env = gym.make("MmWaveLoc-v0", episodes=replay(episode), **kwargs)
    observation, info = env.reset(seed=0)
    observations, infos = [observation], [info]
    rng = np.random.default_rng(0)
    for _ in range(len(episode)):
        observation, _, _, _, info = env.step(rng.integers(env.action_space.n))
        observations.append(observation)
        infos.append(info)
    return Rollout(episode, env.unwrapped.observation, np.array(observations), infos)


def close(found, expected, tolerance=1e-5):
    """Equal up to the rounding of float32."""
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


def test_predicted_speed_is_the_estimate_s(rollout):
    speed = [np.linalg.norm(info["estimate"][3:6]) for info in rollout.infos]
    close(rollout.read("predicted speed"), rollout.limited("predicted speed", speed))


def test_nis_and_verdicts_are_those_of_the_last_epoch(rollout):
    for g, name in enumerate(["anchor 1", "anchor 2", "anchor 3", "Doppler"]):
        nis = [info["nis"][g] for info in rollout.infos[1:]]
        mean, deviation = feature_scales()[f"NIS {'Doppler' if name == 'Doppler' else 'link'}"]
        most = min(10.0, mean + 10.0 * deviation)  # farther off is not shown
        close(rollout.read(f"NIS {name}")[1:], np.minimum(np.log1p(nis), most))
        verdict = [
            int(info["accepted"][g]) - int(info["rejected"][g]) for info in rollout.infos[1:]
        ]
        np.testing.assert_array_equal(rollout.read(f"verdict {name}")[1:], verdict)
        seen = rollout.episode.usable[:, g]
        np.testing.assert_array_equal(np.array(verdict) != 0, seen)
    assert rollout.read("NIS Doppler")[0] == 0.0 == rollout.read("verdict Doppler")[0]


def test_snr_is_that_of_the_coming_epoch(rollout):
    for a in range(3):
        seen, snr = rollout.episode.usable[:, a], rollout.episode.snr_db[:, a]
        coming = np.clip(np.where(seen, snr, -20.0), -20.0, 80.0)
        close(rollout.read(f"SNR anchor {a + 1}"), [*coming, -20.0])


def test_doppler_spread_is_that_of_the_coming_epoch(rollout):
    spread = rollout.episode.doppler_spread_hz / rollout.episode.hz_per_mps
    close(rollout.read("Doppler spread"), [*np.minimum(spread, 50.0), 0.0])


def test_the_doppler_spread_is_averaged(rollout):
    average, expected = 0.0, []
    for spread in [*rollout.episode.doppler_spread_hz / rollout.episode.hz_per_mps, 0.0]:
        average = 0.8 * average + 0.2 * spread
        expected.append(average)
    close(rollout.read("Doppler spread average"), expected)


def test_an_snr_drop_is_below_the_slow_mean_of_what_was_seen(rollout):
    for a in range(3):
        mean, expected = None, []
        seen, snr = rollout.episode.usable[:, a], rollout.episode.snr_db[:, a]
        for visible, now in zip(seen, snr, strict=True):
            if visible:
                mean = now if mean is None else 0.95 * mean + 0.05 * now
            expected.append(np.clip(mean - now, -20.0, 40.0) if visible else 0.0)
        close(rollout.read(f"SNR drop anchor {a + 1}")[:-1], expected)


def predictions(rollout):
    """Epoch by epoch the state predicted for it."""
    for t, info in enumerate(rollout.infos[:-1]):
        x = info["estimate"].copy()
        x[:3] += x[3:6] * float(t > 0)
        yield t, x


def test_distances_are_those_of_the_predicted_position(rollout):
    for t, x in predictions(rollout):
        for a, anchor in enumerate(rollout.episode.scene_anchors_m):
            distance = min(np.linalg.norm(x[:3] - anchor), 1000.0)
            close(rollout.read(f"distance anchor {a + 1}")[t], distance)


def test_the_doppler_innovation_is_the_measured_minus_the_predicted_radial_velocity(rollout):
    episode = rollout.episode
    for t, x in predictions(rollout):
        expected = 0.0
        if episode.usable[t, 3]:
            step = x[:3] - episode.scene_anchors_m[0]
            radial = x[3:6] @ step / np.linalg.norm(step)
            expected = (episode.measurement[t, 12] - x[6]) / episode.hz_per_mps - radial
        name = "coming Doppler innovation"
        close(rollout.read(name)[t], rollout.limited(name, expected), 1e-4)


def test_gamma_is_the_windowed_mean_of_nis_over_dof(rollout):
    window, expected = [1.0] * 10, [1.0]
    for info in rollout.infos[1:]:
        used, dof = info["accepted"], np.array([4, 4, 4, 1])
        if used.any():
            window = [*window[1:], info["nis"][used].sum() / dof[used].sum()]
        expected.append(np.clip(np.mean(window), 0.5, 2.0))
    close(rollout.read("gamma"), expected)
    close([info["gamma"] for info in rollout.infos[1:]], expected[1:], 1e-12)


def test_nis_averages_forget_exponentially(rollout):
    for pace, keep in (("fast", 0.6), ("slow", 0.9)):
        average, expected = 1.0, [1.0]
        for info in rollout.infos[1:]:
            used, dof = info["accepted"], np.array([4, 4, 4, 1])
            if used.any():
                ratio = info["nis"][used].sum() / dof[used].sum()
                average = keep * average + (1.0 - keep) * ratio
            expected.append(average)
        name = f"NIS {pace} average"
        close(rollout.read(name), rollout.limited(name, expected))


def test_the_previous_mode_is_marked(rollout):
    ran = [info["mode"] for info in rollout.infos[1:]]
    for mode, name in enumerate(("ekf", "ukf")):
        np.testing.assert_array_equal(
            rollout.read(f"previous mode {name}")[1:], np.array(ran) == mode
        )


def test_lock_out_and_time_since_fix_count(rollout):
    lockout, unfixed_s = [0.0], [0.0]
    for t, info in enumerate(rollout.infos[1:]):
        links, seen = info["accepted"][:3], rollout.episode.usable[t, :3].any()
        fixed, passed = links.any(), (links & (info["nis"][:3] <= chi2.ppf(0.99, 4))).any()
        lockout.append(0.0 if passed else lockout[-1] + seen)
        unfixed_s.append(0.0 if fixed else unfixed_s[-1] + (1.0 if t else 0.0))
    close(rollout.read("lock-out"), rollout.limited("lock-out", lockout))
    close(rollout.read("time since fix"), rollout.limited("time since fix", unfixed_s))


def test_what_a_mode_would_make_of_the_coming_epoch_is_what_it_makes_of_it(rollout):
    dof = np.array([4, 4, 4, 1])
    for t, (before, info) in enumerate(pairwise(rollout.infos)):
        name = ("ekf", "ukf")[info["mode"]]

        def coming(what, name=name, t=t):
            return rollout.read(f"coming {what} {name}")[t]

        def limited(what, value, name=name):
            return rollout.limited(f"coming {what} {name}", value)

        seen = rollout.episode.usable[t]
        mean_nis = info["nis"][seen].sum() / max(dof[seen].sum(), 1)
        close(coming("NIS"), limited("NIS", np.log1p(mean_nis)))
        assert coming("rejected") == info["rejected"][:3].sum()
        if name == "ukf":  # the last mode: NIS of every group
            for g, group in enumerate(("anchor 1", "anchor 2", "anchor 3", "Doppler")):
                what = f"NIS {group}"
                close(coming(what), limited(what, np.log1p(info["nis"][g])))
        after = rollout.read("position variance")[t + 1]
        both = rollout.limited("position variance", coming("variance"))
        close(both, limited("variance", after), 1e-4)
        x, dt = before["estimate"], float(t > 0)
        step = info["estimate"][:2] - (x[:2] + dt * x[3:5])
        ahead = x[3:5] / np.sqrt(x[3:5] @ x[3:5] + 1e-6)
        left = np.array([-ahead[1], ahead[0]])
        faster = info["estimate"][3:5] - x[3:5]
        for of, change in (("position", step), ("velocity", faster)):
            for way, axis in (("along", ahead), ("across", left)):
                what = f"{of} correction {way}"
                close(coming(what), limited(what, change @ axis), 1e-4)


def test_corrections_are_averaged(rollout):
    along, across, expected = 0.0, 0.0, [(0.0, 0.0)]
    for t, (before, info) in enumerate(pairwise(rollout.infos)):
        x, dt = before["estimate"], float(t > 0)
        step = info["estimate"][:2] - (x[:2] + dt * x[3:5])
        ahead = x[3:5] / np.sqrt(x[3:5] @ x[3:5] + 1e-6)
        along = 0.8 * along + 0.2 * step @ ahead
        across = 0.8 * across + 0.2 * (step[1] * ahead[0] - step[0] * ahead[1])
        expected.append((along, across))
    for i, way in enumerate(("along", "across")):
        name = f"correction {way}"
        close(rollout.read(name), rollout.limited(name, np.array(expected)[:, i]), 1e-4)


def test_preferences_average_the_log_likelihood_difference(rollout):
    difference = rollout.read("coming log-likelihood ekf")  # both are clipped at 30 nats
    for pace, keep in (("fast", 0.6), ("slow", 0.85)):
        average, expected = 0.0, []
        for now in difference:
            average = keep * average + (1.0 - keep) * now
            expected.append(average)
        close(rollout.read(f"preference {pace} ekf"), expected, 1e-4)
    assert (np.abs(difference) <= 30.0).all() and (difference != 0.0).any()


def test_odometry_speed_is_measured_or_else_predicted():
    done = roll(draw(0, odometry=True), modes=["ekf"])
    seen, speed = done.episode.usable[:, -1], done.episode.measurement[:, 13]
    assert seen.any() and not seen.all()
    predicted = done.read("predicted speed")
    expected = np.clip(np.where(seen, speed, predicted[:-1]), 0.0, 50.0)
    close(done.read("odometry speed"), [*expected, predicted[-1]])
