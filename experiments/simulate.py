"""mmwave-loc simulate: one episode as files, for localize and for other people's tools."""

from dataclasses import replace
from pathlib import Path

from experiments.arguments.simulate import Args
from experiments.cli.main import run
from experiments.cli.options import command_line, source_of
from experiments.evaluation.seeds import draw_episodes
from mmwave_env.episodes.log_folder import write_log_folder
from mmwave_env.episodes.simulated import SimulatedSource


def main(args: Args) -> None:
    """Run the command."""
    source = source_of(args)
    if isinstance(source, SimulatedSource):
        source = replace(source, odometry=args.odometry)
    elif args.odometry:
        raise ValueError("odometry: found with --data, which has its own; expected one of the two")
    (episode,) = draw_episodes(source, [args.seed])
    origin = command_line("simulate", replace(args, out=Path(".")))
    names = write_log_folder(args.out, episode, source.scene, origin)
    print(f"written to {args.out}/: {', '.join(names)}")


if __name__ == "__main__":
    run("simulate")
