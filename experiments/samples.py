"""mmwave-loc samples: the logs and recordings that come with the package."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.arguments.samples import Args
from experiments.cli.main import run
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.terminal import say
from experiments.evaluation.text import escaped
from mmwave_env.episodes.log_folder import read_log_folder
from mmwave_env.episodes.samples import recording_from, sample_folder, sample_names
from mmwave_env.files import require_writable, write_bytes
from mmwave_env.numerics.arrays import Array


def _times() -> Iterator[tuple[str, str, Array]]:
    """Name, kind and times of every sample."""
    for name in sample_names():
        yield name, "log", read_log_folder(sample_folder(name)).time_s
    for name in sample_names():
        yield name, "recording", recording_from(name).time_s


def listed() -> str:
    """All samples as Markdown, where they are, and what takes them."""
    rows = [
        [name, kind, str(len(time)), f"{np.median(np.diff(time)):g}", f"{time[-1] - time[0]:g}"]
        for name, kind, time in _times()
    ]
    folders = {kind: sample_folder(sample_names()[0], kind).parent for kind in ("log", "recording")}
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


def main(args: Args) -> None:
    """Run the command."""
    if (args.copy is None) != (args.out is None):
        given = "out" if args.copy is None else "copy"
        raise ValueError(f"{given}: found alone, expected --copy NAME --out FOLDER")
    if args.copy is None or args.out is None:
        show(listed())
    else:
        say(copied(args.copy, args.kind, args.out))


if __name__ == "__main__":
    run("samples")
