"""Where a training stands, on disk: written beside and renamed, read without unpickling."""

import io
from hashlib import sha256
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch

from mmwave_env.files import write_bytes


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write numbers, strings, arrays and tensors in lists, tuples and dicts."""
    memory = io.BytesIO()
    torch.save(_with_tensors(state), memory)
    content = memory.getvalue()
    write_bytes(path, sha256(content).digest() + content)  # PyTorch would not see a flipped bit


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What :func:`write_checkpoint` wrote; arrays come back as tensors.

    Raises:
        ValueError: it is damaged; nothing in it is executed.
    """
    written = path.read_bytes()
    checksum, content = written[: sha256().digest_size], written[sha256().digest_size :]
    try:
        if sha256(content).digest() != checksum:
            raise ValueError("found another checksum than that of its content")
        state: dict[str, Any] = torch.load(
            io.BytesIO(content), map_location="cpu", weights_only=True
        )
    except (ValueError, UnpicklingError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"{path}: not a checkpoint: {reason}; remove it to train from the start"
        ) from error
    return state


def _with_tensors(tree: Any) -> Any:
    """Arrays become tensors: an array is written with a pickle that a safe reader refuses."""
    if isinstance(tree, dict):
        return {key: _with_tensors(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(_with_tensors(value) for value in tree)
    if isinstance(tree, np.ndarray):
        return torch.from_numpy(np.ascontiguousarray(tree))
    return tree.item() if isinstance(tree, np.generic) else tree


def with_arrays(tree: Any) -> Any:
    """Tensors of a checkpoint become arrays."""
    if isinstance(tree, dict):
        return {key: with_arrays(value) for key, value in tree.items()}
    return tree.numpy() if isinstance(tree, torch.Tensor) else tree
