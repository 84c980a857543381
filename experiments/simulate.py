"""mmwave-loc simulate: one episode as files, for localize and for other people's tools."""

from dataclasses import replace
from pathlib import Path

from experiments.arguments.simulate import Args
from experiments.cli.main import run
from experiments.cli.options import command_line, source_of
from experiments.evaluation.seeds import draw_episodes
from experiments.evaluation.terminal import progress, say
from mmwave_env.episodes.deepmimo.params import PARAMS
from mmwave_env.episodes.deepmimo.v4_writer import OBJECTS
from mmwave_env.episodes.deepmimo.way import SIDECAR
from mmwave_env.episodes.deepmimo.writer import write_deepmimo
from mmwave_env.episodes.log_folder import LOG, SCENE, TRUTH, write_log_folder
from mmwave_env.episodes.measured import MeasuredSource
from mmwave_env.episodes.recorded import RecordedSource, Recording
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.lookup import choose
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import scene_of_anchors

FORMATS = {"log": (LOG, SCENE, TRUTH), "deepmimo": (PARAMS, OBJECTS, SIDECAR)}  # and their files


def _require_none(folder: Path, wanted: str, overwrite: bool) -> None:
    """Refuse to replace the files of an episode: perhaps they were recorded, and are the only ones.

    Raises:
        ValueError: there are some that may not be replaced, or some of another format.
    """
    for kind, names in FORMATS.items():
        found = [name for name in names if (folder / name).exists()]
        if found and not (overwrite and kind == wanted):
            rewrite = "--overwrite replaces them, " if kind == wanted else ""
            raise ValueError(
                f"out: found {', '.join(found)} in {folder}, expected a folder without them; "
                f"{rewrite}--out names another folder"
            )


def main(args: Args) -> None:
    """Run the command."""
    choose(FORMATS, args.format, "format")
    if args.unassociated and args.format == "deepmimo":
        raise ValueError("unassociated: found beside format deepmimo, expected a log")
    if args.false_paths and not args.unassociated:
        raise ValueError(
            f"false-paths: found {args.false_paths}, expected --unassociated beside it"
        )
    _require_none(args.out, args.format, args.overwrite)
    source = source_of(args)
    assert isinstance(
        source, SimulatedSource | RecordedSource | MeasuredSource
    )  # what options name
    with progress("simulating"):
        (episode,) = draw_episodes(source, [args.seed])
    scene = source.scene
    if isinstance(scene, RandomScene):  # the file is to bring the anchors of this very episode
        scene = scene_of_anchors(
            scene.name, episode.scene_anchors_m, scene.carrier_hz, scene.bandwidth_hz
        )
    if args.format == "deepmimo":
        names = write_deepmimo(args.out, Recording.of_episode(episode, scene, source.radio))
    else:
        origin = command_line("simulate", replace(args, out=Path("."), overwrite=False))
        names = write_log_folder(
            args.out, episode, scene, origin, not args.unassociated, args.false_paths, args.seed
        )
    say(f"written to {args.out}/: {', '.join(names)}")
    if isinstance(source, SimulatedSource) and not source.travels:
        assert episode.truth_position_m is not None  # who is simulated has one
        name, begin, end = source.ways.find(episode.truth_position_m)
        say(f"seconds {begin:g} to {end:g} of {name}")
        if source.ways.about:
            say(source.ways.about)


if __name__ == "__main__":
    run("simulate")
