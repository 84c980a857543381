"""Models of Stable-Baselines3 as they were saved, ``.zip``."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.observation import Observation


class ZipAgent:
    """A model that was saved with ``model.save``, asked for its most probable actions.

    Args:
        path: the file.
        trust: whether code from the file may run: it holds pickles, so loading it means that.

    Attributes:
        policy: the network.
        normalized: whether it was trained under ``VecNormalize``; None where the file does not
            tell, as it does of actor-critic algorithms only.
        told: seed and steps of the training.

    Raises:
        ValueError: it is not trusted, no such model, or needs packages that are not there.
        FileNotFoundError: there is no such file.
    """

    def __init__(self, path: str, trust: bool) -> None:
        if not Path(path).is_file():
            raise FileNotFoundError(f"{path}: found no file, expected a model (.zip)")
        if not trust:
            raise ValueError(
                f"{path}: loading a model of Stable-Baselines3 runs code from the file; if you "
                "made it, --trust-zip (in Python trust_zip=True) loads it, and mmwave-loc convert "
                f"{path} {Path(path).with_suffix('.safetensors').name} makes a file without code"
            )
        self._path = path
        try:
            from stable_baselines3.common.save_util import load_from_zip_file
        except ImportError as error:
            raise ValueError(
                f"{path}: needs more than the base install: {error}; "
                "pip install 'mmwave-loc[train]'"
            ) from error
        try:
            loaded, parameters, _ = load_from_zip_file(path, device="cpu")
            data: dict[str, Any] = loaded or {}
            self.policy: Any = data["policy_class"](
                data["observation_space"],
                data["action_space"],
                lambda left: 0.0,
                **data["policy_kwargs"],
            )
            self.policy.load_state_dict(parameters["policy"])
        except Exception as error:  # pickles can raise anything
            raise ValueError(
                f"{path}: not a model of Stable-Baselines3: {in_one_line(error)}"
            ) from error
        self.normalized: bool | None = None
        if hasattr(self.policy, "action_net") and data.get("_last_obs") is not None:
            self.normalized = data.get("_last_original_obs") is not None
        self.told = {"seed": data.get("seed"), "timesteps": data.get("num_timesteps")}
        self._state: Any = None
        self._begins = np.empty(0, np.bool_)

    def require_trained_on(self, table: Observation) -> None:
        """Refuse an environment that shows or offers something else than in training.

        Raises:
            ValueError: other observations or actions, or normalized ones.
        """
        box, discrete = self.policy.observation_space, self.policy.action_space
        trained = f"{_shape(box)} and {discrete}"
        expected = f"{_shape(table.space)} and Discrete({len(table.actions)})"
        if trained != expected:
            raise ValueError(
                f"{self._path}: observations and actions: found {trained}, expected {expected}, as "
                f"of {table.made_with}; say --observation, --beliefs and --modes as in its training"
            )
        if self.normalized:
            raise ValueError(
                f"{self._path}: found a model trained under VecNormalize, expected one that takes "
                f"observations as they are; mmwave-loc convert {self._path} "
                f"{Path(self._path).with_suffix('.safetensors').name} --normalize FILE takes what "
                "VecNormalize.save wrote, too"
            )

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the past of the environments (n,) in which an episode begins."""
        self._begins = mask.copy()
        if mask.all():
            self._state = None

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[Any]:
        """Actions (n,) for observations (n, features)."""
        actions, self._state = self.policy.predict(
            observation, self._state, self._begins, deterministic=True
        )
        self._begins = np.zeros(len(observation), np.bool_)
        return np.asarray(actions)


def in_one_line(error: Exception) -> str:
    """What somebody else's code raised."""
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"


def _shape(space: Any) -> str:
    """A space in short: the repr of a Box shows all of its bounds."""
    return f"{type(space).__name__}{space.shape}"
