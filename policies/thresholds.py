"""Thresholds of the speed rule that were tuned on tuning seeds."""

import json
from functools import cache
from importlib.resources import files
from typing import Any

from mmwave_env.lookup import choose


@cache
def _shipped() -> dict[str, Any]:
    text = files("policies").joinpath("data/thresholds.json").read_text()
    return json.loads(text)["radios"]  # type: ignore[no-any-return]


def tuned_threshold(radio: str) -> float:
    """Threshold in m/s for a radio profile; written by ``mmwave-loc tune-threshold``.

    Raises:
        ValueError: no threshold was tuned for this profile.
    """
    return float(choose(_shipped(), radio, "tuned threshold of radio")["threshold_mps"])
