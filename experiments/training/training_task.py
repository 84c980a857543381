"""What a switcher learns: the arguments of its environments, place by place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from experiments.training.places import Place
from mmwave_env.filters.bank import Bank, bank_from, modes_from
from mmwave_env.observation import Observation
from mmwave_env.reward import Reward
from mmwave_env.task import task_from


@dataclass(frozen=True)
class TrainingTask:
    """What is learned: arguments of ``MmWaveLoc-v0``.

    Attributes:
        scenario, observation, beliefs: names.
        places: where; every environment is at one of them.
        banks: what there is to choose from, by the name of a radio (:func:`banks_of`).
        reward: function of (belief, truth).

    Raises:
        ValueError: one that means nothing, and the message says what would; or the agent would see
            or choose one thing at one place and another thing at another.
    """

    scenario: str
    places: tuple[Place, ...]
    banks: Mapping[str, Bank]
    observation: str
    reward: Reward
    beliefs: str = "shared"

    def __post_init__(self) -> None:
        tables = [self._table(place) for place in self.places]
        for place, table in zip(self.places, tables, strict=True):
            if table.digest != tables[0].digest:
                raise ValueError(
                    f"places: found {len(tables[0])} features at {self.places[0]} and "
                    f"{len(table)} others at {place}, expected the same everywhere: as many "
                    "anchors, and modes of the same names"
                )

    @property
    def bank(self) -> Bank:
        """That of the first place."""
        return self.banks[self.places[0].profile]

    def arguments(self, place: Place) -> dict[str, Any]:
        """Of the environment at a place: what it is that has to be learned, but for the reward."""
        bank = self.banks[place.profile]
        return {
            "scenario": self.scenario, "scene": place.scene, "radio": place.radio, "dt": place.dt,
            "beliefs": self.beliefs, "modes": bank if self.beliefs == "per-mode" else bank.modes,
        }  # fmt: skip

    def _table(self, place: Place) -> Observation:
        task = task_from(**self.arguments(place), reward=self.reward)
        return Observation(task.pipeline, self.observation, self.beliefs)


def banks_of(modes: Sequence[str], places: Sequence[Place], beliefs: str) -> dict[str, Bank]:
    """What a switcher chooses from at each radio, by its name.

    Args:
        modes: names and mode files, as of the command line; none for the default ones.
        places: where it is trained.
        beliefs: "per-mode" for banks tuned for each radio; "shared" for the same modes everywhere,
            those of the first place's radio.

    Raises:
        ValueError: as :func:`~mmwave_env.filters.bank.bank_from`.
    """
    if beliefs != "per-mode":
        shared = Bank(modes_from(modes or None, places[0].radio))
        return {place.profile: shared for place in places}
    return {place.profile: bank_from(modes or None, place.radio) for place in places}
