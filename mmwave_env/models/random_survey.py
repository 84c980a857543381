"""Random errors of a survey: what all links of an episode have wrong, and no gate can see.

In a real place, the map's frame is turned against that of the antennas, anchors stand some
decimeters from where the plan shows them, and cables add meters. The world knows the true values;
filters and policies work with the wrong ones.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from mmwave_env.io.lookup import choose
from mmwave_env.io.records import Record, between
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, where
from mmwave_env.numerics.random import Dice

_DEGREE = math.pi / 180.0
Turn = Annotated[float, between(0.0, math.pi / 4.0, "rad")]
Length = Annotated[float, between(0.0, 100.0, "m")]
Rate = Annotated[float, between(0.0, 1.0)]


class SurveyErrors(NamedTuple):
    """The errors of a survey in one episode."""

    # (4,) range (m), azimuth and elevation of arrival, azimuth of departure (rad): what all links'
    # measurements are too large by
    offsets: Numbers
    anchors_m: Matrix  # (L, 3) what the map adds to the anchors' true positions
    slow: Number  # standard deviation of slow errors, in units of each row's noise


@dataclass(frozen=True)
class RandomSurvey(Record):
    """A distribution of survey errors. An episode has each kind with the probability ``rate``.

    Sizes are standard deviations of normally distributed errors.

    Attributes:
        rate: probability of each kind of error.
        rotation_rad: turn of all azimuths.
        tilt_rad: tilt of all elevations.
        range_m: length that cables or a clock add to all ranges.
        anchors_m: error of each anchor's place, horizontally, per axis.
        heights_m: error of the height of all anchors.
        slow: size of errors that change slowly, in units of a row's noise, which they add to.
        slow_s: time for which slow errors last.
    """

    rate: Rate = 0.3
    rotation_rad: Turn = 3.0 * _DEGREE
    tilt_rad: Turn = 2.0 * _DEGREE
    range_m: Length = 1.0
    anchors_m: Length = 0.7
    heights_m: Length = 3.0
    slow: Annotated[float, between(0.0, 10.0)] = 1.0
    slow_s: Annotated[float, between(1e-3, 1e6, "s")] = 30.0

    def draw_numbers(self, dice: Dice, anchors: int) -> SurveyErrors:
        """Draw the errors of an episode.

        The order of the draws must not change, so that an episode key always gives the same errors.
        """

        def some(size: float) -> Number:
            return where(dice.uniform() < self.rate, size, 0.0)

        rotation = some(self.rotation_rad) * dice.normal()
        tilt = some(self.tilt_rad) * dice.normal()
        longer = some(self.range_m) * dice.normal()
        height = some(self.heights_m) * dice.normal()
        away = some(self.anchors_m)
        places = [[away * dice.normal(), away * dice.normal(), height] for _ in range(anchors)]
        return SurveyErrors([longer, rotation, tilt, rotation], places, some(self.slow))


SURVEYS = {"bad": RandomSurvey()}


def survey_from(survey: str | RandomSurvey | None) -> RandomSurvey | None:
    """Return the errors of a ``survey=`` argument; None stands for none.

    Raises:
        ValueError: the name is unknown.
    """
    if survey is None or isinstance(survey, RandomSurvey):
        return survey
    return choose(SURVEYS, survey, "survey")
