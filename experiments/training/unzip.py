"""Extraction of the tensors of a Stable-Baselines3 model, in a separate process.

Loading such a model runs code from its file. The process returns only a file of tensors, which
can be read without running code.
"""

import json
import pickle
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from experiments.evaluation.agents import in_one_line
from experiments.training.actor import Normalization, actor_tensors, layers_of, require_actor
from mmwave_env.io.files import Json, open_regular

DECISIONS = 1000  # number of random observations for which the model's actions are returned
# names of these observations and actions among the tensors
SHOWN = "shown"
CHOSEN = "chosen"


def unzipped(model: Path, normalize: Path | None) -> tuple[dict[str, NDArray[Any]], Json]:
    """Extract the tensors of a model, and facts about its training.

    Args:
        model: file that ``model.save`` wrote.
        normalize: file that ``VecNormalize.save`` wrote, if the model was trained with it.

    Returns:
        First, the tensors of a policy file and two more: "shown" (n, features), random
        observations, and "chosen" (n,), the model's actions for them. Second, facts: the model's
        seed, its timesteps and the name of its network.

    Raises:
        ValueError: the model can't be loaded, or can't be written as a policy file.
    """
    with TemporaryDirectory() as folder:
        out = Path(folder) / "model.safetensors"
        process = get_context("spawn").Process(
            target=_unzip, args=(str(model), normalize, out), daemon=True
        )
        process.start()
        try:
            process.join()
        finally:  # end the process even if waiting for it is interrupted
            process.kill()
            process.join()
        try:
            with safe_open(out, "np") as file:
                facts: Json = json.loads((file.metadata() or {})["facts"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (OSError, KeyError, ValueError, SafetensorError) as error:
            raise ValueError(
                f"{model}: the process that loaded it ended with code {process.exitcode} and left "
                "no tensors"
            ) from error
    if "refusal" in facts:
        raise ValueError(facts["refusal"])
    return tensors, facts


def _unzip(model: str, normalize: Path | None, out: Path) -> None:
    """Write, in the separate process, the tensors or the reason why there are none."""
    try:
        policy, data = _loaded(model)
        require_actor(model, policy)
        normalized = data.get("_last_original_obs") is not None
        if data.get("_last_obs") is not None and normalized is (normalize is None):
            expected = "the file that VecNormalize.save wrote" if normalized else "none"
            raise ValueError(
                f"{model}: normalize: found {normalize or 'none'}, expected {expected}, as in the "
                "model's training"
            )
        normal = _normalization(normalize, policy.observation_space)
        facts = {"seed": data.get("seed"), "timesteps": data.get("num_timesteps")}
        facts |= {"network": type(policy).__name__}
        tensors = actor_tensors(layers_of(policy), normal) | _decisions(policy, normal)
    except Exception as error:  # the file's own code can raise anything
        reason = str(error) if isinstance(error, ValueError) else f"{model}: {in_one_line(error)}"
        facts = {"refusal": reason}
        tensors = {}
    save_file(tensors, out, {"facts": json.dumps(facts)})


def _loaded(model: str) -> tuple[Any, dict[str, Any]]:
    """Load the network of a model, and the other data in its file."""
    from stable_baselines3.common.save_util import load_from_zip_file

    try:
        data, parameters, _ = load_from_zip_file(model, device="cpu")
        assert data is not None
        spaces = data["observation_space"], data["action_space"]
        policy = data["policy_class"](*spaces, lambda left: 0.0, **data["policy_kwargs"])
        policy.load_state_dict(parameters["policy"])
    except Exception as error:  # pickles can raise anything
        raise ValueError(
            f"{model}: not a model of Stable-Baselines3: {in_one_line(error)}"
        ) from error
    return policy, data


def _normalization(path: Path | None, box: Any) -> Normalization:
    """Read the normalization in a file of ``VecNormalize``; without a file, return the identity."""
    low = box.low.astype(float)
    high = box.high.astype(float)
    as_they_are = Normalization(low, high, np.zeros(box.shape), np.ones(box.shape))
    if path is None:
        return as_they_are
    from stable_baselines3.common.vec_env import VecNormalize

    try:
        with open_regular(path) as file:
            normal: Any = pickle.load(file)
        if not isinstance(normal, VecNormalize):
            raise TypeError(f"found {type(normal).__name__}")
    except Exception as error:  # pickles can raise anything
        raise ValueError(f"{path}: not a file of VecNormalize: {in_one_line(error)}") from error
    if not normal.norm_obs:
        return as_they_are
    moments: Any = normal.obs_rms
    if moments.mean.shape != box.shape:
        raise ValueError(f"{path}: found features {moments.mean.shape}, expected {box.shape}")
    sigma = np.sqrt(moments.var + normal.epsilon)
    return Normalization.clipped(moments.mean, sigma, normal.clip_obs)


def _decisions(policy: Any, normal: Normalization) -> dict[str, NDArray[Any]]:
    """Return random observations and the actions that the model chooses for them."""
    low, high, mean, sigma = normal
    spread = np.random.default_rng(0).uniform(-2.0, 2.0, (DECISIONS, len(mean)))
    shown = np.clip(mean + sigma * spread, low, high)
    normalized = ((shown - mean) / sigma).astype(np.float32)
    chosen, _ = policy.predict(normalized, deterministic=True)
    return {SHOWN: shown.astype(np.float32), CHOSEN: chosen}
