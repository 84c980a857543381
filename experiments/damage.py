"""Episodes with measurements taken away or falsified, as receivers and networks do it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episode import Episode
from mmwave_env.measurement import wrap_angles

Mask = NDArray[np.bool_]

SINGLE, VALUE, OUTLIER = 0.03, 0.003, 0.005  # shares of epochs, values and values


def _stretches(
    rng: np.random.Generator, shape: tuple[int, int, int], share: float, epochs: tuple[int, int]
) -> Mask:
    """One stretch of time in a share of the columns (n, T, k), its length within a range."""
    n, T, k = shape
    begin = rng.integers(T, size=(n, 1, k))
    length = rng.integers(*epochs, size=(n, 1, k), endpoint=True)
    t = np.arange(T)[:, None]
    return (begin <= t) & (t < begin + length) & (rng.random((n, 1, k)) < share)


def _some(rng: np.random.Generator, size: int, share: float) -> NDArray[np.int64]:
    """A share of ``size`` places, in order and each but once."""
    return np.unique(rng.integers(size, size=int(share * size)))


def damaged(
    episodes: Sequence[Episode], rng: np.random.Generator
) -> tuple[list[Episode], dict[str, int]]:
    """Copies of episodes of one layout and length, with data missing or wrong.

    Links are missing for stretches, all of them for 50 epochs and more, and the Doppler shift,
    too; everything at times in single epochs. Single values are NaN or infinite, or outliers of
    10 to 1000 standard deviations.

    Args:
        episodes: n of them, which stay as they are.
        rng: for all that happens.

    Returns:
        The copies, and what was done to them: counts of link-epochs, epochs and values.
    """
    layout, T, n = episodes[0].layout, len(episodes[0]), len(episodes)
    L = layout.anchors
    dark = _stretches(rng, (n, T, 1), 0.25, (50, 150))
    missing = _stretches(rng, (n, T, len(layout.groups)), 0.4, (5, 60))
    missing.flat[_some(rng, missing.size, SINGLE)] = True
    missing[..., :L] |= dark
    z = np.stack([episode.measurement for episode in episodes])
    sigma = np.stack([episode.sigma for episode in episodes])
    wild, broken = _some(rng, z.size, OUTLIER), _some(rng, z.size, VALUE)
    off = rng.uniform(10.0, 1000.0, len(wild)) * rng.choice([-1.0, 1.0], len(wild))
    z.flat[wild] += off * sigma.flat[wild]
    rows, epochs = z.reshape(n * T, -1), wild // layout.size
    falsified = rows[epochs]
    wrap_angles(falsified, layout)
    rows[epochs] = falsified
    z.flat[broken] = rng.choice([np.nan, np.inf, -np.inf], len(broken))
    copies = [
        replace(episode, measurement=values, visible=episode.visible & ~gone)
        for episode, values, gone in zip(episodes, z, missing, strict=True)
    ]
    done = {
        "link-epochs taken away": missing[..., :L].sum(),
        "epochs in the dark, 50 and more in a row": dark.sum(),
        "Doppler shifts taken away": missing[..., L].sum(),
        "values NaN or infinite": len(broken),
        "outliers of 10 to 1000 sigma": len(wild),
    }
    return copies, {what: int(count) for what, count in done.items()}
