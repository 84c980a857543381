"""mmwave-loc simulate: one episode written as files, for localize and for other programs."""

from dataclasses import dataclass, replace
from pathlib import Path

from experiments.console.options import WorldArgs, require_alone, require_default

MOST_FALSE_PATHS = 100.0  # mean number per epoch


@dataclass(kw_only=True)
class Args(WorldArgs):
    """Write one episode as a folder: log.csv, scene.json and truth.tum.

    mmwave-loc simulate --scenario vehicle --out episode
    """

    out: Path
    """folder to write to"""
    overwrite: bool = False
    """replace the files of an episode that are already in the folder"""
    seed: int = 0
    """seed of the episode; `mmwave-loc compare` runs the same episode for this seed"""
    paths: bool = False
    """write a log of paths without anchor numbers, in random
    order, and base-station.json, the scene without its
    mirror images, for `mmwave-loc localize --map learn`"""
    false_paths: float = 1.0
    """with --paths, mean number of false paths per epoch"""


def main(args: Args) -> None:
    """Run the command."""
    import numpy as np

    from experiments.console.output import say
    from experiments.console.provenance import command_line
    from experiments.evaluation.contenders import draw_episodes, source_of
    from mmwave_env.datasets.log_folder import (
        LOG,
        SCENE,
        STATION,
        TRUTH,
        path_columns,
        write_log_folder,
    )
    from mmwave_env.datasets.recorded import TrackSource
    from mmwave_env.io.files import write_json
    from mmwave_env.models.random_scene import RandomScene
    from mmwave_env.models.scene import scene_json, scene_of_anchors
    from mmwave_env.world.simulated import SimulatedSource

    if not 0.0 <= args.false_paths <= MOST_FALSE_PATHS:
        raise ValueError(
            f"false-paths: found {args.false_paths}, expected 0 to {MOST_FALSE_PATHS:g} per epoch"
        )
    if args.paths:
        require_alone(args, "paths", "measurements", "clock")
    else:
        require_default(args, "--paths", "false_paths")
    files = (LOG, SCENE, TRUTH, STATION) if args.paths else (LOG, SCENE, TRUTH)
    names = [name for name in files if (args.out / name).exists()]
    if names and not args.overwrite:  # these files may be the only copy of a recording
        raise ValueError(
            f"out: found {', '.join(names)} in {args.out}, expected a folder without them; "
            "--overwrite replaces them, --out names another folder"
        )
    source = source_of(args)
    assert isinstance(source, SimulatedSource | TrackSource)  # options select no other source
    (episode,) = draw_episodes(source, [args.seed])
    scene = source.scene
    inexact = isinstance(source, SimulatedSource) and source.survey is not None
    if inexact or isinstance(scene, RandomScene):  # the file must hold this episode's anchors
        scene = scene_of_anchors(
            scene.name, episode.scene_anchors_m, scene.carrier_hz, scene.bandwidth_hz
        )
    origin = command_line("simulate", replace(args, out=Path(".")), ["overwrite"])
    columns = None
    if args.paths:
        columns = path_columns(episode, args.false_paths, np.random.default_rng(args.seed))
        station = scene.with_anchors(scene.anchors_m[:1])
        write_json(args.out / STATION, scene_json(station))
    write_log_folder(args.out, episode, scene, origin, columns)
    say(f"written to {args.out}/: {', '.join(files)}")
    if isinstance(source, SimulatedSource) and not source.travels and len(source.names) > 1:
        say(f"the user is {episode.name}")
