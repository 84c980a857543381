"""mmwave-loc samples: the logs and recordings that come with the package."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from experiments.arguments.samples import Args
from experiments.arguments.shared import EpisodeArgs
from experiments.cli.main import run
from experiments.cli.reporting import results
from experiments.evaluation.markdown import HEADERS, grid, rounded, show
from experiments.evaluation.terminal import say
from experiments.evaluation.text import escaped
from mmwave_env.episodes.log_folder import read_log_folder
from mmwave_env.episodes.samples import (
    log_names,
    recording_from,
    sample_folder,
    sample_names,
)
from mmwave_env.files import require_writable, write_bytes
from mmwave_env.numerics.arrays import Array

SHOWN = ("reward", "ate_m", "rmse_m", "rpe_m", "nees", "in_bounds")


def _times() -> Iterator[tuple[str, str, Array]]:
    """Name, kind and times of every sample."""
    for name in log_names():
        yield name, "log", read_log_folder(sample_folder(name)).time_s
    for name in sample_names():
        yield name, "recording", recording_from(name).time_s


def listed() -> str:
    """All samples as Markdown, where they are, and what takes them."""
    rows = [
        [name, kind, str(len(time)), f"{np.median(np.diff(time)):g}", f"{time[-1] - time[0]:g}"]
        for name, kind, time in _times()
    ]
    folders = {kind: sample_folder(log_names()[0], kind).parent for kind in ("log", "recording")}
    return (
        f"{grid(['sample', 'kind', 'epochs', 'step s', 'length s'], rows)}\n\n"
        f"- logs, for `localize --sample NAME`, are in {escaped(str(folders['log']))}\n"
        "- recordings, for `--data NAME` and `episodes=NAME`, are in "
        f"{escaped(str(folders['recording']))}"
    )


def copied(name: str, kind: str, out: Path) -> str:
    """Copy a sample file by file, each of them whole or not there; what to say of it."""
    files = sorted(sample_folder(name, kind).iterdir())
    for file in files:
        if (out / file.name).exists():
            raise FileExistsError(f"{out / file.name}: found a file, expected a folder without it")
        require_writable(out / file.name)
    for file in files:
        write_bytes(out / file.name, file.read_bytes())
    return f"copied to {out}/: {len(files)} files"


def compared(policies: Sequence[str], episodes: int) -> str:
    """Policies on every recording, with 95 % half-widths, as Markdown."""
    rows = []
    for name in sample_names():
        result, *_ = results(EpisodeArgs(data=name, episodes=episodes), policies)
        rows += [
            [name, policy, *(rounded(metrics[metric]) for metric in SHOWN)]
            for policy, metrics in result.policies.items()
        ]
    return grid(["recording", "policy", *(HEADERS[metric] for metric in SHOWN)], rows)


def main(args: Args) -> None:
    """Run the command."""
    if (args.copy is None) != (args.out is None):
        given = "out" if args.copy is None else "copy"
        raise ValueError(f"{given}: found alone, expected --copy NAME --out FOLDER")
    if args.copy is not None and args.out is not None:
        say(copied(args.copy, args.kind, args.out))
    elif args.policies:
        show(compared(args.policies, args.episodes))
    else:
        show(listed())


if __name__ == "__main__":
    run("samples")
