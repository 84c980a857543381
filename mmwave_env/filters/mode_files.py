"""Modes by name and from files: the tuned ones that are shipped, and a user's own."""

import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from mmwave_env.filters.modes import Mode, robust
from mmwave_env.lookup import choose
from mmwave_env.models.radio import RADIOS, Radio, radio_from
from mmwave_env.records import object_from, read_object

T = TypeVar("T")

MOST_MODES = 32  # of a file: all run in every epoch, and are compiled
SETTINGS = ("modes", "transition", "nis_quantile")  # of a bank, as files hold them
# What else a mode file may say: how it was made, which nobody looks at.
NOTES = {
    "about": "what the modes are for", "command": "that made the file",
    "numbers": "how many were tuned", "seconds": "that this took on one core",
    "held_out": "figures on episodes that were not tuned on",
}  # fmt: skip


def read_modes(path: str | os.PathLike[str]) -> tuple[Mode, ...]:
    """The modes of a mode file, JSON as ``mmwave-loc tune`` writes it.

    The key "modes" holds a list of modes, each with the attributes of :class:`Mode` that
    differ from the defaults.

    Raises:
        ValueError: naming the file and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    return read_mode_file(path, modes_in)


def read_mode_file(path: str | os.PathLike[str], make: Callable[[dict[str, Any]], T]) -> T:
    """What a mode file holds.

    Args:
        path: of the file.
        make: from the file's object, which has known keys only: one misspelt would be missed.

    Raises:
        ValueError: naming the file and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    return read_object(path, "modes", lambda content: make(known_only(content)))


def known_only(content: Mapping[str, Any]) -> dict[str, Any]:
    """What a mode file holds, or an object like it, if it has the keys that there are.

    Raises:
        ValueError: naming a key that there is not.
    """
    for key in content:
        choose(dict.fromkeys([*SETTINGS, *NOTES]), key, "key")
    return dict(content)


def modes_in(content: dict[str, Any]) -> tuple[Mode, ...]:
    """The modes that a JSON object lists under the key "modes", each :func:`as_written`.

    Raises:
        ValueError: saying what is wrong in it.
    """
    modes = content.get("modes")
    if not isinstance(modes, list) or not modes:
        raise ValueError(f"modes: found {modes!r}, expected a list of one or more")
    if len(modes) > MOST_MODES:
        raise ValueError(f"modes: found {len(modes)}, expected at most {MOST_MODES}")
    made = tuple(object_from(Mode, mode, f"modes[{i}].") for i, mode in enumerate(modes))
    names = [mode.name for mode in made]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"modes: found two named {name!r}, expected no name twice")
    return made


def as_written(mode: Mode) -> dict[str, Any]:
    """A mode as a mode file holds it.

    Raises:
        ValueError: its algorithm is a function, which no file can hold.
    """
    if not isinstance(mode.algorithm, str):
        raise ValueError(f"algorithm of mode {mode.name!r}: found a function, expected a name")
    default = asdict(Mode("default"))
    always = ("name", "algorithm", "sigma_p", "sigma_v")
    return {k: v for k, v in asdict(mode).items() if k in always or v != default[k]}


@cache
def _warn_of_no_tuning(name: str, base: str) -> None:
    warnings.warn(
        f"radio {name!r}: found no modes tuned for it, took those of {base!r}; mmwave-loc tune "
        f"--radio {name}.json --out modes.json tunes modes= and --modes, with --bank a bank",
        stacklevel=3,
    )


def tuned_profile(radio: str | Radio) -> str:
    """The shipped profile whose modes and banks a radio gets: its base, and a warning, once."""
    found = radio_from(radio)
    if found.name not in RADIOS:
        _warn_of_no_tuning(found.name, found.base)
    return found.base


@cache
def shipped_modes(radio: str, coupling: bool = True) -> tuple[Mode, ...]:
    """The EKF and the UKF pipeline as ``mmwave-loc tune`` left them for a shipped radio profile.

    Args:
        radio: name of the profile.
        coupling: False for those with the paper's plain diagonal process noise.
    """
    name = f"data/modes/{radio}{'' if coupling else '-diagonal'}.json"
    return read_modes(Path(str(files("mmwave_env").joinpath(name))))


def default_modes(radio: str | Radio = "handset") -> tuple[Mode, Mode]:
    """The two actions of ``MmWaveLoc-v0``: the paper's EKF and UKF pipelines."""
    low, high = shipped_modes(tuned_profile(radio))
    return low, high


def named_modes(radio: str | Radio = "handset") -> dict[str, Mode]:
    """Modes that can be asked for by name.

    "ekf" and "ukf" (the default two), "ckf" (the UKF's tuning), "ekf-robust", "ukf-robust".
    """
    low, high = default_modes(radio)
    all_of_them = (low, high, replace(high, name="ckf", algorithm="ckf"), robust(low), robust(high))
    return {mode.name: mode for mode in all_of_them}


def modes_from(
    modes: Sequence[Mode | str] | Mapping[str, Any] | str | os.PathLike[str] | None,
    radio: str | Radio = "handset",
) -> tuple[Mode, ...]:
    """The modes of a ``modes=`` argument.

    Args:
        modes: a list of names, mode files and Mode objects; or one mode file, or what one holds;
            None for the default two.
        radio: profile that named modes are tuned for.

    Raises:
        ValueError: for an empty list, two modes of one name, or an unknown name.
    """
    if modes is None:
        return default_modes(radio)
    if isinstance(modes, Mapping):
        modes = modes_in(known_only(modes))
    if isinstance(modes, (str, os.PathLike)):
        name = os.fspath(modes)
        if not name.endswith(".json"):
            raise ValueError(
                f"modes: found the string {modes!r}, expected a list such as ['ekf'], or a mode "
                "file (.json)"
            )
        modes = [name]
    elif not isinstance(modes, Iterable):
        raise ValueError(f"modes: found {modes!r}, expected a list of names, mode files and Modes")
    result: list[Mode] = []
    for mode in modes:
        if isinstance(mode, Mode):
            result.append(mode)
        elif not isinstance(mode, (str, os.PathLike)):
            raise ValueError(f"modes: found {mode!r}, expected a name, a mode file or a Mode")
        elif str(mode).endswith(".json"):
            result += read_modes(mode)
        else:
            result.append(choose(named_modes(radio), mode, "mode"))
    names = [m.name for m in result]
    if not result or len(set(names)) < len(names):
        raise ValueError(f"modes: found {names}, expected at least one mode and no name twice")
    return tuple(result)
