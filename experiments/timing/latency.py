"""Latency of a live track: the time to compute the user's position from the rows of an epoch."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from math import isnan
from typing import Any

import numpy as np

from experiments.evaluation.contenders import imm_banks
from experiments.timing.workloads import RADIO
from mmwave_env.datasets.log_writer import log_columns
from mmwave_env.filters.bank import named_modes
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.tracker import Tracker
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import scene_from
from mmwave_env.world.simulated import SimulatedSource
from policies import load

# 4000 epochs; the first 1000 do not count
SCENE = "street"
EPOCHS = 4000
WARM_UP = 1000
PERCENTILES = (50.0, 99.0, 99.9)
# localize --live, or calls of Tracker.update
PIPE = "through a pipe"
PYTHON = "in Python"
# name -> options of `mmwave-loc localize`, and a function that selects the same filters in Python
CONTENDERS: dict[str, tuple[tuple[str, str], Callable[[], Switching]]] = {
    "EKF": (("--speed", "1"), lambda: Switching((named_modes(RADIO)["ekf"],))),
    "imm-best": (("--imm", "imm-best"), lambda: Switching(imm_banks(RADIO)["imm-best"]())),
    "guided": (("--policy", "guided"), lambda: load("guided", RADIO)),
    "corrector": (("--policy", "corrector"), lambda: load("corrector", RADIO)),
}
LATENCIES = [(name, interface) for name in CONTENDERS for interface in (PYTHON, PIPE)]


def latency_us(name: str, interface: str) -> list[float]:
    """Return percentiles of a contender's latency (microseconds); interface: PYTHON or PIPE."""
    source = SimulatedSource(scene_from(SCENE), radio_from(RADIO), epochs=EPOCHS)
    columns = log_columns(source.sample(np.random.default_rng(0)))
    cells = np.stack(list(columns.values()), axis=1).reshape(EPOCHS, -1, len(columns)).tolist()
    epochs = [
        [{n: v for n, v in zip(columns, row, strict=True) if not isnan(v)} for row in rows]
        for rows in cells
    ]
    options, make = CONTENDERS[name]
    if interface == PYTHON:
        times = _timed(Tracker(SCENE, make(), RADIO).update, epochs)
    else:
        times = _through_a_pipe(options, epochs)
    return np.percentile(1e6 * times[WARM_UP:], PERCENTILES).tolist()  # type: ignore[no-any-return]


def _through_a_pipe(options: tuple[str, str], epochs: list[Any]) -> Any:
    words = [sys.executable, "-m", "experiments.console", "localize", "-", "--live", "--scene"]
    # The new process finds the same packages as this process.
    packages = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [*words, SCENE, "--radio", RADIO, *options], env=packages,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    ) as child:  # fmt: skip

        def ask(line: bytes) -> None:
            child.stdin.write(line)  # type: ignore[union-attr]
            child.stdin.flush()  # type: ignore[union-attr]
            child.stdout.readline()  # type: ignore[union-attr]

        return _timed(ask, [json.dumps({"rows": rows}).encode() + b"\n" for rows in epochs])


def _timed(call: Callable[[Any], object], arguments: list[Any]) -> Any:
    """Return the seconds (n,) that a call takes with each of n arguments."""
    times = [time.perf_counter()]
    for argument in arguments:
        call(argument)
        times.append(time.perf_counter())
    return np.diff(times)
