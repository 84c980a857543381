"""A lock-out ends when a link passes its gate again, not with the first forced update."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from mmwave_env.engines.track_engine import Tracker
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from tests.filters.tracks import STREET, simulated

N, T = 64, 120
TIGHT = Mode("tight", sigma_p=0.01, sigma_v=0.05)


def run(mode, *names):
    tracker = Tracker(Pipeline((mode,), STREET), N)
    tracker.load(simulated(N, epochs=T))
    return tracker.run(*names)


def test_updates_stay_forced_until_a_link_passes_its_gate():
    found = run(TIGHT, "memory.nis", "memory.accepted", "memory.rejected", "memory.lockout")
    nis, accepted = found["memory.nis"][..., :3], found["memory.accepted"][..., :3] > 0.5
    seen = (accepted | (found["memory.rejected"][..., :3] > 0.5)).any(axis=-1)
    passed = (accepted & (nis <= chi2.ppf(0.99, 4))).any(axis=-1)
    expected = np.zeros((N, T + 1))
    for t in range(T):
        expected[:, t + 1] = np.where(passed[:, t], 0.0, expected[:, t] + seen[:, t])
    np.testing.assert_array_equal(found["memory.lockout"], expected[:, 1:])
    forced = expected[:, :-1] > TIGHT.recovery - 0.5
    assert accepted.any(axis=-1)[forced & seen].all() and (forced & seen & ~passed).sum() > 100


def test_recovery_keeps_tracks_within_reach():
    lost = np.linalg.norm(run(replace(TIGHT, recovery=None), "error")["error"], axis=-1)
    kept = np.linalg.norm(run(TIGHT, "error")["error"], axis=-1)
    assert kept.mean() < 0.5 * lost.mean()


def test_a_mode_without_gates_is_never_locked_out():
    for mode in (replace(TIGHT, gate=None), replace(TIGHT, robust=True)):
        assert not run(mode, "memory.lockout")["memory.lockout"].any()
