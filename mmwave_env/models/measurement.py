"""The geometry of an epoch's measurement, for one group of rows at a time (paper, Sec. II-B).

Inside the package the time of arrival is given as the range c tau in meters, and angles are in
radians. With position p, velocity v, first anchor p1 and oscillator bias b, the Doppler shift is

    (f_c / c) v . (p - p1) / |p - p1| + b  (Hz)

The paper prints the first term in m/s and adds b in hertz. Here, the factor f_c / c scales the term
to hertz; its sign is the paper's (positive while the range grows). :mod:`mmwave_env.models.layout`
says which quantity is in which row.

A group of rows (a link, the Doppler shift or odometry) is described by its innovation, its Jacobian
and the exact change of its values when the state changes by a finite step. Filters with sigma
points need this change. It does not jump where angles wrap.

Straight below or above an anchor the azimuth is undefined, and at the anchor itself the elevation
is undefined, too. Near these points, the gradient of the azimuth grows as 1 / (horizontal
distance), and the information that a filter takes from the azimuth grows as the gradient's square.
So lengths up to :data:`NEAREST_M` count as 0, and an undefined angle carries no information: its
row has innovation, gradient and change 0.
"""

from collections.abc import Callable
from typing import NamedTuple

from mmwave_env.models.layout import STATE_SIZE, Layout
from mmwave_env.numerics.linalg import dot, is_zero, minus, plus, product, times
from mmwave_env.numerics.numbers import (
    PI,
    Matrix,
    Number,
    Numbers,
    Pair,
    Vector,
    atan2,
    cos_sin,
    maximum,
    sqrt,
    where,
    wrap,
)
from mmwave_env.numerics.pytree import select

SPEED_OF_LIGHT = 299_792_458.0  # m/s
# Longest length that counts as 0: less than the uncertainty of an antenna's position, but far more
# than the rounding errors of coordinates of 1000 km (1e-10 m).
NEAREST_M = 1e-3
ROWS_OF_LINK = 3  # in a link's group: range, azimuth and elevation
_SLOWEST_ODOMETRY = 1e-3  # m/s; minimum of the speeds by which gradients are divided


class Measurement(NamedTuple):
    """The measurement of one epoch, as an estimator sees it.

    Attributes:
        anchors: (L, 3) positions, meters.
        hz_per_mps: carrier frequency divided by the speed of light, hertz per m/s.
        z: (rows,) measured values; any finite number where missing.
        variance: (rows,) noise variances in squared units of z; positive even where missing.
        visible: (groups,) 1 where the group was measured, else 0.
        layout: which quantity is in which row.
        measured: (rows,) 1 where the row was measured, else 0; empty unless the layout is partial.
        doppler_of: (L,) 1 for the anchor whose Doppler shift was measured, else 0; empty unless the
            layout is partial.
    """

    anchors: Matrix
    hz_per_mps: Number
    z: Vector
    variance: Vector
    visible: Vector
    layout: Layout
    measured: Vector = ()
    doppler_of: Vector = ()


class Group(NamedTuple):
    """The measurement function h of one group, expanded at the prior mean x.

    Attributes:
        innovation: (k,) z - h(x), angles wrapped.
        variance: (k,) noise variances.
        jacobian: (k, 7) dh/dx, (k, 8) with a clock offset; constant zeros for components of the
            state on which h does not depend.
        change: function that returns the exact h(x + step) - h(x) for a step of the state (7,).
        curved: k if h is nonlinear along columns 0 to k - 1 of the covariance's factor
            (:func:`~mmwave_env.filters.linearization.factor_of`), and linear along the others.
        spare_nis, spare_determinant: NIS and variance of the azimuths' difference in a link.
    """

    innovation: Vector
    variance: Vector
    jacobian: Matrix
    change: Callable[[Vector], Numbers]
    curved: int
    spare_nis: Number = 0.0
    spare_determinant: Number = 1.0


def norms(d: Vector) -> Pair:
    """Return the horizontal and the full length of a vector (3,)."""
    squared = d[0] * d[0] + d[1] * d[1]
    return sqrt(squared), sqrt(squared + d[2] * d[2])


def direction(d: Vector) -> tuple[Number, Number, Number]:
    """Return range (m), azimuth and elevation (rad) of d = p - anchor (paper: ToA and AoA)."""
    horizontal, distance = norms(d)
    return distance, atan2(d[1], d[0]), atan2(d[2], horizontal)


def seen_from_image(azimuth: Number, elevation: Number, station: Vector, image: Vector) -> Pair:
    """Convert a ray's direction (rad) at the base station to its direction at the mirror image.

    ``image`` (3,) is the mirror image of ``station`` (3,) in a wall. The direction d becomes
    d - 2 (d.n) n, with the unit vector n along image - station. If image = station, d is unchanged.
    """
    n = minus(image, station)
    cos_az, sin_az = cos_sin(azimuth)
    cos_el, sin_el = cos_sin(elevation)
    d = [cos_el * cos_az, cos_el * sin_az, sin_el]
    square = dot(n, n)
    along = 2.0 * dot(d, n) / where(square > 0.0, square, 1.0)
    _, *mirrored = direction([d[i] - along * n[i] for i in range(3)])
    return mirrored[0], mirrored[1]


def range_rate(d: Vector, velocity: Vector) -> Number:
    """Return the rate of change of |d|, m/s, for an anchor at rest; 0 at the anchor itself."""
    return dot(d, velocity) / maximum(norms(d)[1], NEAREST_M)


def _inverse(length: Number) -> Number:
    """Return 1 / length, or 0 where the length counts as 0, so that gradients vanish there."""
    return where(length > NEAREST_M, 1.0 / maximum(length, NEAREST_M), 0.0)


def _turn(a: Vector, b: Vector) -> Number:
    """Return the angle (rad) from a horizontal vector ``a`` to ``b``; 0 if one of them is zero."""
    return atan2(b[1] * a[0] - b[0] * a[1], b[0] * a[0] + b[1] * a[1])


def exact_rows(
    position: Vector, velocity: Vector, anchors: Matrix, hz_per_mps: Number, layout: Layout
) -> Numbers:
    """Compute a user's measurement (rows,) in m, rad, Hz, m/s, without noise and biases.

    Position and velocity are (3,), m and m/s; anchors (L, 3), m.
    """
    rows: Numbers = []
    for anchor in anchors:
        distance, azimuth, elevation = direction(minus(position, anchor))
        departure = where(azimuth > 0.0, azimuth - PI, azimuth + PI)
        rows += [distance, azimuth, elevation, departure]
    rows.append(hz_per_mps * range_rate(minus(position, anchors[0]), velocity))
    if layout.odometry:
        rows += [norms(velocity)[1], atan2(velocity[1], velocity[0])]
    return rows


def _fused(
    arrival: Number, departure: Number, variance: Vector, measured: Vector
) -> tuple[Number, Number, Number, Number]:
    """Fuse the innovations of a link's azimuths; other arguments are as for :func:`link_group`.

    Return innovation and variance of the bearing, and NIS and variance of the azimuths' difference.

    The azimuths of arrival and departure, which differ by pi (paper, Sec. II-B), measure the same
    bearing, with variances ra and rd. Their weighted mean is a row with variance ra rd / (ra + rd).
    Fusing drops their difference, which has variance ra + rd and does not depend on the state.
    ``Sensor`` in :mod:`mmwave_env.filters.textbook` keeps all four rows.
    """
    _, arrival_variance, _, departure_variance = variance
    total = arrival_variance + departure_variance
    fused = arrival_variance * departure_variance / total
    bearing = (arrival * departure_variance + departure * arrival_variance) / total
    disagreement = arrival - departure
    spare_nis = disagreement * disagreement / total
    if not len(measured):
        return bearing, fused, spare_nis, total
    both = measured[1] * measured[3] > 0.5
    alone = measured[1] > 0.5
    return (
        where(both, bearing, where(alone, arrival, departure)),
        where(both, fused, where(alone, arrival_variance, departure_variance)),
        where(both, spare_nis, 0.0),
        where(both, total, 1.0),
    )


def link_group(
    x: Vector, anchor: Vector, z: Vector, variance: Vector, measured: Vector = ()
) -> Group:
    """Return the group of a link, with its four rows fused to three: range, azimuth and elevation.

    ``x`` (7,) is the prior mean, and ``anchor`` (3,) the anchor's position, m. ``z`` and
    ``variance`` are (4,). ``measured`` (4,) is 1 where a row was measured, else 0; () means all.
    """
    d = minus(x, anchor)
    distance, azimuth, elevation = direction(d)
    horizontal = norms(d)[0]
    aside = horizontal > NEAREST_M
    apart = distance > NEAREST_M
    arrival = where(aside, wrap(z[1] - azimuth), 0.0)
    departure = where(aside, wrap(wrap(z[3] - azimuth + PI)), 0.0)
    bearing, bearing_variance, spare_nis, spare_determinant = _fused(
        arrival, departure, variance, measured
    )
    inverse = _inverse(distance)
    inverse_horizontal = _inverse(horizontal)
    slope = d[2] * inverse_horizontal * inverse * inverse
    across = inverse_horizontal * inverse_horizontal
    ahead = select(aside, d[:2], [0.0, 0.0])
    raised = select(apart, [horizontal, d[2]], [0.0, 0.0])
    still = [0.0] * (len(x) - 3)
    clock = list(x[STATE_SIZE:])
    slow = [*[0.0] * 4, *[1.0] * len(clock)]  # the range contains a clock's bias as a summand

    def change(step: Vector) -> Numbers:
        q = plus(d, step)
        q_horizontal, q_distance = norms(q)
        vertical = all(map(is_zero, step[:2]))
        turn = 0.0 if vertical else _turn(ahead, q)
        rise = _turn(raised, [q_horizontal, q[2]])
        return [sum(step[STATE_SIZE:], q_distance - distance), turn, rise]

    group = Group(
        innovation=[
            z[0] - sum(clock, distance),
            bearing,
            where(apart, wrap(z[2] - elevation), 0.0),
        ],
        variance=[variance[0], bearing_variance, variance[2]],
        jacobian=[
            [d[0] * inverse, d[1] * inverse, d[2] * inverse, *slow],
            [-d[1] * across, d[0] * across, 0.0, *still],
            [-d[0] * slope, -d[1] * slope, horizontal * inverse * inverse, *still],
        ],
        change=change,
        curved=3,
        spare_nis=spare_nis,
        spare_determinant=spare_determinant,
    )
    if not len(measured):
        return group
    return _only(group, [measured[0], maximum(measured[1], measured[3]), measured[2]])


def _only(group: Group, measured: Vector) -> Group:
    """Return a group whose rows (k,) carry information only if they were measured.

    The rows that were not measured get innovation, gradient and change 0, and variance 1, so that
    they add nothing to NIS, determinant and information.
    """

    def change(step: Vector) -> Numbers:
        return times(measured, group.change(step))

    return group._replace(
        innovation=times(measured, group.innovation),
        variance=[where(m > 0.5, v, 1.0) for m, v in zip(measured, group.variance, strict=True)],
        jacobian=[[m * d for d in row] for m, row in zip(measured, group.jacobian, strict=True)],
        change=change,
    )


def doppler_group(
    x: Vector, anchor: Vector, hz_per_mps: Number, z: Vector, variance: Vector
) -> Group:
    """Return the group of an anchor's Doppler shift (Hz), which is linear in v and the bias."""
    d = minus(x, anchor)
    v = x[3:6]
    distance = norms(d)[1]
    inverse = _inverse(distance)
    defined = where(distance > NEAREST_M, 1.0, 0.0)
    u = [component * inverse for component in d]
    rate = range_rate(d, v)

    def change(step: Vector) -> Numbers:
        q = plus(d, step)
        velocity = plus(v, step[3:])
        return [defined * (hz_per_mps * (range_rate(q, velocity) - rate) + step[6])]

    transverse = [hz_per_mps * inverse * (v[i] - u[i] * rate) for i in range(3)]
    radial = [hz_per_mps * component for component in u]
    return Group(
        innovation=[defined * (z[0] - (hz_per_mps * rate + x[6]))],
        variance=variance,
        jacobian=[[*transverse, *radial, defined, *[0.0] * len(x[STATE_SIZE:])]],
        change=change,
        curved=3,
    )


def odometry_group(x: Vector, z: Vector, variance: Vector) -> Group:
    """Return the group of the user's odometry: speed |v| (m/s) and heading atan2(vy, vx) (rad).

    At rest, the heading is undefined and counts as 0.
    """
    v = x[3:6]
    horizontal, speed = norms(v)
    ahead = select(horizontal > _SLOWEST_ODOMETRY, list(v[:2]), [1.0, 0.0])
    speed_inverse = 1.0 / maximum(speed, _SLOWEST_ODOMETRY)
    horizontal_inverse = 1.0 / maximum(horizontal, _SLOWEST_ODOMETRY)
    across = horizontal_inverse * horizontal_inverse

    def change(step: Vector) -> Numbers:
        q = plus(v, step[3:])
        return [norms(q)[1] - speed, _turn(ahead, q)]

    fixed = [0.0] * 3
    others = [0.0] * (len(x) - 6)
    return Group(
        innovation=[z[0] - speed, wrap(z[1] - atan2(ahead[1], ahead[0]))],
        variance=variance,
        jacobian=[
            [*fixed, *(component * speed_inverse for component in v), *others],
            [*fixed, -v[1] * across, v[0] * across, 0.0, *others],
        ],
        change=change,
        curved=len(x) - 1,
    )


def doppler_anchor(anchors: Matrix, doppler_of: Vector) -> Vector:
    """Return the position (3,) of the anchor whose Doppler shift was measured."""
    if not len(doppler_of):
        return anchors[0]
    return product([doppler_of], anchors)[0]


def groups_of(x: Vector, m: Measurement) -> list[Group]:
    """Return the groups of an epoch, expanded at prior mean x (7,): links, Doppler, odometry."""
    rows = m.layout.groups
    links = [
        link_group(x, anchor, m.z[r], m.variance[r], m.measured[r])
        for anchor, r in zip(m.anchors, rows, strict=False)
    ]
    r = rows[m.layout.anchors]
    anchor = doppler_anchor(m.anchors, m.doppler_of)
    groups = [*links, doppler_group(x, anchor, m.hz_per_mps, m.z[r], m.variance[r])]
    if m.layout.odometry:
        r = rows[-1]
        odometry = odometry_group(x, m.z[r], m.variance[r])
        groups.append(_only(odometry, m.measured[r]) if m.layout.partial else odometry)
    return groups


class Epoch(NamedTuple):
    """The input of an estimator in an epoch; missing groups hold arbitrary finite numbers."""

    dt: Number  # seconds since the previous epoch; 0 in the first epoch, which the prior describes
    z: Numbers  # (rows,) measured values: m, rad, Hz, m/s
    sigma: Numbers  # (rows,) standard deviations of the values z, positive
    visible: Numbers  # (groups,) 1 where measured, else 0
    snr_db: Numbers  # (L,) signal-to-noise ratio per link, dB
    doppler_spread_hz: Number
    # measured, doppler_of: same as in :class:`Measurement`
    measured: Vector = ()
    doppler_of: Vector = ()


class Site(NamedTuple):
    """Constants of an episode: anchors, carrier and prior."""

    anchors: Matrix  # (L, 3) positions, m
    hz_per_mps: Number  # carrier frequency divided by the speed of light
    prior_x: Numbers  # (7,) mean at the first epoch; (8,) with a clock offset
    prior_P: Numbers  # (28,) packed covariance (lower triangle); (36,) with a clock offset


def blank_site(layout: Layout) -> Site:
    """Return a placeholder site with valid numbers, to be overwritten."""
    n = layout.state_size
    prior = [float(i == j) for i in range(n) for j in range(i + 1)]
    anchors = [[0.0, 0.0, 10.0 + a] for a in range(layout.anchors)]
    return Site(anchors, 1.0, [1.0] * n, prior)
