"""Infos: the dicts that resets and steps return, for a single or a vector environment."""

import warnings
from collections.abc import Callable, Iterable
from typing import Any

from mmwave_env.numerics.numbers import Mask

Info = dict[str, Any]  # values by key; in vector environments, arrays (n, ...)
STATE_KEYS = ("truth", "estimate")  # in the infos of resets and steps
TERMS_KEY = "reward_terms"
COST_KEY = "cost"  # 1.0 where the horizontal error exceeds its protection level
STEP_KEYS = (
    "position_error_m",
    "nees",
    "nis",
    "accepted",
    "rejected",
    "mode",
    "gamma",
    TERMS_KEY,
    COST_KEY,
)
PROBABILITIES = "mode_probabilities"  # in infos only if each mode has its own belief
FLAGS = ("accepted", "rejected")
NONFINITE_KEY = "nonfinite_beliefs"  # in the info of the last step if a belief was not finite


def reported(at: Any) -> Any:
    """Return the epoch to report: ``at.reported`` if actions correct beliefs, else ``at``."""
    return at.reported or at


def info_rows(at: Any) -> dict[str, Any]:
    """Return the rows of a workspace that contain the values of infos, except mode and cost.

    Args:
        at: state of :mod:`~mmwave_env.engines.epoch` with row numbers in all fields.
    """
    epoch = reported(at)
    memory = epoch.memory
    rows = {"position_error_m": at.distance, "nees": at.nees}
    rows |= {key: getattr(memory, key) for key in ("nis", *FLAGS, "gamma")}
    rows |= {"truth": epoch.truth, "estimate": epoch.x, TERMS_KEY: at.reward_terms}
    if at.mode_probabilities:
        rows[PROBABILITIES] = epoch.mode_probabilities
    return rows


def drawn_rows(at: Any, span: Callable[[Any], Any]) -> dict[str, Any]:
    """Return the rows of a workspace that a :class:`~mmwave_env.rendering.gallery.Gallery` reads.

    Args:
        at: state with row numbers as values, the same as for :func:`info_rows`.
        span: function that converts the row numbers of a value to an index or a slice.
    """
    rows = info_rows(at)
    parts = {name: rows[name] for name in ("truth", "estimate", "nees", "accepted", "rejected")}
    position = reported(at).P[:6]  # the packed covariance begins with that of the position
    parts |= {"P": position, "dt": at.pending.dt, "anchors": at.site.anchors}
    return {name: span(part) for name, part in parts.items()}


def masked(values: Info, where: Mask) -> Info:
    """Return infos (n, ...) for the environments in which ``where`` (n,) is True.

    The values of other environments are replaced by 0 or None, in place. Every key gets a mask
    ``_key``; all masks share one copy of ``where``. If no environment is left, the result is empty.
    """
    if not where.any():
        return {}
    elsewhere = ~where
    for array in values.values():
        array[elsewhere] = None if array.dtype == object else 0
    return values | dict.fromkeys(mask_keys(values), where.copy())


def stepped(infos: Info, where: Mask) -> Info:
    """Return a step's infos, but only STATE_KEYS for environments whose ``where`` (n,) is False."""
    did = {key: infos[key] for key in (*STEP_KEYS, PROBABILITIES) if key in infos}
    kept = (*STATE_KEYS, *mask_keys(STATE_KEYS))
    return masked(did, where) | {key: infos[key] for key in kept if key in infos}


def mask_keys(keys: Iterable[str]) -> list[str]:
    """Return the names of the masks that belong to some keys of infos."""
    return [f"_{key}" for key in keys]


def warn_of_nonfinite() -> None:
    """Warn that an episode had beliefs that were not finite; Python shows the warning once."""
    warnings.warn(
        "the belief was NaN or infinite in an episode, so the metrics of the episode are NaN; "
        f"info[{NONFINITE_KEY!r}] is the number of epochs with such a belief "
        "(docs/reliability.md)",
        RuntimeWarning,
        stacklevel=3,
    )
