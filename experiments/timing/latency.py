"""Latency of a live track: the time from the rows of an epoch to its position.

It is measured in Python, and through the pipe of a command, in a process of its own.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.evaluation.contenders import imm_banks
from experiments.timing.workloads import RADIO
from mmwave_env.datasets.log_writer import log_columns
from mmwave_env.filters.bank import named_modes
from mmwave_env.localization.localizer import Switching, learned
from mmwave_env.localization.tracker import Tracker
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import scene_from
from mmwave_env.world.simulated import SimulatedSource

SCENE, EPOCHS, WARM_UP = "street", 4000, 1000  # epochs of a track; the first are not timed
PERCENTILES = (50.0, 99.0, 99.9)
OPTIONS = {  # by which the command runs the same modes
    "ekf": ("--speed", "1"),
    "imm-best": ("--imm", "imm-best"),
    "guided": ("--policy", "guided"),
}
LATENCIES = [f"{name}_{way}" for name in OPTIONS for way in ("python", "pipe")]
Rows = list[dict[str, float | None]]


def latency_us(latency: str) -> list[float]:
    """Return percentiles of the time of an epoch, microseconds, of one of :data:`LATENCIES`."""
    name, _, way = latency.rpartition("_")
    times = (_in_python if way == "python" else _through_a_pipe)(name, _epochs())
    return np.percentile(1e6 * np.array(times[WARM_UP:]), PERCENTILES).tolist()  # type: ignore[no-any-return]


def _epochs() -> list[Rows]:
    """Return the rows of every epoch of a simulated user."""
    source = SimulatedSource(scene_from(SCENE), radio_from(RADIO), epochs=EPOCHS)
    columns = log_columns(source.sample(np.random.default_rng(0)))
    cells = np.stack(list(columns.values()), axis=1)
    numbers = np.where(np.isnan(cells), None, cells).tolist()  # type: ignore[call-overload]
    rows: Rows = [dict(zip(columns, row, strict=True)) for row in numbers]
    return [rows[i : i + source.layout.anchors] for i in range(0, len(rows), source.layout.anchors)]


def _in_python(name: str, epochs: list[Rows]) -> list[float]:
    mode, bank = named_modes(RADIO).get(name), imm_banks(RADIO).get(name)
    switching = Switching((mode,)) if mode else Switching(bank()) if bank else learned(name, RADIO)
    return _timed(Tracker(SCENE, switching, RADIO).update, epochs)


def _through_a_pipe(name: str, epochs: list[Rows]) -> list[float]:
    words = ["-m", "experiments.console", "localize", "-", "--live", "--scene"]
    packages = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}  # our path
    with subprocess.Popen(
        [sys.executable, *words, SCENE, "--radio", RADIO, *OPTIONS[name]], env=packages,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    ) as child:  # fmt: skip
        source, sink = child.stdin, child.stdout
        assert source is not None and sink is not None

        def ask(line: bytes) -> bytes:
            source.write(line)
            source.flush()
            return sink.readline()

        return _timed(ask, [json.dumps({"rows": rows}).encode() + b"\n" for rows in epochs])


def _timed(call: Callable[[Any], object], arguments: list[Any]) -> list[float]:
    """Return the seconds of a call with each of the arguments."""
    times = [time.perf_counter()]
    for argument in arguments:
        call(argument)
        times.append(time.perf_counter())
    return np.diff(times).tolist()  # type: ignore[no-any-return]
