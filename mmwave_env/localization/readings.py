"""Readings of a log: its values and scene as they are if certain mistakes are undone."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mmwave_env.filters.modes import Mode
from mmwave_env.localization.contradictions import Contradiction
from mmwave_env.localization.localizer import episode_from
from mmwave_env.localization.starts import Start, deviations_of, start_at
from mmwave_env.logs.log import Log
from mmwave_env.models.layout import wrap_angles
from mmwave_env.models.radio import RADIOS, Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask
from mmwave_env.world.episode import Episode

AS_IT_IS = "as it is"
_SOUND = {AS_IT_IS, *(f"radio is {name}" for name in RADIOS)}  # hypotheses of a sound log

# rows of a measurement without odometry: four values per link, then the Doppler shift
RANGE = slice(0, -1, 4)
AZIMUTH = slice(1, -1, 4)
ELEVATION = slice(2, -1, 4)
DEPARTURE = slice(3, -1, 4)
DOPPLER = slice(-1, None)

Fits = dict[str, float | None]
Undo = Callable[["Reading"], "Reading"]  # what undoes a mistake in a reading


class Mistake(NamedTuple):
    """A likely mistake in a log, and what undoes it."""

    words: str  # "the log is consistent if WORDS"
    cure: str  # how to correct the log: "to correct it, CURE"
    undo: Undo


class Reading(NamedTuple):
    """The epochs of a log, read as a hypothesis says: with certain mistakes undone."""

    log: Log  # the epochs; angles need not be wrapped
    # scene, radio: according to the hypothesis, the log was measured in this scene by this radio
    scene: Scene
    radio: Radio
    mode: Mode  # the mode that filters the epochs, without its safeguards
    start: Start | None = None  # None if the track begins with a start from the reading's own links
    # sum of the logarithms of the factors by which values of the file were multiplied; this sum
    # plus the log-likelihood of the new values is the log-likelihood of the values in the file
    log_scale: float = 0.0
    undone: tuple[Mistake, ...] = ()

    def without(self, mistake: Mistake) -> "Reading":
        """Return the reading in which one more mistake is undone."""
        return mistake.undo(self)._replace(undone=(*self.undone, mistake))

    def with_start(self, epoch: int = 0) -> "Reading":
        """Return the reading from an epoch on, with wrapped angles, and with a start if it has one.

        Epochs before this one may help to determine the start.
        """
        z = self.log.measurement.copy()
        wrap_angles(z, self.log.layout)
        log = replace(self.log, measurement=z)
        start = self.start or start_at(log, epoch, self.scene, self.radio)
        return self._replace(log=log.part(slice(epoch, None)), start=start)

    @property
    def sigma(self) -> Array:
        """Return the standard deviations (T, rows) of the measurements."""
        return deviations_of(self.log, self.scene, self.radio)

    @property
    def episode(self) -> Episode:
        """Return the epochs as an episode that begins with the start."""
        return episode_from(self.log, self.scene, self.radio, self.start)

    def finding(
        self, why: list[Contradiction], fits: Fits | None = None, likelihood: float | None = None
    ) -> "Finding":
        """Return the finding on this reading."""
        words = "; ".join(mistake.words for mistake in self.undone)
        cure = "; then ".join(mistake.cure for mistake in self.undone)
        return Finding(words or AS_IT_IS, fits or {}, likelihood, why, cure, self.scene)


class Finding(NamedTuple):
    """The result of testing a hypothesis."""

    hypothesis: str  # the hypothesis in words
    # for each group of measurements (by name), the median over epochs of its NIS divided by the
    # median of chi-square: near 1 if the hypothesis is right; None if the group was not used
    nis_per_dof: Fits
    # mean over epochs of the log-likelihood of the file's values; None if there is no track
    log_likelihood: float | None
    contradictions: list[Contradiction]  # empty if the hypothesis makes the log consistent
    cure: str  # how to correct the log if the hypothesis is right; empty for the log as it is
    scene: Scene  # the scene, corrected if the cure corrects it
    shared: bool = False  # whether links share the error, so that NIS and levels do not show it

    @property
    def misread(self) -> bool:
        """Tell whether values do not mean what the file says, as if their unit is wrong."""
        return not self.shared and self.hypothesis not in _SOUND

    @property
    def worst_anchor(self) -> float | None:
        """Return the NIS / dof farthest from 1 among the anchors; None if no anchor was used."""
        anchors = [nis for name, nis in self.nis_per_dof.items() if name.startswith("anchor")]
        return max(filter(None, anchors), key=lambda nis: abs(np.log(nis)), default=None)


def values_of(log: Log) -> Mask:
    """Tell which values (T, rows) of a log were measured and belong to a visible group."""
    visible = np.repeat(log.visible, log.layout.widths, axis=1)
    return visible & np.isfinite(log.measurement)


def scaled(
    quantities: Sequence[slice],
    factors: float | Sequence[float] = 1.0,
    offset: float = 0.0,
    sources: Sequence[slice] = (),
) -> Undo:
    """Return the function that scales values, given their rows, then adds an offset to them.

    There is one factor for all quantities, or one for each. The values are in the rows ``sources``
    if these differ from their rows.
    """

    def undo(reading: Reading) -> Reading:
        old = reading.log
        z = old.measurement.copy()
        sigma = old.sigma.copy()
        log_scale = reading.log_scale
        each = np.broadcast_to(factors, len(quantities))
        for rows, source, factor in zip(quantities, sources or quantities, each, strict=True):
            z[:, rows] = offset + factor * old.measurement[:, source]
            sigma[:, rows] = abs(factor) * old.sigma[:, source]
            log_scale += float(values_of(old)[:, rows].sum() * np.log(abs(factor)))
        return reading._replace(log=replace(old, measurement=z, sigma=sigma), log_scale=log_scale)

    return undo
