"""Motion of users along streets, written so that SIMD lanes can move eight users at once.

A traveler (a moving user) speeds up to its target speed, and brakes for corners and red lights,
within limits of acceleration, braking and jerk. Each substep takes about 0.1 s. Between substeps,
:mod:`mmwave_env.world.travel` draws events: target speeds, crossings, phases (styles of moving).
"""

from typing import NamedTuple

from mmwave_env.numerics.numbers import (
    Number,
    Numbers,
    Pair,
    clip,
    cos_sin,
    maximum,
    minimum,
    sqrt,
    where,
)

STANDING_MPS = 0.1  # a traveler at or below this speed may begin another phase
FAR = 1e9  # m or s: a distance or time that is never reached


class Net(NamedTuple):
    """The net of streets on which a traveler moves."""

    block: Number  # distance between crossings, m
    # blocks_x, blocks_y: number of blocks, west to east and south to north
    blocks_x: Number
    blocks_y: Number
    # origin_x, origin_y: position of the south-west crossing, m
    origin_x: Number
    origin_y: Number
    height: Number  # height of the user equipment, m


class Traveler(NamedTuple):
    """The state of a traveler.

    The way ahead is a straight stretch, then an arc over the next crossing (no arc if the traveler
    goes straight on). The second crossing comes after that; travelers may brake for it early.
    """

    due: Number  # 1 if an event is due now: a new target speed, crossing or phase
    time: Number  # time since the episode began, s
    # x, y: position at which the way ahead begins, m
    x: Number
    y: Number
    heading: Number  # heading before the arc, in quarter turns counterclockwise from east: 0 to 3
    traveled: Number  # distance traveled on the way ahead, m
    # stretch, arc: lengths of the two parts of the way ahead, m
    stretch: Number
    arc: Number
    radius: Number  # radius of the arc, m
    # v, a: speed (m/s) and acceleration (m/s^2)
    v: Number
    a: Number
    # acceleration, braking, lateral: limits, m/s^2
    acceleration: Number
    braking: Number
    lateral: Number
    jerk: Number  # limit of the jerk, m/s^3
    target: Number  # speed to reach, m/s
    gait_left: Number  # time for which the target speed is still kept, s
    phase: Number  # number of the phase (a style of moving); it ends at ``phase_end`` s
    phase_end: Number
    stopping: Number  # 1 while the traveler brakes to a standstill, before the next phase
    # turn, red: quarter turns to the left, and remaining seconds of red light, at the next crossing
    turn: Number
    red: Number
    # turn_after, red_after: the same for the second crossing
    turn_after: Number
    red_after: Number
    # node_x, node_y: position of the second crossing, in blocks from the origin
    node_x: Number
    node_y: Number


STILL = Traveler(*[0.0] * len(Traveler._fields))  # a placeholder, to be overwritten


def unit(heading: Number) -> Pair:
    """Return the unit vector (east, north) of a heading of 0 to 3 quarter turns."""
    odd = where(abs(heading - 2.0) > 0.5, 0.0, -1.0)
    east = where(heading < 0.5, 1.0, odd)
    north = where(abs(heading - 1.0) < 0.5, 1.0, where(heading > 2.5, -1.0, 0.0))
    return east, north


def around(heading: Number) -> Number:
    """Wrap a heading of -4 to 7 quarter turns into 0 to 3 quarter turns."""
    heading = where(heading > 3.5, heading - 4.0, heading)
    return where(heading < -0.5, heading + 4.0, heading)


def state_of(t: Traveler) -> tuple[Numbers, Numbers]:
    """Return the position (2,), m, and the velocity (2,), m/s, of a traveler."""
    along = minimum(t.traveled, t.stretch)
    bent = clip(t.traveled - t.stretch, 0.0, t.arc)
    beyond = maximum(t.traveled - t.stretch - t.arc, 0.0)  # distance past the arc, if any
    east, north = unit(t.heading)
    side = where(t.turn < -0.5, -1.0, 1.0)
    cosine, sine = cos_sin(bent / t.radius)
    forward = along + t.radius * sine + beyond * cosine
    left = side * (t.radius * (1.0 - cosine) + beyond * sine)
    ahead = t.v * cosine
    across = side * t.v * sine
    position = [t.x + forward * east - left * north, t.y + forward * north + left * east]
    return position, [ahead * east - across * north, ahead * north + across * east]


def wanted_acceleration(t: Traveler, net: Net) -> Number:
    """Return the acceleration, m/s^2, that a traveler wants, given its target and the road ahead.

    Two things ahead limit the speed. A turn at a crossing limits it to v_c, where v_c^2 is the
    limit of lateral acceleration times the radius; a red light limits it to v_c = 0 one meter
    before the crossing. Let d be the distance to this turn or stop, and b the limit of braking.
    Travelers plan to brake at b / 2, so they aim at a speed u with u^2 = v_c^2 + 2 (b / 2) d. At
    their current speed v, they need to brake at (v^2 - v_c^2) / (2 d'), where d' is d minus the
    distance that they travel while the braking builds up (the jerk is limited). If they need more
    than 0.7 b, they brake as hard as needed, up to b.
    """
    left = t.stretch - t.traveled
    turns = t.arc > 0.0
    turns_after = abs(t.turn_after) > 0.5
    beyond = left + net.block - where(turns_after, t.radius, 0.0)
    corner = where(turns, left, where(turns_after, beyond, FAR))
    light_after = where((t.red_after > 0.0) & (beyond > 0.0), beyond, FAR)
    light = where((t.red > 0.0) & (left > 0.0), left, where(turns, FAR, light_after))
    light = maximum(light - 1.0, 0.0)
    cornering = t.lateral * t.radius
    squared = t.v * t.v
    aim = minimum(cornering + t.braking * maximum(corner, 0.0), t.braking * light)
    aim = sqrt(minimum(t.target * t.target, aim))
    pull = clip((aim - t.v) * 2.0, -t.braking, t.acceleration)
    built_up = 0.6 / t.jerk * (maximum(t.a, 0.0) + t.braking) * t.v  # distance d - d'
    need = maximum(
        where(corner > 0.0, squared - cornering, 0.0) / (2.0 * maximum(corner - built_up, 0.5)),
        where(light > 0.0, squared, 0.0) / (2.0 * maximum(light - built_up, 0.5)),
    )
    late = need > 0.7 * t.braking
    return where(late, minimum(pull, -minimum(need, t.braking)), pull)


def move(t: Traveler, net: Net, step: Number) -> Traveler:
    """Move a traveler for a substep of ``step`` seconds, and mark whether an event is due."""
    most = t.jerk * step
    waiting = (t.v < 0.3) & (t.stretch - t.traveled < 3.0)
    a = t.a + clip(wanted_acceleration(t, net) - t.a, -most, most)
    # maximum() keeps v >= 0, and prevents a fused multiply-add, which would round differently.
    v = t.v + maximum(a * step, -t.v)
    a = where(v > 0.0, a, maximum(a, 0.0))
    time = t.time + step
    traveled = t.traveled + 0.5 * (t.v + v) * step
    gait_left = t.gait_left - step
    changing = where(t.stopping > 0.5, STANDING_MPS - v, time - t.phase_end)
    due = (gait_left <= 0.0) | (traveled >= t.stretch + t.arc) | (changing >= 0.0)
    return t._replace(
        due=where(due, 1.0, 0.0),
        time=time,
        traveled=traveled,
        v=v,
        a=a,
        gait_left=gait_left,
        red=where(waiting, t.red - step, t.red),
    )
