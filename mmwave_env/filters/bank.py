"""Banks: modes that interact, with what an IMM over them was tuned to."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from mmwave_env.filters.imm import ImmSettings, stay_matrix
from mmwave_env.filters.mode_files import (
    SETTINGS,
    as_written,
    known_only,
    modes_from,
    modes_in,
    read_mode_file,
    tuned_profile,
)
from mmwave_env.filters.modes import Mode
from mmwave_env.models.measurement import Layout
from mmwave_env.models.radio import Radio
from mmwave_env.records import Bound, Probability, object_from, require_fields

Transition = Annotated[tuple[tuple[Probability, ...], ...], "a list of rows of probabilities"]
_ROUNDING = 1e-6  # of rows that sum to 1


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
        ValueError: no modes, a quantile outside (0, 1], another shape of the transition, rows
            that are no probabilities, or a mode that none leads to.
    """

    modes: tuple[Mode, ...]
    transition: Transition | None = None
    nis_quantile: Annotated[float, Bound("a quantile in (0, 1]", above=0.0, most=1.0)] = 1.0

    def __post_init__(self) -> None:
        if not self.modes:
            raise ValueError("modes of a bank: found none, expected one or more")
        require_fields(self)
        if self.transition is not None:
            _require_probabilities(self.transition, len(self.modes))

    @property
    def probabilities(self) -> Transition:
        """The transition probabilities over a second."""
        return stay_matrix(len(self.modes)) if self.transition is None else self.transition


def settings_of(bank: Bank, layout: Layout) -> ImmSettings:
    """A bank as numbers, for measurements of a layout."""
    from scipy.special import chdtri  # where used: a bank is described without it

    return ImmSettings(
        [list(row) for row in bank.probabilities],
        [mode.tuning for mode in bank.modes],
        [float(chdtri(k, 1.0 - bank.nis_quantile)) for k in layout.widths],
    )


def _require_probabilities(transition: Transition, modes: int) -> None:
    rows_sound = all(
        len(row) == modes and min(row) >= 0.0 and abs(sum(row) - 1.0) <= _ROUNDING
        for row in transition
    )
    square = len(transition) == modes and rows_sound
    if not square or not all(map(any, zip(*transition, strict=True))):
        raise ValueError(
            f"transition: found {[list(row) for row in transition]}, expected {modes} rows of "
            f"{modes} probabilities that sum to 1, and none of the modes out of reach"
        )


def bank_in(content: dict[str, Any]) -> Bank:
    """The bank of a JSON object: "modes" as in a mode file, and what else :class:`Bank` has.

    Raises:
        ValueError: saying what is wrong in it.
    """
    said = {key: content[key] for key in SETTINGS if key in content}
    return object_from(Bank, said | {"modes": modes_in(content)})


def bank_as_written(bank: Bank) -> dict[str, Any]:
    """A bank as JSON files hold it, all of it; :func:`bank_in` reads it.

    Raises:
        ValueError: a mode's algorithm is a function, which no file can hold.
    """
    transition = bank.transition
    return {
        "modes": [as_written(mode) for mode in bank.modes],
        "transition": None if transition is None else [list(row) for row in transition],
        "nis_quantile": bank.nis_quantile,
    }


def read_bank(path: str | os.PathLike[str]) -> Bank:
    """The bank of a mode file.

    Raises:
        ValueError: naming the file and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    return read_mode_file(path, bank_in)


def best_bank(radio: str | Radio = "handset") -> Bank:
    """The bank of the strongest IMM that ``mmwave-loc tune --bank`` found for a radio profile.

    Args:
        radio: profile; one that was not tuned gets the bank of its base, and a warning, once.
    """
    return _shipped_bank(tuned_profile(radio))


@cache
def _shipped_bank(radio: str) -> Bank:
    return read_bank(Path(str(files("mmwave_env").joinpath(f"data/banks/{radio}.json"))))


def bank_over(
    modes: Bank | Sequence[Mode | str] | Mapping[str, Any] | str | os.PathLike[str],
    radio: str | Radio = "handset",
) -> Bank:
    """The bank over the modes of a ``modes=`` argument, one mode or more.

    Args:
        modes: a bank; a mode file, alone, or what one holds, which may say "transition" and
            "nis_quantile", too; or what else :func:`~mmwave_env.filters.mode_files.modes_from`
            takes.
        radio: profile that named modes are tuned for.

    Raises:
        ValueError: as :class:`Bank`, or two modes of one name.
    """
    if isinstance(modes, Bank):
        return modes
    alone = modes[0] if isinstance(modes, (list, tuple)) and len(modes) == 1 else modes
    if isinstance(modes, Mapping):
        bank = bank_in(known_only(modes))
    elif isinstance(alone, (str, os.PathLike)) and str(alone).endswith(".json"):
        bank = read_bank(alone)
    else:
        return Bank(modes_from(modes, radio))
    return replace(bank, modes=modes_from(bank.modes, radio))  # which refuses a name twice


def bank_from(
    modes: Bank | Sequence[Mode | str] | Mapping[str, Any] | str | os.PathLike[str] | None,
    radio: str | Radio = "handset",
) -> Bank:
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
