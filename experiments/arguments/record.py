"""Options of mmwave-loc record."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(kw_only=True)
class WayArgs:
    """The way through a grid."""

    along: str | None = None
    """a CSV file of a way (columns t, x, y, z) or of way-points (x, y, z, speed_mps); or a kind of
    user (pedestrian, vehicle, walk-ride, jam, cyclist or a JSON file) who moves in --scene"""
    scene: str = "o1"
    """streets of a kind of user, in the frame of the grid: o1, dynamic-doppler, street or a JSON
    file"""
    episode_steps: int = 200
    """epochs of a kind of user"""
    seed: int = 0
    """seed of a kind of user"""
    interpolate: bool = False
    """between the four nearest users; the nearest where it is not asked for"""
    within: float = 1.0
    """meters that the nearest user may be away from the way"""


@dataclass(kw_only=True)
class Args(WayArgs):
    """Record a user of a DeepMIMO scenario, of version 4 or 3, as a scenario of one track.

    Other commands then play it with --data. Of a grid it is a user who goes --along a way; of a
    dynamic scenario the --user of a number.

    mmwave-loc record O1_28 --along way.csv --out drive
    """

    scenario: Path = field(metadata={"positional": True})
    """folder of the DeepMIMO scenario"""
    out: Path
    """folder to write"""
    user: int | None = None
    """number, from 0, of the user of a dynamic scenario"""
    dt: float = 0.1
    """seconds between epochs"""
    base_station: int | None = None
    """number of the base station, from 1; all, where none is given"""
    virtual_anchors: int = 2
    """its mirror images at most, those seen most"""
    overwrite: bool = False
    """replace a scenario that is there"""
