"""Episodes with measurements taken away or falsified, as receivers and networks do it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.episode import Episode
from mmwave_env.models.measurement import Layout, wrap_angles
from mmwave_env.numerics.arrays import Mask

SINGLE = 0.03  # share of the epochs of each link and of the Doppler shift
VALUE, OUTLIER = 0.003, 0.005  # shares of the values that are left
DARK = (50, 150)  # epochs in a row without links, least and most


def _stretches(
    rng: np.random.Generator, shape: tuple[int, int, int], share: float, epochs: tuple[int, int]
) -> Mask:
    """One whole stretch of time in a share of the columns (n, T, k).

    Its length is within a range (least, most), as far as T allows.
    """
    n, T, k = shape
    length = np.minimum(rng.integers(*epochs, size=(n, 1, k), endpoint=True), T)
    begin = rng.integers(T - length, endpoint=True)
    t = np.arange(T)[:, None]
    return (begin <= t) & (t < begin + length) & (rng.random((n, 1, k)) < share)


def _falsify(
    z: NDArray[np.float64],
    sigma: NDArray[np.float64],
    visible: Mask,
    layout: Layout,
    rng: np.random.Generator,
) -> tuple[int, int]:
    """Spoil visible values of z (n, T, rows) in place; how many are far off, how many broken."""
    widths = [rows.stop - rows.start for rows in layout.groups]
    places = np.flatnonzero(np.repeat(visible, widths, axis=-1))
    far, both = (int(share * len(places)) for share in (OUTLIER, OUTLIER + VALUE))
    hit = rng.choice(places, both, replace=False)
    wild, broken = hit[:far], hit[far:]
    off = rng.uniform(10.0, 1000.0, len(wild)) * rng.choice([-1.0, 1.0], len(wild))
    z.flat[wild] += off * sigma.flat[wild]
    wrap_angles(z.reshape(-1, layout.size), layout)  # the others stay, to the bit
    z.flat[broken] = rng.choice([np.nan, np.inf, -np.inf], len(broken))
    return len(wild), len(broken)


def damaged(
    episodes: Sequence[Episode], rng: np.random.Generator
) -> tuple[list[Episode], dict[str, int]]:
    """Copies of episodes of one layout and length, with data missing or wrong.

    Links are missing for stretches, all of them at once for 50 epochs and more (or all of a
    shorter episode), and the Doppler shift, too; everything at times in single epochs. Single
    values of what is left are NaN or infinite, or outliers of 10 to 1000 standard deviations.

    Args:
        episodes: n of them, which stay as they are.
        rng: for all that happens.

    Returns:
        The copies, and how much of what was visible was taken away or falsified: counts of
        link-epochs, of epochs with a link, of Doppler shifts and of values.
    """
    layout, T, n = episodes[0].layout, len(episodes[0]), len(episodes)
    L = layout.anchors
    before, z, sigma = (
        np.stack([getattr(episode, name) for episode in episodes])
        for name in ("visible", "measurement", "sigma")
    )
    dark = _stretches(rng, (n, T, 1), 0.25, DARK)
    missing = _stretches(rng, (n, T, len(layout.groups)), 0.4, (5, 60))
    missing |= rng.random(missing.shape) < SINGLE
    missing[..., :L] |= dark
    visible, taken = before & ~missing, before & missing
    darkened = dark[..., 0] & before[..., :L].any(axis=-1)
    far, broken = _falsify(z, sigma, visible, layout, rng)
    copies = [
        replace(episode, measurement=values, visible=seen)
        for episode, values, seen in zip(episodes, z, visible, strict=True)
    ]
    done = {
        "link-epochs taken away": taken[..., :L].sum(),
        f"epochs darkened, in stretches of {DARK[0]} and more": darkened.sum(),
        "Doppler shifts taken away": taken[..., L].sum(),
        "values NaN or infinite": broken,
        "outliers of 10 to 1000 sigma": far,
    }
    return copies, {what: int(count) for what, count in done.items()}
