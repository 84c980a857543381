"""The task that a switcher learns: arguments of its environments, place by place."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from experiments.training.places import Place
from mmwave_env.filters.bank import Bank, bank_from, modes_from
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.reward import Reward
from mmwave_env.task import task_from


@dataclass(frozen=True)
class TrainingTask:
    """Arguments of ``MmWaveLoc-v0`` to learn with.

    Attributes:
        scenario, observation, beliefs: names.
        places: places to train in; every environment is at one place.
        banks: modes to choose from, by the name of a radio (:func:`banks_of`).
        reward: function of (belief, truth).

    Raises:
        ValueError: an argument is invalid, and the message says what is valid; or features or
            actions differ between places.
    """

    scenario: str
    places: tuple[Place, ...]
    banks: Mapping[str, Bank]
    observation: str
    reward: Reward
    beliefs: str = "shared"

    def __post_init__(self) -> None:
        tasks = [task_from(**self.arguments(p), reward=self.reward) for p in self.places]
        tables = [Observation(t.pipeline, self.observation, self.beliefs) for t in tasks]
        for place, table in zip(self.places, tables, strict=True):
            if table.columns != tables[0].columns:
                raise ValueError(
                    f"places: found {len(tables[0])} features at {self.places[0]} and "
                    f"{len(table)} others at {place}, expected the same everywhere: as many "
                    "anchors, and modes of the same names"
                )

    @property
    def bank(self) -> Bank:
        """Return the bank of the first place."""
        return self.banks[self.places[0].profile]

    def arguments(self, place: Place) -> dict[str, Any]:
        """Return the arguments of the environment at a place, without the reward."""
        bank = self.banks[place.profile]
        return {
            "scenario": self.scenario,
            "scene": place.scene,
            "radio": place.radio,
            "dt": place.dt,
            "beliefs": self.beliefs,
            "modes": bank if self.beliefs == "per-mode" else bank.modes,
        }


def banks_of(modes: Sequence[str], places: Sequence[Place], beliefs: str) -> dict[str, Bank]:
    """Return the modes that a switcher chooses from at each radio, by the radio's name.

    Args:
        modes: names and mode files, as on the command line; none for the defaults.
        places: places to train in.
        beliefs: "per-mode" for banks tuned for each radio; "shared" for the modes of the first
            place's radio everywhere.

    Raises:
        ValueError: same as from :func:`~mmwave_env.filters.bank.bank_from`.
    """
    if beliefs != "per-mode":
        shared = Bank(modes_from(modes or None, places[0].radio))
        return {place.profile: shared for place in places}
    return {place.profile: bank_from(modes or None, place.radio) for place in places}
