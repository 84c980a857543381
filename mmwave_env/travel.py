"""Truth: how users move through the streets.

A traveller walks or drives along a net of streets, turns at crossings on circular arcs,
waits at red lights, and follows gaits (target speeds that change now and then) within
limits of acceleration, braking, lateral acceleration and jerk. Simulated at 0.1 s.

Motion is arithmetic, on lanes: eight travellers at once. What happens to a traveller now and
then (a gait, a crossing, a phase) is drawn, one traveller at a time, each from its own generator.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.arithmetic import Number, clip, cos_sin, maximum, minimum, sqrt, where
from mmwave_env.estimator.lanes import WIDTH
from mmwave_env.estimator.program import c_function, tree_kernel
from mmwave_env.generators import leave, take

FINEST_STEP_S = 0.1
STOPPING_S = 5.0  # what a ride takes to stop before its passenger walks on
STANDING_MPS = 0.1  # slow enough to change over to another phase
Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Plan(NamedTuple):
    """K kinds of users in numbers; rows past a kind's phases and gaits are unused.

    Attributes:
        phases: (K,) number of phases.
        returns: (K,) whether the last phase is the first again, until the episode ends.
        duration: (K, phases, 2) range of the phases' lengths, s; infinite for the rest.
        ranges: (K, phases, 3, 2) of acceleration, braking and lateral acceleration, m/s^2.
        fixed: (K, phases, 5) jerk (m/s^3), corner radius (m), probability of a red light and
            range of its length (s).
        gaits: (K, phases, gaits, 4) low and high speed (m/s), mean duration (s), weight.
        block: (K,) distance of crossings, m.
        counts: (K, 2) blocks west to east and south to north.
        origin: (2,) the crossing to the south-west, m.
        height: of the user equipment, m.
    """

    phases: Index
    returns: NDArray[np.bool_]
    duration: Array
    ranges: Array
    fixed: Array
    gaits: Array
    block: Array
    counts: Array
    origin: Array
    height: float


class Traveller(NamedTuple):
    """Where a traveller is, and what it is up to.

    The way ahead is a straight stretch, then an arc over a crossing (none where it is straight
    on); the crossing after that is known too, for braking over a crossing that is driven straight.

    Attributes:
        step: length of a substep, s.
        substep: how many there were.
        due: 1 where something is to happen before the next one; see :func:`_attend`.
        x, y: position, m.
        vx, vy: velocity where last observed, m/s.
        v, a: speed (m/s) and acceleration (m/s^2).
        acceleration, braking, lateral, jerk: limits, m/s^2 and m/s^3.
        target: speed to reach, m/s.
        gait_left: time to keep it, s.
        phase: which; ends at ``phase_end`` s.
        stopping: 1 while coming to a stand to change over to the next phase.
        heading: in quarter turns, before the arc.
        travelled: on the way ahead, m.
        stretch, arc: lengths of the way ahead, m.
        radius, curvature: of its arc, m and 1/m; curvature is positive to the left.
        turn, red: at the crossing ahead: quarter turns to the left; red light, s.
        turn_after, red_after: at the crossing after that.
        node_x, node_y: the crossing after that, in blocks from the origin.
        block: distance of crossings, m.
        blocks_x, blocks_y: how many there are, west to east and south to north.
        origin_x, origin_y: the crossing to the south-west, m.
    """

    step: Number
    substep: Number
    due: Number
    x: Number
    y: Number
    vx: Number
    vy: Number
    v: Number
    a: Number
    acceleration: Number
    braking: Number
    lateral: Number
    jerk: Number
    target: Number
    gait_left: Number
    phase: Number
    phase_end: Number
    stopping: Number
    heading: Number
    travelled: Number
    stretch: Number
    arc: Number
    radius: Number
    curvature: Number
    turn: Number
    red: Number
    turn_after: Number
    red_after: Number
    node_x: Number
    node_y: Number
    block: Number
    blocks_x: Number
    blocks_y: Number
    origin_x: Number
    origin_y: Number


AT = Traveller(*range(len(Traveller._fields)))  # rows of a block


def _direction(t: Traveller, travelled: Number) -> tuple[Number, Number]:
    """Cosine and sine of the course after some metres of the way ahead."""
    bent = clip(travelled - t.stretch, 0.0, t.arc)
    return cos_sin((np.pi / 2) * t.heading + t.curvature * bent)


def observe(t: Traveller) -> Traveller:
    """Fill in the velocity."""
    cosine, sine = _direction(t, t.travelled)
    return t._replace(vx=t.v * cosine, vy=t.v * sine)


def wanted_acceleration(t: Traveller) -> Number:
    """Towards the target, and down to what is ahead, in m/s^2.

    A crossing where the way turns is a limit of v_c^2 = lateral acceleration times radius, a red
    light one of 0 a metre before the crossing. Braking at b over d metres from v reaches v_c with
    v^2 = v_c^2 + 2 b d; half of that is aimed at, and where the rest runs out, what is needed.
    """
    left, turns = t.stretch - t.travelled, t.arc > 0.0
    beyond = left + t.block - where(abs(t.turn_after) > 0.5, t.radius, 0.0)
    corner = where(turns, left, where(abs(t.turn_after) > 0.5, beyond, np.inf))
    light_after = where((t.red_after > 0.0) & (beyond > 0.0), beyond, np.inf)
    light = where((t.red > 0.0) & (left > 0.0), left, where(turns, np.inf, light_after))
    light = maximum(light - 1.0, 0.0)
    cornering, squared = t.lateral * t.radius, t.v * t.v
    aim = minimum(cornering + t.braking * maximum(corner, 0.0), t.braking * light)
    aim = sqrt(minimum(t.target * t.target, aim))
    pull = clip((aim - t.v) / 0.5, -t.braking, t.acceleration)
    built_up = 0.6 / t.jerk * (maximum(t.a, 0.0) + t.braking) * t.v  # until braking has
    need = maximum(
        where(corner > 0.0, squared - cornering, 0.0) / (2.0 * maximum(corner - built_up, 0.5)),
        where(light > 0.0, squared, 0.0) / (2.0 * maximum(light - built_up, 0.5)),
    )
    late = need > 0.7 * t.braking
    return where(late, minimum(pull, -minimum(need, t.braking)), pull)


def move(t: Traveller) -> Traveller:
    """A substep; at its end, whether something is due."""
    most = t.jerk * t.step
    waiting = (t.v < 0.3) & (t.stretch - t.travelled < 3.0)
    a = t.a + clip(wanted_acceleration(t) - t.a, -most, most)
    v = t.v + maximum(a * t.step, -t.v)  # never backwards; nor fused, which rounds otherwise
    a = where(v > 0.0, a, maximum(a, 0.0))
    moved = 0.5 * (t.v + v) * t.step
    cosine, sine = _direction(t, t.travelled + 0.5 * moved)
    substep, travelled = t.substep + 1.0, t.travelled + moved
    gait_left = t.gait_left - t.step
    changing = where(t.stopping > 0.5, STANDING_MPS - v, substep * t.step - t.phase_end)
    due = (gait_left <= 0.0) | (travelled >= t.stretch + t.arc) | (changing >= 0.0)
    return t._replace(
        substep=substep,
        due=where(due, 1.0, 0.0),
        x=t.x + moved * cosine,
        y=t.y + moved * sine,
        v=v,
        a=a,
        gait_left=gait_left,
        travelled=travelled,
        red=where(waiting, t.red - t.step, t.red),
    )


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
    now[AT.heading], now[AT.travelled] = heading, 0.0
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
    turn, left = now[AT.turn], now[AT.stretch] - now[AT.travelled]
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
    """What happens to a traveller before a substep, if anything.

    The order of drawing is part of what a seed means.
    """
    _change_over(now, limits)
    phase = int(now[AT.phase])
    if now[AT.gait_left] <= 0.0:
        _draw_gait(rng, now, gaits[phase])
    if now[AT.travelled] >= now[AT.stretch] + now[AT.arc]:
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
def _begin(rng, now, plan, kind, total_s, limits):  # type: ignore[no-untyped-def]
    """Set a traveller off from a crossing, in a direction that leads somewhere."""
    _draw_phases(rng, plan, kind, total_s, limits)
    now[AT.block] = plan.block[kind]
    now[AT.blocks_x], now[AT.blocks_y] = plan.counts[kind, 0], plan.counts[kind, 1]
    now[AT.origin_x], now[AT.origin_y] = plan.origin[0], plan.origin[1]
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
def travel(dice, first, kinds, plan, dt, stride, move_on, observe, out):  # type: ignore[no-untyped-def]
    """The whole way of up to eight travellers; all randomness of each is its own.

    Args:
        dice: to draw from; the travellers' states begin with number ``first``.
        first: see above.
        kinds: (n,) which of the plan's kinds each is.
        plan: kinds of users.
        dt: seconds between epochs.
        stride: substeps between epochs.
        move_on, observe: of :func:`motion`.
        out: (n, epochs, 6 or more) the first six columns get positions (m) and velocities (m/s).
    """
    rng, here, epochs = dice[0], len(kinds), out.shape[1]
    block = np.zeros((len(AT), WIDTH))
    for lane in range(WIDTH):
        block[AT.step, lane] = dt / stride
    limits = np.empty((here, plan.duration.shape[1], 9))
    for lane in range(here):
        take(dice, first + lane)
        _begin(rng, block[:, lane], plan, kinds[lane], epochs * dt, limits[lane])
        leave(dice, first + lane)
    for epoch in range(epochs):
        observe(block.ctypes)
        for lane in range(here):
            now, row = block[:, lane], out[lane, epoch]
            row[0], row[1], row[2] = now[AT.x], now[AT.y], plan.height
            row[3], row[4], row[5] = now[AT.vx], now[AT.vy], 0.0
        left = stride
        while left > 0:
            for lane in range(here):
                if block[AT.due, lane] > 0.0:
                    take(dice, first + lane)
                    _attend(rng, block[:, lane], plan.gaits[kinds[lane]], limits[lane])
                    leave(dice, first + lane)
            left = move_on(block.ctypes, left, here)


def stride_of(dt: float) -> int:
    """Substeps in a step of some seconds."""
    return max(1, round(dt / FINEST_STEP_S))


@lru_cache(maxsize=1)
def motion() -> tuple[Any, Any]:
    """Two C functions of the address of a block (rows of a Traveller, 8).

    The first moves the travellers in the first lanes until something is due, or for some
    substeps, and returns how many of them are left: (address, substeps, lanes) -> substeps. The
    second fills in their velocities.
    """
    shape, substep, look = (len(AT), WIDTH), tree_kernel(move, AT), tree_kernel(observe, AT)

    @numba.cfunc(types.int64(types.voidptr, types.int64, types.int64))  # type: ignore[untyped-decorator]
    def move_on(address, substeps, here):  # type: ignore[no-untyped-def]
        block = numba.carray(address, shape, np.float64)
        due = False
        while substeps > 0 and not due:  # no events inside: so it all stays in registers
            substep(block)
            substeps -= 1
            for lane in range(here):
                due |= block[AT.due, lane] > 0.0
        return substeps

    @numba.cfunc(types.void(types.voidptr))  # type: ignore[untyped-decorator]
    def observed(address):  # type: ignore[no-untyped-def]
        look(numba.carray(address, shape, np.float64))

    return c_function(move_on), c_function(observed)
