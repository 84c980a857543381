"""Reader and writer of folders with the log, the scene and the true track of an episode."""

import math
from pathlib import Path

import numpy as np

from mmwave_env.datasets.deepmimo.v4 import PARAMS
from mmwave_env.datasets.recorded import MeasuredTrack
from mmwave_env.io.files import write_json, write_text
from mmwave_env.io.lookup import as_name
from mmwave_env.logs.log import places, read_log
from mmwave_env.logs.log_columns import DEVIATIONS, QUANTITIES, QUANTITY_OF
from mmwave_env.logs.log_tables import SUFFIXES
from mmwave_env.logs.truth import Truth, velocity_of
from mmwave_env.logs.tum import COLUMNS, tum_lines
from mmwave_env.models.layout import LINK, sigma_name, wrapped
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.scene import Scene, read_scene, scene_json
from mmwave_env.numerics.numbers import PI, Array
from mmwave_env.world.episode import NEUTRAL_SNR_DB, Episode

Columns = dict[str, Array]  # arrays (n,) with one value per row of a log

LOG = "log.csv"
SCENE = "scene.json"
TRUTH = "truth.tum"
STATION = "base-station.json"  # scene without mirror images, beside a log of paths
_LOGS = tuple(f"log{suffix}" for suffix in SUFFIXES)
_COLUMNS = (  # written besides times and anchors, in this order
    "toa_s", *LINK[1:], "doppler_hz", "snr_db", "doppler_spread_hz",
    *map(sigma_name, (*LINK, "doppler_hz")), "speed_mps", "heading_rad",
)  # fmt: skip


def read_log_folder(folder: Path, clock: str = "synchronized") -> MeasuredTrack:
    """Read a folder with a log, its scene and its true track, completely into memory.

    :class:`~mmwave_env.logs.truth.Truth` interpolates the true positions at the times of the
    epochs. True velocities are computed from these positions. The layout is partial (single values
    of a link may be missing) if a link lacks some of its values, if the log states standard
    deviations, or if a Doppler shift was measured at an anchor other than the base station.

    Args:
        folder: contains ``log.csv`` (or ``.csv.gz``, ``.parquet``), ``scene.json``, ``truth.tum``.
        clock: state of the user's clock, one of :data:`~mmwave_env.models.layout.CLOCKS`.

    Raises:
        ValueError: a file is missing, damaged or of a wrong kind, or no epoch has a known true
            position; the message names file and row, what was found and what was expected.
        OSError: a file can't be read.
    """
    path = log_of(folder)
    scene = read_scene(folder / SCENE)
    truth = Truth(folder / TRUTH)
    log = read_log(path, scene, clock=clock)
    if log.damage:
        raise log.damage
    whole = log.whole()
    if np.array_equal(whole.visible, log.visible) and not np.isfinite(log.sigma).any():
        log = whole
    position = truth.at(log.time_s)
    truth.require_match(int(np.isfinite(position[:, 0]).sum()), log.time_s)
    return MeasuredTrack(
        name=as_name(folder.resolve().name),
        scene=scene,
        layout=log.layout,
        time_s=log.time_s,
        measurement=log.measurement,
        visible=log.visible,
        snr_db=log.snr_db,
        doppler_spread_hz=log.doppler_spread_hz,
        sigma=log.sigma if log.layout.partial else None,
        doppler_anchor=log.doppler_anchor if log.layout.partial else None,
        position_m=position,
        velocity_mps=velocity_of(log.time_s, position, GAP_S),
    )


def log_of(folder: Path) -> Path:
    """Return the log of a folder; refuse a folder that lacks a file or has several logs."""
    logs = [name for name in _LOGS if (folder / name).exists()]
    missing = [] if logs else [LOG]
    missing += [name for name in (SCENE, TRUTH) if not (folder / name).exists()]
    if missing or len(logs) > 1:
        files = f"no {', no '.join(missing)}" if missing else " and ".join(logs)
        raise ValueError(
            f"{folder}: found {files}, expected a log (one of {', '.join(_LOGS)}), {SCENE} and "
            f"{TRUTH} (docs/own-log.md), or the {PARAMS} of a DeepMIMO scenario"
        )
    return folder / logs[0]


def write_log_folder(
    folder: Path,
    episode: Episode,
    scene: Scene,
    origin: str,
    columns: Columns | None = None,
) -> None:
    """Write an episode so that :func:`read_log_folder` can read it.

    Args:
        folder: folder to write to; created if it does not exist.
        episode: the episode, whose prior is not written and whose true positions are known.
        scene: scene of the episode.
        origin: how the episode was made, as text for a comment in ``truth.tum``.
        columns: columns (n,) of the log; None for those of :func:`log_columns`.

    Raises:
        OSError: a file can't be written.
    """
    write_text(folder / LOG, log_text(columns or log_columns(episode)))
    write_json(folder / SCENE, scene_json(scene))
    assert episode.truth_position_m is not None
    track = tum_lines(episode.time_s, episode.truth_position_m)
    write_text(folder / TRUTH, f"# {' '.join(COLUMNS)}; {origin}\n{track}")


def log_columns(episode: Episode) -> Columns:
    """Return the columns of an episode's log, arrays (n,) with one row per epoch and anchor.

    NaN stands for an empty cell. The cells of measurements that are not usable are empty. An SNR is
    given only if its anchor's link or Doppler shift is usable. A partial layout (single values may
    be missing) adds columns of standard deviations. Elevations beyond the vertical are clipped.
    """
    layout = episode.layout
    usable = episode.usable
    T = len(episode)
    L = layout.anchors
    shifted = episode.doppler_anchor
    if shifted is None:
        shifted = np.zeros(T, np.int64)
    measured = np.where(episode.used, episode.measurement, np.nan)
    elevations = measured[:, 2 : layout.doppler : 4]
    np.clip(elevations, -PI / 2, PI / 2, out=elevations)
    sigma = np.where(np.isnan(measured), np.nan, episode.sigma)
    heard = usable[:, :L].copy()
    heard[np.arange(T), shifted] |= usable[:, L]
    if layout.partial:
        heard &= episode.snr_db != NEUTRAL_SNR_DB  # this value means that no SNR was measured
    heard_db = np.where(heard, episode.snr_db, np.nan)
    numbers = np.column_stack([measured, sigma, heard_db, episode.doppler_spread_hz])
    epoch, anchor = np.divmod(np.arange(T * L), L)
    columns: Columns = {"time_s": episode.time_s[epoch], "anchor": anchor + 1}
    at = places(layout)
    for name in _COLUMNS:
        quantity = QUANTITY_OF[name]
        if quantity not in at or (quantity in DEVIATIONS and not layout.partial):
            continue
        first, step = at[quantity]
        values = numbers[epoch, first + step * anchor]
        if not step:
            owner = shifted[epoch] if quantity in ("doppler", "doppler_sigma") else 0
            values[anchor != owner] = np.nan
        unit = QUANTITIES[quantity].columns[name]
        columns[name] = values * unit.divide / unit.multiply
    return columns


def path_columns(episode: Episode, false_paths: float, rng: np.random.Generator) -> Columns:
    """Return the columns of an episode's log of paths, arrays (n,) with one row per path.

    The paths of an epoch are in random order, without anchors. A Poisson number of false paths is
    added to each epoch, ``false_paths`` on average. The range of a false path and its direction are
    uniformly distributed. Its other values are those of random true paths, so that arrival and
    departure are as opposite as theirs.
    """
    columns = log_columns(episode)
    del columns["anchor"]
    columns["doppler_spread_hz"] = np.repeat(episode.doppler_spread_hz, episode.layout.anchors)
    numbers = rng.poisson(false_paths, len(episode))
    true = np.flatnonzero(np.isfinite(columns["toa_s"]))
    shifted = np.flatnonzero(np.isfinite(columns["doppler_hz"]))
    n = int(numbers.sum())
    copied = rng.choice(true, n)
    turn = rng.uniform(-PI, PI, n)
    toa_s = columns["toa_s"][true]
    false = {name: values[copied] for name, values in columns.items()}
    false |= {
        "time_s": np.repeat(episode.time_s, numbers),
        "toa_s": rng.uniform(toa_s.min(), toa_s.max(), n),
        "aoa_azimuth_rad": wrapped(false["aoa_azimuth_rad"] + turn),
        "aod_azimuth_rad": wrapped(false["aod_azimuth_rad"] + turn),
        "doppler_hz": columns["doppler_hz"][rng.choice(shifted, n)],
        "doppler_spread_hz": np.repeat(episode.doppler_spread_hz, numbers),
    }
    odometry = columns.keys() & {"speed_mps", "heading_rad"}
    false |= {name: np.full(n, np.nan) for name in odometry}
    joined = {name: np.append(values, false[name]) for name, values in columns.items()}
    values = np.array([joined[name] for name in ("toa_s", *odometry)])
    kept = ~np.isnan(values).all(axis=0)
    order = np.lexsort([rng.random(len(kept)), joined["time_s"]])
    order = order[kept[order]]
    return {name: values[order] for name, values in joined.items()}


def log_text(columns: Columns) -> str:
    """Return columns (n,) as CSV; reading them gives exactly the same numbers."""
    words = [
        ["" if math.isnan(v) else repr(v) for v in values.tolist()] for values in columns.values()
    ]
    return "".join(",".join(row) + "\n" for row in [tuple(columns), *zip(*words, strict=True)])
