"""Tracing with Sionna RT: what goes into its process, what comes back, and why it failed."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np

from mmwave_env.episodes.deepmimo.paths import Paths, StationPaths
from mmwave_env.episodes.raytracing.child import ARRAYS, RAYS, SEED
from mmwave_env.files import write_json
from mmwave_env.lookup import require_extra
from mmwave_env.models.scene import Scene, Streets
from mmwave_env.numerics.arrays import Array

CHILD = "mmwave_env.episodes.raytracing.child"
GEOMETRY = "simple_street_canyon"  # of sionna.rt.scene
# The base station of the recordings that come along; the street between the buildings.
CANYON = Scene("canyon", (-5.0, 4.0, 6.0), streets=Streets((-70.0, 71.0), (0.5, 0.5), 47.0))
LLVM_NEEDED = (
    "expected libLLVM 19 or newer (19 and 22 are tried; 15 and 16 end the process): "
    "apt-get install libllvm19, or DRJIT_LIBLLVM_PATH=/path/to/libLLVM.so"
)


class RayTracerError(RuntimeError, ValueError):
    """The ray tracer can't run here, or ended before its end.

    A RuntimeError in Python; bad input to commands, which end with its one line.
    """


def trace_rays(
    scene: Scene,
    position_m: Array,
    geometry: str = GEOMETRY,
    progress: Callable[[float], None] | None = None,
) -> Paths:
    """The paths from a scene's base station to a user's positions (E, 3), by Sionna RT.

    Lines of sight and paths with one mirror-like reflection, between isotropic antennas with
    vertical polarization. Two runs differ in the last digits: by 1e-5 m of length.

    Args:
        scene: base station and carrier.
        position_m: where the user is, in the frame of the geometry.
        geometry: buildings: a scene of ``sionna.rt.scene``, or a Mitsuba file (.xml).
        progress: takes the share done, from 0 to 1.

    Raises:
        MissingExtraError: Sionna RT is not installed.
        RayTracerError: no LLVM that can be used; it says which was found and what is needed. Or
            the tracer failed.
        ValueError: a geometry that is none.
    """
    require_extra("sionna", "raytrace", "ray tracing")
    job = {
        "geometry": geometry,
        "carrier_hz": scene.carrier_hz,
        "base_station_m": list(scene.base_station_m),
        "receivers_m": position_m.tolist(),
    }
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "paths.npz"
        write_json(Path(folder) / "job.json", job)
        _run(Path(folder) / "job.json", out, len(position_m), progress or (lambda share: None))
        with np.load(out, allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in ARRAYS}
    station = StationPaths(
        name="base station",
        position_m=np.array(scene.base_station_m),
        source=lambda key, epoch: (Path(geometry), epoch),
        **found,
    )
    return Paths(scene.name, scene.carrier_hz, position_m, (station,))


def raytracer(geometry: str) -> dict[str, Any]:
    """What ``params.json`` of a scenario says of the tracer and its settings."""
    return {
        "raytracer_name": "Sionna Ray Tracing",
        "raytracer_version": version("sionna-rt"),
        "terrain_reflection": True,
        "num_rays": RAYS,
        "raw_params": {"geometry": Path(geometry).name, "seed": SEED},
    }


def _run(job: Path, out: Path, receivers: int, progress: Callable[[float], None]) -> None:
    """Run the child, and raise what it died of."""
    words = [sys.executable, "-m", CHILD, str(job), str(out)]
    same = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
        told: dict[str, Any] = {}
        with subprocess.Popen(
            words, env=same, stdout=subprocess.PIPE, stderr=errors, text=True
        ) as child:
            try:
                for message in _messages(child.stdout):
                    told |= message
                    progress(told.get("done", 0) / receivers)
            except BaseException:
                child.kill()
                raise
        if child.returncode:
            errors.seek(0)
            raise _failure(child.returncode, told, errors.read().splitlines())


def _messages(lines: IO[str] | None) -> Iterator[dict[str, Any]]:
    """What the child tells; libraries of its may print other lines between."""
    for line in lines or ():
        if line.startswith("{"):
            yield json.loads(line)


def _failure(code: int, told: dict[str, Any], errors: list[str]) -> Exception:
    """Why the child ended early: what it told itself, or what its libraries wrote last."""
    if "wrong" in told:
        return ValueError(told["wrong"])
    compiler = told.get("compiler")
    if compiler is None and any("LLVM" in line for line in errors):
        given = os.environ.get("DRJIT_LIBLLVM_PATH")
        where = f" with DRJIT_LIBLLVM_PATH={given}" if given else ""
        said = next((line for line in errors if line.startswith("jit")), errors[-1])
        return RayTracerError(f"ray tracing: found no usable LLVM{where} ({said}), {LLVM_NEEDED}")
    said = next((line for line in errors if line.startswith("LLVM ERROR")), "")
    said = said or (errors or ["it said nothing"])[-1]
    if compiler and "llvm" in compiler and code < 0:
        found = f"LLVM {compiler['llvm']} ({compiler['library'] or 'of an unknown path'})"
        ended = f"with which it ended by {signal.Signals(-code).name}"
        return RayTracerError(f"ray tracing: found {found}, {ended} ({said}), {LLVM_NEEDED}")
    return RayTracerError(f"ray tracing: found that it ended with code {code}: {said}")
