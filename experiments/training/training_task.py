"""The task that a policy learns: places to train at, and arguments of the environments there.

A *place* is a scene with a radio and a rate of epochs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

from experiments.console.options import TaskArgs, WorldArgs
from experiments.evaluation.contenders import source_of
from experiments.evaluation.protocol import UNSEEN
from mmwave_env.filters.bank import Bank, bank_from, modes_from
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.reward import LogScore, Reward, TrackingReward
from mmwave_env.models.radio import radio_from
from mmwave_env.task import task_from
from mmwave_env.world.simulated import SimulatedSource


@dataclass(frozen=True)
class Place:
    """A place to train at.

    Attributes:
        scene, radio: names or JSON files, as in ``MmWaveLoc-v0``.
        dt: seconds between epochs.

    Raises:
        ValueError: an argument is invalid, or the benchmark holds out the scene or radio.
        FileNotFoundError: there is no such file.
    """

    scene: str
    radio: str
    dt: float = 1.0

    def __post_init__(self) -> None:
        source = self.source("mixed")
        # A JSON file may have any name, so the check reads the names that the files contain.
        for argument, name in (("scene", source.scene.name), ("radio", source.radio.name)):
            if name in UNSEEN:
                raise ValueError(
                    f"{argument}: found {name!r}, expected another {argument}; the benchmark keeps "
                    f"{', '.join(UNSEEN)} unseen"
                )

    @property
    def profile(self) -> str:
        """Return the name of the radio, which identifies its tuned modes and IMMs."""
        return radio_from(self.radio).name

    def source(self, scenario: str) -> SimulatedSource:
        """Return the source of episodes at this place, for a kind of user (``scenario``)."""
        world = WorldArgs(scenario=scenario, **asdict(self))
        return cast(SimulatedSource, source_of(world))  # simulated, since ``world`` names no data


def place_from(text: str) -> Place:
    """Return the place that a word on the command line names, such as street:handset:0.1.

    Raises:
        ValueError: the word has another form, or :class:`Place` refuses a part of it.
        FileNotFoundError: there is no such file.
    """
    scene, *rest = text.split(":")
    if not (scene and all(rest) and 1 <= len(rest) <= 2):
        raise ValueError(
            f"places: found {text!r}, expected SCENE:RADIO[:SECONDS], with seconds between epochs"
        )
    radio, *dt = rest
    try:
        return Place(scene, radio, *map(float, dt))
    except ValueError as error:
        raise ValueError(f"places: {text}: {error}") from error


def places_from(words: Sequence[str]) -> tuple[Place, ...]:
    """Return the places that words on the command line name, in order.

    Raises:
        ValueError: same as from :func:`place_from`, or a place is named twice.
    """
    places = tuple(map(place_from, words))
    if len(set(places)) < len(places):
        raise ValueError(f"places: found {', '.join(words)}, expected different places")
    return places


@dataclass(frozen=True)
class TrainingTask:
    """Arguments of ``MmWaveLoc-v0`` for training.

    Attributes:
        scenario, observation, beliefs: same as for ``MmWaveLoc-v0``.
        places: places to train at; every environment is at one place.
        banks: banks of modes to choose from, by the name of their radio (:func:`banks_of`).
        reward: function of (belief, truth).

    Raises:
        ValueError: an argument is invalid (the message says what is valid), or the features or the
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
                    f"{len(table)} different ones at {place}, expected the same everywhere: the "
                    "same number of anchors, and modes of the same names"
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
            **asdict(place),
            "beliefs": self.beliefs,
            "modes": bank if self.beliefs == "per-mode" else bank.modes,
        }


def banks_of(modes: Sequence[str], places: Sequence[Place], beliefs: str) -> dict[str, Bank]:
    """Return, for the name of each radio, the bank of modes that a policy uses with this radio.

    Args:
        modes: names and mode files, as on the command line; empty for the defaults.
        places: places to train at.
        beliefs: "per-mode" for a bank tuned for each radio; "shared" for one bank at all places,
            with the modes tuned for the radio of the first place.

    Raises:
        ValueError: same as from :func:`~mmwave_env.filters.bank.bank_from`.
    """
    if beliefs != "per-mode":
        shared = Bank(modes_from(modes or None, places[0].radio))
        return {place.profile: shared for place in places}
    return {place.profile: bank_from(modes or None, place.radio) for place in places}


def with_beliefs(args: Any) -> Any:
    """Return options with the beliefs that the algorithm needs."""
    return replace(args, beliefs="per-mode") if args.algo in ("corrector", "two-way") else args


def training_task(args: TaskArgs) -> TrainingTask:
    """Return the training task that options describe.

    Raises:
        ValueError: a place (scene and radio to train at) or mode is unknown, a place is named
            twice, or both a radio and places are named.
    """
    places = places_from(args.places) if args.places else (Place("street", args.radio),)
    if args.places and args.radio != TaskArgs.radio:
        raise ValueError("radio: cannot be combined with places, which name their radios")
    banks = banks_of(args.modes, places, args.beliefs)
    reward: Reward = TrackingReward(nees_weight=args.nees_weight)
    if args.reward == "log-score":
        reward = LogScore()
    return TrainingTask(args.scenario, places, banks, args.observation, reward, args.beliefs)
