"""Writer of measurement logs from episodes; :func:`~mmwave_env.logs.log.read_log` reads them."""

import math

import numpy as np

from mmwave_env.models.layout import LINK, sigma_name
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.numerics.numbers import PI, Array, Index
from mmwave_env.world.episode import NEUTRAL_SNR_DB, Episode


def log_columns(episode: Episode) -> dict[str, Array]:
    """Return the columns of an episode's log, arrays (n,) with one row per epoch and anchor.

    NaN stands for an empty cell. The cells of measurements that are not usable are empty. An SNR is
    given only if its anchor's link or Doppler shift is usable. A partial layout (single values may
    be missing) adds columns of standard deviations. Elevations beyond the vertical are clipped.
    """
    layout = episode.layout
    usable = episode.usable
    T = len(episode)
    L = layout.anchors
    epochs = np.arange(T)
    shifted = episode.doppler_anchor
    if shifted is None:
        shifted = np.zeros(T, np.int64)
    shown = np.repeat(usable, layout.widths, axis=1)
    measured = np.where(shown, episode.measurement, np.nan)
    measured[:, 2 : layout.doppler : 4] = np.clip(
        measured[:, 2 : layout.doppler : 4], -PI / 2, PI / 2
    )
    sigma = np.where(np.isnan(measured), np.nan, episode.sigma)
    heard = usable[:, :L].copy()
    heard[epochs, shifted] |= usable[:, L]
    if layout.partial:
        heard &= episode.snr_db != NEUTRAL_SNR_DB  # this value means that no SNR was measured

    def of_links(values: Array, row: int) -> Array:
        return values[:, row : layout.doppler : 4].ravel()

    def of_epochs(values: Array, anchor: Index | int = 0) -> Array:
        out = np.full((T, L), np.nan)
        out[epochs, anchor] = values
        return out.ravel()

    columns = {
        "time_s": np.repeat(episode.time_s, L),
        "anchor": np.tile(np.arange(1, L + 1), T),
        "toa_s": of_links(measured, 0) / SPEED_OF_LIGHT,
        **{name: of_links(measured, row) for row, name in enumerate(LINK) if row},
        "doppler_hz": of_epochs(measured[:, layout.doppler], shifted),
        "snr_db": np.where(heard, episode.snr_db, np.nan).ravel(),
        "doppler_spread_hz": of_epochs(episode.doppler_spread_hz),
    }
    if layout.partial:
        columns |= {sigma_name(name): of_links(sigma, row) for row, name in enumerate(LINK)}
        columns[sigma_name("doppler_hz")] = of_epochs(sigma[:, layout.doppler], shifted)
    if layout.odometry:
        columns["speed_mps"] = of_epochs(measured[:, layout.doppler + 1])
        columns["heading_rad"] = of_epochs(measured[:, layout.doppler + 2])
    return columns


def log_text(columns: dict[str, Array]) -> str:
    """Return columns (n,) as CSV; reading them gives exactly the same numbers."""
    words = [
        ["" if math.isnan(v) else repr(v) for v in values.tolist()] for values in columns.values()
    ]
    return "".join(",".join(row) + "\n" for row in [tuple(columns), *zip(*words, strict=True)])
