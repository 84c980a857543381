"""mmwave-loc tune-threshold: the best threshold of the speed rule, on tuning seeds."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.progress import track

from experiments.cli.main import run
from experiments.cli.options import TUNING_SEED, command_line, require_tuning_seed
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runner import contender_from, draw_episodes, score
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.files import write_json
from mmwave_env.models.radio import RADIOS, radio_from
from mmwave_env.models.scene import scene_from
from policies import SpeedRule


@dataclass
class Args:
    """Tune the threshold of the speed rule per radio profile, by mean reward."""

    scenario: str = "mixed"
    """kind of user"""
    radios: tuple[str, ...] = tuple(RADIOS)
    """radio profiles"""
    episodes: int = 1000
    """how many"""
    seed: int = TUNING_SEED
    """seed of the first episode; never a test seed"""
    thresholds: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
    """candidates, m/s"""
    json: Path | None = None
    """write the result here; the shipped policies/data/thresholds.json is such a file"""


def main(args: Args) -> None:
    """Run the command."""
    require_tuning_seed(args.seed)
    radios = {}
    for radio in args.radios:
        source = SimulatedSource(scene_from("street"), radio_from(radio), args.scenario)
        seeds = range(args.seed, args.seed + args.episodes)
        episodes = draw_episodes(source, seeds)
        rule = contender_from("speed-rule", radio)
        rewards = []
        for threshold in track(args.thresholds, description=radio, transient=True):
            tried = replace(rule, policy=partial(SpeedRule, threshold=threshold))
            rewards.append(score(tried, tried.start(source.layout), episodes)["reward"])
        intervals = bootstrap(np.stack(rewards, axis=1))
        best = int(np.argmax([i.mean for i in intervals]))
        for i, (threshold, interval) in enumerate(zip(args.thresholds, intervals, strict=True)):
            print(f"{radio} {threshold:g} m/s: reward {interval}" + " <- best" * (i == best))
        radios[radio] = {
            "threshold_mps": args.thresholds[best],
            "reward": {f"{t:g}": i.json for t, i in zip(args.thresholds, intervals, strict=True)},
        }
    if args.json:
        command = command_line("tune-threshold", args)
        what = {"scenario": args.scenario, "episodes": args.episodes, "seed": args.seed}
        write_json(args.json, {"command": command, **what, "radios": radios})


if __name__ == "__main__":
    run("tune-threshold")
