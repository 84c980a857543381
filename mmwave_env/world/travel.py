"""The true motion of users through the streets.

A traveler walks or drives along a net of streets, turns at crossings on circular arcs and waits at
red lights. It follows a gait (a target speed that is kept for a while), within limits of
acceleration, braking, lateral acceleration and jerk. Time passes in substeps of about 0.1 s.

This module draws events: a new gait, the next crossing, or the next phase (a part of an episode
with one style of moving). Between events, :mod:`mmwave_env.world.kinematics` moves the traveler.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from mmwave_env.numerics.numbers import Number, Pair, Vector, floor, maximum, where
from mmwave_env.numerics.pytree import select, tree_at
from mmwave_env.numerics.random import Dice
from mmwave_env.world.kinematics import FAR, STANDING_MPS, STILL, Net, Traveler, around, unit

FINEST_STEP_S = 0.1  # approximate length of a substep
STOPPING_S = 5.0  # time reserved at the end of a ride for braking to a standstill


class TravelGait(NamedTuple):
    """A target speed that is kept for a while."""

    # low, high: range of the speed, m/s
    low: Number
    high: Number
    mean_s: Number  # mean duration
    weight: Number  # relative frequency with which this gait is chosen


NO_GAIT = TravelGait(0.0, 0.0, 1.0, 0.0)  # never chosen, as its weight is 0


class TravelPhase(NamedTuple):
    """A part of an episode with one style of moving; it begins when the previous phase ends.

    In a plan, the first three limits are ranges (2,), from which they are drawn as the episode
    begins, and ``end`` is the range (2,) of the phase's duration, s.
    """

    # the same limits, in the same order, as in :class:`~mmwave_env.world.mobility.Limits`
    acceleration: Any
    braking: Any
    lateral: Any
    jerk: Number
    radius: Number  # radius of corners, m
    red_probability: Number
    red: Vector  # (2,) range of the duration of a red light, s
    end: Any  # time at which the phase ends, s since the episode began
    gaits: list[TravelGait]


class PhasePlan(NamedTuple):
    """A phase before its limits and its duration are drawn."""

    phase: TravelPhase
    ends_early: Number  # 1 if the next phase is the last one and needs the rest of the time


class TravelPlan(NamedTuple):
    """A kind of user, described by numbers only."""

    closer: Number  # crossings are this many times closer together than in the scene
    phases: list[PhasePlan]


def blank_plan(phases: int, gaits: int) -> TravelPlan:
    """Return a placeholder plan with the given numbers of phases and gaits, to be overwritten."""
    at_one = [1.0, 1.0]
    limits = [at_one, at_one, at_one, 1.0, 1.0, 0.0, at_one]
    phase = TravelPhase._make([*limits, [FAR, FAR], [NO_GAIT] * gaits])
    return TravelPlan(1.0, [PhasePlan(phase, 0.0)] * phases)


def _draw_gait(dice: Dice, gaits: Sequence[TravelGait]) -> Pair:
    """Draw a gait; return its target speed and the time for which it is kept."""
    left = sum(gait.weight for gait in gaits) * dice.uniform()
    chosen = gaits[0]
    passed = gaits[0].weight
    for gait in gaits[1:]:
        here = (left >= passed) & (left < passed + gait.weight)
        chosen = select(here, gait, chosen)
        passed = passed + gait.weight
    return dice.uniform(chosen.low, chosen.high), chosen.mean_s * dice.exponential()


def _leads_on(x: Number, y: Number, heading: Number, net: Net) -> Number:
    """Return 1 if a street leads from the crossing (x, y) in this direction, else 0."""
    east, north = unit(heading)
    x = x + east
    y = y + north
    inside = (x > -0.5) & (y > -0.5) & (x < net.blocks_x + 0.5) & (y < net.blocks_y + 0.5)
    return where(inside, 1.0, 0.0)


def _draw_turn(dice: Dice, x: Number, y: Number, heading: Number, net: Net) -> Number:
    """Draw the number of quarter turns to the left at a crossing: 0, 1, -1, or 2 in a dead end."""
    ahead = _leads_on(x, y, heading, net)
    left = _leads_on(x, y, around(heading + 1.0), net)
    options = ahead + left + _leads_on(x, y, around(heading - 1.0), net)
    chosen = floor(options * dice.uniform())
    sideways = where((left > 0.5) & (chosen < ahead + 0.5), 1.0, -1.0)
    turn = where((ahead > 0.5) & (chosen < 0.5), 0.0, sideways)
    return where(options > 0.5, turn, 2.0)


def _look_ahead(dice: Dice, t: Traveler, heading: Number, phase: TravelPhase, net: Net) -> Traveler:
    """Draw the turn and the duration of the red light at the crossing after the next one."""
    east, north = unit(heading)
    x = t.node_x + east
    y = t.node_y + north
    turn = _draw_turn(dice, x, y, heading, net)
    stops = dice.uniform() < phase.red_probability
    red = where(stops, dice.uniform(*phase.red), 0.0)
    return t._replace(node_x=x, node_y=y, turn_after=turn, red_after=red)


def _arc(turn: Number, radius: Number) -> Number:
    """Return the length of an arc of ``turn`` quarter turns."""
    return abs(turn) * (math.pi / 2) * radius


def _cross(dice: Dice, t: Traveler, phase: TravelPhase, net: Net) -> Traveler:
    """Pass a crossing: the street that leads from it becomes the way ahead."""
    east, north = unit(t.heading)
    turned = abs(t.turn)
    side = where(t.turn < 0.0, -1.0, 1.0)
    forward = t.stretch + where(abs(turned - 1.0) < 0.5, t.radius, 0.0)
    left = side * turned * t.radius
    x = t.x + forward * east - left * north
    y = t.y + forward * north + left * east
    heading = around(t.heading + t.turn)
    turn = t.turn_after
    east, north = unit(heading)
    distance = east * (net.origin_x + net.block * t.node_x - x)
    distance = distance + north * (net.origin_y + net.block * t.node_y - y)
    t = t._replace(
        x=x,
        y=y,
        heading=heading,
        traveled=t.traveled - t.stretch - t.arc,
        turn=turn,
        red=t.red_after,
        radius=phase.radius,
        arc=_arc(turn, phase.radius),
        stretch=maximum(distance - where(abs(turn) > 0.5, phase.radius, 0.0), 0.5),
    )
    return _look_ahead(dice, t, around(heading + turn), phase, net)


def _enter(t: Traveler, number: Number, phase: TravelPhase) -> Traveler:
    """Begin a phase."""
    return t._replace(
        phase=number,
        phase_end=phase.end,
        stopping=0.0,
        acceleration=phase.acceleration,
        braking=phase.braking,
        lateral=phase.lateral,
        jerk=phase.jerk,
    )


def _change_over(t: Traveler, following: TravelPhase) -> Traveler:
    """Make a traveler stop when its phase is over; begin the next phase once it stands still."""
    left = t.stretch - t.traveled
    wider = following.radius - t.radius
    # If too little street is left for the next phase's wider corner, turn at this corner first.
    room = (abs(t.turn) < 0.5) | (left > wider + 4.0)
    over = (t.time >= t.phase_end) & (t.stopping < 0.5) & room
    t = select(over, t._replace(stopping=1.0, target=0.0, gait_left=FAR), t)
    stands = (t.stopping > 0.5) & (t.v <= STANDING_MPS)
    fits = (abs(t.turn) > 0.5) & (left > maximum(wider, -1.0) + 1.0)
    bent = t._replace(
        stretch=t.stretch - wider, radius=following.radius, arc=_arc(t.turn, following.radius)
    )
    entered = _enter(select(fits, bent, t), t.phase + 1.0, following)._replace(gait_left=0.0)
    return select(stands, entered, t)


def attend(dice: Dice, t: Traveler, phases: Sequence[TravelPhase], net: Net) -> Traveler:
    """Return the traveler after the events that are due now, before a substep."""
    t = _change_over(t, tree_at(t.phase + 1.0, phases))
    phase = tree_at(t.phase, phases)
    target, lasts = _draw_gait(dice, phase.gaits)
    t = select(t.gait_left <= 0.0, t._replace(target=target, gait_left=lasts), t)
    return select(t.traveled >= t.stretch + t.arc, _cross(dice, t, phase, net), t)


def draw_phases(dice: Dice, plans: Sequence[PhasePlan], total_s: Number) -> list[TravelPhase]:
    """Draw the phases of an episode; the limits of a repeated phase are drawn again."""
    lengths = [dice.uniform(*plan.phase.end) for plan in plans]
    phases = []
    passed = 0.0
    for (phase, ends_early), length, after in zip(plans, lengths, [*lengths[1:], 0.0], strict=True):
        passed = passed + length
        phases.append(
            phase._replace(
                acceleration=dice.uniform(*phase.acceleration),
                braking=dice.uniform(*phase.braking),
                lateral=dice.uniform(*phase.lateral),
                end=where(ends_early > 0.5, total_s - after - STOPPING_S, passed),
            )
        )
    return phases


def set_off(dice: Dice, phases: Sequence[TravelPhase], net: Net) -> Traveler:
    """Draw the traveler that starts an episode: at a crossing, heading along a street."""
    x = floor((net.blocks_x + 1.0) * dice.uniform())
    y = floor((net.blocks_y + 1.0) * dice.uniform())
    heading = floor(4.0 * dice.uniform())
    heading = around(heading + _draw_turn(dice, x, y, heading, net))
    first = phases[0]
    target, lasts = _draw_gait(dice, first.gaits)
    t = STILL._replace(
        due=1.0,
        x=net.origin_x + net.block * x,
        y=net.origin_y + net.block * y,
        heading=heading,
        radius=first.radius,
        v=0.6 * target * dice.uniform(),  # slow enough for the first corner
        target=target,
        gait_left=lasts,
        node_x=x,
        node_y=y,
    )
    return _look_ahead(dice, _enter(t, 0.0, first), heading, first, net)


def stride_of(dt: float) -> int:
    """Return the number of substeps in an epoch of ``dt`` seconds."""
    return max(1, round(dt / FINEST_STEP_S))
