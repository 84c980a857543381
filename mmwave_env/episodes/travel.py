"""Truth: how users move through the streets.

A traveler walks or drives along a net of streets, turns at crossings on circular arcs,
waits at red lights, and follows gaits (target speeds that change now and then) within
limits of acceleration, braking, lateral acceleration and jerk. Simulated at 0.1 s.

What happens to a traveler now and then (a gait, a crossing, a phase) is drawn here, one
traveler at a time, each from its own generator; :mod:`mmwave_env.episodes.kinematics` moves them.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.rng import load_state, save_state
from mmwave_env.episodes.kinematics import AT, STANDING_MPS
from mmwave_env.numerics.arrays import Array, Index

FINEST_STEP_S = 0.1
STOPPING_S = 5.0  # what a ride takes to stop before its passenger walks on


class TravelPlan(NamedTuple):
    """K kinds of users in numbers, or a way that is given.

    Rows past a kind's phases and gaits are unused.
    """

    phases: Index  # (K,) number of phases
    # (K,) whether the last phase is the first again, until the episode ends
    returns: NDArray[np.bool_]
    duration: Array  # (K, phases, 2) range of the phases' lengths, s; infinite for the rest
    ranges: Array  # (K, phases, 3, 2) of acceleration, braking and lateral acceleration, m/s^2
    # (K, phases, 5) jerk (m/s^3), corner radius (m), probability of a red light and range of its
    # length (s)
    fixed: Array
    gaits: Array  # (K, phases, gaits, 4) low and high speed (m/s), mean duration (s), weight
    # (E, 6) where K is 0: the way of all users, positions (m) and velocities (m/s)
    way: Array


class StreetNets(NamedTuple):
    """S nets of streets in numbers: one for all travelers, or one for each."""

    block: Array  # (S, K) distance of a kind's crossings, m
    counts: Array  # (S, K, 2) blocks west to east and south to north
    origin: Array  # (S, 3) the crossing to the south-west at the height of the user equipment, m


@register_jitable
def _uniform(rng, interval):  # type: ignore[no-untyped-def]
    return interval[0] + (interval[1] - interval[0]) * rng.random()


@register_jitable
def _draw_gait(rng, now, gaits):  # type: ignore[no-untyped-def]
    """Target speed and duration of the next gait; gaits (n, 4) as in Plan."""
    total = 0.0
    for i in range(len(gaits)):
        total += gaits[i, 3]
    left = rng.random() * total
    chosen = 0
    for i in range(len(gaits)):
        if left < gaits[i, 3]:
            chosen = i
            break
        left -= gaits[i, 3]
    now[AT.target] = _uniform(rng, gaits[chosen])
    now[AT.gait_left] = gaits[chosen, 2] * rng.standard_exponential()


@register_jitable
def _next_node(now, heading):  # type: ignore[no-untyped-def]
    """The crossing to come to from the last one known, in blocks."""
    x = now[AT.node_x] + (1 if heading == 0 else -1 if heading == 2 else 0)
    y = now[AT.node_y] + (1 if heading == 1 else -1 if heading == 3 else 0)
    return x, y


@register_jitable
def _leads_on(now, heading):  # type: ignore[no-untyped-def]
    """Whether there is a street in this direction."""
    x, y = _next_node(now, heading % 4)
    return 0 <= x <= now[AT.blocks_x] and 0 <= y <= now[AT.blocks_y]


@register_jitable
def _draw_turn(rng, now, heading):  # type: ignore[no-untyped-def]
    """Quarter turns to the left at a crossing: 0, 1, -1, or 2 (back) where no other stays in."""
    ahead, left = _leads_on(now, heading), _leads_on(now, heading + 1)
    options = int(ahead) + int(left) + int(_leads_on(now, heading - 1))
    if options == 0:
        return 2
    chosen = int(rng.random() * options)
    if ahead and chosen == 0:
        return 0
    return 1 if left and chosen == int(ahead) else -1


@register_jitable
def _draw_crossing(rng, now, heading, limits):  # type: ignore[no-untyped-def]
    """Look ahead to the next crossing: where to turn there, and seconds of red light."""
    now[AT.node_x], now[AT.node_y] = _next_node(now, heading)
    now[AT.turn_after] = _draw_turn(rng, now, heading)
    now[AT.red_after] = _uniform(rng, limits[6:8]) if rng.random() < limits[5] else 0.0


@register_jitable
def _bend(now, radius):  # type: ignore[no-untyped-def]
    """Give the crossing ahead an arc of some radius, if the way turns there."""
    turn = now[AT.turn]
    now[AT.radius], now[AT.arc] = radius, abs(turn) * (np.pi / 2) * radius
    now[AT.curvature] = np.sign(turn) / radius


@register_jitable
def _cross(rng, now, limits):  # type: ignore[no-untyped-def]
    """Over a crossing: what was after it is ahead now."""
    heading = (now[AT.heading] + now[AT.turn]) % 4
    x = now[AT.origin_x] + now[AT.block] * now[AT.node_x] - now[AT.x]
    y = now[AT.origin_y] + now[AT.block] * now[AT.node_y] - now[AT.y]
    distance = abs(x if heading % 2 == 0 else y)
    now[AT.heading], now[AT.traveled] = heading, 0.0
    now[AT.turn], now[AT.red] = now[AT.turn_after], now[AT.red_after]
    _bend(now, limits[4])
    now[AT.stretch] = max(distance - (limits[4] if now[AT.turn] != 0 else 0.0), 0.5)
    _draw_crossing(rng, now, (heading + now[AT.turn]) % 4, limits)


@register_jitable
def _enter(now, phase, limits):  # type: ignore[no-untyped-def]
    """Begin a phase with limits (9,)."""
    now[AT.phase], now[AT.phase_end], now[AT.stopping] = phase, limits[8], 0.0
    now[AT.acceleration], now[AT.braking] = limits[0], limits[1]
    now[AT.lateral], now[AT.jerk] = limits[2], limits[3]


@register_jitable
def _change_over(now, limits):  # type: ignore[no-untyped-def]
    """Where a phase is over: come to a stand, then begin the next."""
    phase = int(now[AT.phase])
    turn, left = now[AT.turn], now[AT.stretch] - now[AT.traveled]
    over = now[AT.substep] * now[AT.step] >= now[AT.phase_end] and now[AT.stopping] == 0.0
    # Where the next phase needs a wider corner than there is room for: first round it.
    if over and (turn == 0 or left > limits[phase + 1, 4] - now[AT.radius] + 4.0):
        now[AT.stopping], now[AT.target], now[AT.gait_left] = 1.0, 0.0, np.inf
    if now[AT.stopping] != 0.0 and now[AT.v] <= STANDING_MPS:
        now[AT.gait_left] = 0.0
        wider = limits[phase + 1, 4] - now[AT.radius]
        if turn != 0 and left > max(wider, -1.0) + 1.0:
            now[AT.stretch] -= wider
            _bend(now, limits[phase + 1, 4])
        _enter(now, phase + 1, limits[phase + 1])


@register_jitable
def _attend(rng, now, gaits, limits):  # type: ignore[no-untyped-def]
    """What happens to a traveler before a substep, if anything.

    The order of drawing is part of what a seed means.
    """
    _change_over(now, limits)
    phase = int(now[AT.phase])
    if now[AT.gait_left] <= 0.0:
        _draw_gait(rng, now, gaits[phase])
    if now[AT.traveled] >= now[AT.stretch] + now[AT.arc]:
        _cross(rng, now, limits[phase])


@register_jitable
def _draw_phases(rng, plan, kind, total_s, limits):  # type: ignore[no-untyped-def]
    """Limits of each phase (phases, 9): drawn ranges, then ``fixed``, then when it ends (s).

    Limits are drawn once per episode; a phase that returns at the end has its own.
    """
    phases, duration = plan.phases[kind], plan.duration[kind]
    passed = 0.0
    for p in range(phases - plan.returns[kind]):
        passed += _uniform(rng, duration[p]) if duration[p, 0] < np.inf else np.inf
        limits[p, 8] = passed
    if plan.returns[kind]:
        limits[phases - 2, 8] = total_s - _uniform(rng, duration[0]) - STOPPING_S
        limits[phases - 1, 8] = np.inf
    for p in range(phases):
        for i in range(3):
            limits[p, i] = _uniform(rng, plan.ranges[kind, p, i])
        for i in range(5):
            limits[p, 3 + i] = plan.fixed[kind, p, i]


@register_jitable
def _begin(rng, now, plan, nets, net, kind, total_s, limits):  # type: ignore[no-untyped-def]
    """Set a traveler off from a crossing, in a direction that leads somewhere."""
    _draw_phases(rng, plan, kind, total_s, limits)
    now[AT.block] = nets.block[net, kind]
    now[AT.blocks_x], now[AT.blocks_y] = nets.counts[net, kind, 0], nets.counts[net, kind, 1]
    now[AT.origin_x], now[AT.origin_y] = nets.origin[net, 0], nets.origin[net, 1]
    now[AT.node_x] = int(rng.random() * (now[AT.blocks_x] + 1))
    now[AT.node_y] = int(rng.random() * (now[AT.blocks_y] + 1))
    heading = int(rng.random() * 4)
    heading = (heading + _draw_turn(rng, now, heading)) % 4
    now[AT.heading] = heading
    now[AT.x] = now[AT.origin_x] + now[AT.block] * now[AT.node_x]
    now[AT.y] = now[AT.origin_y] + now[AT.block] * now[AT.node_y]
    _enter(now, 0, limits[0])
    _draw_gait(rng, now, plan.gaits[kind, 0])
    now[AT.v] = 0.6 * now[AT.target] * rng.random()  # slow enough for the first corner
    now[AT.radius] = limits[0, 4]
    now[AT.due] = 1.0
    _draw_crossing(rng, now, heading, limits[0])


@register_jitable
def draw_kind(rng, plan, epochs):  # type: ignore[no-untyped-def]
    """A traveler's kind; of a way that is given, the row where it begins."""
    given = len(plan.way)
    return int(rng.random() * (given - epochs + 1 if given else len(plan.phases)))


@register_jitable
def travel(view, first, kinds, plan, nets, dt, stride, move_on, observe, out):  # type: ignore[no-untyped-def]
    """The whole way of up to eight travelers; all randomness of each is its own.

    Args:
        view: to draw from.
        first: which of the dice's states is the first traveler's; the others' follow.
        kinds: (n,) of :func:`draw_kind`.
        plan: kinds of users.
        nets: one for all of the view's travelers, or one for each.
        dt: seconds between epochs.
        stride: substeps between epochs.
        move_on, observe: of :func:`~mmwave_env.episodes.kinematics.motion`.
        out: (n, epochs, 6 or more) the first six columns get positions (m) and velocities (m/s).
    """
    rng, here, epochs = view[0], len(kinds), out.shape[1]
    if len(plan.way):
        for lane in range(here):
            for epoch in range(epochs):
                for i in range(6):  # slices take numba two seconds more to compile
                    out[lane, epoch, i] = plan.way[kinds[lane] + epoch, i]
        return
    block = np.zeros((len(AT), WIDTH))
    for lane in range(WIDTH):
        block[AT.step, lane] = dt / stride
    limits = np.empty((here, plan.duration.shape[1], 9))
    for lane in range(here):
        load_state(view, first + lane)
        net = (first + lane) % len(nets.origin)
        _begin(rng, block[:, lane], plan, nets, net, kinds[lane], epochs * dt, limits[lane])
        save_state(view, first + lane)
    for epoch in range(epochs):
        observe(block.ctypes)
        for lane in range(here):
            now, row = block[:, lane], out[lane, epoch]
            row[0], row[1] = now[AT.x], now[AT.y]
            row[2] = nets.origin[(first + lane) % len(nets.origin), 2]
            row[3], row[4], row[5] = now[AT.vx], now[AT.vy], 0.0
        left = stride
        while left > 0:
            for lane in range(here):
                if block[AT.due, lane] > 0.0:
                    load_state(view, first + lane)
                    _attend(rng, block[:, lane], plan.gaits[kinds[lane]], limits[lane])
                    save_state(view, first + lane)
            left = move_on(block.ctypes, left, here)


def stride_of(dt: float) -> int:
    """Substeps in a step of some seconds."""
    return max(1, round(dt / FINEST_STEP_S))
