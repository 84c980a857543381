"""What the commands that run episodes have in common."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from experiments.evaluation.bounds import bound_markdown, over_bound
from experiments.evaluation.comparison import Comparison, compare
from experiments.evaluation.decisions import Decisions
from experiments.evaluation.markdown import markdown, show
from experiments.evaluation.runner import (
    Contender,
    Scores,
    Watch,
    contender_from,
    contenders,
    evaluate,
)
from experiments.evaluation.runs import Run, trainings
from experiments.evaluation.training_seeds import (
    draw_profiles,
    over_training_seeds,
    seeds_markdown,
)
from mmwave_env.episodes.episode import EpisodeSource
from mmwave_env.episodes.recorded import RecordedSource
from mmwave_env.episodes.samples import recording_from
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.files import write_json
from mmwave_env.filters.mode_files import modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import scene_from

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

    def contender(self, name: str) -> Contender:
        """One of them, or a learned one by name or file."""
        return contender_from(name, self.radio, self._modes())

    def runs(self, names: Sequence[str]) -> dict[str, Run]:
        """Those of the names that are folders of runs."""
        known = self.contenders()
        return {n: Run.read(n) for n in names if n not in known and Path(n).is_dir()}

    def evaluate(self, names: Sequence[str], watch: Watch | None = None) -> dict[str, Scores]:
        """Scores of contenders on the episodes."""
        source, modes = self.source(), self._modes()
        return evaluate(names, source, self.radio, self.episodes, self.seed, modes, watch)

    def source(self) -> EpisodeSource:
        """Where the episodes come from."""
        radio = radio_from(self.radio)
        if self.data is not None:
            for name, value in (("scenario", self.scenario), ("scene", self.scene)):
                if value is not None:
                    raise ValueError(f"{name}: found {value!r}, but recorded --data brings it")
            return RecordedSource(recording_from(self.data), radio)
        return SimulatedSource(scene_from(self.scene or "street"), radio, self.scenario or "mixed")


def report(
    args: EpisodeArgs,
    names: Sequence[str],
    bound: bool = False,
    figure: Path | None = None,
    decisions: Path | None = None,
) -> Comparison:
    """Run contenders on the episodes, print the tables and write ``args.json``.

    The arguments are those of :func:`results`.
    """
    result, text, content = results(args, names, bound, figure, decisions)
    show(text)
    if args.json:
        write_json(args.json, content)
    return result


def results(
    args: EpisodeArgs,
    names: Sequence[str],
    bound: bool = False,
    figure: Path | None = None,
    decisions: Path | None = None,
) -> tuple[Comparison, str, dict[str, Any]]:
    """Run contenders on the episodes.

    Args:
        args: which episodes.
        names: of the contenders; the folder of a run stands for its median training.
        bound: whether to measure them in posterior Cramer-Rao bounds, too.
        figure: gets the performance profiles of runs.
        decisions: gets a picture of what policies choose around stops and pull-aways.

    Returns:
        The comparison, all tables as Markdown, and every figure as JSON.
    """
    source, runs = args.source(), args.runs(names)
    if figure:
        _require_profiles(names, runs)
    files = {name: runs[name].policy if name in runs else name for name in names}
    learned = [name for name, file in files.items() if args.contender(file).trained]
    seen = Decisions({file: name for name, file in files.items()}) if decisions else None
    found = args.evaluate(trainings(names, runs), seen.add if seen else None)
    scores = {name: found[file] for name, file in files.items()}
    result = compare(
        scores, learned, scenario=source.name, radio=args.radio, episodes=args.episodes,
        seed=args.seed,
    )  # fmt: skip
    text, content = markdown(result), result.json
    if bound:
        over = over_bound(scores, source, radio_from(args.radio), args.seed)
        text, content = text + bound_markdown(over), content | {"bound": over.json}
    if runs:
        trained = {run: [found[file] for file in run.policies] for run in runs.values()}
        seeds = over_training_seeds(trained, scores)
        text += "".join(map(seeds_markdown, seeds))
        content |= {"training_seeds": {one.run.name: one.json for one in seeds}}
        if figure:
            draw_profiles(seeds, figure)
    if seen and decisions:
        content |= {"decisions": seen.json}
        seen.draw(decisions)
    return result, text, content


def _require_profiles(names: Sequence[str], runs: Mapping[str, Run]) -> None:
    """Refuse a figure of performance profiles that would be empty."""
    if not runs:
        raise ValueError("figure: found no folder of a run among the policies, expected one")
    if not any(name == "speed-rule" or name.startswith(("fixed-", "imm")) for name in names):
        raise ValueError(
            "figure: found nobody to compare runs with among the policies, expected speed-rule, "
            "imm or a fixed mode"
        )
