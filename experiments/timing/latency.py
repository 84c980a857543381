"""Latency of a live track: the time to compute the user's position from the rows of an epoch."""

import json
import subprocess
import time
from collections.abc import Callable, Sequence
from math import isnan
from typing import Any

import numpy as np

from experiments.evaluation.contenders import contender_from
from experiments.timing.fresh import started
from experiments.timing.workloads import RADIO
from mmwave_env.datasets.log_folder import log_columns
from mmwave_env.filters.bank import named_modes
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.tracker import Tracker
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import scene_from
from mmwave_env.world.simulated import SimulatedSource

# 4000 epochs; the first 1000 do not count
SCENE = "street"
EPOCHS = 4000
WARM_UP = 1000
PERCENTILES = (50.0, 99.0, 99.9)
# localize --live, or calls of Tracker.update
PIPE = "through a pipe"
PYTHON = "in Python"
EKF = "EKF"
# name -> options of `mmwave-loc localize`
CONTENDERS = {
    EKF: ("--speed", "1"),
    "imm-best": ("--imm", "imm-best"),
    "guided": ("--policy", "guided"),
    "corrector": ("--policy", "corrector"),
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
    if interface == PIPE:
        times = _through_a_pipe(CONTENDERS[name], epochs)
    else:
        ekf = Switching((named_modes(RADIO)["ekf"],))
        switching = ekf if name == EKF else contender_from(name, RADIO)
        times = _timed(Tracker(SCENE, switching, RADIO).update, epochs)
    return np.percentile(1e6 * times[WARM_UP:], PERCENTILES).tolist()  # type: ignore[no-any-return]


def _through_a_pipe(options: Sequence[str], epochs: list[Any]) -> Any:
    words = ["experiments.console", "localize", "-", "--live", "--scene", SCENE, "--radio", RADIO]
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with started(*words, *options, **pipes) as child:

        def ask(line: bytes) -> None:
            child.stdin.write(line)
            child.stdin.flush()
            child.stdout.readline()

        return _timed(ask, [json.dumps({"rows": rows}).encode() + b"\n" for rows in epochs])


def _timed(call: Callable[[Any], object], arguments: list[Any]) -> Any:
    """Return the seconds (n,) that a call takes with each of n arguments."""
    times = [time.perf_counter()]
    for argument in arguments:
        call(argument)
        times.append(time.perf_counter())
    return np.diff(times)
