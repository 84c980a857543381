"""Checkpoints of a training, from which it goes on after an interruption."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from mmwave_env.io.files import first_line, read_bounded, write_bytes

State = dict[str, Any]  # numbers, strings and tensors in nested lists and dicts

MOST_BYTES = 1 << 30  # size limit of a checkpoint


def write_checkpoint(path: Path, state: State) -> None:
    """Write a state to a file."""
    memory = io.BytesIO()
    torch.save(state, memory)
    write_bytes(path, memory.getvalue())


def read_checkpoint(path: Path) -> State:
    """Read what :func:`write_checkpoint` wrote.

    Raises:
        ValueError: the file is damaged; nothing in it is executed.
        OSError: the file can't be read.
    """
    content = io.BytesIO(read_bounded(path, MOST_BYTES, "a checkpoint"))
    with going_on_from(path):
        state: State = torch.load(content, map_location="cpu", weights_only=True)
    return state


@contextmanager
def going_on_from(path: Path) -> Iterator[None]:
    """Turn any exception into a ValueError while a checkpoint is read or restored.

    PyTorch can raise any exception for damaged bytes.

    Raises:
        ValueError: an exception was raised; the message names the checkpoint's file.
    """
    try:
        yield
    except Exception as error:
        message = (
            f"{path}: not a checkpoint: {first_line(error)}; remove it to train from the start"
        )
        raise ValueError(message) from error
