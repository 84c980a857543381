"""mmwave-loc traffic: vehicles and pedestrians of a simulated town, by SUMO, as a scenario."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from experiments.arguments.traffic import Args
from experiments.cli.main import run
from experiments.evaluation.terminal import progress, say
from mmwave_env.episodes.fcd import SUFFIXES, read_fcd
from mmwave_env.files import require_writable, write_bytes
from mmwave_env.lookup import require_extra

LANE_CHANGE_S = 3.0  # at once, by default: nobody jumps sideways


def _check(args: Args) -> None:
    if not args.out.name.lower().endswith(SUFFIXES):
        raise ValueError(f"out: found {args.out}, expected a name in {', '.join(SUFFIXES)}")
    for name in ("seconds", "step", "block_m", "vehicles", "pedestrians"):
        value = getattr(args, name)
        if not 0.0 < value < float("inf"):
            raise ValueError(f"{name}: found {value}, expected a number > 0")
    if args.blocks < 1:
        raise ValueError(f"blocks: found {args.blocks}, expected at least 1")
    if args.step < 0.01 or args.step > args.seconds:
        raise ValueError(f"step: found {args.step}, expected 0.01 s to {args.seconds:g}, seconds")


class Sumo:
    """The programs of the package eclipse-sumo, in a folder for what they write."""

    def __init__(self, folder: Path) -> None:
        import sumo

        self.home, self.folder = Path(sumo.SUMO_HOME), folder

    def run(self, program: str, *options: object) -> None:
        """Run a program, or a Python tool.

        Raises:
            ValueError: it failed; with the first error that it named.
        """
        tool = program.endswith(".py")
        path = self.home / ("tools" if tool else "bin") / program
        words = [sys.executable] * tool + [str(path), *map(str, options)]
        done = subprocess.run(
            words, cwd=self.folder, env=os.environ | {"SUMO_HOME": str(self.home)},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            said = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
            why = next((line for line in said if "Error" in line), f"exit code {done.returncode}")
            raise ValueError(f"{program} of SUMO failed: {why}")

    def net(self, args: Args) -> None:
        """A grid of streets with sidewalks, crossings and traffic lights."""
        self.run(
            "netgenerate", "--grid", "--grid.number", args.blocks + 1,
            "--grid.length", args.block_m, "--default-junction-type", "traffic_light",
            "--sidewalks.guess", "--crossings.guess", "--no-turnarounds", "-o", "net.xml",
        )  # fmt: skip

    def trips(self, args: Args, name: str, per_minute: float, *more: object) -> None:
        """Who goes where, and when: trips at random."""
        self.run(
            "randomTrips.py", "-n", "net.xml", "-o", f"{name}.trips.xml", "-r", f"{name}.xml",
            "-e", args.seconds, "-p", 60.0 / per_minute, "--seed", args.seed, "--prefix", name,
            "--min-distance", 0.5 * args.blocks * args.block_m, *more,
        )  # fmt: skip

    def drive(self, args: Args, kinds: Sequence[str]) -> Path:
        """The traffic, as floating-car data; what is written tells no path of this computer."""
        name = "traffic" + next(end for end in SUFFIXES if args.out.name.lower().endswith(end))
        self.run(
            "sumo", "-n", "net.xml", "-r", ",".join(f"{name}.xml" for name in kinds),
            "-e", args.seconds, "--step-length", args.step, "--seed", args.seed, "--no-step-log",
            "--lanechange.duration", LANE_CHANGE_S, "--fcd-output", name,
            "--fcd-output.attributes", "id,x,y,angle,type,speed",
        )  # fmt: skip
        return self.folder / name


def main(args: Args) -> None:
    """Run the command."""
    _check(args)
    require_extra("sumo", "sumo", "traffic")
    require_writable(args.out)
    with TemporaryDirectory() as folder, progress("simulating"):
        sumo = Sumo(Path(folder))
        sumo.net(args)
        sumo.trips(args, "vehicle", args.vehicles)
        sumo.trips(args, "pedestrian", args.pedestrians, "--pedestrians")
        made = sumo.drive(args, ("vehicle", "pedestrian"))
        trips = read_fcd(made, lambda name, kind: True)
        write_bytes(args.out, made.read_bytes())
    say(f"written to {args.out}: {len(trips)} trips (made by SUMO)")


if __name__ == "__main__":
    run("traffic")
