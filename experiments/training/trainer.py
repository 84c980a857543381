"""Train one switcher: learn, look how good it is on tuning seeds, keep the best, stop and go on."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from experiments.training.checkpoint import read_checkpoint, with_arrays, write_checkpoint
from experiments.training.evaluator import EPISODES, Evaluator
from experiments.training.hyperparameters import Hyperparameters
from experiments.training.network import actor_of, falling, learner
from experiments.training.progress_log import ProgressLog
from experiments.training.training_env import TrainingEnv
from experiments.training.training_task import TrainingTask
from mmwave_env import __version__
from mmwave_env.files import write_bytes, write_json
from policies.policy_file import Card, to_bytes

TRAINING_SEED = 10_000_000  # of the first training; each has a million of its own
SEEDS_EACH = 1_000_000
# Updates between two rows of the journal, and between two looks: until the rule is beaten, and
# after that.
LOG, EARLY, LATER = 4, 2, 16

LOGGED = ("ate_m", "rmse_m", "mean_nees", "in_bounds", "divergence", "smoothed_ate_m")
PACKAGES = ("gymnasium", "numpy", "numba", "torch", "stable-baselines3", "sb3-contrib")

Tell = Callable[[int, str], None]


@dataclass(frozen=True)
class Job:
    """One training."""

    # task, recipe: what is learned, and how
    task: TrainingTask
    recipe: Hyperparameters
    algorithm: str  # name
    seed: int  # number of the training, from 0
    timesteps: int  # epochs to train for, in all environments together
    folder: Path  # for all that is written
    command: str  # that makes the policy file
    checkpoint_every: int  # updates between two checkpoints
    episodes: int = EPISODES  # that policies are judged on

    @property
    def outcome(self) -> Path:
        """Figures of the policy; there once the training is over."""
        return self.folder / "outcome.json"

    @property
    def policy(self) -> Path:
        """The best policy so far."""
        return self.folder / "policy.safetensors"


class Training(BaseCallback):
    """A training under way; Stable-Baselines3 calls it around the epochs it collects.

    Args:
        job: what to do; goes on where a checkpoint in its folder stands.
        tell: takes the number of epochs trained for and what is new.

    Raises:
        ValueError: the checkpoint is damaged.
    """

    def __init__(self, job: Job, tell: Tell) -> None:
        super().__init__()
        self._begun_s = time.monotonic()
        torch.set_num_threads(1)  # networks this small gain nothing from more
        self._job, self._tell = job, tell
        self._checkpoint = job.folder / "checkpoint.pt"
        self._stand: dict[str, Any] = {
            "update": -1, "best": None, "beat_rule": None, "seconds": 0.0, "rows": [],
        }  # fmt: skip
        if self._checkpoint.exists():
            self._stand = read_checkpoint(self._checkpoint)
        self._env = TrainingEnv(job.task, job.recipe)
        seed = TRAINING_SEED + SEEDS_EACH * job.seed
        self._learner = learner(self._env, job.recipe, seed)
        self._examiner = Evaluator(job.task, job.episodes)
        self._journal = ProgressLog(job.folder, self._stand["rows"])
        self._ended: list[dict[str, Any]] = []

    def run(self) -> dict[str, Any]:
        """Train to the end; figures of the training and of its best policy."""
        job, model, stand = self._job, self._learner, self._stand
        model.set_logger(Logger(None, [self._journal]))
        if "learner" in stand:
            self._restore(stand.pop("learner"))
            self._env.restore(with_arrays(stand.pop("world")))
        left = job.timesteps - model.num_timesteps
        fresh = not model.num_timesteps
        # It counts anew. Its own type knows no None, its code does: log when this class says so.
        model.learn(left, self, log_interval=None, reset_num_timesteps=fresh)  # type: ignore[arg-type]
        self._look()
        model.dump_logs()
        model.save(job.folder / "model.zip")
        self._env.normal.save(str(job.folder / "normalization.pkl"))
        self._journal.close()
        outcome = {
            "seed": job.seed, "timesteps": model.num_timesteps,
            "seconds": round(self._seconds(), 1), "beat_rule": stand["beat_rule"],
            "best": stand["best"],
        }  # fmt: skip
        write_json(job.outcome, outcome)
        self._checkpoint.unlink(missing_ok=True)
        return outcome

    def _seconds(self) -> float:
        """Wall time of the training, of what came before an interruption too."""
        return float(self._stand["seconds"]) + time.monotonic() - self._begun_s

    def _on_rollout_start(self) -> None:
        model, recipe, stand = self._learner, self._job.recipe, self._stand
        model.ent_coef = recipe.ent_coef * falling(recipe, 1.0 - self._done())
        update = model.num_timesteps // (recipe.num_envs * recipe.n_steps)
        if update == stand["update"]:
            return  # the checkpoint that this training goes on from
        stand["update"] = update
        if update:
            if update % (LATER if stand["beat_rule"] else EARLY) == 0:
                self._look()
            if update % LOG == 0:
                model.dump_logs()
            if update % self._job.checkpoint_every == 0:
                self._save()
        self._tell(model.num_timesteps, "")

    def _done(self) -> float:
        """Share of the training that is over."""
        return self._learner.num_timesteps / self._job.timesteps

    def _on_step(self) -> bool:
        self._ended += [info for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_rollout_end(self) -> None:
        for key in LOGGED if self._ended else ():
            mean = float(np.mean([info[key] for info in self._ended]))
            self.logger.record_mean(f"rollout/{key}", mean)
        self._ended.clear()
        actions = self._learner.rollout_buffer.actions.astype(np.int64).ravel()
        names = self._env.observation.actions
        for name, n in zip(names, np.bincount(actions, minlength=len(names)), strict=True):
            self.logger.record_mean(f"share/{name}", n / len(actions))
        self.logger.record("seconds", self._seconds())

    def _look(self) -> None:
        """Examine the policy, and keep it if it is the best so far."""
        stand, timesteps = self._stand, self._learner.num_timesteps
        latest = self._job.folder / "latest.safetensors"
        self._write(latest, {})
        figures = self._examiner.examine(latest)
        for key, value in figures.items():
            number = value["mean"] if isinstance(value, dict) else value
            self.logger.record(f"tuning/{key}", number)
        if stand["best"] is None or figures["reward"] > stand["best"]["reward"]:
            stand["best"] = {"timesteps": timesteps, **figures}
            self._write(self._job.policy, stand["best"])
        news = f"reward {figures['reward']:.3f}"
        if stand["beat_rule"] is None and figures["minus speed-rule"]["ci95"][0] > 0.0:
            seconds = round(self._seconds(), 1)
            stand["beat_rule"] = {"timesteps": timesteps, "seconds": seconds}
            news = f"beats the 2 m/s rule after {timesteps} steps, {seconds} s; {news}"
        self._tell(timesteps, news)

    def _write(self, path: Path, evaluation: dict[str, Any]) -> None:
        job, task, table = self._job, self._job.task, self._env.observation
        per_mode = task.beliefs == "per-mode"
        card = Card(
            modes=task.bank.modes, observation=task.observation, digest=table.digest,
            frames=job.recipe.frames, scenario=task.scenario, radio=", ".join(task.banks),
            algorithm=job.algorithm, seed=job.seed, timesteps=self._learner.num_timesteps,
            command=job.command, evaluation=evaluation,
            versions={"mmwave-loc": __version__} | {p: version(p) for p in PACKAGES},
            beliefs=task.beliefs, banks=dict(task.banks) if per_mode else {},
        )  # fmt: skip
        actor = actor_of(self._learner, self._env, job.recipe)
        write_bytes(path, to_bytes(actor, card))

    def _save(self) -> None:
        self._journal.save()
        write_checkpoint(
            self._checkpoint,
            self._stand | {
                "seconds": self._seconds(), "rows": self._journal.rows,
                "world": self._env.state(), "learner": self._learner_state(),
            },
        )  # fmt: skip

    def _learner_state(self) -> dict[str, Any]:
        model = self._learner
        kind, keys, *rest = np.random.get_state()  # noqa: NPY002  it shuffles the batches
        return {
            "timesteps": model.num_timesteps, "updates": model._n_updates,
            "policy": model.policy.state_dict(), "optimizer": model.policy.optimizer.state_dict(),
            "observations": model._last_obs, "begins": model._last_episode_starts,
            "lstm": [list(pair) for pair in getattr(model, "_last_lstm_states", None) or ()],
            "torch": torch.get_rng_state(), "numpy": [kind, keys, *rest],
            "episodes": list(model.ep_info_buffer or ()),
            "pending": {k: float(v) for k, v in model.logger.name_to_value.items()},
            "counts": dict(model.logger.name_to_count),
        }  # fmt: skip

    def _restore(self, state: dict[str, Any]) -> None:
        model = self._learner
        model._setup_learn(0)
        model.num_timesteps, model._n_updates = state["timesteps"], state["updates"]
        model.policy.load_state_dict(state["policy"])
        model.policy.optimizer.load_state_dict(state["optimizer"])
        model._last_obs = state["observations"].numpy()
        model._last_episode_starts = state["begins"].numpy()
        if state["lstm"]:
            recurrent: Any = model  # a RecurrentPPO, whose own type for the states is None
            recurrent._last_lstm_states = RNNStates(*(tuple(pair) for pair in state["lstm"]))
        assert model.ep_info_buffer is not None  # _setup_learn made it
        model.ep_info_buffer.extend(state["episodes"])
        model.logger.name_to_value.update(state["pending"])
        model.logger.name_to_count.update(state["counts"])
        torch.set_rng_state(state["torch"])
        kind, keys, *rest = state["numpy"]
        np.random.set_state((kind, keys.numpy(), *rest))  # noqa: NPY002
