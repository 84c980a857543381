"""Data sets of transitions as Minari keeps them: a folder with one HDF5 file and its metadata."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.envs.registration import EnvSpec

from experiments.offline.transitions import Transitions
from mmwave_env.files import atomic_folder
from mmwave_env.lookup import require_extra

PACKAGES = ("minari", "h5py", "PIL")  # Minari's files need the others, too
DATASET_ID = re.compile(r"([\w-]{2,}/)*[\w-]+-v\d+")
MADE_BY = "mmwave-loc collect"  # begins the metadata "command" of what may be replaced


def require_minari(what: str) -> None:
    """Refuse what needs Minari where the extra is not installed.

    Raises:
        MissingExtraError: a package is missing; the message says how to get it.
    """
    for package in PACKAGES:
        require_extra(package, "offline", what)


def folder_for(dataset_id: str, root: Path | None, overwrite: bool) -> Path:
    """The folder to write a data set to.

    Args:
        dataset_id: that ``minari.load_dataset`` is to find it by.
        root: of all data sets; None for that of Minari: ``MINARI_DATASETS_PATH``, or
            ``~/.minari/datasets``.
        overwrite: whether a data set that was made here may be there.

    Raises:
        ValueError: the id is none, or something is there.
    """
    from minari.storage import get_dataset_path

    if not DATASET_ID.fullmatch(dataset_id):
        raise ValueError(
            f"id: found {dataset_id!r}, expected a name of letters, digits, - and _ with a "
            "version, perhaps in folders, such as mmwave-loc/collected-v0"
        )
    folder = (root or get_dataset_path()) / dataset_id
    if not folder.exists() or (overwrite and _is_ours(folder)):
        return folder
    what, advice = "something else", ""
    if _is_ours(folder):
        what, advice = "a data set", "--overwrite replaces it, "
    raise ValueError(
        f"out: found {what} in {folder}, expected a folder that is not there; {advice}--id names "
        "another"
    )


def _is_ours(folder: Path) -> bool:
    """Whether a folder is a data set that :func:`new_dataset` began."""
    from minari.dataset.minari_storage import MinariStorage

    try:
        metadata = MinariStorage.read_raw_metadata(folder / "data")
    except ValueError:  # no metadata, or no JSON
        return False
    return isinstance(metadata, dict) and str(metadata.get("command")).startswith(MADE_BY)


@contextmanager
def new_dataset(
    folder: Path, spec: EnvSpec, spaces: tuple[Space[Any], Space[Any]], about: dict[str, Any]
) -> Iterator[Any]:
    """Minari's storage of a data set to fill, which is in its folder at the end, whole.

    Args:
        folder: of :func:`folder_for`.
        spec: of the environment, which Minari makes again from it.
        spaces: of its observations and actions.
        about: metadata, with "dataset_id" and "command".

    Raises:
        OSError: it can't be written.
    """
    from minari import __version__
    from minari.dataset.minari_storage import MinariStorage

    with atomic_folder(folder.absolute()) as beside:  # Minari puts a relative path before itself
        storage = MinariStorage.new(beside / "data", *spaces, spec, "hdf5")
        storage.update_metadata({"minari_version": __version__} | about)
        yield storage


def add_episodes(storage: Any, policy: str, played: Transitions) -> None:
    """Add what a policy did; its name, and seed and key of each episode, are their metadata.

    Args:
        storage: of :func:`new_dataset`.
        policy: its name.
        played: episodes, which all end by truncation.
    """
    from minari.data_collector.episode_buffer import EpisodeBuffer

    n, T = played.actions.shape
    first, ends = storage.total_episodes, np.arange(1, T + 1) == T
    storage.update_episodes(
        EpisodeBuffer(
            seed=seed,
            observations=played.observations[i],
            actions=played.actions[i],
            rewards=played.rewards[i],
            terminations=np.zeros(T, np.bool_),
            truncations=ends,
            infos={name: values[i] for name, values in played.infos.items()},
        )
        for i, seed in enumerate(played.seeds)
    )
    keys = [{}] * n if played.keys is None else [{"key": key} for key in played.keys]
    storage.update_episode_metadata(
        [{"policy": policy} | key for key in keys], range(first, first + n)
    )
