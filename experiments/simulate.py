"""mmwave-loc simulate: one episode as files, for localize and for other people's tools."""

from dataclasses import replace
from pathlib import Path

from experiments.arguments.simulate import Args
from experiments.cli.main import run
from experiments.cli.options import command_line, source_of
from experiments.evaluation.seeds import draw_episodes
from mmwave_env.episodes.log_writer import write_log
from mmwave_env.episodes.recorded import RecordedSource
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.files import atomic_path, write_json, write_text
from mmwave_env.logs.tum import COLUMNS, tum_lines
from mmwave_env.models.scene import Scene, anchors_json


def _source(args: Args) -> tuple[SimulatedSource | RecordedSource, Scene]:
    """Where the episode comes from, and the scene it is in."""
    given = source_of(args)
    if isinstance(given, SimulatedSource):
        return replace(given, odometry=args.odometry), given.scene
    assert isinstance(given, RecordedSource)
    if args.odometry:
        raise ValueError("odometry: found with --data, which has none; expected one of the two")
    return given, given.recording.scene


def main(args: Args) -> None:
    """Run the command."""
    source, scene = _source(args)
    (episode,) = draw_episodes(source, [args.seed])
    files = {name: args.out / name for name in ("log.csv", "scene.json", "truth.tum")}
    with atomic_path(files["log.csv"]) as log:
        write_log(log, episode)
    write_json(files["scene.json"], anchors_json(scene))
    if episode.truth_position_m is None:
        del files["truth.tum"]
    else:
        header = f"# {' '.join(COLUMNS)}; {command_line('simulate', replace(args, out=Path('.')))}"
        track = tum_lines(episode.time_s, episode.truth_position_m)
        write_text(files["truth.tum"], f"{header}\n{track}")
    print(f"written to {args.out}/: {', '.join(files)}")


if __name__ == "__main__":
    run("simulate")
