"""Tests of functions that choose for each call whether they run compiled or as plain Python."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from mmwave_env.compiler import disk_cache
from mmwave_env.compiler.disk_cache import LazyJit


def function(x):
    return x + 1


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """Return a function that makes a new LazyJit; all these LazyJits share one disk cache."""
    monkeypatch.setattr(disk_cache, "_folder", lambda: tmp_path)
    return lambda: LazyJit(function, 5)  # runs as plain Python for 5 units of work


def kinds(lazy, *works):
    """Return which form, plain or compiled, a LazyJit chooses for each amount of work in turn."""
    named = {lazy.plain: "plain", lazy.compiled: "compiled"}
    return [named[lazy.choice(work, 20)] for work in works]


def test_a_function_is_compiled_after_several_small_calls_or_for_the_first_large_call(fresh):
    assert kinds(fresh(), 2, 3, 1, 1) == ["plain", "plain", "compiled", "compiled"]
    assert kinds(fresh(), 6, 1) == ["compiled", "compiled"]


def test_a_compiled_function_is_used_for_any_amount_of_work(fresh):
    for ready in (fresh(), fresh()):  # the first compiles, the second loads from disk
        ready.compiled(20)
        assert kinds(ready, 1) == ["compiled"]
    assert kinds(fresh(), 1) == ["compiled"]


def test_without_a_disk_cache_a_process_uses_what_it_has_compiled(fresh, monkeypatch):
    monkeypatch.setattr(disk_cache, "_folder", lambda: None)
    lazy = fresh()
    assert kinds(lazy, 1) == ["plain"]
    lazy.compiled(20)
    assert kinds(lazy, 1) == ["compiled"]


@pytest.mark.parametrize(("scenario", "mode"), [("walk-ride", "NextStep"), ("mixed", "SameStep")])
def test_environments_with_plain_and_compiled_functions_are_bit_identical(
    scenario, mode, monkeypatch
):
    def run(form):
        monkeypatch.setattr(LazyJit, "choice", lambda lazy, *_: form(lazy))
        envs = gym.make_vec(
            "MmWaveLoc-v0", num_envs=9, episode_steps=12, scenario=scenario, autoreset_mode=mode
        )
        results = [envs.reset(seed=0)]
        return results + [envs.step(np.arange(9) % 2) for _ in range(14)]

    plain = run(lambda lazy: lazy.plain)
    ready = run(lambda lazy: lazy.compiled)
    assert data_equivalence(plain, ready, exact=True)
