"""mmwave-loc raytrace: a user's way through the streets of a ray tracer, as a DeepMIMO scenario."""

import numpy as np

from experiments.arguments.raytrace import Args
from experiments.cli.main import run
from experiments.cli.options import MOST_EPOCHS, way_of
from experiments.evaluation.terminal import progress, say
from mmwave_env.episodes.deepmimo.params import PARAMS
from mmwave_env.episodes.deepmimo.paths import LINE_OF_SIGHT, Paths
from mmwave_env.episodes.deepmimo.v4_writer import write_v4
from mmwave_env.episodes.raytracing.tracing import CANYON, raytracer, trace_rays
from mmwave_env.models.scene import Scene, read_scene
from mmwave_env.numerics.arrays import Array

_DIGITS = 6  # micrometers: what is beyond is not traced either


def epochs_of(args: Args, scene: Scene) -> Array:
    """Positions and velocities (E, 6) of the user, at steps of ``--dt``.

    Raises:
        ValueError, FileNotFoundError: as of :func:`~experiments.cli.options.way_of`; or steps that
            make fewer than two epochs of the way, or too many.
    """
    way = way_of(args.scenario, scene, args.dt, args.episode_steps, args.seed)
    seconds = float(way.time_s[-1] - way.time_s[0])
    if not seconds / MOST_EPOCHS <= args.dt <= seconds:
        raise ValueError(
            f"dt: found {args.dt:g}, expected {seconds / MOST_EPOCHS:g} to {seconds:g}, the "
            f"seconds of {way.name}"
        )
    return way.resampled(args.dt)


def described(args: Args, paths: Paths) -> str:
    """What was found, in a line.

    Raises:
        ValueError: no line of sight, without which nobody knows the conventions of the angles.
    """
    (station,) = paths.stations
    epochs = len(paths.position_m)
    sight = (station.interactions == LINE_OF_SIGHT).any(axis=1).sum()
    if not sight:
        x, y, z = station.position_m
        raise ValueError(
            f"{args.scenario}: found no line of sight to the base station at ({x:g}, {y:g}, {z:g}) "
            f"m in any epoch, expected one at least; is the way in the frame of {args.geometry}?"
        )
    none = np.isnan(station.interactions).all(axis=1).sum()
    kinds = ", ".join(f"{count} x {kind}" for kind, count in station.kinds().items())
    return f"{epochs} epochs, {sight} with a line of sight, {none} without any path; {kinds}"


def main(args: Args) -> None:
    """Run the command."""
    if (args.out / PARAMS).exists() and not args.overwrite:
        raise ValueError(
            f"out: found {PARAMS} in {args.out}, expected a folder without it; --overwrite "
            "replaces the scenario, --out names another folder"
        )
    scene = read_scene(args.scene) if args.scene else CANYON
    way = np.round(epochs_of(args, scene), _DIGITS) + 0.0
    with progress("tracing") as done:
        paths = trace_rays(scene, way[:, :3], args.geometry, done)
    told = described(args, paths)
    time = np.round(args.dt * np.arange(len(way)), 9)
    names = write_v4(args.out, paths, time, way[:, 3:], raytracer(args.geometry))
    say(told, f"written to {args.out}/: {len(names)} files")


if __name__ == "__main__":
    run("raytrace")
