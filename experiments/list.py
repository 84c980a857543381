"""mmwave-loc list: names that options and arguments accept, each with a description."""

import inspect
import sys
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

Kind = Literal["all", "policies", "scenarios", "radios", "scenes", "modes", "samples", "rewards"]


@dataclass(kw_only=True)
class Args:
    """List the names that options and arguments accept; copy samples.

    mmwave-loc list policies
    """

    what: Positional[Kind] = "all"
    """what to list: policies, scenarios, radios, scenes, modes, samples, rewards or all"""
    radio: str = "handset"
    """radio profile whose policies and modes are listed"""
    out: Path | None = None
    """folder for the files of the sample that --copy names; only with `list samples`"""
    copy: str | None = None
    """name of the sample to copy into --out: its log if it
    has one, otherwise its recording"""


COLUMN = 25  # column in which the descriptions of names begin
POLICIES = {
    "speed-rule": "the paper's rule: EKF up to 2 m/s, UKF above",
    "likelihood-rule": "chooses the mode that explains the coming measurement best",
    "imm": "interacting multiple models: mixes all modes instead of choosing one",
    "imm-best": "tuned IMM of modes for users who stand, cruise, turn, accelerate or brake",
    "ppo": "learned policy that chooses between the profile's two modes",
    "guided": "learned policy that raises the probability of one mode of `imm-best`, or of none",
    "corrector": "the policy `guided`, with a recurrent network that corrects the positions",
    "guided-ppo": "same as `guided`, but trained only with PPO",
    "clairvoyant": "knows the truth: a ceiling for policies that choose modes; runs only if named",
}


def policies(radio: str) -> dict[str, str]:
    """Return the policies for a radio profile, with a description of each."""
    from experiments.evaluation.branches import CLAIRVOYANT
    from experiments.evaluation.contenders import contenders

    return {
        name: POLICIES.get(name, f"mode {name.removeprefix('fixed-')} in every epoch")
        for name in (*contenders(radio), CLAIRVOYANT)
    }


def modes(radio: str) -> dict[str, str]:
    """Return the modes tuned for a radio profile, with their differences from the defaults."""
    from mmwave_env.filters.bank import as_written, named_modes

    return {
        name: ", ".join(f"{k} {v}" for k, v in as_written(mode).items() if k != "name")
        for name, mode in named_modes(radio).items()
    }


def scenes() -> dict[str, str]:
    """Return scenes with a description of each; x points east and y north."""
    from mmwave_env.models.random_scene import RANDOM
    from mmwave_env.models.scene import SCENES

    described = {}
    for name, scene in SCENES.items():
        x, y, z = base = scene.base_station_m
        (west, east) = scene.streets.x_m
        (south, north) = scene.streets.y_m
        words = [
            f"{len(scene.anchors_m)} anchors, {scene.carrier_hz / 1e9:g} GHz, "
            f"{scene.bandwidth_hz / 1e6:g} MHz",
            f"base station at ({x:g}, {y:g}, {z:g}) m",
            f"streets x {west:g} to {east:g} m, y {south:g} to {north:g} m",
            f"inside the walls: {' and '.join(wall.side_of(base) for wall in scene.walls)}",
        ]
        described[name] = "; ".join(words)
    random = "a new scene in each episode: random blocks, base station and walls"
    return described | {RANDOM: random}


def samples() -> dict[str, str]:
    """Return the samples that come with the package, and whether each is also a log."""
    from mmwave_env.datasets.samples import log_names, recording_from, sample_names

    logs = dict.fromkeys(log_names(), "; also as a log, for localize --sample")
    return {
        name: f"ray-traced street, {len(recording_from(name).time_s)} epochs, for --data"
        + logs.get(name, "")
        for name in sample_names()
    }


def copied(out: Path, name: str) -> int:
    """Copy the files of a sample; return the number of files.

    Raises:
        ValueError: there is no such sample.
        FileExistsError: a file already exists.
    """
    from mmwave_env.datasets.samples import log_names, sample_folder
    from mmwave_env.io.files import require_writable, write_bytes

    folder = sample_folder(name, "log" if name in log_names() else "recording")
    files = {out / file.name: file for file in sorted(folder.iterdir())}
    for new in files:
        if new.exists():
            raise FileExistsError(f"{new}: found a file of this name, expected none in the folder")
        require_writable(new)
    for new, file in files.items():
        write_bytes(new, file.read_bytes())
    return len(files)


def main(args: Args) -> None:
    """Run the command."""
    from rich.console import Console

    from experiments.console.progress import say
    from mmwave_env.interface.reward import REWARDS
    from mmwave_env.models.radio import RADIOS, radio_from
    from mmwave_env.world.mobility import SCENARIOS

    if args.out is not None and args.copy is not None and args.what == "samples":
        say(f"copied to {args.out}/: {copied(args.out, args.copy)} files")
        return
    for name, value in (("out", args.out), ("copy", args.copy)):
        if value is not None:
            raise ValueError(f"{name}: found {value}, expected: list samples --copy NAME --out DIR")
    radio_from(args.radio)  # refuses an unknown radio
    kinds: dict[str, Callable[[], dict[str, str]]] = {
        "policies": partial(policies, args.radio),
        "scenarios": lambda: SCENARIOS,
        "radios": lambda: {
            name: f"{radio.gnb_elements} x {radio.gnb_elements} antennas at the base station, "
            f"{radio.ue_elements} x {radio.ue_elements} at the user"
            for name, radio in RADIOS.items()
        },
        "scenes": scenes,
        "modes": partial(modes, args.radio),
        "samples": samples,
        "rewards": lambda: {
            name: str(inspect.getdoc(kind)).partition("\n")[0] for name, kind in REWARDS.items()
        },
    }
    terminal = Console()
    fold = textwrap.TextWrapper(
        terminal.width if terminal.is_terminal else sys.maxsize,
        subsequent_indent=" " * COLUMN,
        break_long_words=False,
        break_on_hyphens=False,
    )
    for kind, table in kinds.items():
        if args.what in (kind, "all"):
            lines = (f"  {name:{COLUMN - 3}} {meaning}" for name, meaning in table().items())
            say(f"{kind}:", *(part for line in lines for part in fold.wrap(line)))
