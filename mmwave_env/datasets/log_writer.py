"""Writer of measurement logs from episodes; :func:`~mmwave_env.logs.log.read_log` reads them."""

import math

import numpy as np

from mmwave_env.models.layout import LINK, sigma_name
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.numerics.numbers import PI, Array, Index, Mask
from mmwave_env.world.episode import NEUTRAL_SNR_DB, Episode


def log_columns(episode: Episode) -> dict[str, Array]:
    """Return the columns of an episode's log, arrays (n,) with one row per epoch and anchor.

    NaN stands for an empty cell. The cells of measurements that are not usable are empty. An SNR is
    given only if its anchor's link or Doppler shift is usable. A partial layout adds columns of
    standard deviations. Elevations that noise pushes beyond the vertical are clipped to it.
    """
    layout, usable = episode.layout, episode.usable
    T, L = len(episode), layout.anchors
    links = np.where(
        usable[:, :L, None], episode.measurement[:, : layout.doppler].reshape(T, L, 4), np.nan
    )
    links[..., 2] = np.clip(links[..., 2], -PI / 2, PI / 2)
    epochs, shifted = np.arange(T), np.zeros(T, np.int64)
    if episode.doppler_anchor is not None:
        shifted = episode.doppler_anchor
    heard = usable[:, :L].copy()
    heard[epochs, shifted] |= usable[:, L]
    if layout.partial:
        heard &= episode.snr_db != NEUTRAL_SNR_DB  # this value means that no SNR was measured

    def first_row(values: Array, shown: Mask | bool = True, anchor: Index | int = 0) -> Array:
        out = np.full((T, L), np.nan)
        out[epochs, anchor] = np.where(shown, values, np.nan)
        return out.ravel()

    columns = {
        "time_s": np.repeat(episode.time_s, L),
        "anchor": np.tile(np.arange(1, L + 1), T),
        "toa_s": links[..., 0].ravel() / SPEED_OF_LIGHT,
        **{name: links[..., i].ravel() for i, name in enumerate(LINK) if i},
        "doppler_hz": first_row(episode.measurement[:, layout.doppler], usable[:, L], shifted),
        "snr_db": np.where(heard, episode.snr_db, np.nan).ravel(),
        "doppler_spread_hz": first_row(episode.doppler_spread_hz),
    }
    if layout.partial:
        sigma = episode.sigma[:, : layout.doppler].reshape(T, L, 4)
        for i, name in enumerate(LINK):
            own = np.where(np.isnan(links[..., i]), np.nan, sigma[..., i])
            columns[sigma_name(name)] = own.ravel()
        own = episode.sigma[:, layout.doppler]
        columns[sigma_name("doppler_hz")] = first_row(own, usable[:, L], shifted)
    if layout.odometry:
        odometry = episode.measurement[:, layout.doppler + 1 :].T
        for name, values in zip(("speed_mps", "heading_rad"), odometry, strict=True):
            columns[name] = first_row(values, usable[:, -1])
    return columns


def log_text(columns: dict[str, Array]) -> str:
    """Return columns (n,) as CSV; reading them gives exactly the same numbers."""
    words = [
        ["" if math.isnan(v) else repr(v) for v in values.tolist()] for values in columns.values()
    ]
    return "".join(",".join(row) + "\n" for row in [tuple(columns), *zip(*words, strict=True)])
