"""Record of a training: its log, best policy, checkpoints and outcome."""

import csv
import io
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter

from experiments.console.provenance import versions_of
from experiments.training.checkpoint import State, read_checkpoint, write_checkpoint
from experiments.training.evaluator import Evaluator
from experiments.training.job import Job, News, Tell
from mmwave_env.interface.observation import Column, Observation
from mmwave_env.io.files import Json, write_bytes, write_json, write_text
from policies.policy_file import Card, Tensors, to_bytes

STEP = "timesteps"


class ProgressLog(KVWriter):
    """A log of a training; each row has statistics of recent episodes and of the latest update.

    Args:
        folder: folder of ``progress.csv``.
        rows: rows that were written before the training was interrupted; empty for a new training.
    """

    def __init__(self, folder: Path, rows: list[dict[str, float]]) -> None:
        self.rows = list(rows)
        self._path = folder / "progress.csv"

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Add a row without the times of Stable-Baselines3, which begin anew in every process."""
        numbers = {
            key: float(value) for key, value in key_values.items() if not key.startswith("time/")
        }
        self.rows.append({STEP: float(step), **numbers})

    def save(self) -> None:
        """Write the CSV file; the cell of a missing value is empty."""
        names = dict.fromkeys(name for row in self.rows for name in row)
        text = io.StringIO()
        table = csv.DictWriter(text, list(names), lineterminator="\n")
        table.writeheader()
        for row in self.rows:
            cells = {name: f"{value:.6g}" for name, value in row.items()}
            table.writerow(cells | {STEP: str(int(row[STEP]))})
        write_text(self._path, text.getvalue())


class Record:
    """The record of a training. If the job's folder has a checkpoint, the record continues from it.

    Args:
        job: training to record.
        tell: function that is called with :class:`News` of the training.

    Attributes:
        progress: state of the training, by name. "update" counts updates, "timesteps" epochs.
            "best" has results of the best policy so far. "beat_rule" has the timesteps and seconds
            until a policy first beat the paper's rule. "best" and "beat_rule" are None at first.
            "seconds" (wall time) and "rows" (log) are from the checkpoint; without one, 0 and [].
            All other entries belong to the trainer, which removes them when it resumes.
        log: log of the training's progress.
        first_seed: seed of the first environment; the other seeds count up from it.

    Raises:
        ValueError: the checkpoint is damaged.
    """

    def __init__(self, job: Job[Any], tell: Tell) -> None:
        self._begun_s = time.monotonic()
        self._job = job
        self._tell = tell
        self.progress: State = {
            "update": 0,
            "timesteps": 0,
            "best": None,
            "beat_rule": None,
            "seconds": 0.0,
            "rows": [],
        }
        if job.checkpoint.exists():
            self.progress |= read_checkpoint(job.checkpoint)
        # environments that go on after an interruption get new episodes
        self.first_seed = job.first_seed + self.progress["update"] * job.hyperparameters.num_envs
        self._evaluator = Evaluator(job.task, job.episodes)
        self.log = ProgressLog(job.folder, self.progress["rows"])

    @property
    def seconds(self) -> float:
        """Return the wall time of the training, including time before an interruption."""
        return float(self.progress["seconds"]) + time.monotonic() - self._begun_s

    def evaluate(
        self, actor: Tensors, table: Observation, features: Sequence[str] | None = None
    ) -> dict[str, float]:
        """Evaluate a policy; keep its file if it is the best so far; return means for the log.

        Args:
            actor: tensors of the policy.
            table: definition of the environments' features.
            features: names of the features that the policy's network reads; None for all.
        """
        columns = table.columns
        if features is not None:
            columns = tuple(column for column in columns if column.name in features)
        progress = self.progress
        latest = self._job.folder / "latest.safetensors"
        write_bytes(latest, to_bytes(actor, self._card(columns, table.kind, {})))
        figures = self._evaluator.examine(latest)
        timesteps = progress["timesteps"]
        if progress["best"] is None or figures["reward"] > progress["best"]["reward"]:
            progress["best"] = {"timesteps": timesteps, **figures}
            write_bytes(
                self._job.policy, to_bytes(actor, self._card(columns, table.kind, progress["best"]))
            )
        text = f"reward {figures['reward']:.3f}"
        if progress["beat_rule"] is None and figures["minus speed-rule"]["ci95"][0] > 0.0:
            seconds = round(self.seconds, 1)
            progress["beat_rule"] = {"timesteps": timesteps, "seconds": seconds}
            text = f"beats the 2 m/s rule after {timesteps} steps, {seconds} s; {text}"
        means = {
            key: float(value["mean"] if isinstance(value, dict) else value)
            for key, value in figures.items()
        }
        self._tell(News(timesteps, text, means))
        return {f"tuning/{key}": mean for key, mean in means.items()}

    def save(self, **more: Any) -> None:
        """Write the log, and a checkpoint with :attr:`progress` and the entries ``more``."""
        self.log.save()
        here = {"seconds": self.seconds, "rows": self.log.rows}
        write_checkpoint(self._job.checkpoint, self.progress | here | more)

    def close(self) -> Json:
        """Write the log and the outcome, delete the checkpoint, and return the outcome."""
        self.log.save()
        outcome = {"seed": self._job.seed, "timesteps": self.progress["timesteps"]}
        outcome |= {"seconds": round(self.seconds, 1)}
        outcome |= {key: self.progress[key] for key in ("beat_rule", "best")}
        write_json(self._job.outcome, outcome)
        self._job.checkpoint.unlink(missing_ok=True)
        return outcome

    def _card(self, columns: tuple[Column, ...], observation: str, evaluation: Json) -> Card:
        job = self._job
        task = self._job.task
        return Card(
            modes=task.bank.modes,
            observation=observation,
            features=columns,
            scenario=task.scenario,
            radio=", ".join(task.banks),
            algorithm=job.hyperparameters.algorithm,
            seed=job.seed,
            timesteps=self.progress["timesteps"],
            command=job.command,
            evaluation=evaluation,
            versions=versions_of("gymnasium", "numpy", "numba", "torch", "stable-baselines3"),
            beliefs=task.beliefs,
            banks=dict(task.banks) if task.beliefs == "per-mode" else {},
            base=getattr(job.hyperparameters, "base", ""),
        )
