"""Train a switcher with PPO: learn, look how good it is, keep the best, stop and go on."""

import time
from typing import Any

import numpy as np
import torch
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from experiments.training.checkpoint import (
    going_on_from,
    read_stand,
    with_arrays,
    write_checkpoint,
)
from experiments.training.hyperparameters import Hyperparameters, falling
from experiments.training.job import Job, Tell
from experiments.training.looks import Looks
from experiments.training.network import actor_of, learner
from experiments.training.progress_log import ProgressLog
from experiments.training.training_env import TrainingEnv
from mmwave_env.files import atomic_path, write_json

# Updates between two rows of the journal, and between two looks: until the rule is beaten, and
# after that.
LOG, EARLY, LATER = 4, 2, 16

LOGGED = ("ate_m", "rmse_m", "mean_nees", "in_bounds", "divergence", "smoothed_ate_m")


class PpoTraining(BaseCallback):
    """A training under way; Stable-Baselines3 calls it around the epochs it collects.

    Args:
        job: what to do; goes on where a checkpoint in its folder stands.
        tell: takes the number of epochs trained for and what is new.

    Raises:
        ValueError: the checkpoint is damaged.
    """

    def __init__(self, job: Job[Hyperparameters], tell: Tell) -> None:
        super().__init__()
        self._begun_s = time.monotonic()
        torch.set_num_threads(1)  # networks this small gain nothing from more
        self._job, self._tell = job, tell
        self._stand: dict[str, Any] = {
            "update": -1, "best": None, "beat_rule": None, "seconds": 0.0, "rows": [],
        }  # fmt: skip
        if job.checkpoint.exists():
            self._stand = read_stand(job.checkpoint, self._stand)
        self._env = TrainingEnv(job.task, job.recipe)
        self._learner = learner(self._env, job.recipe, job.first_seed)
        self._looks = Looks(job, tell, self._stand)
        self._journal = ProgressLog(job.folder, self._stand["rows"])
        self._ended: list[dict[str, Any]] = []

    def run(self) -> dict[str, Any]:
        """Train to the end; figures of the training and of its best policy."""
        job, model, stand = self._job, self._learner, self._stand
        with self._journal:
            model.set_logger(Logger(None, [self._journal]))
            if "learner" in stand:
                with going_on_from(job.checkpoint):
                    self._restore(stand.pop("learner"))
                    self._env.restore(with_arrays(stand.pop("world")))
            left = job.timesteps - model.num_timesteps
            fresh = not model.num_timesteps
            # It counts anew. Its own type knows no None, its code does: log when this class
            # says so.
            model.learn(
                left, self, log_interval=None, reset_num_timesteps=fresh  # type: ignore[arg-type]
            )  # fmt: skip
            self._look()
            model.dump_logs()
            with atomic_path(job.folder / "model.zip") as path:
                model.save(path)
            with atomic_path(job.folder / "normalization.pkl") as path:
                self._env.normal.save(str(path))
        outcome = {
            "seed": job.seed, "timesteps": model.num_timesteps,
            "seconds": round(self._seconds(), 1), "beat_rule": stand["beat_rule"],
            "best": stand["best"],
        }  # fmt: skip
        write_json(job.outcome, outcome)
        job.checkpoint.unlink(missing_ok=True)
        return outcome

    def _seconds(self) -> float:
        """Wall time of the training, of what came before an interruption too."""
        return float(self._stand["seconds"]) + time.monotonic() - self._begun_s

    def _on_rollout_start(self) -> None:
        model, recipe, stand = self._learner, self._job.recipe, self._stand
        model.ent_coef = recipe.ent_coef * falling(recipe.final_fraction, 1.0 - self._done())
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
        for key in (key for key in LOGGED if self._ended and key in self._ended[0]):
            mean = float(np.mean([info[key] for info in self._ended]))
            self.logger.record_mean(f"rollout/{key}", mean)
        self._ended.clear()
        actions = self._learner.rollout_buffer.actions.astype(np.int64).ravel()
        names = self._env.observation.actions
        for name, n in zip(names, np.bincount(actions, minlength=len(names)), strict=True):
            self.logger.record_mean(f"share/{name}", n / len(actions))
        self.logger.record("seconds", self._seconds())

    def _look(self) -> None:
        job, model = self._job, self._learner
        actor = actor_of(model, self._env, job.recipe)
        figures = self._looks.take(
            actor, self._env.observation, model.num_timesteps, self._seconds(), job.recipe.frames
        )
        for key, number in figures.items():
            self.logger.record(key, number)

    def _save(self) -> None:
        self._journal.save()
        write_checkpoint(
            self._job.checkpoint,
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
