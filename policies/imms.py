"""IMMs that were tuned on tuning seeds."""

import json
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

from mmwave_env.estimator.modes import Mode
from mmwave_env.names import choose

Transition = tuple[tuple[float, ...], ...]

TUNED_IMMS: dict[str, tuple[str, ...]] = {
    "imm-tuned": ("ekf", "ukf"),
    "imm-robust": ("ekf-robust", "ukf-robust"),
    "imm-extended": ("extended",),
}  # and the modes that their tuning started from


class TunedImm(NamedTuple):
    """An IMM as ``mmwave-loc tune-imm`` left it.

    Attributes:
        modes: what it weighs.
        transition: (modes, modes) transition probabilities (from, to).
        nis_quantile: as :class:`~mmwave_env.imm_engine.ImmEngine` has it.
    """

    modes: tuple[Mode, ...]
    transition: Transition
    nis_quantile: float


@cache
def _shipped() -> dict[str, Any]:
    text = files("policies").joinpath("data/imms.json").read_text()
    return json.loads(text)["radios"]  # type: ignore[no-any-return]


def tuned_imm(name: str, radio: str) -> TunedImm:
    """A tuned IMM.

    Args:
        name: one of :data:`TUNED_IMMS`.
        radio: profile; one that was not tuned gets the IMM of "standard".

    Raises:
        ValueError: no IMM of this name was tuned.
    """
    radios = _shipped()
    found = choose(radios.get(radio, radios["standard"]), name, "tuned IMM")
    modes = tuple(Mode(**mode) for mode in found["modes"])
    return TunedImm(modes, tuple(map(tuple, found["transition"])), found["nis_quantile"])
