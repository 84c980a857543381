"""Tests of engines with a belief per mode, in which an action raises the odds of a mode or none."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.engine import run_imm
from mmwave_env.filters import Mode, Pipeline
from mmwave_env.filters.bank import Bank, best_bank
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.radio import TUNED_RADIOS
from tests.filters.gated_textbook import textbook_imm
from tests.filters.tracks import assert_same_beliefs, packed, process_noise, simulated, track

PLAIN = {"gate": None, "adaptive": False, "coupling": False}
BANK = Bank(
    (Mode("slow", "ekf", sigma_v=0.3, **PLAIN), Mode("fast", "ukf", sigma_v=1.8, **PLAIN)),
    ((0.9, 0.1), (0.3, 0.7)),
    0.99,
)


def in_steps_of(dt, episodes):
    return [replace(episode, time_s=dt * np.arange(len(episode))) for episode in episodes]


def played(bank, episodes, actions, *names):
    """Return parts (n, T, ...) of an engine's workspace after each of the actions (n, T)."""
    pipeline = Pipeline(bank.modes, episodes[0].layout)
    parts = track(pipeline, episodes, actions.T, actions.shape[1], names, bank=bank)
    return {name: values.swapaxes(0, 1) for name, values in parts.items()}


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1.0, 0.1])
@pytest.mark.parametrize("radio", TUNED_RADIOS)
def test_trusting_no_mode_equals_the_imm(radio, dt):
    bank = best_bank(radio)
    episodes = in_steps_of(dt, simulated(9, epochs=200))
    ours = played(bank, episodes, np.zeros((9, 200), int), "x", "P", "reward", "nees")
    expected = run_imm(bank, TrackingReward(), episodes, *ours)
    for name, values in ours.items():
        assert_allclose(values, expected[name], rtol=1e-10, atol=1e-10, err_msg=name)


@pytest.mark.parametrize(("dt", "nis_quantile", "off_m"), [(1.0, 1.0, 90.0), (0.25, 0.99, 0.0)])
def test_a_mixture_and_trust_in_its_modes_equal_the_textbook(dt, nis_quantile, off_m):
    """Compare with a textbook IMM in which each epoch raises the trusted mode's probability.

    If a range is 90 m off, all likelihoods would underflow without logarithms.
    """
    episodes = in_steps_of(dt, simulated(4, epochs=30))
    episodes[0].measurement[10, 4] += off_m
    actions = np.random.default_rng(1).integers(0, 3, (4, 30))
    bank = replace(BANK, nis_quantile=nis_quantile)
    ours = played(bank, episodes, actions, "x", "P", "mode_probabilities", "memory.mode")
    for e, episode in enumerate(episodes):
        modes = [
            (mode.algorithm, process_noise(mode, hz_per_mps=episode.hz_per_mps))
            for mode in BANK.modes
        ]

        def change(t, probability, chosen=actions[e]):
            step = dt if t else 1.0
            factor = np.ones(2)
            if chosen[t]:
                factor[chosen[t] - 1] = np.exp(3.0 * step)
            return factor * probability / (factor @ probability)

        step = [1.0, *[dt] * 29]
        T_ij = np.array(BANK.transition)
        transitions = [np.eye(2) + s * (T_ij - np.eye(2)) for s in step]
        x, P, probability = textbook_imm(episode, modes, transitions, nis_quantile, change)
        mixture = {name: ours[name][e] for name in ("x", "P")}
        assert_same_beliefs(mixture, {"x": x, "P": packed(P)}, rtol=1e-8)
        assert_allclose(ours["mode_probabilities"][e], probability, rtol=1e-7, atol=1e-9)
        assert_array_equal(ours["memory.mode"][e], probability.argmax(axis=1))
