"""Motion of users along their way, on lanes: eight travelers at once.

A traveler speeds up and brakes within limits of acceleration, braking and jerk, towards its
target speed and down to what lies ahead: corners and red lights. The equations are those of a
substep without events; :mod:`mmwave_env.episodes.travel` has what happens between them.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import c_function, tree_kernel
from mmwave_env.numerics.numbers import Number, clip, cos_sin, maximum, minimum, sqrt, where

STANDING_MPS = 0.1  # slow enough to change over to another phase


class Traveler(NamedTuple):
    """Where a traveler is, and what it is up to.

    The way ahead is a straight stretch, then an arc over a crossing (none where it is straight
    on); the crossing after that is known too, for braking over a crossing that is driven straight.
    """

    step: Number  # length of a substep, s
    substep: Number  # how many there were
    due: Number  # 1 where something is to happen before the next one: a gait, a crossing, a phase
    # x, y: position, m
    x: Number
    y: Number
    # vx, vy: velocity where last observed, m/s
    vx: Number
    vy: Number
    # v, a: speed (m/s) and acceleration (m/s^2)
    v: Number
    a: Number
    # acceleration, braking, lateral, jerk: limits, m/s^2 and m/s^3
    acceleration: Number
    braking: Number
    lateral: Number
    jerk: Number
    target: Number  # speed to reach, m/s
    gait_left: Number  # time to keep it, s
    phase: Number  # which; ends at ``phase_end`` s
    phase_end: Number
    stopping: Number  # 1 while coming to a stand to change over to the next phase
    heading: Number  # in quarter turns, before the arc
    traveled: Number  # on the way ahead, m
    # stretch, arc: lengths of the way ahead, m
    stretch: Number
    arc: Number
    # radius, curvature: of its arc, m and 1/m; curvature is positive to the left
    radius: Number
    curvature: Number
    # turn, red: at the crossing ahead: quarter turns to the left; red light, s
    turn: Number
    red: Number
    # turn_after, red_after: at the crossing after that
    turn_after: Number
    red_after: Number
    # node_x, node_y: the crossing after that, in blocks from the origin
    node_x: Number
    node_y: Number
    block: Number  # distance of crossings, m
    # blocks_x, blocks_y: how many there are, west to east and south to north
    blocks_x: Number
    blocks_y: Number
    # origin_x, origin_y: the crossing to the south-west, m
    origin_x: Number
    origin_y: Number


AT = Traveler(*range(len(Traveler._fields)))  # rows of a block


def _direction(t: Traveler, traveled: Number) -> tuple[Number, Number]:
    """Cosine and sine of the course after some meters of the way ahead."""
    bent = clip(traveled - t.stretch, 0.0, t.arc)
    return cos_sin((np.pi / 2) * t.heading + t.curvature * bent)


def observe(t: Traveler) -> Traveler:
    """Fill in the velocity."""
    cosine, sine = _direction(t, t.traveled)
    return t._replace(vx=t.v * cosine, vy=t.v * sine)


def wanted_acceleration(t: Traveler) -> Number:
    """The acceleration a traveler asks for, m/s^2: to its target speed, or down for what is ahead.

    Two things ahead limit the speed. A turn at a crossing limits it to v_c with v_c^2 = lateral
    acceleration times radius; a red light limits it to v_c = 0 one meter before the crossing.
    Braking at b over a distance d goes from v down to v_c with v^2 = v_c^2 + 2 b d. Travelers plan
    with half of their b, so the speed they aim at is v^2 = v_c^2 + b d. The braking that v needs,
    (v^2 - v_c^2) / 2 d, counts d without what is traveled until the braking has built up; where it
    exceeds 0.7 b, they brake as hard as needed, up to b.
    """
    left, turns = t.stretch - t.traveled, t.arc > 0.0
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


def move(t: Traveler) -> Traveler:
    """A substep; at its end, whether something is due."""
    most = t.jerk * t.step
    waiting = (t.v < 0.3) & (t.stretch - t.traveled < 3.0)
    a = t.a + clip(wanted_acceleration(t) - t.a, -most, most)
    v = t.v + maximum(a * t.step, -t.v)  # never backwards; nor fused, which rounds otherwise
    a = where(v > 0.0, a, maximum(a, 0.0))
    moved = 0.5 * (t.v + v) * t.step
    cosine, sine = _direction(t, t.traveled + 0.5 * moved)
    substep, traveled = t.substep + 1.0, t.traveled + moved
    gait_left = t.gait_left - t.step
    changing = where(t.stopping > 0.5, STANDING_MPS - v, substep * t.step - t.phase_end)
    due = (gait_left <= 0.0) | (traveled >= t.stretch + t.arc) | (changing >= 0.0)
    return t._replace(
        substep=substep,
        due=where(due, 1.0, 0.0),
        x=t.x + moved * cosine,
        y=t.y + moved * sine,
        v=v,
        a=a,
        gait_left=gait_left,
        traveled=traveled,
        red=where(waiting, t.red - t.step, t.red),
    )


@lru_cache(maxsize=1)
def motion() -> tuple[Any, Any]:
    """Two C functions of the address of a block (rows of a Traveler, 8).

    The first moves the travelers in the first lanes until something is due, or for some
    substeps, and returns how many of them are left: (address, substeps, lanes) -> substeps. The
    second fills in their velocities.
    """
    shape, substep, look = (len(AT), WIDTH), tree_kernel(move, AT), tree_kernel(observe, AT)

    def move_on(address, substeps, here):  # type: ignore[no-untyped-def]
        block = numba.carray(address, shape, np.float64)
        due = False
        while substeps > 0 and not due:  # no events inside: so it all stays in registers
            substep(block)
            substeps -= 1
            for lane in range(here):
                due |= block[AT.due, lane] > 0.0
        return substeps

    def observed(address):  # type: ignore[no-untyped-def]
        look(numba.carray(address, shape, np.float64))

    moving = types.int64(types.voidptr, types.int64, types.int64)
    return c_function(moving, move_on), c_function(types.void(types.voidptr), observed)
