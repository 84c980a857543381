"""Episodes as a receiver sees them that does not know the anchors: paths, false ones among them."""

import numpy as np

from mmwave_env.models.measurement import range_rate
from mmwave_env.numerics.arrays import Array
from mmwave_env.numerics.numbers import PI
from mmwave_env.world.episode import Episode

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
