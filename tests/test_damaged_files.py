"""Tests that readers either read a damaged file or refuse it with a message that names it."""

import gzip
import io
import json
import shutil
import warnings
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from experiments.evaluation.contenders import Run
from experiments.reporting.webpage.page import read_part
from experiments.training.hyperparameters import read_hyperparameters, shipped_hyperparameters
from mmwave_env.datasets.deepmimo.recording import read_deepmimo
from mmwave_env.datasets.recorded import Recording
from mmwave_env.datasets.ways import read_ways
from mmwave_env.filters.bank import modes_from, read_bank
from mmwave_env.logs.log import Log, read_log, read_paths
from mmwave_env.logs.tum import read_tum
from mmwave_env.models.radio import read_radio
from mmwave_env.models.scene import SCENES, read_scene, scene_json
from mmwave_env.world.mobility import read_mobility
from policies.policy_file import read_policy, to_bytes
from tests.damage import changed, damaged
from tests.datasets.deepmimo.scenarios import shortened
from tests.paths import RIDE, ROOT, json_in
from tests.training.actors import TABLE, actor, card_of

SCENE = read_scene(RIDE / "scene.json")
BANK = json_in(ROOT / "mmwave_env" / "data" / "banks" / "handset.json")
RUN = ROOT / "docs" / "learning" / "ppo-standard"
SUMMARY = json_in(RUN / "summary.json")
CARD = card_of(features=TABLE.columns[:3])
CASES = 60  # number of random cases for each reader
SLOWEST_S = 20  # longest time that reading may take


class Reader(NamedTuple):
    """Intact files, which the test damages, and the function that reads them."""

    files: Callable[[], dict[str, Any]]  # returns file name -> bytes, or content of a JSON file
    read: Callable[[Path], Any]  # function that reads the files in a folder


def head(path, lines):
    return b"".join(path.read_bytes().splitlines(keepends=True)[:lines])


def parquet():
    csv, parquet = map(pytest.importorskip, ("pyarrow.csv", "pyarrow.parquet"))
    memory = io.BytesIO()
    parquet.write_table(csv.read_csv(io.BytesIO(head(RIDE / "log.csv", 13))), memory)
    return {"log.parquet": memory.getvalue()}


@cache
def deepmimo():
    with TemporaryDirectory() as folder:
        made = shortened(Path(folder, "scenario"), 4)
        files = {path.name: path.read_bytes() for path in sorted(made.iterdir())}
    return files | {"params.json": json.loads(files["params.json"])}


def alone(name, content, read):
    return Reader(lambda: {name: content}, lambda folder: read(folder / name))


def sound(content):
    """Return a log; raise the error of a damaged row."""
    if content.damage:
        raise content.damage
    return content


def log(name, content=b""):
    return alone(name, content, lambda path: sound(read_log(path, SCENE)))


LIMITS = {"jerk_mps3": 1.0, "corner_radius_m": 1.0}
LIMITS |= {f"{kind}_mps2": [0.5, 1.0] for kind in ("acceleration", "braking", "lateral")}
WALK = {"phases": [{"limits": LIMITS, "gaits": [{"low_mps": 1.0, "high_mps": 1.5}]}]}
ROUTE = b"t,x,y,z\n" + b"".join(b"%.1f,%.2f,-20.0,1.5\n" % (0.1 * i, 20 + i) for i in range(30))
LOG = head(RIDE / "log.csv", 40)
HYPERPARAMETERS = json_in(shipped_hyperparameters("ppo"))
RESULTS = json_in(ROOT / "docs" / "results.json")
READERS = {
    "log": log("log.csv", LOG),
    "gzipped log": log("log.csv.gz", gzip.compress(LOG, mtime=0)),
    "Parquet log": log("log.parquet")._replace(files=parquet),
    "log of signal paths": alone("log.csv", LOG, lambda path: sound(read_paths(path, SCENE))),
    "truth": alone("truth.tum", head(RIDE / "truth.tum", 30), read_tum),
    "scene": alone("scene.json", json_in(RIDE / "scene.json"), read_scene),
    "scene of walls": alone("scene.json", scene_json(SCENES["street"]), read_scene),
    "radio": alone(
        "r.json", {"base": "standard", "gnb_elements": 16, "aoa_floor_deg": 2.0}, read_radio
    ),
    "modes": alone("m.json", {"modes": BANK["modes"]}, modes_from),
    "bank": alone("m.json", BANK, read_bank),
    "mobility": alone("walk.json", WALK, read_mobility),
    "trajectory": alone("route.csv", ROUTE, read_ways),
    "DeepMIMO": Reader(deepmimo, read_deepmimo),
    "policy": alone("p.safetensors", to_bytes(actor(3), CARD), read_policy),
    "hyperparameters": alone(
        "h.json", HYPERPARAMETERS, partial(read_hyperparameters, algorithm="ppo")
    ),
    "summary": alone("summary.json", SUMMARY, lambda path: Run.read(str(path.parent))),
    "results": alone("c.json", RESULTS, read_part),
}


def numbers_in(content):
    """Yield the arrays that computations use; skip measurements that are not marked as visible."""
    if isinstance(content, (Log, Recording)):
        rows = np.repeat(content.visible, content.layout.widths, axis=1)
        yield from (content.time_s, content.measurement[rows])
        if isinstance(content, Recording):
            yield from (content.anchors_m, content.position_m, content.velocity_mps)
    elif isinstance(content, (float, np.ndarray)):
        yield np.asarray(content)
    elif isinstance(content, dict):
        yield from numbers_in([*content.values()])
    elif isinstance(content, (list, tuple)):
        for value in content:
            yield from numbers_in(value)
    elif is_dataclass(content):
        yield from numbers_in(vars(content))


# Readers accept NaN in these files. Most of these files are only displayed, and no computation uses
# their numbers; in logs of signal paths, NaN means a missing value.
MAY_BE_NAN = ("results", "summary", "policy", "log of signal paths")


def read(kind, folder):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        content = READERS[kind].read(folder)
    if kind not in MAY_BE_NAN:
        numbers = [array for array in numbers_in(content) if array.dtype.kind == "f"]
        assert not any(np.isnan(array).any() for array in numbers), "the reader accepted a NaN"


@pytest.mark.parametrize("kind", READERS)
def test_an_undamaged_file_is_read(tmp_path, kind):
    for name, content in READERS[kind].files().items():
        raw = isinstance(content, bytes)
        (tmp_path / name).write_bytes(content if raw else json.dumps(content).encode())
    read(kind, tmp_path)


@pytest.mark.parametrize("kind", READERS)
@settings(
    max_examples=CASES,
    deadline=1000 * SLOWEST_S,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_a_damaged_file_is_read_or_is_named_in_an_error(tmp_path, kind, data):
    reader = READERS[kind]
    folder = tmp_path / "scenario"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    files = reader.files()
    hit = data.draw(st.sampled_from(sorted(files)))
    for name, content in files.items():
        if isinstance(content, bytes):
            content = data.draw(damaged(content)) if name == hit else content
        elif data.draw(st.booleans()):
            content = json.dumps(data.draw(changed(content))).encode()
        else:
            content = data.draw(damaged(json.dumps(content).encode()))
        (folder / name).write_bytes(content)
    try:
        read(kind, folder)
    except (ValueError, OSError) as error:
        refusal = str(error)
    else:
        return
    assert any(name in refusal for name in ("scenario", *files)) and len(refusal) < 5000
