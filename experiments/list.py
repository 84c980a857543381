"""mmwave-loc list: names that options and arguments accept, each with a description."""

import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

if TYPE_CHECKING:
    from mmwave_env.models.scene import Scene

Kind = Literal["all", "policies", "scenarios", "radios", "scenes", "modes", "samples", "rewards"]


@dataclass(kw_only=True)
class Args:
    """List the names that options and arguments accept.

    mmwave-loc list policies
    """

    what: Positional[Kind] = "all"
    """what to list: policies, scenarios, radios, scenes, modes, samples, rewards or all"""
    radio: str = "handset"
    """radio profile whose policies and modes are listed"""


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import say
    from experiments.evaluation.branches import CLAIRVOYANT
    from experiments.evaluation.contenders import DESCRIPTIONS, contenders
    from mmwave_env.datasets.samples import recording_from, sample_names
    from mmwave_env.filters.bank import as_written, named_modes
    from mmwave_env.interface.reward import REWARDS
    from mmwave_env.models.radio import RADIOS
    from mmwave_env.models.random_scene import RANDOM
    from mmwave_env.models.scene import SCENES
    from mmwave_env.world.mobility import SCENARIOS

    samples = {}
    logs = sample_names("log")
    for name in sample_names():
        log = "; also as a log, for localize --sample" if name in logs else ""
        epochs = len(recording_from(name).time_s)
        samples[name] = f"ray-traced street, {epochs} epochs, for --data{log}"
    for name in logs:
        samples.setdefault(name, "log of paths, for localize --sample with --map learn")
    kinds = {
        "policies": {
            name: DESCRIPTIONS.get(name, f"mode {name.removeprefix('fixed-')} in every epoch")
            for name in (*contenders(args.radio), CLAIRVOYANT)
        },
        "scenarios": SCENARIOS,
        "radios": {
            name: f"{r.gnb_elements} x {r.gnb_elements} antennas at the base station, "
            f"{r.ue_elements} x {r.ue_elements} at the user"
            for name, r in RADIOS.items()
        },
        "scenes": {name: _description(scene) for name, scene in SCENES.items()}
        | {RANDOM: "a new scene in each episode: random blocks, base station and walls"},
        "modes": {
            name: ", ".join(f"{key} {v}" for key, v in as_written(mode).items() if key != "name")
            for name, mode in named_modes(args.radio).items()
        },
        "samples": samples,
        "rewards": {
            name: str(inspect.getdoc(reward)).partition("\n")[0] for name, reward in REWARDS.items()
        },
    }
    for kind, names in kinds.items():
        if args.what in (kind, "all"):
            say(f"{kind}:", *(f"  {name:22} {meaning}" for name, meaning in names.items()))


def _description(scene: "Scene") -> str:
    """Describe a scene; x points east and y north."""
    x, y, z = base = scene.base_station_m
    west, east = scene.streets.x_m
    south, north = scene.streets.y_m
    return (
        f"{len(scene.anchors_m)} anchors, {scene.carrier_hz / 1e9:g} GHz, "
        f"{scene.bandwidth_hz / 1e6:g} MHz; base station at ({x:g}, {y:g}, {z:g}) m; "
        f"streets x {west:g} to {east:g} m, y {south:g} to {north:g} m; "
        f"inside the walls: {' and '.join(wall.side_of(base) for wall in scene.walls)}"
    )
