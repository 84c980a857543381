"""Episodes as measurement logs: CSV or Parquet, as :func:`~mmwave_env.logs.log.read_log` reads."""

import gzip
import math
from pathlib import Path

import numpy as np

from mmwave_env.logs.log_tables import SUFFIXES, LogError, require_arrow
from mmwave_env.models.measurement import LINK, SPEED_OF_LIGHT, range_rate
from mmwave_env.numerics.numbers import PI, Array, Mask
from mmwave_env.world.episode import Episode


def log_columns(episode: Episode) -> dict[str, Array]:
    """The columns (n,) of an episode's log, NaN where empty; a row for each epoch and anchor.

    Numbers of groups that can't be used are left out. The SNR stays where a link or the
    Doppler shift needs it. An elevation that noise pushes past the vertical ends there, as a
    receiver's does.
    """
    layout, usable = episode.layout, episode.usable
    T, L = len(episode), layout.anchors
    links = np.where(
        usable[:, :L, None], episode.measurement[:, : layout.doppler].reshape(T, L, 4), np.nan
    )
    links[..., 2] = np.clip(links[..., 2], -PI / 2, PI / 2)
    heard = usable[:, :L].copy()
    heard[:, 0] |= usable[:, L]

    def first_row(values: Array, shown: Mask | bool = True) -> Array:
        out = np.full((T, L), np.nan)
        out[:, 0] = np.where(shown, values, np.nan)
        return out.ravel()

    columns = {
        "time_s": np.repeat(episode.time_s, L),
        "anchor": np.tile(np.arange(1, L + 1), T),
        "toa_s": links[..., 0].ravel() / SPEED_OF_LIGHT,
        **{name: links[..., i].ravel() for i, name in enumerate(LINK) if i},
        "doppler_hz": first_row(episode.measurement[:, layout.doppler], usable[:, L]),
        "snr_db": np.where(heard, episode.snr_db, np.nan).ravel(),
        "doppler_spread_hz": first_row(episode.doppler_spread_hz),
    }
    if layout.odometry:
        odometry = episode.measurement[:, layout.doppler + 1 :].T
        for name, values in zip(("speed_mps", "heading_rad"), odometry, strict=True):
            columns[name] = first_row(values, usable[:, -1])
    return columns


def log_text(columns: dict[str, Array]) -> str:
    """Columns (n,) as CSV, exact to the last bit."""
    words = [
        ["" if math.isnan(v) else repr(v) for v in values.tolist()] for values in columns.values()
    ]
    return "".join(",".join(row) + "\n" for row in [tuple(columns), *zip(*words, strict=True)])


def write_log(
    path: Path, episode: Episode, associated: bool = True, false_paths: int = 0, seed: int = 0
) -> None:
    """Write the log of an episode, as CSV or Parquet by the name of the file.

    Args:
        path: of the file.
        episode: its measurements.
        associated: whether rows have the number of their anchor; otherwise they are paths in random
            order, as :func:`~mmwave_env.logs.path_log.read_paths` reads them.
        false_paths: drawn among the others in every epoch, where they are not associated.
        seed: of false paths and order.

    Raises:
        LogError: another kind of file, or pyarrow is missing.
        ValueError: false paths among rows that have anchors, or fewer than none; or a log of paths
            of an episode without truth.
        OSError: it can't be written.
    """
    name, columns = path.name.lower(), log_columns(episode)
    if not associated:
        columns = path_columns(columns, episode, false_paths, seed)
    elif false_paths:
        raise ValueError(f"false_paths: found {false_paths} among rows with anchors, expected none")
    if name.endswith(".parquet"):
        pyarrow, parquet = require_arrow(path)
        arrays = {
            name: pyarrow.array(values, mask=np.isnan(values)) for name, values in columns.items()
        }
        parquet.write_table(pyarrow.table(arrays), path, write_page_checksum=True)
    elif name.endswith(".csv.gz"):
        path.write_bytes(gzip.compress(log_text(columns).encode(), mtime=0))
    elif name.endswith(".csv"):
        path.write_text(log_text(columns), encoding="utf-8", newline="\n")
    else:
        raise LogError(f"{path}: found {path.suffix!r}, expected a name in {', '.join(SUFFIXES)}")


Columns = dict[str, Array]  # (n,) NaN where empty

# Drawn between the least and the greatest of the episode's own paths, so that none of them tells
# which path is false. Azimuths are drawn all around.
_SPANNED = ("toa_s", "aoa_elevation_rad", "doppler_hz", "snr_db")
_AZIMUTHS = ("aoa_azimuth_rad", "aod_azimuth_rad")
_OF_EPOCH = ("doppler_spread_hz", "speed_mps", "heading_rad")


def path_columns(columns: Columns, episode: Episode, false_paths: int, seed: int) -> Columns:
    """The columns of a log without ``anchor``: rows are paths, in random order in every epoch.

    An epoch without a path is one empty row.

    Args:
        columns: of the log with anchors, a row for each epoch and anchor.
        episode: that they are of; its truth gives the Doppler shifts of virtual anchors' paths.
        false_paths: drawn in every epoch.
        seed: of false paths and order.

    Raises:
        ValueError: fewer than no false paths; or the truth is not known.
    """
    if false_paths < 0:
        raise ValueError(f"false_paths: found {false_paths}, expected at least 0")
    rng, T, L = np.random.default_rng([seed, false_paths]), len(episode), episode.layout.anchors
    of_epoch = {name: columns[name][::L] for name in _OF_EPOCH if name in columns}
    epoch = np.repeat(np.arange(T), L)
    there = ~np.isnan(columns["toa_s"])
    paths = {name: columns[name] for name in (*_SPANNED, *_AZIMUTHS)}
    paths["doppler_hz"] = _shifts(episode).ravel()
    paths = {name: values[there] for name, values in paths.items()}
    epoch = np.concatenate([epoch[there], np.repeat(np.arange(T), false_paths)])
    false = _false_paths(paths, T * false_paths, rng)
    empty = np.setdiff1d(np.arange(T), epoch)
    epoch = np.concatenate([epoch, empty])
    order = np.lexsort([rng.random(len(epoch)), epoch])
    nothing = np.full(len(empty), np.nan)
    rows = {n: np.concatenate([paths[n], false[n], nothing])[order] for n in paths}
    _, first = np.unique(epoch[order], return_index=True)
    for name, values in of_epoch.items():
        rows[name] = np.full(len(epoch), np.nan)
        rows[name][first] = values
    rows["time_s"] = episode.time_s[epoch[order]]
    return {name: rows[name] for name in columns if name != "anchor"}


def _false_paths(paths: Columns, n: int, rng: np.random.Generator) -> Columns:
    """Columns (n,) of paths that come from nowhere.

    Arrival and departure know nothing of each other, as after several reflections.
    """
    azimuths = {name: rng.uniform(-PI, PI, n) for name in _AZIMUTHS}
    spans = {name: paths[name][~np.isnan(paths[name])] for name in _SPANNED}
    return azimuths | {
        name: rng.uniform(span.min(), span.max(), n) if len(span) else np.full(n, np.nan)
        for name, span in spans.items()
    }


def _shifts(episode: Episode) -> Array:
    """Doppler shifts (T, L) of all anchors' paths, Hz.

    An episode measures that of the base station alone. Noise and oscillator bias of the others
    are those of its last measured one, or a shift would tell which path is the line of sight.
    """
    episode.require_truth()
    assert episode.truth_position_m is not None and episode.truth_velocity_mps is not None
    velocity = list(episode.truth_velocity_mps.T)
    away = episode.truth_position_m - episode.scene_anchors_m[:, None]  # (L, T, 3)
    exact = np.array([episode.hz_per_mps * range_rate(list(d.T), velocity) for d in away])
    measured = episode.usable[:, episode.layout.anchors]
    if not measured.any():
        return np.full(exact.T.shape, np.nan)
    last = np.maximum.accumulate(np.where(measured, np.arange(len(episode)), 0))
    last[: np.argmax(measured)] = np.argmax(measured)
    shifts = exact + (episode.measurement[:, episode.layout.doppler] - exact[0])[last]
    shifts[0, ~measured] = np.nan
    return np.asarray(shifts.T)
