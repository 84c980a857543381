"""Whatever is in a file, its reader reads it or refuses it in words that name it."""

import gzip
import json
import warnings
from functools import partial

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from experiments.evaluation.runs import Run
from experiments.training.hyperparameters import read_hyperparameters, shipped_hyperparameters
from experiments.webpage.runs import curves_of
from experiments.webpage.sources import read_source
from mmwave_env.episodes.mobility import read_mobility
from mmwave_env.episodes.ways import read_ways
from mmwave_env.filters.bank import read_bank
from mmwave_env.logs.log import read_log
from mmwave_env.logs.tum import read_tum
from mmwave_env.models.radio import read_radio
from mmwave_env.models.scene import read_scene
from policies.policy_file import _checksum, read_policy, save
from tests.damage import changed, damaged
from tests.paths import LOGS, ROOT
from tests.training.actors import actor, card_of

RIDE = LOGS / "canyon28_vehicle"
SCENE = read_scene(RIDE / "scene.json")
DATA = ROOT / "mmwave_env" / "data"
RUN = ROOT / "docs" / "learning" / "ppo-standard"
TENSORS, CARD = actor(3), card_of().as_json()


def head(path, lines):
    return b"".join(path.read_bytes().splitlines(keepends=True)[:lines])


def written(content):
    return json.dumps(content).encode()


def policy(card):
    """A policy file with a right checksum over any card."""
    document = {"format": 1, "sha256": _checksum(TENSORS, card), "card": card}
    return save(TENSORS, {"policy": json.dumps(document)})


def log(path):
    list(read_log(path, SCENE))


WAY = b"t,x,y,z\n" + b"".join(b"%.1f,%.2f,-20.0,1.5\n" % (0.1 * i, 20 + i) for i in range(30))
LIMITS = {
    "acceleration_mps2": [0.5, 1.0], "braking_mps2": [0.5, 1.0], "lateral_mps2": [0.5, 1.0],
    "jerk_mps3": 1.0, "corner_radius_m": 1.0,
}  # fmt: skip
WALK = {"phases": [{"limits": LIMITS, "gaits": [{"low_mps": 1.0, "high_mps": 1.5}]}]}
JSON = {  # content, name of the file, reader
    "scene": (json.loads((RIDE / "scene.json").read_text()), "scene.json", read_scene),
    "modes": (json.loads((DATA / "banks" / "handset.json").read_text()), "m.json", read_bank),
    "radio": ({"base": "standard", "gnb_elements": 16, "aoa_floor_deg": 2.0}, "r.json", read_radio),
    "mobility": (WALK, "walk.json", read_mobility),
    "hyperparameters": (
        json.loads(shipped_hyperparameters("ppo").read_text()), "h.json",
        partial(read_hyperparameters, algorithm="ppo"),
    ),
    "summary": (
        json.loads((RUN / "summary.json").read_text()), "summary.json",
        lambda path: Run.read(str(path.parent)),
    ),
    "results": (json.loads((ROOT / "docs" / "results.json").read_text()), "c.json", read_source),
    "run": (json.loads((RUN / "summary.json").read_text()), "run.json",
            lambda path: read_source(path.parent)),
}  # fmt: skip
JOURNAL = head(RUN / "seed-0" / "progress.csv", 10)
BYTES = {
    "log": (head(RIDE / "log.csv", 40), "log.csv", log),
    "gzipped log": (gzip.compress(head(RIDE / "log.csv", 40), mtime=0), "log.csv.gz", log),
    "track": (head(RIDE / "truth.tum", 30), "truth.tum", read_tum),
    "trajectory": (WAY, "way.csv", read_ways),
    "journal": (JOURNAL, "progress.csv", curves_of),
    "policy": (policy(CARD), "p.safetensors", read_policy),
}  # fmt: skip
CONTENTS = (
    {f"{name}, bytes": (damaged(written(one[0])), *one[1:]) for name, one in JSON.items()}
    | {f"{name}, values": (changed(one[0]).map(written), *one[1:]) for name, one in JSON.items()}
    | {f"{name}, bytes": (damaged(one[0]), *one[1:]) for name, one in BYTES.items()}
    | {"policy, card": (changed(CARD).map(policy), "p.safetensors", read_policy)}
)


@pytest.mark.parametrize("kind", [*JSON, *BYTES])
def test_what_is_to_be_damaged_is_read(tmp_path, kind):
    content, name, read = (JSON | BYTES)[kind]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else written(content))
    read(path)


@pytest.mark.parametrize("kind", CONTENTS)
@settings(
    max_examples=50, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_by_name(tmp_path, kind, data):
    contents, name, read = CONTENTS[kind]
    path = tmp_path / name
    path.write_bytes(data.draw(contents))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            read(path)
        except (ValueError, OSError) as error:
            refusal = str(error)
        else:
            return
    assert path.name in refusal and len(refusal) < 5000
