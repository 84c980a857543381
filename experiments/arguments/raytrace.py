"""Options of mmwave-loc raytrace."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class Args:
    """Trace rays along a user's way through streets of Sionna RT; write a DeepMIMO v4 scenario.

    Its paths are what recordings are made of: lines of sight and those with one reflection. Sionna
    RT needs the extra raytrace and libLLVM 19 or newer, and runs in a process of its own.

    mmwave-loc raytrace --scenario way.csv --out canyon-way
    """

    out: Path
    """the folder; --data takes it, and so does the deepmimo package"""
    scenario: str
    """who goes where: a CSV file of a way (columns t, x, y, z) or of way-points (x, y, z,
    speed_mps), in the frame of the geometry; or a kind of user, by name or as a JSON file, placed
    in the streets of --scene"""
    scene: Path | None = None
    """JSON file with the base station, the carrier and the streets of kinds of users; where none is
    named those of the recordings that come along"""
    geometry: str = "simple_street_canyon"
    """the buildings: a scene of sionna.rt.scene, by name, or a Mitsuba file (.xml)"""
    dt: float = 0.1
    """seconds between epochs"""
    episode_steps: int = 600
    """epochs of a kind of user; a way has all of its own"""
    seed: int = 0
    """seed of a kind of user's way"""
    overwrite: bool = False
    """replace the scenario that is there"""
