"""The process in which Sionna RT traces: ``python -m ...child JOB OUT``, a .json and an .npz file.

An LLVM that Dr.Jit can't use ends the whole process, so it is one of its own. Every line of its
standard output is a JSON object for :mod:`mmwave_env.episodes.raytracing.tracing`: which compiler
is used, how many receivers are done, or what is wrong with the job.
"""

import json
import sys
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from mmwave_env.episodes.deepmimo.paths import StationPaths
from mmwave_env.episodes.raytracing.sionna_paths import paths_from_sionna
from mmwave_env.lookup import unknown
from mmwave_env.numerics.arrays import Array

SEED = 1  # of the rays that look for walls
RAYS = 10**5
BLOCK = 200  # receivers that are traced at once
ARRAYS = (
    "interactions", "bounce_m", "gain_db", "delay_s", "arrival", "departure", "phase_rad",
)  # fmt: skip


def _tell(**what: Any) -> None:
    print(json.dumps(what), flush=True)


def _refuse(wrong: str) -> NoReturn:
    _tell(wrong=wrong)
    sys.exit(2)


def _compiler() -> dict[str, str]:
    """What compiles the tracer's kernels: the variant of Mitsuba; of LLVM version and library."""
    import drjit
    import mitsuba

    variant = str(mitsuba.variant())
    if not variant.startswith("llvm"):
        return {"variant": variant}
    version = ".".join(map(str, drjit.detail.llvm_version()))
    return {"variant": variant, "llvm": version, "library": _library()}


def _library() -> str:
    """The file of the LLVM that this process has loaded; empty where nobody tells."""
    maps = Path("/proc/self/maps")
    lines = maps.read_text(encoding="utf-8").splitlines() if maps.exists() else []
    return next((line.split()[-1] for line in lines if "libLLVM" in line), "")


def _load(job: dict[str, Any]) -> Any:
    """The scene of a job, with its base station and antennas."""
    from sionna import rt

    geometry = job["geometry"]
    there = {name: str(file) for name, file in vars(rt.scene).items() if str(file).endswith(".xml")}
    if geometry not in there and not geometry.endswith(".xml"):
        _refuse(f"{unknown('geometry', geometry, there)}, or an .xml file")
    try:
        scene = rt.load_scene(there.get(geometry, geometry), merge_shapes=False)
        scene.frequency = job["carrier_hz"]
    except Exception as error:  # Mitsuba and the XML parser raise many kinds for a damaged file
        reason = " ".join(str(error).split())
        _refuse(f"{geometry}: found what Sionna can't load ({reason}), expected a Mitsuba scene")
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    scene.add(rt.Transmitter("base station", position=job["base_station_m"]))
    return scene


def _trace(scene: Any, receivers_m: Array) -> StationPaths:
    """The paths from the base station to some receivers (R, 3)."""
    from sionna import rt

    for i, position in enumerate(receivers_m.tolist()):
        scene.add(rt.Receiver(f"user {i}", position=position))
    found = rt.PathSolver()(
        scene=scene, max_depth=1, samples_per_src=RAYS, los=True, specular_reflection=True,
        diffuse_reflection=False, refraction=False, diffraction=False, synthetic_array=True,
        seed=SEED,
    )  # fmt: skip
    (station,) = paths_from_sionna(found, float(scene.frequency[0])).stations
    for i in range(len(receivers_m)):
        scene.remove(f"user {i}")
    return station


def _joined(blocks: list[Array]) -> Array:
    """Arrays (R, P, ...) one below the other, with NaN where one has fewer paths."""
    P = max(block.shape[1] for block in blocks)
    filled = [
        np.pad(b, [(0, 0), (0, P - b.shape[1])] + [(0, 0)] * (b.ndim - 2), constant_values=np.nan)
        for b in blocks
    ]
    return np.concatenate(filled)


def main(job_file: str, out: str) -> None:
    """Trace the job of a JSON file; write its arrays."""
    job = json.loads(Path(job_file).read_text(encoding="utf-8"))
    import sionna.rt  # noqa: F401 -- chooses the variant

    _tell(compiler=_compiler())
    scene, receivers = _load(job), np.array(job["receivers_m"], float)
    blocks = []
    for start in range(0, len(receivers), BLOCK):
        blocks.append(_trace(scene, receivers[start : start + BLOCK]))
        _tell(done=min(start + BLOCK, len(receivers)))
    found: dict[str, Any] = {n: _joined([getattr(b, n) for b in blocks]) for n in ARRAYS}
    np.savez(out, **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
