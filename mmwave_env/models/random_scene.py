"""Random scenes, and random errors of their survey.

With random scenes, a policy in training cannot memorize one street. With a wrong survey, all links
of an episode share errors that no gate can see. In a real place, the map's frame is turned against
that of the antennas, anchors stand some decimeters from where the plan shows them, and cables add
meters. The world knows the true values; filters and policies work with the wrong ones.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mmwave_env.io.lookup import choose
from mmwave_env.io.records import Name, Probability, Record, between, counts
from mmwave_env.models.scene import (
    SCENES,
    Bandwidth,
    Carrier,
    Scene,
    SceneNumbers,
    Streets,
    Wall,
    scene_from,
)
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, floor, maximum, minimum, where
from mmwave_env.numerics.random import Dice, seeded

RANDOM = "random"
WIDE = "wide"

Length = Annotated[float, between(1e-3, 1e4, "m")]
Lengths = Annotated[tuple[Length, Length], "[low, high], each 0.001 to 10000 m"]

# sizes of errors of a survey
_DEGREE = math.pi / 180.0
Turn = Annotated[float, between(0.0, math.pi / 4.0, "rad")]
ErrorLength = Annotated[float, between(0.0, 100.0, "m")]


@dataclass(frozen=True)
class RandomScene(Record):
    """A random scene: a grid of streets, a base station at one of its crossings and two walls.

    One wall closes the grid to the north or south, the other to the east or west, so that every
    scene has three anchors, like the named scenes. Values are drawn uniformly from their ranges.

    Attributes:
        name: name to show in results.
        block_m: distance between parallel streets.
        blocks: maximum number of blocks in each direction. The number may be 0 in one direction;
            then the grid is a single street.
        beside_m: distance of the base station from each street of its crossing, on a random side.
        height_m: height of the base station.
        behind_m: distance from a wall to the last street, or to the base station if that is
            farther out.
        user_height_m: height of the user equipment.
        carrier_hz, bandwidth_hz: same as in :class:`~mmwave_env.models.scene.Scene`.
    """

    ordered = ("block_m", "beside_m", "height_m", "behind_m")

    name: Name = RANDOM
    block_m: Lengths = (60.0, 140.0)
    blocks: Annotated[int, counts(1, 30)] = 3
    beside_m: Lengths = (5.0, 25.0)
    height_m: Lengths = (4.0, 12.0)
    behind_m: Lengths = (5.0, 30.0)
    user_height_m: Length = 1.5
    carrier_hz: Carrier = 28e9
    bandwidth_hz: Bandwidth = 100e6

    @property
    def example(self) -> Scene:
        """Return an example; all scenes have the same carrier, bandwidth and number of anchors."""
        return self.scene_of(self.draw_numbers(Dice(seeded(0.0, 0))))

    def draw_numbers(self, dice: Dice) -> SceneNumbers:
        """Draw the numbers of a scene.

        The order of the draws must not change, so that an episode key always gives the same scene.
        """
        block = dice.uniform(*self.block_m)
        each = float(self.blocks + 1)
        counts = floor(1.0 + (each * each - 1.0) * dice.uniform())  # encodes the blocks in x and y
        east = floor((counts + 0.5) * (1.0 / each))
        extent = []
        base = []
        walls = []
        for count in (east, counts - each * east):
            end = count * block
            beside = dice.uniform(*self.beside_m) * _either(dice)
            base.append(floor((count + 1.0) * dice.uniform()) * block + beside)
            behind = dice.uniform(*self.behind_m)
            side = _either(dice)
            high = maximum(end, base[-1]) + behind
            low = minimum(0.0, base[-1]) - behind
            walls.append(where(side > 0.0, high, low))
            extent.append(end)
        x, y = base
        height = dice.uniform(*self.height_m)
        anchors = [[x, y, height], [2.0 * walls[0] - x, y, height], [x, 2.0 * walls[1] - y, height]]
        return SceneNumbers(anchors, block, extent, [0.0, 0.0], self.user_height_m)

    def scene_of(self, numbers: SceneNumbers) -> Scene:
        """Return the scene with these numbers, which must be plain floats, not SIMD lanes."""
        (x, y, height), west, south = numbers.anchors
        walls = Wall((1.0, 0.0), (west[0] + x) / 2.0), Wall((0.0, 1.0), (south[1] + y) / 2.0)
        east, north = numbers.extent_m
        return Scene(
            self.name,
            (x, y, height),
            walls,
            Streets((0.0, east), (0.0, north), numbers.block_m, self.user_height_m),
            self.carrier_hz,
            self.bandwidth_hz,
        )


# Streets of almost any size, for policies that must work in unknown streets.
WIDE_SCENE = RandomScene(
    WIDE, block_m=(40.0, 240.0), beside_m=(3.0, 40.0), height_m=(3.0, 25.0), behind_m=(3.0, 60.0)
)


def _either(dice: Dice) -> Number:
    """Draw 1 or -1 with equal probability."""
    return where(dice.uniform() < 0.5, 1.0, -1.0)


def scenes_from(scene: str | Path | Scene | RandomScene) -> Scene | RandomScene:
    """Return the scene of a ``scene=`` argument; "random" and "wide" stand for random scenes.

    Raises:
        ValueError: the name is unknown, or a field of the file is missing or wrong.
    """
    if isinstance(scene, RandomScene):
        return scene
    if isinstance(scene, Scene) or str(scene).endswith(".json"):
        return scene_from(scene)
    named: dict[str, Scene | RandomScene] = {**SCENES, RANDOM: RandomScene(), WIDE: WIDE_SCENE}
    return choose(named, str(scene), "scene", ", or a .json file")


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

    rate: Probability = 0.3
    rotation_rad: Turn = 3.0 * _DEGREE
    tilt_rad: Turn = 2.0 * _DEGREE
    range_m: ErrorLength = 1.0
    anchors_m: ErrorLength = 0.7
    heights_m: ErrorLength = 3.0
    slow: Annotated[float, between(0.0, 10.0)] = 1.0
    slow_s: Annotated[float, between(1e-3, 1e6, "s")] = 30.0

    def draw_numbers(self, dice: Dice, anchors: int) -> tuple[Numbers, Matrix, Number]:
        """Draw the errors of an episode.

        The order of the draws must not change, so that an episode key always gives the same errors.

        Returns:
            What all links' measurements are too large by (4,): range (m), azimuth and elevation of
            arrival, azimuth of departure (rad); what the map adds to the true positions of the
            anchors (L, 3), m; the standard deviation of slow errors, in units of each row's noise.
        """

        def some(size: float) -> Number:
            return where(dice.uniform() < self.rate, size, 0.0)

        rotation = some(self.rotation_rad) * dice.normal()
        tilt = some(self.tilt_rad) * dice.normal()
        longer = some(self.range_m) * dice.normal()
        height = some(self.heights_m) * dice.normal()
        away = some(self.anchors_m)
        places = [[away * dice.normal(), away * dice.normal(), height] for _ in range(anchors)]
        return [longer, rotation, tilt, rotation], places, some(self.slow)


SURVEYS = {"bad": RandomSurvey()}


def survey_from(survey: str | RandomSurvey | None) -> RandomSurvey | None:
    """Return the errors of a ``survey=`` argument; None stands for none.

    Raises:
        ValueError: the name is unknown.
    """
    if survey is None or isinstance(survey, RandomSurvey):
        return survey
    return choose(SURVEYS, survey, "survey")
