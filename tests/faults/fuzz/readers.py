"""Every reader of files that come from elsewhere, each with a good folder to begin with."""

import gzip
import io
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from experiments.evaluation.runs import Run
from experiments.sweeping.spec import read_spec
from experiments.training.hyperparameters import read_hyperparameters, shipped_hyperparameters
from experiments.webpage.sources import read_source
from mmwave_env.episodes.deepmimo.recording import read_deepmimo
from mmwave_env.episodes.mobility import read_mobility
from mmwave_env.episodes.recorded import Recording
from mmwave_env.episodes.ways import read_ways
from mmwave_env.filters.bank import read_bank
from mmwave_env.logs.log import LogBlock, read_log
from mmwave_env.logs.tum import read_tum
from mmwave_env.models.radio import read_radio
from mmwave_env.models.scene import SCENES, read_scene, scene_json
from policies.policy_file import _checksum, read_policy, save
from tests.episodes.deepmimo.scenarios import shortened
from tests.paths import LOGS, ROOT
from tests.training.actors import actor, card_of

RIDE = LOGS / "canyon28_vehicle"
RUN = ROOT / "docs" / "learning" / "ppo-standard"
EPOCHS = 4  # of recordings: cases are many, so files are small
Content = dict[str, bytes]  # by name within the folder


def _as_it_is(content: bytes) -> bytes:
    return content


@dataclass(frozen=True)
class Reader:
    """What a campaign needs to know of a reader.

    Attributes:
        name: in tables.
        good: makes the files of a folder that is read without complaint.
        read: takes the folder.
        seal: what is done to a file's content before it is written, by name: what a checksum or a
            compression would hide from the reader behind it.
        also: other good contents, by the name of the file.
    """

    name: str
    good: Callable[[], Content]
    read: Callable[[Path], Any]
    seal: Mapping[str, Callable[[bytes], bytes]] = field(default_factory=dict)
    also: Mapping[str, bytes] = field(default_factory=dict)

    def write(self, folder: Path, name: str, content: bytes) -> None:
        """One file of the folder."""
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.seal.get(name, _as_it_is)(content))


# --- good files


def _head(path: Path, lines: int) -> bytes:
    return b"".join(path.read_bytes().splitlines(keepends=True)[:lines])


def _alone(name: str, content: bytes) -> Callable[[], Content]:
    return lambda: {name: content}


def _json(content: Any) -> bytes:
    return json.dumps(content).encode()


def _policy() -> Content:
    return {"policy.safetensors": _signed(_json(card_of().as_json()))}


def _signed(card: bytes) -> bytes:
    """A policy file with a right checksum over any card that is JSON, or else a wrong one."""
    tensors = actor(3)
    try:
        content = json.loads(card)
        checksum = _checksum(tensors, content)
    except (ValueError, TypeError, RecursionError):
        content, checksum = card.decode("utf-8", "replace"), ""
    document = {"format": 1, "sha256": checksum, "card": content}
    return bytes(save(tensors, {"policy": json.dumps(document)}))


def _parquet() -> Content:
    from pyarrow import csv, parquet  # threads of its own: not before the fork

    memory = io.BytesIO()
    table = csv.read_csv(io.BytesIO(_head(RIDE / "log.csv", 13)))
    parquet.write_table(table, memory)
    return {"log.parquet": memory.getvalue()}


def _run() -> Content:
    names = ("run.json", "summary.json", "seed-0/outcome.json")
    return {name: (RUN / name).read_bytes() for name in names} | {
        "seed-0/progress.csv": _head(RUN / "seed-0" / "progress.csv", 10)
    }


def _checkpoint() -> Content:
    import torch

    memory = io.BytesIO()
    torch.save({"steps": 3, "weights": torch.zeros(2), "rows": [("a", 1.0)]}, memory)
    return {"checkpoint.pt": memory.getvalue()}


def _read_sweep(folder: Path) -> Any:
    spec = read_spec(folder / "grid.toml")
    return spec, spec.run


def _read_checkpoint(path: Path) -> Any:
    from experiments.training.checkpoint import read_checkpoint

    return read_checkpoint(path)


def _scenario(suffix: str) -> Content:
    with TemporaryDirectory() as folder:
        made = shortened(Path(folder, "scenario"), EPOCHS, suffix)
        return {path.name: path.read_bytes() for path in made.iterdir()}


_LIMITS = {
    "acceleration_mps2": [0.5, 1.0], "braking_mps2": [0.5, 1.0], "lateral_mps2": [0.5, 1.0],
    "jerk_mps3": 1.0, "corner_radius_m": 1.0,
}  # fmt: skip
_WALK = {"phases": [{"limits": _LIMITS, "gaits": [{"low_mps": 1.0, "high_mps": 1.5}]}]}
_RADIO = {"base": "standard", "gnb_elements": 16, "aoa_floor_deg": 2.0}
_WAY = b"t,x,y,z\n" + b"".join(b"%.1f,%.2f,-20.0,1.5\n" % (0.1 * i, 20 + i) for i in range(10))
_GRID = b"""[evaluate]
policy = ["fixed-ekf", "imm"]
radio = ["handset", "standard"]
modes = ["ekf", "ukf"]
seed = [0, 10]
episodes = 10
[train]
total_timesteps = 1000
hyperparameters.learning_rate = [1e-3, 3e-4]
"""
_SEARCH = b"""[search]
trials = 12
total_timesteps = 1000
radio = "handset"
hyperparameters.learning_rate = { low = 1e-4, high = 1e-2, log = true }
hyperparameters.n_epochs = { low = 4, high = 16 }
hyperparameters.hidden = [[64, 64], [32]]
"""
_RESULTS = (ROOT / "docs" / "results.json").read_bytes()


# --- readers


def _log(name: str) -> Callable[[Path], Any]:
    scene = read_scene(RIDE / "scene.json")
    return lambda folder: list(read_log(folder / name, scene))


# What results and cards say of figures is shown, not computed with: where one diverged, NaN.


def _read_policy(folder: Path) -> Any:
    tensors, card = read_policy(folder / "policy.safetensors")
    return tensors, card.modes, card.banks


def _read_run(folder: Path) -> None:
    read_source(folder)
    Run.read(str(folder))


def _read_results(folder: Path) -> None:
    read_source(folder / "results.json")


LOG = _head(RIDE / "log.csv", 13)
READERS = (
    Reader("log CSV", _alone("log.csv", LOG), _log("log.csv")),
    Reader("log CSV.gz", _alone("log.csv.gz", gzip.compress(LOG, mtime=0)), _log("log.csv.gz")),
    Reader("log Parquet", _parquet, _log("log.parquet")),
    Reader(
        "scene", _alone("scene.json", (RIDE / "scene.json").read_bytes()),
        lambda folder: read_scene(folder / "scene.json"),
        also={"scene.json": _json(scene_json(SCENES["street"]))},
    ),
    Reader("truth TUM", _alone("truth.tum", _head(RIDE / "truth.tum", 12)),
           lambda folder: read_tum(folder / "truth.tum")),
    Reader("mode file",
           _alone("modes.json", (ROOT / "mmwave_env/data/banks/handset.json").read_bytes()),
           lambda folder: read_bank(folder / "modes.json")),
    Reader("radio", _alone("radio.json", _json(_RADIO)),
           lambda folder: read_radio(folder / "radio.json")),
    Reader("mobility", _alone("walk.json", _json(_WALK)),
           lambda folder: read_mobility(folder / "walk.json")),
    Reader("trajectory", _alone("way.csv", _WAY),
           lambda folder: read_ways(folder / "way.csv")),
    Reader("policy file", _policy, _read_policy),
    Reader("policy file, signed anew",
           _alone("policy.safetensors", _json(card_of().as_json())),
           _read_policy,
           seal={"policy.safetensors": _signed}),
    Reader("hyperparameters", _alone("ppo.json", shipped_hyperparameters("ppo").read_bytes()),
           lambda folder: read_hyperparameters(folder / "ppo.json", "ppo")),
    Reader("run folder", _run, _read_run),
    Reader("checkpoint, signed anew", _checkpoint,
           lambda folder: _read_checkpoint(folder / "checkpoint.pt"),
           seal={"checkpoint.pt": lambda content: sha256(content).digest() + content}),
    Reader("results JSON", _alone("results.json", _RESULTS),
           _read_results),
    Reader("DeepMIMO folder", lambda: _scenario(".npz"), read_deepmimo),
    Reader("DeepMIMO folder, .mat", lambda: _scenario(".mat"), read_deepmimo),
    Reader(
        "sweep", _alone("grid.toml", _GRID), _read_sweep,
        also={"grid.toml": _SEARCH},
    ),
)  # fmt: skip


# --- what was read


def numbers_in(found: Any) -> Iterator[Any]:
    """Numbers and arrays that something will compute with; what is not visible means nothing."""
    if isinstance(found, LogBlock):
        rows = np.repeat(found.visible, [g.stop - g.start for g in found.layout.groups], axis=1)
        yield from (found.time_s, found.measurement[rows], found.doppler_spread_hz)
        yield found.snr_db[found.visible[:, : found.layout.anchors]]
    elif isinstance(found, Recording):
        rows = np.repeat(found.visible, [g.stop - g.start for g in found.layout.groups], axis=1)
        yield from (found.anchors_m, found.time_s, found.measurement[rows], found.position_m)
        yield from (found.velocity_mps, found.carrier_hz)
    elif isinstance(found, (float, np.ndarray)):
        yield found
    elif isinstance(found, dict):
        for value in found.values():
            yield from numbers_in(value)
    elif isinstance(found, (list, tuple)):
        for value in found:
            yield from numbers_in(value)
    elif is_dataclass(found):
        for one in fields(found):
            yield from numbers_in(getattr(found, one.name))


def has_nan(found: Any) -> bool:
    """Whether a number that something will compute with is none."""
    arrays = (np.asarray(one) for one in numbers_in(found) if one is not None)
    return any(bool(np.isnan(one).any()) for one in arrays if one.dtype.kind == "f")
