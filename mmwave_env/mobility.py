"""Truth: how pedestrians, vehicles and others move through the streets.

A traveller walks or drives along a net of streets, turns at crossings on circular arcs,
waits at red lights, and follows gaits (target speeds that change now and then) within
limits of acceleration, braking, lateral acceleration and jerk. Simulated at 0.1 s.
"""

from dataclasses import astuple, dataclass, field, replace
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from mmwave_env.disk_cache import compiled
from mmwave_env.names import choose
from mmwave_env.scene import Streets

FINEST_STEP_S = 0.1
STOPPING_S = 5.0  # what a ride takes to stop before its passenger walks on
Range = tuple[float, float]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Gait:
    """A target speed that is kept for a while.

    Attributes:
        low_mps, high_mps: the target is uniform between these.
        mean_s: mean duration, exponential.
        weight: how often it is chosen next, relative to the others.
    """

    low_mps: float
    high_mps: float
    mean_s: float
    weight: float = 1.0


@dataclass(frozen=True)
class Limits:
    """What a traveller can do; ranges are drawn once per episode.

    Attributes:
        acceleration_mps2, braking_mps2, lateral_mps2: ranges.
        jerk_mps3: limit of the change of acceleration.
        corner_radius_m: of the arcs at crossings.
        red_light_probability: of waiting at a crossing.
        red_light_s: range of the wait.
    """

    acceleration_mps2: Range
    braking_mps2: Range
    lateral_mps2: Range
    jerk_mps3: float
    corner_radius_m: float
    red_light_probability: float = 0.0
    red_light_s: Range = (5.0, 25.0)


@dataclass(frozen=True)
class Phase:
    """A stretch of an episode with one way of moving.

    Attributes:
        limits: what is possible.
        gaits: what is wanted.
        duration_s: range of its length; infinite for the rest of the episode.
    """

    limits: Limits
    gaits: tuple[Gait, ...]
    duration_s: Range = (np.inf, np.inf)


@dataclass(frozen=True)
class Mobility:
    """A kind of user.

    Attributes:
        name: of the scenario.
        phases: in order of time; the first of a last-and-first pair also ends the episode.
        blocks: how many times finer than the streets' blocks the crossings lie.
        ends_as_it_began: whether the first phase returns at the end.
    """

    name: str
    phases: tuple[Phase, ...]
    blocks: int = 1
    ends_as_it_began: bool = field(default=False)


_ON_FOOT = Limits((0.5, 1.0), (0.8, 1.5), (1.0, 2.0), 2.0, 1.0)
_WALK = (Gait(0.4, 1.9, 20.0, 3.0), Gait(0.0, 0.0, 10.0, 1.0))
_DRIVING = Limits((1.5, 3.0), (2.0, 3.5), (2.0, 3.5), 4.0, 8.0, 0.4)
_DRIVE = (Gait(9.0, 20.0, np.inf),)
_JAM = (Gait(0.0, 0.0, 8.0, 1.0), Gait(0.5, 2.5, 8.0, 1.5), Gait(3.0, 7.0, 6.0, 1.0))
_CYCLING = Limits((0.6, 1.2), (1.5, 2.5), (1.5, 2.5), 2.0, 4.0, 0.2, (5.0, 15.0))
_CYCLE = (Gait(2.0, 6.5, 25.0),)

MOBILITIES: dict[str, Mobility] = {
    "pedestrian": Mobility("pedestrian", (Phase(_ON_FOOT, _WALK),), blocks=4),
    "vehicle": Mobility("vehicle", (Phase(_DRIVING, _DRIVE),)),
    "walk-ride": Mobility(
        "walk-ride",
        (Phase(_ON_FOOT, _WALK, (45.0, 75.0)), Phase(_DRIVING, _DRIVE)),
        ends_as_it_began=True,
    ),
    "jam": Mobility("jam", (Phase(replace(_DRIVING, red_light_probability=0.0), _JAM),)),
    "cyclist": Mobility("cyclist", (Phase(_CYCLING, _CYCLE),)),
}
MIXED = "mixed"
SCENARIOS = (*MOBILITIES, MIXED)


def mobilities_of(scenario: str) -> tuple[Mobility, ...]:
    """The mobilities a scenario draws from, in equal shares.

    Raises:
        ValueError: unknown scenario; the message lists the valid ones.
    """
    names = {name: (mobility,) for name, mobility in MOBILITIES.items()}
    names[MIXED] = tuple(MOBILITIES.values())  # type: ignore[assignment]
    return choose(names, scenario, "scenario")


@lru_cache(maxsize=64)
def _plan(mobility: Mobility, streets: Streets) -> tuple[Array, Array, Array, Array, Array, float]:
    """A mobility in numbers.

    Returns:
        Ranges of the phases' durations (phases, 2); of acceleration, braking and lateral
        acceleration (phases, 3, 2); other limits (phases, 5); gaits (phases, most, 4), zero
        rows unused; first crossing and numbers of blocks (2, 2); length of a block.
    """
    phases = mobility.phases
    duration = np.array([p.duration_s for p in phases])
    ranges = np.array([
        [p.limits.acceleration_mps2, p.limits.braking_mps2, p.limits.lateral_mps2] for p in phases
    ])  # fmt: skip
    fixed = np.array([
        [p.limits.jerk_mps3, p.limits.corner_radius_m, p.limits.red_light_probability,
         *p.limits.red_light_s]
        for p in phases
    ])  # fmt: skip
    gaits = np.zeros((len(phases), max(len(p.gaits) for p in phases), 4))
    for row, p in zip(gaits, phases, strict=True):
        row[: len(p.gaits)] = [astuple(g) for g in p.gaits]
    block = streets.block_m / mobility.blocks
    extents = (streets.x_m, streets.y_m)
    net = [[low for low, _ in extents], [round((high - low) / block) for low, high in extents]]
    return duration, ranges, fixed, gaits, np.array(net, float), block


def trajectory(
    mobility: Mobility,
    streets: Streets,
    dt: float,
    rng: np.random.Generator,
    out: Array,
) -> None:
    """Fill (epochs, 6) with positions (m) and velocities (m/s) at steps of ``dt`` seconds."""
    stride = max(1, round(dt / FINEST_STEP_S))
    duration, ranges, fixed, gaits, net, block = _plan(mobility, streets)
    out[:, 2], out[:, 5] = streets.height_m, 0.0
    _travel(
        rng, duration, ranges, fixed, mobility.ends_as_it_began, gaits, net, block, dt, stride, out
    )


@numba.njit
def _uniform(rng, interval):  # type: ignore[no-untyped-def]
    return interval[0] + (interval[1] - interval[0]) * rng.random()


@numba.njit
def _draw_phases(rng, duration, ranges, fixed, ends_as_it_began, total_s):  # type: ignore[no-untyped-def]
    """When each phase ends (phases,), and its limits (phases, 8); see :func:`_plan`.

    Limits are drawn once per episode; a phase that returns at the end has its own.
    """
    phases = len(duration)
    ends, n = np.empty(phases + 1), phases
    passed = 0.0
    for p in range(phases):
        passed += _uniform(rng, duration[p]) if np.isfinite(duration[p, 0]) else np.inf
        ends[p] = passed
    if ends_as_it_began:
        ends[phases - 1] = total_s - _uniform(rng, duration[0]) - STOPPING_S
        ends[phases] = np.inf
        n = phases + 1
    limits = np.empty((n, 8))
    for p in range(n):
        for i in range(3):
            limits[p, i] = _uniform(rng, ranges[p % phases, i])
        limits[p, 3:] = fixed[p % phases]
    return ends[:n], limits


@numba.njit
def _draw_gait(rng, gaits):  # type: ignore[no-untyped-def]
    """Target speed and duration of the next gait; gaits (n, 4) as in Gait, zero rows unused."""
    left = rng.random() * gaits[:, 3].sum()
    chosen = 0
    for i in range(len(gaits)):
        if left < gaits[i, 3]:
            chosen = i
            break
        left -= gaits[i, 3]
    speed = gaits[chosen, 0] + (gaits[chosen, 1] - gaits[chosen, 0]) * rng.random()
    return speed, gaits[chosen, 2] * rng.standard_exponential()


@numba.njit
def _draw_turn(rng, node, heading, counts):  # type: ignore[no-untyped-def]
    """Quarter turns to the left at a node: 0, 1, -1, or 2 (back) where nothing else stays in."""
    options = np.empty(3, np.int64)
    n = 0
    for turn in (0, 1, -1):
        way = (heading + turn) % 4
        x = node[0] + (1 if way == 0 else -1 if way == 2 else 0)
        y = node[1] + (1 if way == 1 else -1 if way == 3 else 0)
        if 0 <= x <= counts[0] and 0 <= y <= counts[1]:
            options[n] = turn
            n += 1
    return options[int(rng.random() * n)] if n else 2


@numba.njit
def _draw_start(rng, counts):  # type: ignore[no-untyped-def]
    """A crossing to start at, and a heading that leads somewhere."""
    node = np.array([int(rng.random() * (counts[0] + 1)), int(rng.random() * (counts[1] + 1))])
    heading = int(rng.random() * 4)
    return node, (heading + _draw_turn(rng, node, heading, counts)) % 4


@numba.njit
def _row(limits, phase):  # type: ignore[no-untyped-def]
    """A phase's limits as a tuple, which costs nothing to hand on."""
    l = limits[phase]
    return l[0], l[1], l[2], l[3], l[4], l[5], l[6], l[7]


@numba.njit
def _draw_crossing(rng, node, heading, counts, limits):  # type: ignore[no-untyped-def]
    """Move ``node`` to the next crossing; what to do there: the turn, and seconds of red light."""
    node[0] += 1 if heading == 0 else -1 if heading == 2 else 0
    node[1] += 1 if heading == 1 else -1 if heading == 3 else 0
    turn = _draw_turn(rng, node, heading, counts)
    red = 0.0
    if rng.random() < limits[5]:
        red = _uniform(rng, limits[6:8])
    return turn, red


@numba.njit
def _toward(v, target, limits):  # type: ignore[no-untyped-def]
    """Wanted acceleration to reach a target speed."""
    return min(max((target - v) / 0.5, -limits[1]), limits[0])


@numba.njit
def _pull(v, a, target, limits, cap, left):  # type: ignore[no-untyped-def]
    """Wanted acceleration: towards the target, and down to ``cap`` within ``left`` metres."""
    braking, jerk = limits[1], limits[3]
    pull = _toward(v, min(target, np.sqrt(cap * cap + braking * max(left, 0.0))), limits)
    if left > 0.0 and v > cap:
        reaction_s = 0.6 * (max(a, 0.0) + braking) / jerk  # until braking has built up
        need = (v * v - cap * cap) / (2.0 * max(left - reaction_s * v, 0.5))
        if need > 0.7 * braking:
            pull = min(pull, -min(need, braking))
    return pull


@numba.njit
def _drive(v, a, target, limits, turn, red, radius, left):  # type: ignore[no-untyped-def]
    """Wanted acceleration with a crossing ``left`` metres ahead."""
    if turn != 0 and left <= 0.0:  # on the arc
        target = min(target, np.sqrt(limits[2] * radius))
    pull = _toward(v, target, limits)
    if turn != 0:
        pull = min(pull, _pull(v, a, target, limits, np.sqrt(limits[2] * radius), left))
    if red > 0.0 and left > 0.0:
        pull = min(pull, _pull(v, a, target, limits, 0.0, max(left - 1.0, 0.0)))
    return pull


@numba.njit
def _within_jerk(a, pull, most):  # type: ignore[no-untyped-def]
    """The acceleration, moved towards the wanted one by no more than ``most``."""
    return a + min(max(pull - a, -most), most)


@numba.njit
def _speed_up(v, a, step):  # type: ignore[no-untyped-def]
    """Speed a step on, never backwards, and the acceleration: none into standing still."""
    faster = max(v + a * step, 0.0)
    return faster, a if faster > 0.0 else max(a, 0.0)


@numba.njit
def _course(heading, turn, bent, arc):  # type: ignore[no-untyped-def]
    """Direction of travel (rad), ``bent`` metres into an arc of ``arc`` metres."""
    share = min(max(bent / arc, 0.0), 1.0) if turn != 0 else 0.0
    return (heading + turn * share) * (np.pi / 2)


@numba.njit
def _turned(before, angle):  # type: ignore[no-untyped-def]
    """An angle, its cosine and its sine, from those before: most of the way is straight."""
    return before if angle == before[0] else (angle, np.cos(angle), np.sin(angle))


@numba.njit
def _ahead(distance, turn, radius):  # type: ignore[no-untyped-def]
    """Straight stretch and arc to a crossing ``distance`` metres away."""
    if turn == 0:
        return max(distance, 0.5), 0.0
    return max(distance - radius, 0.5), abs(turn) * (np.pi / 2) * radius


@numba.njit
def _widen(turn, travelled, stretch, arc, radius, wanted):  # type: ignore[no-untyped-def]
    """Corner radius, straight stretch and arc ahead, for another radius if there is room."""
    if turn == 0 or stretch - travelled <= max(wanted - radius, -1.0) + 1.0:
        return radius, stretch, arc
    return wanted, stretch - (wanted - radius), abs(turn) * (np.pi / 2) * wanted


@compiled
def _travel(  # type: ignore[no-untyped-def]
    rng, duration, ranges, fixed, ends_as_it_began, gaits, net, block, dt, stride, out
):
    """Fill x, y, vx and vy of one traveller; arguments as :func:`trajectory` makes them."""
    epochs, step, phases = len(out), dt / stride, len(gaits)
    ends, limits = _draw_phases(rng, duration, ranges, fixed, ends_as_it_began, epochs * dt)
    origin, counts = net[0], net[1].astype(np.int64)
    node, heading = _draw_start(rng, counts)
    phase, limit, along = 0, _row(limits, 0), origin + block * node
    target, gait_left = _draw_gait(rng, gaits[0])
    v, a = 0.6 * target * rng.random(), 0.0  # slow enough for the first corner
    # The way ahead is a straight stretch, then an arc over a crossing (none if turn is 0);
    # the crossing after that is known too, for braking over a crossing that is driven straight.
    travelled, stretch, arc, turn, red = 0.0, 0.0, 0.0, 0, 0.0
    turn_after, red_after = _draw_crossing(rng, node, heading, counts, limit)
    radius, course = limit[4], (0.0, 1.0, 0.0)
    stopping = False  # to change over to the next phase
    for k in range(epochs * stride):
        if k % stride == 0:
            course = _turned(course, _course(heading, turn, travelled - stretch, arc))
            epoch = out[k // stride]
            epoch[:2], epoch[3], epoch[4] = along, v * course[1], v * course[2]
        if k * step >= ends[phase] and not stopping:
            # Where the next phase needs a wider corner than there is room for: first round it.
            wider = limits[phase + 1, 4] - radius
            stopping = turn == 0 or stretch - travelled > wider + 4.0
        if stopping:
            target, gait_left = 0.0, 1.0
            if v <= 0.1:
                stopping, phase, gait_left = False, phase + 1, 0.0
                limit = _row(limits, phase)
                radius, stretch, arc = _widen(turn, travelled, stretch, arc, radius, limit[4])
        if gait_left <= 0.0:
            target, gait_left = _draw_gait(rng, gaits[phase % phases])
        gait_left -= step
        if travelled >= stretch + arc:  # over the crossing: on to the next
            heading = (heading + turn) % 4
            distance = np.abs(origin + block * node - along)[heading % 2]
            turn, red, radius, travelled = turn_after, red_after, limit[4], 0.0
            stretch, arc = _ahead(distance, turn, radius)
            turn_after, red_after = _draw_crossing(rng, node, (heading + turn) % 4, counts, limit)
        left = stretch - travelled
        pull = _drive(v, a, target, limit, turn, red, radius, left)
        if turn == 0:
            beyond = left + block - (radius if turn_after != 0 else 0.0)
            then = _drive(v, a, target, limit, turn_after, red_after, radius, beyond)
            pull = min(pull, then)
        if v < 0.3 and left < 3.0:
            red -= step
        a = _within_jerk(a, pull, limit[3] * step)
        faster, a = _speed_up(v, a, step)
        moved = 0.5 * (v + faster) * step
        course = _turned(course, _course(heading, turn, travelled + 0.5 * moved - stretch, arc))
        along[0] += moved * course[1]
        along[1] += moved * course[2]
        travelled += moved
        v = faster
