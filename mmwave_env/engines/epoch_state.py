"""The parts that the states of environments, tracks and IMMs have in common."""

import math
from functools import reduce
from typing import Any, NamedTuple

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.memory import Memory, initial_memory
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.reward import Reward, term_names, terms_of, total
from mmwave_env.interface.signed import LastEpoch
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Site, blank_site
from mmwave_env.models.radio import Radio
from mmwave_env.numerics.linalg import dot
from mmwave_env.numerics.numbers import Number, Vector, maximum, sqrt, where
from mmwave_env.numerics.pytree import select
from mmwave_env.world.episode import Incoming, blank_incoming


class PendingEpoch(NamedTuple):
    """The parts of an epoch that are needed after the modes have run on it."""

    # dt, visible: same as in :class:`~mmwave_env.models.measurement.Epoch`
    dt: Number
    visible: list[Number]
    truth: list[Number]  # (6,) true position (m) and velocity (m/s)
    measured: Vector  # same as in :class:`~mmwave_env.models.measurement.Epoch`
    # the complete epoch if the observation is "signed" (:mod:`mmwave_env.interface.signed`)
    incoming: Any = ()


def blank_track(layout: Layout, modes: int) -> dict[str, Any]:
    """Return the fields that every state has, with their values before the first epoch."""
    incoming = blank_incoming(layout)
    site = blank_site(layout)
    return {
        "incoming": incoming,
        "site": site,
        "is_first": 1.0,
        "action": 0.0,
        "x": site.prior_x,
        "P": site.prior_P,
        "memory": initial_memory(layout, modes),
        "error": [0.0] * 3,
        "nees": 0.0,
    }


def blank_environment(
    layout: Layout, modes: int, reward: Reward, observation: Observation
) -> dict[str, Any]:
    """Return the fields that every environment's state has, with values before the first epoch."""
    track = blank_track(layout, modes)
    last = track["incoming"] if observation.kind == "signed" else ()
    truth = track["incoming"].truth
    measured = [0.0] * layout.size if layout.partial else ()
    return track | {
        "pending": PendingEpoch(0.0, [0.0] * len(layout.groups), truth, measured, last),
        "observation": [0.0] * len(observation),
        "reward": 0.0,
        "reward_terms": [0.0] * (len(term_names(reward)) + 1),
        "truth": truth,
        "distance": 0.0,
    }


def pending_of(incoming: Incoming, epoch: Epoch, observation: Observation) -> PendingEpoch:
    """Return the parts of an epoch that are still needed after the modes have run on it."""
    last = incoming if observation.kind == "signed" else ()
    return PendingEpoch(epoch.dt, epoch.visible, incoming.truth, epoch.measured, last)


def with_expected_spread(epoch: Epoch, velocity: Vector, site: Site) -> Epoch:
    """Return the epoch, with an expected Doppler spread if none was measured (value 0).

    Features need this, because 0 would tell policies that the user stands still. This expectation
    approximates the mean of :func:`~mmwave_env.models.radio.doppler_spread` for the estimated
    ``velocity`` (3,), m/s, with the default parameters of a radio. Epochs without any measurement,
    such as the blank epoch after an episode's last epoch, keep the value 0.
    """
    floor_mps = Radio.spread_floor_mps * math.sqrt(2.0 / math.pi)  # mean of |N(0, floor)|
    speed_mps = sqrt(dot(velocity, velocity))
    expected = site.hz_per_mps * (Radio.spread_gain * speed_mps + floor_mps)
    spread = epoch.doppler_spread_hz
    measured = reduce(maximum, epoch.visible)
    return epoch._replace(doppler_spread_hz=where(spread > 0.0, spread, measured * expected))


def last_of(w: Any, layout: Layout, probabilities: Vector = ()) -> LastEpoch | None:
    """Return the last epoch if the observation has signed features (residuals); else None."""
    if not w.pending.incoming:
        return None
    epoch = with_expected_spread(w.pending.incoming.epoch(layout), w.x[3:6], w.site)
    return LastEpoch(epoch, w.is_first, w.x[3:6], probabilities)


def initial_belief(
    w: Any, x: list[Number], P: list[Number], memory: Memory, pipeline: Pipeline
) -> tuple[list[Number], list[Number], Memory]:
    """Return the belief x (7,), P (28,), and the memory, with which an epoch begins.

    At the start of a track, they are the prior and a new memory; otherwise, the arguments.
    """
    blank = initial_memory(pipeline.layout, len(pipeline.modes))
    first = w.is_first > 0.5
    x = select(first, w.site.prior_x, x)
    P = select(first, w.site.prior_P, P)
    return x, P, select(first, blank, memory)


def scores(belief: Belief, truth: Vector, reward: Reward, cost: Number) -> dict[str, Any]:
    """Return the errors of a belief, its reward minus ``cost``, and the terms of the reward."""
    terms = terms_of(reward, belief, truth)
    return {
        "reward": total(terms) - cost,
        "reward_terms": [*terms.values(), 0.0 - cost],
        "error": belief.error(truth),
        "distance": belief.distance(truth),
        "nees": belief.nees(truth),
    }
