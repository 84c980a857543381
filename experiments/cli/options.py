"""What the commands that run episodes have in common."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from experiments.evaluation.contenders import Contender, contender_from, contenders
from experiments.evaluation.runs import Run
from mmwave_env.episodes.episode import EpisodeSource
from mmwave_env.episodes.recorded import RecordedSource
from mmwave_env.episodes.samples import recording_from
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.filters.mode_files import modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import scene_from


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
    observation: str = "full"
    """what agents of your own were trained with: full, or prior; policy files say it themselves"""
    trust_zip: bool = False
    """load models of Stable-Baselines3 (.zip), which runs code from the file; mmwave-loc convert
    makes policy files of them, which hold none"""
    json: Path | None = None
    """write every figure to this file"""

    def contenders(self) -> tuple[str, ...]:
        """Names of all there are for these modes."""
        return tuple(contenders(self.radio, self._modes()))

    def _modes(self) -> tuple[Mode, ...] | None:
        return modes_from(self.modes, self.radio) if self.modes else None

    def contender(self, name: str) -> Contender:
        """One of them, or an agent by name or file."""
        modes = self._modes()
        return contender_from(name, self.radio, modes, self.observation, self.trust_zip)

    def runs(self, names: Sequence[str]) -> dict[str, Run]:
        """Those of the names that are folders of runs."""
        known = self.contenders()
        return {n: Run.read(n) for n in names if n not in known and Path(n).is_dir()}

    def source(self) -> EpisodeSource:
        """Where the episodes come from."""
        radio = radio_from(self.radio)
        if self.data is not None:
            for name, value in (("scenario", self.scenario), ("scene", self.scene)):
                if value is not None:
                    raise ValueError(f"{name}: found {value!r}, but recorded --data brings it")
            return RecordedSource(recording_from(self.data), radio)
        return SimulatedSource(scene_from(self.scene or "street"), radio, self.scenario or "mixed")
