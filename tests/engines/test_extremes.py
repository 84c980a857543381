"""Tests that inputs within models.envelope give sound beliefs and other inputs are refused."""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, product
from types import NoneType
from typing import Annotated, get_args, get_origin

import numpy as np
import pytest

from mmwave_env.engines.engine import tracker_of
from mmwave_env.env import MmWaveLocEnv
from mmwave_env.filters.bank import named_modes
from mmwave_env.io.records import Bound, hints_of
from mmwave_env.models import envelope
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import SCENES, Wall
from mmwave_env.world.episode import Episode
from mmwave_env.world.mobility import MOBILITIES
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import drawn, packed, street_source, unpacked
from tests.paths import ROOT
from tests.refusals import refuses

ASIDE = 0.01  # tested values differ from a limit of their bound by this share of the limit
FAR = (1e30, 1e150, 1e300, np.nan)  # without inf: an infinite sigma means a missing row
SEEDS = (0, 5)  # seeds of the episodes that get extreme values
NOISES = ("sigma_p", "sigma_v", "sigma_pz", "sigma_vz", "sigma_b_mps")


@dataclass(frozen=True)
class Quantity:
    """Quantity that the envelope bounds, with a function that sets its value in an episode."""

    name: str
    bound: Bound
    put: Callable[[Episode, float], Episode]

    def within(self):
        """Return a value just within each end of the bound, and 0 itself for an end of 0."""
        return [end * (1.0 - out) for end, out in self._ends()]

    def beyond(self):
        return [end * (1.0 + out) if end else -1.0 for end, out in self._ends()] + [*FAR]

    def _ends(self):
        least = self.bound.least
        most = self.bound.most
        return [(least, ASIDE * (1 if least < 0 else -1)), (most, ASIDE)]


def setting(field, rows):
    """Return a function that sets elements of an episode's field to a value, in every epoch."""

    def put(episode, value):
        changed = getattr(episode, field).copy()
        changed[..., rows] = value
        return replace(episode, **{field: changed})

    return put


def prior_sigma(states):
    def put(episode, value):
        P = episode.prior_covariance.copy()
        P[states, states] = value * value if abs(value) < 1e150 else value  # P is diagonal
        return replace(episode, prior_covariance=P)

    return put


def steps(episode, value):
    return replace(episode, time_s=np.arange(len(episode)) * value)


def shifted(episode, value):
    """Shift the coordinates of anchors and user, as if a national grid were used."""
    prior = episode.prior_mean.copy()
    prior[:3] += value
    return replace(episode, scene_anchors_m=episode.scene_anchors_m + value, prior_mean=prior)


ANGLES = [i for i in range(12) if i % 4]
DOPPLER = 12
QUANTITIES = (
    Quantity("step", envelope.STEP_S, steps),
    Quantity("position of anchors and user", envelope.POSITION_M, shifted),
    Quantity("prior position", envelope.POSITION_M, setting("prior_mean", slice(3))),
    Quantity("prior velocity", envelope.VELOCITY_MPS, setting("prior_mean", slice(3, 6))),
    Quantity("prior bias", envelope.BIAS_HZ, setting("prior_mean", slice(6, 7))),
    Quantity("prior sigma of position", envelope.POSITION_SIGMA_M, prior_sigma([0, 1, 2])),
    Quantity("prior sigma of one axis", envelope.POSITION_SIGMA_M, prior_sigma([0])),
    Quantity("prior sigma of velocity", envelope.VELOCITY_SIGMA_MPS, prior_sigma([3, 4, 5])),
    Quantity("prior sigma of bias", envelope.BIAS_SIGMA_HZ, prior_sigma([6])),
    Quantity("sigma of ranges", envelope.RANGE_SIGMA_M, setting("sigma", [0, 4, 8])),
    Quantity("sigma of angles", envelope.ANGLE_SIGMA_RAD, setting("sigma", ANGLES)),
    Quantity("sigma of azimuths", envelope.ANGLE_SIGMA_RAD, setting("sigma", [1, 3, 5, 7, 9, 11])),
    Quantity("sigma of Doppler", envelope.DOPPLER_SIGMA_HZ, setting("sigma", [DOPPLER])),
    Quantity(
        "Doppler spread", envelope.DOPPLER_SPREAD_HZ,
        lambda e, value: replace(e, doppler_spread_hz=np.full(len(e), value)),
    ),
    Quantity("Hz per m/s", envelope.HZ_PER_MPS, lambda e, value: replace(e, hz_per_mps=value)),
)  # fmt: skip
LOUD = dict.fromkeys(NOISES, envelope.PROCESS_NOISE.most)
CHANGES = (  # sets of changes that are made to each mode
    {}, {"gate": None}, dict.fromkeys(NOISES, 0.0), LOUD, LOUD | {"gate": None},
    {"spread_gain": envelope.PROCESS_NOISE.most},
    {"acceleration_mps2": -100.0},
)  # fmt: skip


@pytest.fixture(scope="module")
def episode():
    return drawn(3, epochs=5)


def sound(x, P):
    """Return a mask (n,) of tracks with finite x (n, T, 7) and positive definite P (n, T, 28)."""
    finite = np.isfinite(np.concatenate([x, P], axis=2)).all(axis=(1, 2))
    full = unpacked(np.where(finite[:, None, None], P, packed(np.eye(7))))
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", full), 1e-300))
    least = np.linalg.eigvalsh(full / scale[..., :, None] / scale[..., None, :])[..., 0]
    return finite & (least > -1e-9).all(axis=1)  # eigenvalues have rounding errors


@pytest.mark.slow
@pytest.mark.parametrize("name", named_modes())
def test_beliefs_are_sound_if_one_or_two_quantities_are_at_the_ends_of_their_bounds(name):
    single = [(quantity, value) for quantity in QUANTITIES for value in quantity.within()]
    pairs = [pair for pair in combinations(single, 2) if pair[0][0].put is not pair[1][0].put]
    ordinary = {seed: drawn(seed, epochs=30) for seed in SEEDS}
    cases = {}
    for seed, changes in product(SEEDS, [*zip(single), *pairs]):
        changed = ordinary[seed]
        for quantity, value in changes:
            changed = quantity.put(changed, value)
        did = ", ".join(f"{quantity.name} {value:g}" for quantity, value in changes)
        cases[f"{did}, seed {seed}"] = changed
    assert len(cases) > 400 * len(SEEDS)
    for change in CHANGES:
        mode = replace(named_modes()[name], **change)
        good = sound(**tracker_of(mode, [*cases.values()]).run("x", "P"))
        assert [case for case, fine in zip(cases, good, strict=True) if not fine] == [], change


def test_unsound_tracks_are_detected():
    x = np.zeros((3, 2, 7))
    P = np.tile(packed(np.eye(7)), (3, 2, 1))
    P[0, 1, 1] = 1.1  # a correlation above 1
    x[1, 0, 6] = np.nan
    assert sound(x, P).tolist() == [False, False, True]


BEYOND = [(quantity, value) for quantity in QUANTITIES for value in quantity.beyond()]


@pytest.mark.parametrize(
    ("quantity", "value"), BEYOND, ids=[f"{quantity.name} {value:g}" for quantity, value in BEYOND]
)
def test_an_episode_beyond_the_envelope_is_refused(quantity, value, episode):
    with np.errstate(all="ignore"), refuses("of episode"):
        quantity.put(episode, value)


def numbers_of(record):
    """Yield each numeric field's name, its bound, and a function from a number to a field value."""
    for name, hint in hints_of(type(record)).items():
        hint = next(iter(get_args(hint)), hint) if NoneType in get_args(hint) else hint
        inside = get_args(hint)[:1] if get_origin(hint) is Annotated else ()
        parts = get_args(next(iter(inside), hint))
        if inside and isinstance(get_args(hint)[1], Bound):
            yield name, get_args(hint)[1], lambda value: value
        elif parts and get_origin(parts[0]) is Annotated and parts[-1] is not ...:
            count = len(parts)
            bound = get_args(parts[0])[1]
            yield name, bound, lambda value, count=count: (value,) * count


STREET = SCENES["street"]
RECORDS = {  # name -> settings, function from settings to arguments of an environment
    "radio": (RADIOS["standard"], lambda radio: {"radio": radio}),
    "scene": (STREET, lambda scene: {"scene": scene}),
    "streets": (STREET.streets, lambda streets: {"scene": replace(STREET, streets=streets)}),
    "streets drawn": (RandomScene(), lambda scene: {"scene": scene}),
    "mode": (named_modes()["ukf"], lambda mode: {"modes": [mode, "ekf"]}),
    "gait": (MOBILITIES["vehicle"].phases[0].gaits[0], lambda gait: moving(gaits=(gait,))),
    "limits": (MOBILITIES["vehicle"].phases[0].limits, lambda limits: moving(limits=limits)),
}
FIELDS = [
    pytest.param(
        record,
        *number,
        id=f"{record} {number[0]}",
        marks=[pytest.mark.slow] if record == "streets drawn" else [],  # each case compiles
    )
    for record, (of, _) in RECORDS.items()
    for number in numbers_of(of)
]


def moving(**changes):
    vehicle = MOBILITIES["vehicle"]
    return {"scenario": replace(vehicle, phases=(replace(vehicle.phases[0], **changes),))}


@pytest.mark.parametrize(("record", "name", "bound", "shape"), FIELDS)
def test_the_error_names_a_setting_that_is_far_beyond_its_bounds(record, name, bound, shape):
    of, _ = RECORDS[record]
    for value in (-1e300, 1e300, np.nan, -(10**200), 10**200):
        if value < 0 or bound.most != np.inf:  # durations may be infinite
            with refuses(name):
                replace(of, **{name: shape(value)})


def test_the_page_states_all_bounds():
    page = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    numbers = dict(re.findall(r"^\| `([A-Z_]+)` \|.*\| (.+) \|$", page, re.MULTILINE))
    bounds = {name: b.expected for name, b in vars(envelope).items() if isinstance(b, Bound)}
    assert {name: f"a number from {text}" for name, text in numbers.items()} == bounds


def test_a_radio_and_a_scene_that_together_exceed_the_envelope_are_refused():
    far = replace(STREET, walls=(Wall((1.0, 0.0), 9e6),))
    loud = replace(RADIOS["standard"], spread_gain=90.0)
    for scene, radio, name in (
        (far, RADIOS["high"], "scene_anchors_m of episode 'high in street'"),
        (STREET, loud, "doppler_spread_hz of episode 'standard in street'"),
    ):
        with refuses(name):
            SimulatedSource(scene, radio)


@pytest.mark.parametrize(
    ("record", "name", "bound", "shape"), [field for field in FIELDS if field.values[0] != "mode"]
)
def test_a_setting_at_its_bounds_gives_sound_beliefs_or_is_refused(record, name, bound, shape):
    of, arguments = RECORDS[record]
    for value in (bound.least, bound.most):
        env = None
        with suppress(ValueError):  # the value may contradict other settings
            changed = arguments(replace(of, **{name: shape(value)}))
            env = MmWaveLocEnv(episode_steps=24, dt=0.5, **changed)
        if env is not None:
            env.reset(seed=0)
            for k in range(24):
                observation, reward, *_, info = env.step(k % 2)
                assert np.isfinite([reward, info["nees"], *info["estimate"], *observation]).all()
            assert "nonfinite_beliefs" not in info


@pytest.mark.parametrize("dt", [0.0, 1e-9, 61.0, 1e12, np.inf, np.nan])
def test_a_time_step_beyond_its_bounds_is_refused_before_anything_is_drawn(dt):
    with refuses("dt"):
        street_source(dt=dt)
