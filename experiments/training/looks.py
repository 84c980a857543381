"""Looks at a policy in training: how good it is on tuning seeds; the best so far is kept."""

from importlib.metadata import version
from typing import Any

from experiments.training.evaluator import Evaluator
from experiments.training.job import Job, Tell
from mmwave_env import __version__
from mmwave_env.files import write_bytes
from mmwave_env.observation import Observation
from policies.policy_file import Card, Tensors, to_bytes

PACKAGES = ("gymnasium", "numpy", "numba", "torch", "stable-baselines3", "sb3-contrib")


class Looks:
    """The looks of one training.

    Args:
        job: the training.
        tell: takes the number of timesteps so far and what is new.
        stand: where the training stands; gets "best", the figures of the best policy, and
            "beat_rule", when the paper's rule was beaten. Both are None before.
    """

    def __init__(self, job: Job[Any], tell: Tell, stand: dict[str, Any]) -> None:
        self._job, self._tell, self._stand = job, tell, stand
        self._evaluator = Evaluator(job.task, job.episodes)

    def take(
        self, actor: Tensors, table: Observation, timesteps: int, seconds: float, frames: int = 1
    ) -> dict[str, float]:
        """Examine a policy, and keep it if it is the best so far.

        Args:
            actor: its tensors.
            table: features that it sees.
            timesteps, seconds: of the training until now.
            frames: observations that it sees at once.

        Returns:
            Figures for the journal.
        """
        stand, latest = self._stand, self._job.folder / "latest.safetensors"

        def written(evaluation: dict[str, Any]) -> bytes:
            return to_bytes(actor, self._card(table, timesteps, frames, evaluation))

        write_bytes(latest, written({}))
        figures = self._evaluator.examine(latest)
        if stand["best"] is None or figures["reward"] > stand["best"]["reward"]:
            stand["best"] = {"timesteps": timesteps, **figures}
            write_bytes(self._job.policy, written(stand["best"]))
        news = f"reward {figures['reward']:.3f}"
        if stand["beat_rule"] is None and figures["minus speed-rule"]["ci95"][0] > 0.0:
            seconds = round(seconds, 1)
            stand["beat_rule"] = {"timesteps": timesteps, "seconds": seconds}
            news = f"beats the 2 m/s rule after {timesteps} steps, {seconds} s; {news}"
        self._tell(timesteps, news)
        return {
            f"tuning/{key}": value["mean"] if isinstance(value, dict) else value
            for key, value in figures.items()
        }

    def _card(
        self, table: Observation, timesteps: int, frames: int, evaluation: dict[str, Any]
    ) -> Card:
        job, task = self._job, self._job.task
        per_mode = task.beliefs == "per-mode"
        return Card(
            modes=task.bank.modes, observation=task.observation, digest=table.digest,
            frames=frames, scenario=task.scenario, radio=", ".join(task.banks),
            algorithm=job.algorithm, seed=job.seed, timesteps=timesteps, command=job.command,
            evaluation=evaluation,
            versions={"mmwave-loc": __version__} | {p: version(p) for p in PACKAGES},
            beliefs=task.beliefs, banks=dict(task.banks) if per_mode else {},
        )  # fmt: skip
