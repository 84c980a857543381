"""IMMs that were tuned on tuning seeds."""

import json
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

from mmwave_env.filters.bank import Bank, bank_in
from mmwave_env.lookup import choose
from mmwave_env.models.radio import profile_of


class Untuned(NamedTuple):
    """What the tuning of an IMM starts from."""

    modes: tuple[str, ...]  # names
    # an outlier counts up to a quantile in its likelihoods, and of two modes the process noise is
    # tuned as well; else the likelihoods are the textbook's and the transition alone is tuned
    limited: bool


_BANKS = {
    "imm-tuned": ("ekf", "ukf"),
    "imm-robust": ("ekf-robust", "ukf-robust"),
    "imm-extended": ("extended",),
}
TUNED_IMMS = {name: Untuned(modes, limited=False) for name, modes in _BANKS.items()}
TUNED_IMMS |= {f"{name}-limited": Untuned(modes, limited=True) for name, modes in _BANKS.items()}


@cache
def _shipped() -> dict[str, Any]:
    text = files("policies").joinpath("data/imms.json").read_text()
    return json.loads(text)  # type: ignore[no-any-return]


def tuned_imm(name: str, radio: str) -> Bank:
    """A tuned IMM, as ``mmwave-loc tune-imm`` left it.

    Args:
        name: one of :data:`TUNED_IMMS`.
        radio: profile; where it was not tuned, that of "standard".

    Raises:
        ValueError: no IMM of this name was tuned.
    """
    radios = _shipped()
    known = radios["standard"] | radios.get(profile_of(radio), {})
    found = choose({imm: known[imm] for imm in TUNED_IMMS}, name, "tuned IMM")
    return bank_in(found)
