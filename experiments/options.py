"""What the commands that run episodes have in common."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from experiments.bounds import bound_markdown, over_bound
from experiments.comparison import Comparison, compare
from experiments.evaluation import Scores, contenders, evaluate
from experiments.files import write_json
from experiments.markdown import markdown, show
from mmwave_env.episode import EpisodeSource
from mmwave_env.estimator.modes import Mode, modes_from
from mmwave_env.io.samples import recording_from
from mmwave_env.radio import radio_from
from mmwave_env.recording import RecordedSource
from mmwave_env.scene import scene_from
from mmwave_env.simulation import SimulatedSource

TUNING_SEED = 5_000_000  # test seeds start at 0, training seeds at 10 000 000


def require_tuning_seed(seed: int) -> None:
    """Refuse to tune on test seeds.

    Raises:
        ValueError: naming the first tuning seed.
    """
    if seed < TUNING_SEED:
        raise ValueError(f"seed: found {seed}, expected a tuning seed >= {TUNING_SEED}")


def command_line(name: str, args: Any) -> str:
    """The command that a dataclass of arguments stands for, defaults left out."""
    words = ["mmwave-loc", name]
    for field in fields(args):
        value = getattr(args, field.name)
        if value != field.default:
            values = value if isinstance(value, tuple) else () if value is True else (value,)
            words += [f"--{field.name.replace('_', '-')}", *map(str, values)]
    return shlex.join(words)


@dataclass
class EpisodeArgs:
    """Which episodes to run."""

    scenario: str | None = None
    """pedestrian, vehicle, walk-ride, jam, cyclist or mixed (equal shares, the default)"""
    radio: str = "handset"
    """handset, standard or high"""
    scene: str | None = None
    """street (the default), o1, dynamic-doppler or a JSON file"""
    episodes: int = 1000
    """how many; 1000 or more to publish"""
    seed: int = 0
    """seed of the first episode; test seeds start at 0, tuning seeds at 5000000"""
    data: str | None = None
    """recorded data instead of a simulation: canyon28_vehicle, canyon28_pedestrian, or the
    folder of a DeepMIMO scenario; each seed draws receiver noise and prior anew"""
    modes: tuple[str, ...] = ()
    """modes to work with in place of the profile's ekf and ukf: names (ekf, ukf, ckf, ekf-robust,
    ukf-robust, or extended for a bank of eight) and mode files; policies are then fixed-NAME,
    likelihood-rule, random, imm and, with two modes, speed-rule"""
    json: Path | None = None
    """write every figure to this file"""

    def contenders(self) -> tuple[str, ...]:
        """Names of all there are for these modes."""
        return tuple(contenders(self.radio, self._modes()))

    def _modes(self) -> tuple[Mode, ...] | None:
        return modes_from(self.modes, self.radio) if self.modes else None

    def evaluate(self, names: Sequence[str]) -> dict[str, Scores]:
        """Scores of contenders on the episodes."""
        return evaluate(names, self.source(), self.radio, self.episodes, self.seed, self._modes())

    def source(self) -> EpisodeSource:
        """Where the episodes come from."""
        radio = radio_from(self.radio)
        if self.data is not None:
            for name, value in (("scenario", self.scenario), ("scene", self.scene)):
                if value is not None:
                    raise ValueError(f"{name}: found {value!r}, but recorded --data brings it")
            return RecordedSource(recording_from(self.data), radio)
        return SimulatedSource(scene_from(self.scene or "street"), radio, self.scenario or "mixed")


def report(args: EpisodeArgs, names: Sequence[str], bound: bool = False) -> Comparison:
    """Run contenders on the episodes, print the tables and write ``args.json``.

    Args:
        args: which episodes.
        names: of the contenders.
        bound: whether to measure them in posterior Cramer-Rao bounds, too.
    """
    source = args.source()
    scores = args.evaluate(names)
    result = compare(
        scores, scenario=source.name, radio=args.radio, episodes=args.episodes, seed=args.seed
    )
    text, content = markdown(result), result.json
    if bound:
        over = over_bound(scores, source, radio_from(args.radio), args.seed)
        text, content = text + bound_markdown(over), content | {"bound": over.json}
    show(text)
    if args.json:
        write_json(args.json, content)
    return result
