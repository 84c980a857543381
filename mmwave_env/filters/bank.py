"""Modes and banks of them: by name, as they are shipped, and from a user's files.

A bank is modes that interact, with what an IMM over them was tuned to. A mode file holds one; where
the modes share a belief, only they count.
"""

import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from mmwave_env.filters.imm import ImmSettings, stay_matrix
from mmwave_env.filters.modes import Mode, robust
from mmwave_env.lookup import choose
from mmwave_env.models.measurement import Layout
from mmwave_env.models.radio import RADIOS, Radio, radio_from
from mmwave_env.records import Bound, Probability, Size, object_from, read_object, require_fields

MOST_MODES = 32  # all run in every epoch, and are compiled
Transition = Annotated[tuple[tuple[Probability, ...], ...], "a list of rows of probabilities"]
_ROUNDING = 1e-6  # of rows that sum to 1
# What else a mode file may say: how it was made, which nobody looks at.
NOTES = {
    "about": "what the modes are for", "command": "that made the file",
    "numbers": "how many were tuned", "seconds": "that this took on one core",
    "held_out": "figures on episodes that were not tuned on",
}  # fmt: skip


@dataclass(frozen=True)
class Bank:
    """Modes that keep a belief each, and how the beliefs interact.

    Attributes:
        modes: one or more; no name twice.
        transition: (modes, modes) probabilities (from, to) over a second; None to stay with
            probability 0.95.
        nis_quantile: chi-square quantile up to which the NIS of a link counts in a likelihood; 1
            for all of it, as in the textbook.

    Raises:
        ValueError: no modes, a name twice, a quantile outside (0, 1], another shape of the
            transition, rows that are no probabilities, or a mode that none leads to.
    """

    modes: Annotated[tuple[Mode, ...], Size(1, MOST_MODES)]
    transition: Transition | None = None
    nis_quantile: Annotated[float, Bound("a quantile in (0, 1]", above=0.0, most=1.0)] = 1.0

    def __post_init__(self) -> None:
        require_fields(self)
        names = [mode.name for mode in self.modes]
        if len(set(names)) < len(names):
            raise ValueError(f"modes: found {names}, expected no name twice")
        if self.transition is not None:
            _require_probabilities(self.transition, len(names))


# of a ``modes=`` argument; a mapping is what a mode file holds
Modes = Bank | Sequence[Mode | str] | Mapping[str, Any] | str | os.PathLike[str] | None


def settings_of(bank: Bank, layout: Layout) -> ImmSettings:
    """A bank as numbers, for measurements of a layout."""
    from scipy.special import chdtri  # where used: a bank is described without it

    transition = bank.transition
    if transition is None:
        transition = stay_matrix(len(bank.modes))

    return ImmSettings(
        [list(row) for row in transition],
        [mode.tuning for mode in bank.modes],
        [float(chdtri(k, 1.0 - bank.nis_quantile)) for k in layout.widths],
    )


def _require_probabilities(transition: Transition, modes: int) -> None:
    rows_sound = all(len(row) == modes and abs(sum(row) - 1.0) <= _ROUNDING for row in transition)
    square = len(transition) == modes and rows_sound
    if not (square and all(map(any, zip(*transition, strict=True)))):
        raise ValueError(
            f"transition: found {[list(row) for row in transition]}, expected {modes} rows of "
            f"{modes} probabilities that sum to 1, and none of the modes out of reach"
        )


# --- files


def bank_in(content: Mapping[str, Any]) -> Bank:
    """The bank of a mode file's object, or of one like it.

    The key "modes" holds a list of modes, each with the attributes of :class:`Mode` that differ
    from the defaults; the others are those of :class:`Bank`, and :data:`NOTES`.

    Raises:
        ValueError: saying what is wrong in it.
    """
    if isinstance(content, Mapping):
        content = {key: said for key, said in content.items() if key not in NOTES}
    return object_from(Bank, content)


def read_bank(path: str | os.PathLike[str]) -> Bank:
    """The bank of a mode file, JSON as ``mmwave-loc tune`` writes it.

    Raises:
        ValueError: naming the file and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    return read_object(path, "modes", bank_in)


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


def bank_as_written(bank: Bank) -> dict[str, Any]:
    """A bank as JSON files hold it, all of it; :func:`bank_in` reads it.

    Raises:
        ValueError: as of :func:`as_written`.
    """
    return {**asdict(bank), "modes": [as_written(mode) for mode in bank.modes]}


# --- shipped


@cache  # so that it warns once
def _tuned_profile(radio: Radio) -> str:
    """The shipped profile whose modes and banks a radio gets: its base."""
    if radio.name not in RADIOS:
        warnings.warn(
            f"radio {radio.name!r}: found no modes tuned for it, took those of {radio.base!r}; "
            f"mmwave-loc tune --radio {radio.name}.json --out modes.json tunes modes= and --modes, "
            "with --bank a bank",
            stacklevel=3,
        )
    return radio.base


@cache
def _shipped(name: str) -> Bank:
    return read_bank(Path(str(files("mmwave_env").joinpath(f"data/{name}.json"))))


def shipped_modes(radio: str, coupling: bool = True) -> tuple[Mode, ...]:
    """The EKF and the UKF pipeline as ``mmwave-loc tune`` left them for a shipped radio profile.

    Args:
        radio: name of the profile.
        coupling: False for those with the paper's plain diagonal process noise.
    """
    return _shipped(f"modes/{radio}{'' if coupling else '-diagonal'}").modes


def default_modes(radio: str | Radio = "handset") -> tuple[Mode, Mode]:
    """The two actions of ``MmWaveLoc-v0``: the paper's EKF and UKF pipelines."""
    low, high = shipped_modes(_tuned_profile(radio_from(radio)))
    return low, high


def named_modes(radio: str | Radio = "handset") -> dict[str, Mode]:
    """Modes that can be asked for by name.

    "ekf" and "ukf" (the default two), "ckf" (the UKF's tuning), "ekf-robust", "ukf-robust".
    """
    low, high = default_modes(radio)
    all_of_them = (low, high, replace(high, name="ckf", algorithm="ckf"), robust(low), robust(high))
    return {mode.name: mode for mode in all_of_them}


def best_bank(radio: str | Radio = "handset") -> Bank:
    """The bank of the strongest IMM that ``mmwave-loc tune --bank`` found for a radio profile.

    Args:
        radio: profile; one that was not tuned gets the bank of its base, and a warning, once.
    """
    return _shipped(f"banks/{_tuned_profile(radio_from(radio))}")


# --- arguments


def bank_over(modes: Modes, radio: str | Radio = "handset") -> Bank:
    """The bank over the modes of a ``modes=`` argument, one mode or more.

    Args:
        modes: a list of names, mode files and Mode objects; a bank; one mode file, or what one
            holds. A file that stands alone also says how its modes interact.
        radio: profile that named modes are tuned for.

    Raises:
        ValueError: as :class:`Bank`, or what is no mode.
    """
    if isinstance(modes, Bank):
        return modes
    if isinstance(modes, Mapping):
        return bank_in(modes)
    if isinstance(modes, (str, os.PathLike)):
        if not str(modes).endswith(".json"):
            raise ValueError(
                f"modes: found the string {modes!r}, expected a list such as ['ekf'], or a mode "
                "file (.json)"
            )
        return read_bank(modes)
    if not isinstance(modes, Iterable):
        raise ValueError(f"modes: found {modes!r}, expected a list of names, mode files and Modes")
    banks = [_bank_of(mode, radio) for mode in modes]
    return banks[0] if len(banks) == 1 else Bank(sum((bank.modes for bank in banks), ()))


def _bank_of(mode: Mode | str, radio: str | Radio) -> Bank:
    """The bank of one in a list."""
    if isinstance(mode, Mode):
        return Bank((mode,))
    if not isinstance(mode, (str, os.PathLike)):
        raise ValueError(f"modes: found {mode!r}, expected a name, a mode file or a Mode")
    if str(mode).endswith(".json"):
        return read_bank(mode)
    return Bank((choose(named_modes(radio), mode, "mode"),))


def modes_from(modes: Modes, radio: str | Radio = "handset") -> tuple[Mode, ...]:
    """The modes of a ``modes=`` argument, as of :func:`bank_over`; None for the default two."""
    return default_modes(radio) if modes is None else bank_over(modes, radio).modes


def bank_from(modes: Modes, radio: str | Radio = "handset") -> Bank:
    """The bank of a ``modes=`` argument where every mode keeps its own belief.

    Args:
        modes: as of :func:`bank_over`; None for :func:`best_bank`.
        radio: profile that named modes are tuned for.

    Raises:
        ValueError: as :func:`bank_over`, or there are fewer than two modes.
    """
    bank = best_bank(radio) if modes is None else bank_over(modes, radio)
    if len(bank.modes) < 2:
        raise ValueError(
            f"modes: found {bank.modes[0].name!r} alone, expected two or more where every mode "
            "keeps its own belief"
        )
    return bank
