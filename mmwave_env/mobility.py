"""Truth: how pedestrians, vehicles and others move through the streets.

A traveller walks or drives along a net of streets, turns at crossings on circular arcs,
waits at red lights, and follows gaits (target speeds that change now and then) within
limits of acceleration, braking, lateral acceleration and jerk. Simulated at 0.1 s.
"""

from dataclasses import astuple, dataclass, field, replace

import numba
import numpy as np
from numpy.typing import NDArray

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


def trajectory(
    mobility: Mobility, streets: Streets, dt: float, epochs: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Positions (epochs, 3) in m and velocities (epochs, 3) in m/s at steps of ``dt`` seconds."""
    stride = max(1, round(dt / FINEST_STEP_S))
    step = dt / stride
    phases = mobility.phases
    ends = np.cumsum([rng.uniform(*p.duration_s) if np.isfinite(p.duration_s[0]) else np.inf
                      for p in phases])  # fmt: skip
    if mobility.ends_as_it_began:
        ends[-1] = epochs * dt - rng.uniform(*phases[0].duration_s) - STOPPING_S
        phases, ends = (*phases, phases[0]), np.append(ends, np.inf)
    limits = np.array([
        [rng.uniform(*p.limits.acceleration_mps2), rng.uniform(*p.limits.braking_mps2),
         rng.uniform(*p.limits.lateral_mps2), p.limits.jerk_mps3, p.limits.corner_radius_m,
         p.limits.red_light_probability, *p.limits.red_light_s]
        for p in phases
    ])  # fmt: skip
    gaits = np.zeros((len(phases), max(len(p.gaits) for p in phases), 4))
    for row, p in zip(gaits, phases, strict=True):
        row[: len(p.gaits)] = [astuple(g) for g in p.gaits]
    block = streets.block_m / mobility.blocks
    origin = np.array([streets.x_m[0], streets.y_m[0]])
    counts = np.array([
        round((high - low) / block) for low, high in (streets.x_m, streets.y_m)
    ])  # fmt: skip
    path = _travel(rng, ends, limits, gaits, origin, counts, block, step, stride, epochs)
    position = np.empty((epochs, 3))
    velocity = np.zeros((epochs, 3))
    position[:, :2], position[:, 2] = path[:, :2], streets.height_m
    velocity[:, :2] = path[:, 2:]
    return position, velocity


@numba.njit(cache=True)
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


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def _draw_start(rng, counts):  # type: ignore[no-untyped-def]
    """A crossing to start at, and a heading that leads somewhere."""
    node = np.array([int(rng.random() * (counts[0] + 1)), int(rng.random() * (counts[1] + 1))])
    heading = int(rng.random() * 4)
    return node, (heading + _draw_turn(rng, node, heading, counts)) % 4


@numba.njit(cache=True)
def _draw_crossing(rng, node, heading, counts, limits):  # type: ignore[no-untyped-def]
    """Move ``node`` to the next crossing; what to do there: the turn, and seconds of red light."""
    node[0] += 1 if heading == 0 else -1 if heading == 2 else 0
    node[1] += 1 if heading == 1 else -1 if heading == 3 else 0
    turn = _draw_turn(rng, node, heading, counts)
    red = 0.0
    if rng.random() < limits[5]:
        red = limits[6] + (limits[7] - limits[6]) * rng.random()
    return turn, red


@numba.njit(cache=True)
def _pull(v, a, target, limits, cap, left):  # type: ignore[no-untyped-def]
    """Wanted acceleration: towards the target, and down to ``cap`` within ``left`` metres."""
    acceleration, braking, jerk = limits[0], limits[1], limits[3]
    wanted = min(target, np.sqrt(cap * cap + braking * max(left, 0.0)))
    pull = min(max((wanted - v) / 0.5, -braking), acceleration)
    if left > 0.0 and v > cap:
        reaction_s = 0.6 * (max(a, 0.0) + braking) / jerk  # until braking has built up
        need = (v * v - cap * cap) / (2.0 * max(left - reaction_s * v, 0.5))
        if need > 0.7 * braking:
            pull = min(pull, -min(need, braking))
    return pull


@numba.njit(cache=True)
def _drive(v, a, target, limits, turn, red, radius, left):  # type: ignore[no-untyped-def]
    """Wanted acceleration with a crossing ``left`` metres ahead."""
    if turn != 0 and left <= 0.0:  # on the arc
        target = min(target, np.sqrt(limits[2] * radius))
    pull = _pull(v, a, target, limits, np.inf, 0.0)
    if turn != 0:
        pull = min(pull, _pull(v, a, target, limits, np.sqrt(limits[2] * radius), left))
    if red > 0.0 and left > 0.0:
        pull = min(pull, _pull(v, a, target, limits, 0.0, max(left - 1.0, 0.0)))
    return pull


@numba.njit(cache=True)
def _within_jerk(a, pull, most):  # type: ignore[no-untyped-def]
    """The acceleration, moved towards the wanted one by no more than ``most``."""
    return a + min(max(pull - a, -most), most)


@numba.njit(cache=True)
def _speed_up(v, a, step):  # type: ignore[no-untyped-def]
    """Speed a step on, never backwards, and the acceleration: none into standing still."""
    faster = max(v + a * step, 0.0)
    return faster, a if faster > 0.0 else max(a, 0.0)


@numba.njit(cache=True)
def _course(heading, turn, bent, arc):  # type: ignore[no-untyped-def]
    """Direction of travel (rad), ``bent`` metres into an arc of ``arc`` metres."""
    share = min(max(bent / arc, 0.0), 1.0) if turn != 0 else 0.0
    return (heading + turn * share) * (np.pi / 2)


@numba.njit(cache=True)
def _widen(turn, travelled, stretch, arc, radius, wanted):  # type: ignore[no-untyped-def]
    """Corner radius, straight stretch and arc ahead, for another radius if there is room."""
    if turn == 0 or stretch - travelled <= max(wanted - radius, -1.0) + 1.0:
        return radius, stretch, arc
    return wanted, stretch - (wanted - radius), abs(turn) * (np.pi / 2) * wanted


@numba.njit(cache=True)
def _travel(  # type: ignore[no-untyped-def]
    rng, ends, limits, gaits, origin, counts, block, step, stride, epochs
):
    """x, y, vx, vy (epochs, 4) of one traveller; arguments as :func:`trajectory` makes them."""
    out = np.empty((epochs, 4))
    node, heading = _draw_start(rng, counts)
    along = origin + block * node
    phase = 0
    target, gait_left = _draw_gait(rng, gaits[0])
    v, a = 0.6 * target * rng.random(), 0.0  # slow enough for the first corner
    stopping = False  # to change over to the next phase
    # The way ahead is a straight stretch, then an arc over a crossing (none if turn is 0);
    # the crossing after that is known too, for braking over a crossing that is driven straight.
    travelled, stretch, arc, turn, red = 0.0, 0.0, 0.0, 0, 0.0
    radius = limits[0, 4]
    turn_after, red_after = _draw_crossing(rng, node, heading, counts, limits[0])
    for k in range(epochs * stride):
        if k % stride == 0:
            angle = _course(heading, turn, travelled - stretch, arc)
            out[k // stride] = along[0], along[1], v * np.cos(angle), v * np.sin(angle)
        if k * step >= ends[phase] and not stopping:
            # Where the next phase needs a wider corner than there is room for: first round it.
            wider = limits[phase + 1, 4] - radius
            stopping = turn == 0 or stretch - travelled > wider + 4.0
        if stopping:
            target, gait_left = 0.0, 1.0
            if v <= 0.1:
                stopping, phase, gait_left = False, phase + 1, 0.0
                radius, stretch, arc = _widen(
                    turn, travelled, stretch, arc, radius, limits[phase, 4]
                )
        if gait_left <= 0.0:
            target, gait_left = _draw_gait(rng, gaits[phase])
        gait_left -= step
        if travelled >= stretch + arc:  # over the crossing: on to the next
            heading = (heading + turn) % 4
            ahead = heading % 2
            distance = abs(origin[ahead] + block * node[ahead] - along[ahead])
            turn, red, radius = turn_after, red_after, limits[phase, 4]
            arc = abs(turn) * (np.pi / 2) * radius
            stretch, travelled = max(distance - (radius if turn != 0 else 0.0), 0.5), 0.0
            turn_after, red_after = _draw_crossing(
                rng, node, (heading + turn) % 4, counts, limits[phase]
            )
        left = stretch - travelled
        pull = _drive(v, a, target, limits[phase], turn, red, radius, left)
        if turn == 0:
            beyond = left + block - (radius if turn_after != 0 else 0.0)
            then = _drive(v, a, target, limits[phase], turn_after, red_after, radius, beyond)
            pull = min(pull, then)
        if v < 0.3 and left < 3.0:
            red -= step
        a = _within_jerk(a, pull, limits[phase, 3] * step)
        faster, a = _speed_up(v, a, step)
        moved = 0.5 * (v + faster) * step
        angle = _course(heading, turn, travelled + 0.5 * moved - stretch, arc)
        along[0] += moved * np.cos(angle)
        along[1] += moved * np.sin(angle)
        travelled += moved
        v = faster
    return out
