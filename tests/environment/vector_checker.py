"""Comparisons of results of environments, and a check of the memory of vector environments."""

import numpy as np
from gymnasium.vector import AutoresetMode


def same(a, b):
    """Return whether two results have the same keys, types and values; NaN equals NaN."""
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, (tuple, list)):
        return len(a) == len(b) and all(map(same, a, b))
    if not isinstance(a, np.ndarray):
        return type(a) is type(b) and (a == b or (a != a and b != b))  # NaN != NaN
    if a.dtype != b.dtype or a.shape != b.shape:
        return False
    if a.dtype == object:
        return all(map(same, a, b))
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def arrays(result):
    """Return all arrays of numbers in a result."""
    if isinstance(result, dict):
        result = list(result.values())
    if isinstance(result, (tuple, list)):
        return [array for part in result for array in arrays(part)]
    if isinstance(result, np.ndarray) and result.dtype == object:
        return arrays(list(result))
    return [result] if isinstance(result, np.ndarray) else []


def forward(env, actions):
    """Return the results of a step and, if autoreset is off, of the reset of ended episodes."""
    results = [env.step(actions)]
    over = results[0][2] | results[0][3]
    if env.metadata["autoreset_mode"] == AutoresetMode.DISABLED and over.any():
        results.append(env.reset(options={"reset_mask": over.copy()}))
    return results


def rollout(env, seed, steps):
    """Return the results of a reset and of random steps."""
    rng = np.random.default_rng(0)
    n = env.single_action_space.n
    results = [env.reset(seed=seed)]
    for _ in range(steps):
        results += forward(env, rng.integers(n, size=env.num_envs))
    return results


def assert_own_memory(results):
    """Check that no two results share memory. Then overwrite all results, so that a caller can
    check that the environment does not use their arrays.
    """
    for i, earlier in enumerate(results):
        for later in results[i + 1 :]:
            assert not any(np.shares_memory(a, b) for a in arrays(earlier) for b in arrays(later))
    for array in arrays(results):
        array.fill(1)


def check_memory(make):
    """Check that results share no memory with each other or with the vector environment."""
    env = make()
    twin = make()
    assert_own_memory(rollout(env, seed=0, steps=12))
    rollout(twin, seed=0, steps=12)
    actions = np.zeros(env.num_envs, np.int64)
    assert same(env.step(actions), twin.step(actions)), (
        "changing a returned array changes the environment"
    )
    assert not actions.any()
