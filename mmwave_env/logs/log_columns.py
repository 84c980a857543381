"""Columns of a measurement log: the name of a column states a quantity and its unit."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from mmwave_env.io.lookup import did_you_mean, quoted
from mmwave_env.io.records import Bound, between
from mmwave_env.models import envelope
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.numerics.numbers import Number


class Unit(NamedTuple):
    """A unit: a value in this unit, times ``multiply`` / ``divide``, is the value in SI units.

    A division by 1000 rounds correctly; a factor of 0.001 would not, as floats can't represent it.
    """

    multiply: float = 1.0
    divide: float = 1.0

    def convert(self, value: Number) -> Number:
        """Convert a value of a column to SI units; values in dB stay in dB."""
        return value * self.multiply / self.divide


Units = dict[str, Unit]  # by the name of a column, or by the ending of names


class Quantity(NamedTuple):
    """A quantity in a log; its values are converted to s, m, rad, Hz, dB or m/s."""

    columns: Units  # names of the columns that may hold the quantity, with their units
    meaning: str  # the quantity in words, for messages
    # limits of what a receiver can measure, and their unit; "" for times and numbers of anchors
    limits: tuple[Bound, str] = (between(-1e300, 1e300), "")
    per_epoch: bool = False  # whether the quantity belongs to the epoch instead of an anchor

    def range_in(self, name: str, unit: Unit) -> tuple[float, float]:
        """Return the least and the most plausible value of a column, in the column's unit."""
        bound, limits_unit = self.limits
        scale = unit.divide / unit.multiply
        spare = 0.0
        if limits_unit == "degrees":
            scale *= np.pi / 180.0
            spare = _ROUNDING_DEG
        if self.limits is _TURN and name.endswith("_deg"):
            spare = _UNWRAPPED_DEG
        return scale * ((bound.least or 0.0) - spare), scale * ((bound.most or 0.0) + spare)


def _in(name: str, units: Units) -> Units:
    return {f"{name}{ending}": unit for ending, unit in units.items()}


_TIME = {"_s": Unit(), "_ms": Unit(1.0, 1e3), "_us": Unit(1.0, 1e6), "_ns": Unit(1.0, 1e9)}
_LENGTH = {"_m": Unit(), "_ft": Unit(0.3048)}  # international foot
_ANGLE = {"_rad": Unit(), "_deg": Unit(np.pi, 180.0)}
_SHIFT = {"_hz": Unit(), "_khz": Unit(1e3), "_mps": Unit()}  # columns_of converts m/s to Hz


DIFFERENCE = "rstd"  # reference signal time difference, as in LPP (3GPP TS 37.355)


def _flight(name: str) -> Units:
    """Return the columns that may hold a range: one-way time, round-trip time, or length.

    A range may also be the difference (rstd) to the range of a reference anchor in the same epoch.
    """
    ways = (("toa", SPEED_OF_LIGHT), ("rtt", SPEED_OF_LIGHT / 2.0), (DIFFERENCE, SPEED_OF_LIGHT))
    times = {
        f"{way}{name}{ending}": Unit(speed, unit.divide)
        for way, speed in ways
        for ending, unit in _TIME.items()
    }
    return {**times, f"{DIFFERENCE}{name}_m": Unit(), **_in(f"range{name}", _LENGTH)}


_SPEED = {"speed_mps": Unit(), "speed_kmh": Unit(1.0, 3.6)}

RANGE_LIMITS_M = (1e-3, 1e6)  # limits of real ranges; ranges in a wrong unit often violate them
WIDEST_ELEVATION_DEG = 90.0
_RANGE = between(-1.0, RANGE_LIMITS_M[1], "m"), "m"  # noise makes short ranges negative
_TURN = between(-360.0, 360.0, "degrees (docs/data.md, Angles)"), "degrees"
_TILT = (
    between(-WIDEST_ELEVATION_DEG, WIDEST_ELEVATION_DEG, "degrees from the horizon"),
    "degrees",
)
# Angles may be a little beyond their limits, if they were once stored as 32-bit numbers. Unwrapped
# azimuths of many turns are wrapped if they are surely in degrees.
_ROUNDING_DEG = 1e-4
_UNWRAPPED_DEG = 36_000.0
_SNR = between(-1e3, 1e3, "dB"), "dB"
# limits within which filters are numerically sound
_BIAS = (envelope.BIAS_HZ, "Hz")
_SPREAD = (envelope.DOPPLER_SPREAD_HZ, "Hz")
_FASTEST = envelope.VELOCITY_MPS, "m/s"
_DEVIATION = envelope.ANGLE_SIGMA_RAD, "rad"

STATION = "aoa_azimuth_station"
BODY = "aod_azimuth_body"
QUANTITIES = {
    "time": Quantity(_in("time", _TIME), "the time of the epoch"),
    "anchor": Quantity(
        {"anchor": Unit()},
        "the anchor's number in the scene; if unknown, use mmwave-loc localize --associate "
        "(docs/data.md)",
    ),
    "toa": Quantity(
        _flight(""),
        "the time of flight (rtt: round trip; rstd: minus a reference anchor's), or the range",
        _RANGE,
    ),
    "aoa_azimuth": Quantity(
        _in("aoa_azimuth", _ANGLE), "the azimuth from the anchor to the user", _TURN
    ),
    STATION: Quantity(_in(STATION, _ANGLE), "the azimuth of arrival at the base station", _TURN),
    "aoa_elevation": Quantity(_in("aoa_elevation", _ANGLE), "the elevation of arrival", _TILT),
    "aod_azimuth": Quantity(
        _in("aod_azimuth", _ANGLE), "the azimuth from the user to the anchor", _TURN
    ),
    BODY: Quantity(_in(BODY, _ANGLE), "the azimuth of departure, minus the heading", _TURN),
    "snr": Quantity({"snr_db": Unit()}, "the signal-to-noise ratio", _SNR),
    "doppler": Quantity(_in("doppler", _SHIFT), "the Doppler shift of one anchor", _BIAS),
    "toa_sigma": Quantity(
        _flight("_sigma"), "the standard deviation of the range", (envelope.RANGE_SIGMA_M, "m")
    ),
    **{
        f"{angle}_sigma": Quantity(
            _in(f"{angle}_sigma", _ANGLE), f"the standard deviation of {angle}", _DEVIATION
        )
        for angle in ("aoa_azimuth", "aoa_elevation", "aod_azimuth")
    },
    "doppler_sigma": Quantity(
        _in("doppler_sigma", _SHIFT),
        "the standard deviation of the Doppler shift",
        (envelope.DOPPLER_SIGMA_HZ, "Hz"),
    ),
    "doppler_spread": Quantity(
        _in("doppler_spread", _SHIFT), "the Doppler spread", _SPREAD, per_epoch=True
    ),
    "speed": Quantity(_SPEED, "the speed from odometry", _FASTEST, per_epoch=True),
    "heading": Quantity(_in("heading", _ANGLE), "the direction of travel", _TURN, per_epoch=True),
}
QUANTITY_OF = {name: quantity for quantity, row in QUANTITIES.items() for name in row.columns}

# For each quantity, words that suggest it if they occur in the name of an unknown column.
_SYNONYMS = {
    "time": ("t", "timestamp", "epoch", "seconds"),
    "anchor": ("bs", "gnb", "cell", "trp", "station", "beacon", "tx"),
    "toa": ("delay", "tof", "tau", "distance", "dist", "flight"),
    "aoa_azimuth": ("az", "azimuth", "aoa"),
    "aoa_elevation": ("el", "elev", "elevation"),
    "aod_azimuth": ("aod", "departure"),
    "snr": ("sinr",),
    "doppler": ("cfo", "shift"),
}

LINK_QUANTITIES = ("toa", "aoa_azimuth", "aoa_elevation", "aod_azimuth")
ODOMETRY_QUANTITIES = ("speed", "heading")
SIGMA_OF = {quantity: f"{quantity}_sigma" for quantity in (*LINK_QUANTITIES, "doppler")}
SIGMA_OF |= {STATION: "aoa_azimuth_sigma", BODY: "aod_azimuth_sigma"}
DEVIATIONS = list(SIGMA_OF.values())
USER = "ue"  # name of the column that names the users of live rows
# numbers that mean "lost" in the files of some receivers, with either sign, in any unit
LOST = (999.0, 9999.0, 99999.0, 999999.0, 32767.0, 32768.0, 65535.0)
HORIZONTAL = ("toa", "aoa_azimuth", STATION, "aod_azimuth", BODY)  # a log needs one or more of them
_OF_PATHS = ("toa", "aoa_azimuth")  # required of paths
_OTHER_FRAMES = {  # angle: (angle in another frame, quantity required in place of the angle)
    "aoa_azimuth": (STATION, STATION),
    "aod_azimuth": (BODY, "heading"),
}


class Column(NamedTuple):
    """A column of a log."""

    name: str  # name in the file
    number: int  # index of the column in the file, from 0
    unit: Unit  # unit in the file
    low: float  # least and most plausible value, in the file's unit
    high: float


ByQuantity = dict[str, Column]  # the columns of a log that are used


def columns_of(
    names: Sequence[str],
    hz_per_mps: float,
    odometry: bool,
    associated: bool,
) -> ByQuantity:
    """Return the columns of a log by quantity, from the names of all its columns.

    If ``odometry`` is False, columns of odometry are ignored, except a heading that angles need; if
    ``associated`` is False, a column of anchors is ignored. A Doppler shift in m/s is multiplied by
    ``hz_per_mps``, f_c / c. Paths (not ``associated``) need a range and an azimuth of arrival;
    otherwise, one quantity of :data:`HORIZONTAL` is enough. Columns named "" are ignored.

    Raises:
        ValueError: a name is unknown or lacks its unit, or a quantity occurs twice or is
            missing; the message lists the names that are allowed.
    """
    columns: ByQuantity = {}
    if unknown := [name for name in names if name and name not in QUANTITY_OF]:
        problems = "; ".join(map(_problem, unknown[:10]))  # enough to read in one message
        known = ", ".join(next(iter(row.columns)) for row in QUANTITIES.values())
        raise ValueError(
            f"{problems}; the only allowed columns are {known}, or the same in other units; "
            "docs/own-data.md shows a command that renames the columns of a log"
        )
    for number, name in enumerate(names):
        if not name:
            continue
        quantity = QUANTITY_OF[name]
        if quantity in columns:
            raise _twice(columns[quantity].name, name, f"{quantity} once")
        unit = QUANTITIES[quantity].columns[name]
        if name.startswith("doppler") and name.endswith("_mps"):
            unit = Unit(hz_per_mps)
        columns[quantity] = Column(name, number, unit, *QUANTITIES[quantity].range_in(name, unit))
    ignored = () if odometry else ("speed",) if BODY in columns else ODOMETRY_QUANTITIES
    for quantity in ignored if associated else (*ignored, "anchor"):
        columns.pop(quantity, None)
    _require(columns, names, associated)
    return columns


def _twice(name: str, other: str, expected: str) -> ValueError:
    """Return the error for two columns with the same quantity."""
    both = f"{name!r} twice" if name == other else f"both {name!r} and {other!r}"
    return ValueError(f"columns: found {both}, expected {expected}")


def _require(columns: ByQuantity, names: Sequence[str], associated: bool) -> None:
    """Refuse columns if some are missing or contradict each other."""
    required = ["time", "anchor"] if associated else ["time", *_OF_PATHS]
    for usual, (other, needed) in _OTHER_FRAMES.items():
        if other in columns:
            if usual in columns:
                raise _twice(columns[usual].name, columns[other].name, f"{usual} in only one frame")
            required = [*(quantity for quantity in required if quantity != usual), needed]
    if associated and columns.keys().isdisjoint(HORIZONTAL):
        known = ", ".join(next(iter(QUANTITIES[quantity].columns)) for quantity in HORIZONTAL)
        raise ValueError(
            f"columns: found {', '.join(names)}, which say nothing about the horizontal position, "
            f"expected one or more of {known}"
        )
    if BODY not in columns and not columns.keys().isdisjoint(ODOMETRY_QUANTITIES):
        required += ODOMETRY_QUANTITIES
    for quantity in required:
        if quantity not in columns:
            row = QUANTITIES[quantity]
            raise ValueError(
                f"columns: found no {quantity} in {', '.join(names)}, expected "
                f"{_one_of(row.columns)}, {row.meaning}"
            )


def require_clock_and_noise(columns: ByQuantity, clock: str, has_snr: bool) -> None:
    """Refuse a clock that contradicts the ranges, and measurements without deviation or SNR."""
    for quantity, sigma in SIGMA_OF.items():
        if quantity in columns and not (has_snr or "snr" in columns or sigma in columns):
            name = columns[quantity].name
            unit = name.rpartition("_")[2]
            own = next(n for n in QUANTITIES[sigma].columns if n.endswith(f"_{unit}"))
            raise ValueError(
                f"columns: found {name} without its noise, expected {own} or "
                "snr_db, or --snr DB for all links"
            )
    times = columns["toa"].name if "toa" in columns else ""
    if clock != "synchronized" and (not times or times.startswith("rtt")):
        problem = f"round-trip times ({times})" if times else "no range"
        raise ValueError(
            f"clock: found the setting {clock!r}, but the log has {problem}; expected one-way "
            "times or ranges, such as toa_s, or the setting 'synchronized'"
        )
    if clock != "free" and times.startswith(DIFFERENCE):
        raise ValueError(
            f"clock: found time differences ({times}) and the setting {clock!r}, expected the "
            "setting 'free', in which only differences of ranges count"
        )


def _problem(name: str) -> str:
    """Return the message about an unknown column name, with a suggestion if there is one."""
    if name == USER:
        return f"column {name!r}: found users, expected one (a file has one; --live reads many)"
    # The longest match counts, so that doppler_spread_x is not taken for a Doppler shift.
    spelled = {quantity: quantity for quantity in QUANTITIES} | {"range": "toa"}
    meant = [start for start in spelled if name == start or name.startswith(f"{start}_")]
    if meant:
        expected = _one_of(QUANTITIES[spelled[max(meant, key=len)]].columns)
        return f"column {quoted(name)}: found no known unit, expected {expected}"
    *_, unit = words = re.findall("[a-z]+", name.lower()) or [name]
    hint = did_you_mean(name, QUANTITY_OF, 2)
    for quantity, synonyms in _SYNONYMS.items():
        if not set(synonyms).isdisjoint(words):
            known = [own for own in QUANTITIES[quantity].columns if not own.startswith(DIFFERENCE)]
            same = [own for own in known if own.endswith(f"_{unit}")] or known
            hint = f"; did you mean {_one_of(same)}, {QUANTITIES[quantity].meaning}?"
            break
    return f"column {quoted(name)}: found an unknown quantity{hint.replace('; ', ' (', 1)}" + (
        ")" if hint else ""
    )


def _one_of(names: Iterable[str]) -> str:
    *most, last = names
    return f"{', '.join(most)} or {last}" if most else last
