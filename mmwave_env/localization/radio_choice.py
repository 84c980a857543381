"""Default radio profile of a log: the shipped profile with the noise most like the log's."""

import numpy as np

from mmwave_env.logs.log import Log
from mmwave_env.models.layout import LINK
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, wrap
from mmwave_env.world.episode import NEUTRAL_SNR_DB

_FEWEST = 20  # minimum number of second differences for a median
_ROBUST = 1.4826 / np.sqrt(6.0)  # white noise: standard deviation / median |second difference|


def nearest_radio(log: Log, scene: Scene) -> str:
    """Return the name of the shipped profile whose standard deviations best match a log.

    The standard deviation of a measurement (such as the range) is the median of the values that the
    receiver states. If the receiver states none, the standard deviation is estimated from second
    differences in time, in which steady motion cancels. Then the log's standard deviations are
    divided by each profile's; the best profile has the smallest mean square of the logarithms of
    these ratios. If no standard deviation can be computed, the result is "handset".
    """
    measured = np.array([_deviation(log, row) for row in range(len(LINK))])
    snr = log.snr_db[np.isfinite(log.snr_db)]
    snr_db = np.full((1, log.layout.anchors), np.median(snr) if len(snr) else NEUTRAL_SNR_DB)
    distances = {
        name: np.nanmean(np.log(measured / radio.sigma(snr_db, scene, log.layout)[0, :4]) ** 2)
        for name, radio in RADIOS.items()
        if np.isfinite(measured).any()
    }
    return min(distances, key=lambda name: distances[name], default="handset")


def _deviation(log: Log, row: int) -> float:
    """Return the standard deviation (m or rad) of ``LINK[row]``; NaN if values are too few."""
    columns = slice(row, log.layout.doppler, len(LINK))
    own = log.sigma[:, columns]
    if np.isfinite(own).any():
        return float(np.nanmedian(own))
    links = log.visible[:, : log.layout.anchors]
    values: Array = np.where(links, log.measurement[:, columns], np.nan)
    change = np.diff(values, axis=0)
    second = np.diff(wrap(change) if row else change, axis=0)
    second = second[np.isfinite(second)]
    deviation = float(_ROBUST * np.median(np.abs(second))) if len(second) >= _FEWEST else 0.0
    return deviation or np.nan  # values may change steadily, without any noise
