"""Columns of a measurement log: the name of a column is a quantity and its unit."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from mmwave_env.io.lookup import quoted
from mmwave_env.models.measurement import SPEED_OF_LIGHT


class Unit(NamedTuple):
    """A unit: value * multiply / divide. Powers of ten divide, because that rounds correctly."""

    multiply: float = 1.0
    divide: float = 1.0


_TIME = {"_s": Unit(), "_ms": Unit(1.0, 1e3), "_us": Unit(1.0, 1e6), "_ns": Unit(1.0, 1e9)}
_ANGLE = {"_rad": Unit(), "_deg": Unit(np.pi, 180.0)}
_SHIFT = {"_hz": Unit(), "_khz": Unit(1e3), "_mps": Unit()}  # _mps: times f_c / c


def _in(name: str, units: dict[str, Unit]) -> dict[str, Unit]:
    return {f"{name}{ending}": unit for ending, unit in units.items()}


_FLIGHT = {f"toa{unit}": Unit(SPEED_OF_LIGHT, u.divide) for unit, u in _TIME.items()}

QUANTITIES: dict[str, dict[str, Unit]] = {
    "time": _in("time", _TIME),
    "anchor": {"anchor": Unit()},
    "toa": {**_FLIGHT, "range_m": Unit()},
    "aoa_azimuth": _in("aoa_azimuth", _ANGLE),
    "aoa_azimuth_station": _in("aoa_azimuth_station", _ANGLE),
    "aoa_elevation": _in("aoa_elevation", _ANGLE),
    "aod_azimuth": _in("aod_azimuth", _ANGLE),
    "aod_azimuth_body": _in("aod_azimuth_body", _ANGLE),
    "snr": {"snr_db": Unit()},
    "doppler": _in("doppler", _SHIFT),
    "doppler_spread": _in("doppler_spread", _SHIFT),
    "speed": {"speed_mps": Unit(), "speed_kmh": Unit(1.0, 3.6)},
    "heading": _in("heading", _ANGLE),
}
"""Quantities with the columns that may hold them; converted units: s, m, rad, Hz, dB and m/s."""

LINK_QUANTITIES = ("toa", "aoa_azimuth", "aoa_elevation", "aod_azimuth")
ODOMETRY_QUANTITIES = ("speed", "heading")
_REQUIRED = ("time", "anchor", *LINK_QUANTITIES, "snr")
# Replaces aoa_azimuth: the azimuth at the base station, also of a path that a wall mirrors.
_STATION = "aoa_azimuth_station"
_BODY = "aod_azimuth_body"  # replaces aod_azimuth, if there is a heading

_HINTS = {
    "anchor": "; mmwave-loc localize --associate does without (docs/data.md)",
    "heading": ", which turns the azimuth of departure from the body's frame to the map's",
}


class Column(NamedTuple):
    """A column of a log."""

    name: str  # in the file
    place: int  # in the file, from 0
    unit: Unit  # to convert by


def columns_of(
    names: Sequence[str], hz_per_mps: float, odometry: bool = True, associated: bool = True
) -> dict[str, Column]:
    """Return the columns of a log by quantity, from the names of all its columns.

    Without ``odometry`` its columns are ignored, except a heading that angles need; a column of
    anchors is ignored where rows are not ``associated``.

    Raises:
        ValueError: a name is unknown or lacks its unit, or a quantity is given twice or is
            missing; the message tells which names are allowed.
    """
    columns: dict[str, Column] = {}
    for place, name in enumerate(names):
        quantity = _quantity(name)
        if quantity in columns:
            other = columns[quantity].name
            both = f"{other!r} twice" if name == other else f"both {other!r} and {name!r}"
            raise ValueError(f"columns: found {both}, expected {quantity} once")
        unit = QUANTITIES[quantity][name]
        if name.startswith("doppler") and name.endswith("_mps"):
            unit = Unit(hz_per_mps)
        columns[quantity] = Column(name, place, unit)
    if not associated:
        columns.pop("anchor", None)
    if not odometry:
        columns.pop("speed", None)
        if _BODY not in columns:
            columns.pop("heading", None)
    _require(columns, names, associated)
    return columns


def _require(columns: dict[str, Column], names: Sequence[str], associated: bool) -> None:
    """Refuse columns if some are missing or contradict each other."""
    instead: dict[str, str] = {}
    for usual, other, needed in (
        ("aoa_azimuth", _STATION, _STATION),
        ("aod_azimuth", _BODY, "heading"),
    ):
        if other in columns:
            instead[usual] = needed
            if usual in columns:
                both = f"both {columns[usual].name!r} and {columns[other].name!r}"
                raise ValueError(f"columns: found {both}, expected {usual} in one frame")
    for quantity in (instead.get(one, one) for one in _REQUIRED if associated or one != "anchor"):
        if quantity not in columns:
            raise ValueError(
                f"columns: found no {quantity} in {', '.join(names)}, "
                f"expected {_one_of(QUANTITIES[quantity])}{_HINTS.get(quantity, '')}"
            )
    for one, other in (ODOMETRY_QUANTITIES, ODOMETRY_QUANTITIES[::-1]):
        if one in columns and other not in columns and (one, _BODY in columns) != ("heading", True):
            raise ValueError(
                f"columns: found {columns[one].name!r} alone, expected {other} "
                f"({_one_of(QUANTITIES[other])}) beside it"
            )


def _quantity(name: str) -> str:
    """Return the quantity in a column of this name."""
    for quantity, spellings in QUANTITIES.items():
        if name in spellings:
            return quantity
    # The longest match, so that doppler_spread_x is not taken for a Doppler shift.
    spelled = {**{quantity: quantity for quantity in QUANTITIES}, "range": "toa"}
    meant = [start for start in spelled if name == start or name.startswith(f"{start}_")]
    if meant:
        expected = _one_of(QUANTITIES[spelled[max(meant, key=len)]])
        raise ValueError(f"column {quoted(name)}: found no unit we know, expected {expected}")
    known = ", ".join(next(iter(spellings)) for spellings in QUANTITIES.values())
    raise ValueError(
        f"column {quoted(name)}: found no quantity we know, expected columns divided by commas "
        f"out of {known}, or the same in other units"
    )


def _one_of(names: Iterable[str]) -> str:
    *most, last = names
    return f"{', '.join(most)} or {last}" if most else last
