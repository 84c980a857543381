"""Mistakes in logs, as functions from correct columns (arrays by name) to wrong columns."""

from itertools import permutations

import numpy as np
import pandas as pd

from mmwave_env.datasets.log_folder import log_text
from tests.paths import RIDE, WALK

FOLDERS = [RIDE, WALK]
AZIMUTHS = ("aoa_azimuth_rad", "aod_azimuth_rad")
ANGLES = (*AZIMUTHS, "aoa_elevation_rad")
HZ_PER_MPS = 28e9 / 299_792_458.0


def read_columns(path):
    """Return the columns of a log by name, with NaN for empty cells."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    return {name: table[name].copy() for name in table.dtype.names}


def write_columns(path, columns):
    """Write a log with these columns."""
    path.write_text(log_text(columns))


def wrong_log(tmp_path, folder, mistake):
    """Write the log of a folder again, with a mistake; return the path of the new file."""
    path = tmp_path / "log.csv"
    write_columns(path, mistake(read_columns(folder / "log.csv")))
    return path


def linear(factor, *names, offset=0.0):
    """Return a mistake that multiplies columns by a factor and adds an offset."""
    return lambda c: {**c, **{name: offset + factor * c[name] for name in names}}


def exchange(column, other):
    """Return a mistake that exchanges two columns."""
    return lambda c: {**c, column: c[other], other: c[column]}


def renamed(names):
    """Return a mistake that gives columns other names."""
    return lambda c: {names.get(name, name): values for name, values in c.items()}


def differences(columns):
    """Return columns in which time differences to an epoch's first link replace its times."""
    log = pd.DataFrame(columns).rename(columns={"toa_s": "rstd_s"})
    log["rstd_s"] -= log.groupby("time_s").rstd_s.transform("first")
    return dict(log)


exchanged = exchange(*AZIMUTHS)  # azimuths of arrival and departure
upside_down = linear(-1.0, "aoa_elevation_rad")
FACTORS = {  # how the text of a hypothesis about times ends -> factor by which times are wrong
    f"1e{n} times too large ({unit}?)": 10.0**n for n, unit in ((3, "ms"), (6, "us"), (9, "ns"))
}
FACTORS |= {f"1e{n} times too small": 10.0**-n for n in (3, 6, 9)}
MISTAKES = {  # text of a hypothesis of the diagnosis -> the mistake that it explains
    "arrival and departure are exchanged": exchanged,
    "azimuth and elevation of arrival are exchanged": exchange(AZIMUTHS[0], "aoa_elevation_rad"),
    "elevation has the other sign": upside_down,
    "arrival is measured at the user (downlink)": lambda c: upside_down(exchanged(c)),
    "elevation is a zenith angle": linear(-1.0, "aoa_elevation_rad", offset=np.pi / 2),
    "elevation is a nadir angle": linear(1.0, "aoa_elevation_rad", offset=np.pi / 2),
    "azimuths are clockwise from north": linear(-1.0, *AZIMUTHS, offset=np.pi / 2),
    "azimuths have the other sign": linear(-1.0, *AZIMUTHS),
    "azimuth of arrival has the other sign": linear(-1.0, AZIMUTHS[0]),
    "azimuth of departure has the other sign": linear(-1.0, AZIMUTHS[1]),
    "angles are in degrees": linear(180.0 / np.pi, *ANGLES),
    "angles are in radians": renamed({name: f"{name[:-3]}deg" for name in ANGLES}),
    "azimuth of arrival is in degrees": linear(180.0 / np.pi, AZIMUTHS[0]),
    "azimuth of departure is in degrees": linear(180.0 / np.pi, AZIMUTHS[1]),
    "elevation is in degrees": linear(180.0 / np.pi, "aoa_elevation_rad"),
    "azimuth of arrival is in radians": renamed({AZIMUTHS[0]: "aoa_azimuth_deg"}),
    "azimuth of departure is in radians": renamed({AZIMUTHS[1]: "aod_azimuth_deg"}),
    "times are round-trip times": linear(2.0, "toa_s"),
    "toa_s is in meters": linear(299_792_458.0, "toa_s"),
    "rtt_s is a one-way time": renamed({"toa_s": "rtt_s"}),
    "ranges are in feet": lambda c: renamed({"toa_s": "range_m"})(
        linear(299_792_458.0 / 0.3048, "toa_s")(c)
    ),
    "ranges are 1e3 times too small (km?)": lambda c: renamed({"toa_s": "range_m"})(
        linear(299_792.458, "toa_s")(c)
    ),
    **{
        f"{quantity} is {mistake}": linear(factor, column)
        for quantity, column in (("time of flight", "toa_s"), ("time", "time_s"))
        for mistake, factor in FACTORS.items()
    },
    "Doppler shift has the other sign": linear(-1.0, "doppler_hz"),
    "Doppler shift is in m/s, not in Hz": linear(1.0 / HZ_PER_MPS, "doppler_hz"),
    "Doppler shift is in Hz, not in m/s": renamed({"doppler_hz": "doppler_mps"}),
    "Doppler shift is in kHz, not in Hz": linear(1e-3, "doppler_hz"),
    "Doppler shift is in Hz, not in kHz": renamed({"doppler_hz": "doppler_khz"}),
}
ORDERS = list(permutations((1, 2, 3)))[1:]  # all wrong orders of three anchors
