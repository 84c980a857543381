"""mmwave-loc simulate: one episode written as files, for localize and for other programs."""

from dataclasses import dataclass, replace
from pathlib import Path

from experiments.console.options import WorldArgs


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


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import say
    from experiments.console.provenance import command_line
    from experiments.evaluation.contenders import draw_episodes, source_of
    from mmwave_env.datasets.log_folder import LOG, SCENE, TRUTH, write_log_folder
    from mmwave_env.datasets.recorded import TrackSource
    from mmwave_env.models.random_scene import RandomScene
    from mmwave_env.models.scene import scene_of_anchors
    from mmwave_env.world.simulated import SimulatedSource

    names = [name for name in (LOG, SCENE, TRUTH) if (args.out / name).exists()]
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
    origin = command_line("simulate", replace(args, out=Path("."), overwrite=False))
    names = write_log_folder(args.out, episode, scene, origin)
    say(f"written to {args.out}/: {', '.join(names)}")
    if isinstance(source, SimulatedSource) and not source.travels and len(source.names) > 1:
        say(f"the user is {episode.name}")
