"""Sionna RT: trace rays to a user who moves through streets; write a DeepMIMO v4 folder for --data.

python examples/raytrace.py way.csv canyon-way
mmwave-loc compare --policies fixed-ekf fixed-ukf --data canyon-way

The file way.csv has the user's trajectory in columns t, x, y, z, in the scene's coordinates.
Sionna traces lines of sight and single reflections between vertically polarized isotropic antennas.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from mmwave_env.datasets.ways import read_trajectory

# number of rays; their seed; number of receivers per call
RAYS = 10**5
SEED = 1
BLOCK = 200
INTERACTIONS = {1: 1.0, 2: 3.0, 4: 4.0, 8: 2.0}  # Sionna's code -> DeepMIMO's code (a digit)


def trace(geometry, carrier_hz, base_station_m, receivers_m):
    """Yield Sionna's paths from a base station to receivers (N, 3), one block at a time."""
    from sionna import rt

    known = {name: file for name, file in vars(rt.scene).items() if str(file).endswith(".xml")}
    scene = rt.load_scene(str(known.get(geometry, geometry)), merge_shapes=False)
    scene.frequency = carrier_hz
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    scene.add(rt.Transmitter("base station", position=base_station_m))
    for start in range(0, len(receivers_m), BLOCK):
        some = receivers_m[start : start + BLOCK].tolist()
        for i, position in enumerate(some):
            scene.add(rt.Receiver(f"user {i}", position=position))
        on = dict.fromkeys(("los", "specular_reflection", "synthetic_array"), True)
        off = dict.fromkeys(("diffuse_reflection", "refraction", "diffraction"), False)
        yield rt.PathSolver()(
            scene=scene, max_depth=1, samples_per_src=RAYS, seed=SEED, **on, **off
        )
        for i in range(len(some)):
            scene.remove(f"user {i}")
        print(f"{start + len(some)} of {len(receivers_m)} epochs traced")


def arrays_of(paths):
    """Convert Sionna's paths to DeepMIMO's arrays (receivers, paths, ...), strongest path first."""
    real, imaginary = (np.array(part, float)[:, 0, 0, 0] for part in paths.a)
    delay = np.array(paths.tau, float)[:, 0]
    gain = np.hypot(real, imaginary)
    valid = np.array(paths.valid, bool)[:, 0] & (delay >= 0.0) & (gain > 0.0)
    inter = np.zeros(delay.shape)
    for depth in np.array(paths.interactions)[:, :, 0]:
        kinds = (0, *INTERACTIONS)
        digits = [0.0, *INTERACTIONS.values()]
        digit = np.select([depth == kind for kind in kinds], digits, 9.0)
        inter = np.where(digit > 0.0, 10.0 * inter + digit, inter)
    bounce = np.array(paths.vertices, float)[0][:, 0]
    with np.errstate(divide="ignore"):
        power = 20.0 * np.log10(gain)
    arrays = {
        "inter": inter,
        "inter_pos": np.where(inter[..., None] > 0.0, bounce, np.nan)[:, :, None],
        "power": power,
        "phase": np.degrees(np.arctan2(imaginary, real)),
        "delay": delay,
    }
    for end, name in (("r", "aoa"), ("t", "aod")):
        arrays[f"{name}_az"] = np.degrees(np.array(getattr(paths, f"phi_{end}"), float)[:, 0])
        arrays[f"{name}_el"] = np.degrees(np.array(getattr(paths, f"theta_{end}"), float)[:, 0])
    order = np.argsort(-np.where(valid, power, -np.inf), axis=1, kind="stable")
    order = order[:, : valid.sum(axis=1).max()]
    packed = {}
    for key, array in arrays.items():
        wide = (...,) + (None,) * (array.ndim - 2)
        kept = np.where(valid[wide], array, np.nan)
        packed[key] = np.take_along_axis(kept, order[wide], axis=1)
    return packed


def joined(blocks):
    """Concatenate arrays along the axis of receivers; fill missing paths with NaN."""
    most = max(block.shape[1] for block in blocks)
    fill = [[(0, 0), (0, most - b.shape[1])] + [(0, 0)] * (b.ndim - 2) for b in blocks]
    return np.concatenate(
        [np.pad(b, by, constant_values=np.nan) for b, by in zip(blocks, fill, strict=True)]
    )


def write_folder(folder, arrays, carrier_hz, base_station_m, time_s, track):
    """Write a static DeepMIMO v4 scenario with a receiver for each epoch of a track (N, 6)."""
    folder.mkdir(parents=True)  # fails if the folder exists, because it may contain other arrays
    arrays |= {"rx_pos": track[:, :3], "tx_pos": np.array([base_station_m])}
    for key, array in arrays.items():
        np.savez_compressed(
            folder / f"{key}_t000_tx000_r001.npz", **{key: array.astype(np.float32)}
        )
    rows = np.column_stack([time_s, track]).tolist()
    lines = ["t,x,y,z,vx,vy,vz", *(",".join(map(repr, row)) for row in rows)]
    (folder / "trajectory.csv").write_text("\n".join(lines) + "\n")
    sets = {f"txrx_set_{i}": {"id": i, "num_points": n} for i, n in enumerate((1, len(track)))}
    about = {"rt_params": {"frequency": carrier_hz}, "txrx_sets": sets, "scene": {"num_scenes": 1}}
    (folder / "params.json").write_text(json.dumps(about, indent=2) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("way", type=Path, help="CSV file of a trajectory: columns t, x, y, z")
    parser.add_argument("out", type=Path, help="folder to write")
    geometry = "name of one of Sionna's scenes, or a Mitsuba .xml file"
    parser.add_argument("--geometry", default="simple_street_canyon", help=geometry)
    parser.add_argument("--base-station", type=float, nargs=3, default=[-5.0, 4.0, 6.0])
    parser.add_argument("--carrier-hz", type=float, default=28e9)
    parser.add_argument("--dt", type=float, default=0.1, help="seconds between epochs")
    args = parser.parse_args()
    track = np.round(read_trajectory(args.way).resampled(args.dt), 6) + 0.0
    where = (args.carrier_hz, args.base_station)
    blocks = [arrays_of(paths) for paths in trace(args.geometry, *where, track[:, :3])]
    arrays = {key: joined([block[key] for block in blocks]) for key in blocks[0]}
    write_folder(args.out, arrays, *where, np.round(args.dt * np.arange(len(track)), 9), track)
