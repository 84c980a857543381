"""Places: the streets, the radios and the rates that a switcher is trained at."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

from experiments.evaluation.protocol import UNSEEN
from mmwave_env.filters.modes import Mode
from mmwave_env.task import task_from
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.ways import Scenario

FORM = "SCENE:RADIO or SCENE:RADIO:DT, such as street:handset or o1:standard:0.1"


@dataclass(frozen=True)
class Place:
    """Where users move, what receives them and how often; ``str`` is as on the command line.

    Attributes:
        scene, radio: names or JSON files, as of ``MmWaveLoc-v0``.
        dt: seconds between epochs.

    Raises:
        ValueError: there is no such scene or radio, no such rate, or no training may see them.
        FileNotFoundError: there is no such file.
    """

    scene: str
    radio: str
    dt: float = 1.0

    def __post_init__(self) -> None:
        self._refuse_unseen(self.scene, self.radio)
        source = self.source("mixed")
        self._refuse_unseen(source.scene.name, source.radio.name)  # of files, the names in them

    def __str__(self) -> str:
        rate = "" if self.dt == 1.0 else f":{self.dt:g}"
        return f"{self.scene}:{self.radio}{rate}"

    def _refuse_unseen(self, scene: str, radio: str) -> None:
        for what, name in (("scene", scene), ("radio", radio)):
            if name in UNSEEN:
                raise ValueError(
                    f"{what}: found {name!r}, expected one to train on: the benchmark keeps "
                    f"{', '.join(UNSEEN)} unseen"
                )

    @cached_property
    def profile(self) -> str:
        """The name of the radio, which modes and IMMs tuned for it go by."""
        return self.source("mixed").radio.name

    def source(self, scenario: Scenario) -> SimulatedSource:
        """Episodes of kinds of users at the place."""
        # What filters them is not asked: with modes named, nobody is told that some are not tuned.
        task = task_from(
            scenario=scenario, scene=self.scene, radio=self.radio, dt=self.dt, modes=[Mode("none")]
        )
        return cast(SimulatedSource, task.source)  # it was given no recorded episodes


def place_from(text: str) -> Place:
    """The place of a word on the command line, :data:`FORM`.

    Raises:
        ValueError: naming the word, what was found in it and what was expected.
        FileNotFoundError: there is no such file.
    """
    scene, *rest = text.split(":")
    if not (scene and all(rest) and len(rest) in (1, 2)):
        raise ValueError(f"places: found {text!r}, expected {FORM}")
    radio, *rate = rest
    try:
        dt = float(rate[0]) if rate else 1.0
    except ValueError:
        raise ValueError(
            f"places: {text}: dt: found {rate[0]!r}, expected a number of seconds"
        ) from None
    try:
        return Place(scene, radio, dt)
    except ValueError as error:
        raise ValueError(f"places: {text}: {error}") from error


def places_from(words: Sequence[str]) -> tuple[Place, ...]:
    """The places of the command line, in order.

    Raises:
        ValueError: as :func:`place_from`, or one is named twice.
    """
    places = tuple(map(place_from, words))
    if len(set(places)) < len(places):
        raise ValueError(f"places: found {', '.join(map(str, places))}, expected none twice")
    return places


def require_environments(count: int, places: int, together: int = 1) -> None:
    """Refuse environments that can't be spread over the places.

    Args:
        count: of environments.
        places: how many there are.
        together: environments side by side that have to be at one place.

    Raises:
        ValueError: saying how many there may be.
    """
    if count % together or count < together * places:
        multiple = f"a multiple of {together}, " if together > 1 else ""
        raise ValueError(
            f"num_envs: found {count}, expected {multiple}{together * places} or more for "
            f"{places} places"
        )


def shares(count: int, places: int) -> list[int]:
    """How many of ``count`` environments or episodes each place gets, as evenly as can be."""
    each, more = divmod(count, places)
    return [each + (place < more) for place in range(places)]
