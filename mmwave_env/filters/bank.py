"""Modes and banks of modes, shipped with the package or supplied by the user.

A mode is a filter with its tuning. A bank is a set of modes, together with the parameters of an IMM
(interacting multiple models) that combines them. A mode file contains a bank. An environment whose
modes share one belief (mean and covariance) uses the modes of a bank and ignores the parameters.
"""

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Annotated, Any

from mmwave_env.filters.gating import chi_square_limits
from mmwave_env.filters.imm import ImmSettings, stay_matrix
from mmwave_env.filters.modes import Mode, robust
from mmwave_env.io.files import Json, shipped_json
from mmwave_env.io.lookup import choose
from mmwave_env.io.records import Bound, Probability, Record, Size, object_from, read_object
from mmwave_env.models.radio import TUNED_RADIOS, Radio, radio_from

MOST_MODES = 32  # maximum number of modes; each is compiled, and runs in every epoch
Transition = Annotated[tuple[tuple[Probability, ...], ...], "a list of rows of probabilities"]
_ROUNDING = 1e-6  # tolerance of the sum of a row of probabilities
# Keys that say how a mode file was made, with their meanings. This package ignores their values.
NOTES = {
    "about": "what the modes are for",
    "command": "the command that made the file",
    "numbers": "how many parameters were tuned",
    "seconds": "the time that tuning took on one core",
    "held_out": "figures on episodes that were not used for tuning",
}


@dataclass(frozen=True)
class Bank(Record):
    """Modes that each keep their own belief, and the parameters of their interaction.

    Attributes:
        modes: one or more modes with different names.
        transition: (modes, modes) transition probabilities over one second, indexed [from, to]; if
            None, the probability of staying in the same mode is 0.95.
        nis_quantile: probability p; in a mode's likelihood, the NIS (normalized innovation squared)
            of each group of measurements is limited to the chi-square quantile of p; 1 for no
            limit, as in the textbook.

    Raises:
        ValueError: there are no modes or too many; two modes have the same name; the quantile is
            outside (0, 1]; the transition has a wrong shape; one of its rows does not contain
            probabilities with a sum of 1; or one of its columns contains only zeros.
    """

    modes: Annotated[tuple[Mode, ...], Size(1, MOST_MODES)]
    transition: Transition | None = None
    nis_quantile: Annotated[float, Bound("a quantile in (0, 1]", above=0.0, most=1.0)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [mode.name for mode in self.modes]
        if len(set(names)) < len(names):
            raise ValueError(f"modes: found {names}, expected different names")
        if self.transition is None:
            return
        rows = self.transition
        n = len(names)
        sound = all(len(row) == n and abs(sum(row) - 1.0) <= _ROUNDING for row in rows)
        if len(rows) != n or not sound or not all(map(any, zip(*rows, strict=True))):
            raise ValueError(
                f"transition: found {[list(row) for row in rows]}, expected {n} rows of {n} "
                "probabilities that sum to 1, and no column of zeros"
            )


# type of a ``modes=`` argument; a mapping is the content of a mode file
Modes = Bank | Sequence[Mode | str] | Mapping[str, Any] | str | os.PathLike[str] | None


def settings_of(bank: Bank) -> ImmSettings:
    """Return the parameters of a bank as numbers."""
    return ImmSettings(
        [list(row) for row in bank.transition or stay_matrix(len(bank.modes))],
        [mode.tuning for mode in bank.modes],
        chi_square_limits(bank.nis_quantile),
    )


def bank_in(content: Mapping[str, Any]) -> Bank:
    """Return the bank in a mode file's content, or in a mapping of the same form.

    The key "modes" contains a list of modes, each with the attributes of :class:`Mode` that differ
    from the defaults. Keys of :data:`NOTES` are ignored; the rest are attributes of :class:`Bank`.

    Raises:
        ValueError: the content is wrong; the message names the error.
    """
    if isinstance(content, Mapping):
        content = {key: value for key, value in content.items() if key not in NOTES}
    return object_from(Bank, content)


def read_bank(path: str | os.PathLike[str]) -> Bank:
    """Read the bank from a mode file, a JSON file like those that ``mmwave-loc tune`` writes.

    Raises:
        ValueError: the file is wrong; the message names the file and the error.
        FileNotFoundError: the file does not exist.
    """
    return read_object(path, "modes", bank_in)


def as_written(mode: Mode) -> Json:
    """Return a mode in the form that mode files contain.

    Raises:
        ValueError: the mode's algorithm is a function, which cannot be written to a file.
    """
    if not isinstance(mode.algorithm, str):
        raise ValueError(
            f"algorithm of mode {mode.name!r}: found a function, expected a name, as files contain "
            "no code; a policy in a module of yours may have any algorithm"
        )
    default = asdict(Mode("default"))
    always = ("name", "algorithm", "sigma_p", "sigma_v")
    return {k: v for k, v in asdict(mode).items() if k in always or v != default[k]}


def bank_as_written(bank: Bank) -> Json:
    """Return the complete bank in the form that JSON files contain and :func:`bank_in` reads.

    Raises:
        ValueError: same as for :func:`as_written`.
    """
    modes = [as_written(mode) for mode in bank.modes]
    transition = None if bank.transition is None else [list(row) for row in bank.transition]
    return {**asdict(bank), "modes": modes, "transition": transition}


@cache  # each radio causes only one warning
def _tuned_profile(radio: Radio) -> str:
    """Return the radio's base: the shipped profile whose modes and banks the radio uses."""
    if radio.name not in TUNED_RADIOS:
        warnings.warn(
            f"radio {radio.name!r}: found no modes tuned for this radio, so the modes of "
            f"{radio.base!r} are used; to tune some, run mmwave-loc tune --radio {radio.name}.json "
            "--out modes.json (--bank for a bank), and pass the file as modes= or --modes",
            stacklevel=3,
        )
    return radio.base


@cache
def _shipped(name: str) -> Bank:
    return bank_in(shipped_json(name))


def shipped_modes(radio: str, coupling: bool = True) -> tuple[Mode, ...]:
    """Return the EKF and the UKF pipeline that were tuned for a shipped radio profile.

    With ``coupling`` False, they have the paper's diagonal process noise covariance.
    """
    return _shipped(f"modes/{radio}{'' if coupling else '-diagonal'}").modes


def default_modes(radio: str | Radio = "handset") -> tuple[Mode, ...]:
    """Return the two default modes of ``MmWaveLoc-v0``: the paper's EKF and UKF pipelines."""
    return shipped_modes(_tuned_profile(radio_from(radio)))


def named_modes(radio: str | Radio = "handset") -> dict[str, Mode]:
    """Return modes by name: the default modes, their robust forms, and "ckf" tuned like "ukf"."""
    low, high = default_modes(radio)
    modes = (low, high, replace(high, name="ckf", algorithm="ckf"), robust(low), robust(high))
    return {mode.name: mode for mode in modes}


def best_bank(radio: str | Radio = "handset") -> Bank:
    """Return the bank of the best IMM that ``mmwave-loc tune --bank`` found for a radio profile.

    If no bank was tuned for the profile, warn and return the bank of the profile's base.
    """
    return _shipped(f"banks/{_tuned_profile(radio_from(radio))}")


def bank_over(modes: Modes, radio: str | Radio) -> Bank:
    """Return the bank that a ``modes=`` argument describes; it may have a single mode.

    Args:
        modes: a bank, a mode file, the content of a mode file, or a list of names, mode files and
            Mode objects. A list with several entries gives a bank with the default parameters.
        radio: radio profile; names stand for the modes that were tuned for this profile.

    Raises:
        ValueError: same as for :class:`Bank`, or an entry of the list is not a mode.
    """
    if isinstance(modes, Bank):
        return modes
    if isinstance(modes, Mapping):
        return bank_in(modes)
    entries: Any = [modes] if str(modes).endswith(".json") else modes
    if isinstance(entries, str | os.PathLike) or not isinstance(entries, Sequence):
        raise ValueError(
            f"modes: found {modes!r}, expected a list of names, mode files and Modes, such as "
            "['ekf']; or a mode file (.json)"
        )
    banks = [_bank_of(entry, radio) for entry in entries]
    return banks[0] if len(banks) == 1 else Bank(sum((bank.modes for bank in banks), ()))


def _bank_of(mode: Mode | str, radio: str | Radio) -> Bank:
    """Return the bank of an entry in a list of modes."""
    if isinstance(mode, Mode):
        return Bank((mode,))
    if str(mode).endswith(".json"):
        return read_bank(mode)
    return Bank((choose(named_modes(radio), mode, "mode"),))


def modes_from(modes: Modes, radio: str | Radio = "handset") -> tuple[Mode, ...]:
    """Return the modes of a ``modes=`` argument (:func:`bank_over`); None for the default modes."""
    return default_modes(radio) if modes is None else bank_over(modes, radio).modes


def bank_from(modes: Modes, radio: str | Radio = "handset") -> Bank:
    """Return the bank of a ``modes=`` argument for modes that each keep their own belief.

    Arguments are as for :func:`bank_over`, but ``modes=None`` stands for :func:`best_bank`.

    Raises:
        ValueError: same as for :func:`bank_over`, or there are fewer than two modes.
    """
    bank = best_bank(radio) if modes is None else bank_over(modes, radio)
    if len(bank.modes) < 2:
        raise ValueError(
            f"modes: found only {bank.modes[0].name!r}, expected two or more modes "
            "that each keep their own belief"
        )
    return bank
