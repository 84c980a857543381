"""Effects of the channel on the links: shadowing, blockage, multipath and detection.

Like the filters, the channel is written as functions of plain numbers, so that it can be compiled
to simulate eight episodes at once on SIMD lanes.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import DECIBEL, Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import (
    Number,
    Numbers,
    Vector,
    clip,
    exp,
    log,
    maximum,
    sqrt,
    where,
)
from mmwave_env.numerics.pytree import select
from mmwave_env.numerics.random import Dice


class SpellParams(NamedTuple):
    """Parameters of a link's spells (periods of blockage or multipath) and of their biases."""

    end: Number  # probability that a spell ends within a step
    # constant_m, mean_m: a range bias is constant_m plus an exponential variate with mean mean_m
    constant_m: Number
    mean_m: Number
    angle_rad: Number  # standard deviation of the angle biases


class Channel(NamedTuple):
    """The channel's parameters for a fixed time step, derived from a radio and a scene."""

    offset_db: Numbers  # (L,) SNR of each link at 1 m
    # shadowing_db, correlation: standard deviation of shadowing, and its correlation over a step
    shadowing_db: Number
    correlation: Number
    blockage: SpellParams
    multipath: SpellParams
    # blockage_scale, blockage_base, blockage_per_m, blockage_limit, blockage_loss_db: see
    # :class:`~mmwave_env.models.radio.Radio`
    blockage_scale: Number
    blockage_base: Number
    blockage_per_m: Number
    blockage_limit: Number
    blockage_loss_db: Number
    # multipath_onset, outage_onset, outage_end: probabilities of these events within a step
    multipath_onset: Number
    outage_onset: Number
    outage_end: Number
    # detection_snr_db, detection_slope_db: parameters of the logistic probability of detection
    detection_snr_db: Number
    detection_slope_db: Number
    # floor_variance, bound_variance: (rows,) from :meth:`~mmwave_env.models.radio.Radio.variances`
    floor_variance: Numbers
    bound_variance: Numbers
    spread_gain_hz: Number  # Doppler spread per m/s of speed
    spread_sigma: Number  # standard deviation of the logarithm of a random factor on the spread
    spread_floor_hz: Number  # |N(0, 1)| times this number is added to the spread
    odometry_slowest_mps: Number  # speed below which odometry is missing


def channel_of(radio: Radio, scene: Scene, layout: Layout, dt: float) -> Channel:
    """Return the channel of a radio in a scene, for steps of ``dt`` seconds."""
    floor, bound = radio.variances(scene, layout)
    loss = 32.4 + 20.0 * math.log10(scene.carrier_hz / 1e9)  # 3GPP TR 38.901, UMi, at 1 m
    at_1_m = radio.snr_db(-loss, scene.bandwidth_hz)
    blockage_end = -math.expm1(-dt / radio.blockage_mean_s)
    multipath_end = -math.expm1(-dt / radio.multipath_mean_s)
    return Channel(
        offset_db=[at_1_m] + [at_1_m - radio.reflection_loss_db] * (layout.anchors - 1),
        correlation=radio.shadowing_correlation**dt,
        blockage=SpellParams(blockage_end, 0.0, radio.blockage_range_m, radio.blockage_angle_rad),
        multipath=SpellParams(multipath_end, *radio.multipath_range_m, radio.multipath_angle_rad),
        blockage_per_m=radio.blockage_per_100m / 100.0,
        multipath_onset=-math.expm1(-dt * radio.multipath_rate_hz),
        outage_onset=-math.expm1(-dt * radio.outage_rate_hz),
        outage_end=-math.expm1(-dt / radio.outage_mean_s),
        floor_variance=floor,
        bound_variance=bound,
        spread_gain_hz=radio.spread_gain * scene.hz_per_mps,
        spread_floor_hz=radio.spread_floor_mps * scene.hz_per_mps,
        **{name: value for name, value in vars(radio).items() if name in Channel._fields},
    )


class Spell(NamedTuple):
    """A spell of blockage or multipath on one link."""

    on: Number  # 1 while the spell lasts, else 0
    bias: Numbers  # (4,) biases of the link's rows (m, rad), drawn when the spell begins


class ChannelState(NamedTuple):
    """The state of the channel between two epochs."""

    shadowing: Numbers  # (L,) shadowing, in units of its standard deviation
    # blockage, multipath: (L,) spell of each link
    blockage: list[Spell]
    multipath: list[Spell]
    outage: Number  # 1 while all links are lost, else 0


def initial_state(anchors: int) -> ChannelState:
    """Return the state of the channel before the first epoch."""
    still = Spell(0.0, [0.0] * 4)
    return ChannelState([0.0] * anchors, [still] * anchors, [still] * anchors, 0.0)


class SpellDraws(NamedTuple):
    """Random numbers for a link's spell in an epoch."""

    uniform: Number  # in [0, 1)
    excess: Number  # exponential with mean 1, for the range bias
    angles: Numbers  # (3,) standard normals, for the angle biases


def _draw(dice: Dice, anchors: int) -> tuple[Numbers, list[list[SpellDraws]], Number, Numbers]:
    """Draw the random numbers for the links of ``anchors`` anchors in an epoch.

    Returns:
        Standard normals (L,) for the shadowing; random numbers (2, L) for blockage and multipath;
        a number in [0, 1) for the outage; numbers (L,) in [0, 1) for the detection.
    """

    def each(draw: Callable[[], Number]) -> Numbers:
        return [draw() for _ in range(anchors)]

    both = range(2)
    shadowing = each(dice.normal)
    uniforms = [each(dice.uniform) for _ in both]
    outage = dice.uniform()
    excess = [each(dice.exponential) for _ in both]
    angles = [each(lambda: [dice.normal() for _ in range(3)]) for _ in both]
    spells = [list(map(SpellDraws, *parts)) for parts in zip(uniforms, excess, angles, strict=True)]
    return shadowing, spells, outage, each(dice.uniform)


class Reception(NamedTuple):
    """The effects of the channel on the links in an epoch."""

    snr_db: Numbers  # (L,) SNR of each link
    detected: Numbers  # (L,) 1 if the link is detected, else 0
    bias: list[Numbers]  # (L, 4) biases added to the rows of each link
    doppler_spread_hz: Number


def spell_goes_on(on: Number, uniform: Number, onset: Number, end: Number) -> Number:
    """Return 1 if a spell is on after this step, else 0; ``on`` is its state before the step."""
    return where(on > 0.5, where(uniform < end, 0.0, 1.0), where(uniform < onset, 1.0, 0.0))


def _next_spell(
    before: Spell, params: SpellParams, is_first: Number, onset: Number, draws: SpellDraws
) -> Spell:
    """Return a spell's state one epoch later; a spell that begins gets new biases."""
    was_on = where(is_first, 0.0, before.on)
    on = spell_goes_on(was_on, draws.uniform, onset, params.end)
    angles = [params.angle_rad * a for a in draws.angles]
    drawn = [params.constant_m + params.mean_m * draws.excess, *angles]
    return Spell(on, select(was_on > 0.5, before.bias, drawn))


def channel_epoch(
    channel: Channel,
    before: ChannelState,
    is_first: Number,
    dice: Dice,
    distance: Vector,
    speed: Number,
) -> tuple[ChannelState, Reception]:
    """Simulate one epoch of the channel between the anchors and a user.

    The user is at distances (L,), m, from the anchors and moves at a speed, m/s. In the episode's
    first epoch (``is_first``), shadowing and blockages have their stationary distributions, and
    there is no multipath or outage. Other epochs start from the state ``before``.
    """
    c = channel
    normals, (blockage, multipath), uniform, detection = _draw(dice, len(distance))
    rho = c.correlation
    innovation = sqrt(1.0 - rho * rho)
    state = ChannelState([], [], [], 0.0)
    reception = Reception([], [], [], 0.0)
    onset = where(is_first, 0.0, c.outage_onset)
    was_out = where(is_first, 0.0, before.outage)
    outage = spell_goes_on(was_out, uniform, onset, c.outage_end)
    for a, d in enumerate(distance):
        moved = rho * before.shadowing[a] + innovation * normals[a]
        shadow = where(is_first, normals[a], moved)
        chance = c.blockage_base + c.blockage_per_m * d
        chance = c.blockage_scale * where(chance < c.blockage_limit, chance, c.blockage_limit)
        onset = c.blockage.end * chance / maximum(1.0 - chance, 1e-9)
        onset = where(is_first, chance, onset)
        blocked = _next_spell(before.blockage[a], c.blockage, is_first, onset, blockage[a])
        onset = where(is_first, 0.0, c.multipath_onset)
        reflected = _next_spell(before.multipath[a], c.multipath, is_first, onset, multipath[a])
        snr = c.offset_db[a] - (2.1 / DECIBEL) * log(d) + c.shadowing_db * shadow
        snr = snr - c.blockage_loss_db * blocked.on
        odds = exp(clip((c.detection_snr_db - snr) / c.detection_slope_db, -500.0, 500.0))
        state.shadowing.append(shadow)
        state.blockage.append(blocked)
        state.multipath.append(reflected)
        reception.snr_db.append(snr)
        detected = where(detection[a] * (1.0 + odds) < 1.0, 1.0 - outage, 0.0)
        reception.detected.append(detected)
        biases = zip(blocked.bias, reflected.bias, strict=True)
        reception.bias.append([blocked.on * u + reflected.on * v for u, v in biases])
    scatter = exp(c.spread_sigma * dice.normal())
    normal = dice.normal()
    floor = c.spread_floor_hz * maximum(normal, -1.0 * normal)
    spread = c.spread_gain_hz * speed * scatter + floor
    return state._replace(outage=outage), reception._replace(doppler_spread_hz=spread)
