"""Atomically written checkpoints of a training; reading a checkpoint runs no code from it."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mmwave_env.io.files import first_line, read_bounded, write_bytes

State = dict[str, Any]  # numbers, strings, arrays and tensors in nested lists, tuples and dicts

MOST_BYTES = 1 << 30  # size limit of a checkpoint; with --algo rollouts, it holds many states


def write_checkpoint(path: Path, state: State) -> None:
    """Write a state to a file."""
    memory = io.BytesIO()
    torch.save(_with_tensors(state), memory)
    content = memory.getvalue()
    write_bytes(path, sha256(content).digest() + content)  # PyTorch would not notice a flipped bit


def read_checkpoint(path: Path) -> State:
    """Read what :func:`write_checkpoint` wrote; return arrays as tensors.

    Raises:
        ValueError: the file is damaged; nothing in it is executed.
        OSError: the file can't be read.
    """
    written = read_bounded(path, MOST_BYTES, "a checkpoint")
    checksum = written[: sha256().digest_size]
    content = written[sha256().digest_size :]
    with going_on_from(path):  # PyTorch can raise any exception for damaged bytes
        if sha256(content).digest() != checksum:
            raise ValueError("found a checksum that does not match the content")
        state: State = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    return state


@contextmanager
def going_on_from(path: Path) -> Iterator[None]:
    """Turn any exception into a ValueError while a checkpoint is read or restored.

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


def _with_tensors(tree: Any) -> Any:
    """Replace arrays by tensors, since PyTorch's safe reader refuses pickled arrays."""
    if isinstance(tree, dict):
        return {key: _with_tensors(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(_with_tensors(value) for value in tree)
    if isinstance(tree, np.ndarray):
        return torch.from_numpy(np.ascontiguousarray(tree))
    return tree.item() if isinstance(tree, np.generic) else tree


def with_arrays(tree: Any) -> Any:
    """Replace the tensors of a checkpoint by arrays."""
    if isinstance(tree, dict):
        return {key: with_arrays(value) for key, value in tree.items()}
    return tree.numpy() if isinstance(tree, torch.Tensor) else tree
