"""Modes chosen lately: what a plain list of all steps would say."""

import numpy as np
import pytest

from mmwave_env.engines.vector_step import ActionHistory


@pytest.mark.parametrize("modes", [2, 300])
def test_it_knows_the_last_steps_whenever_room_is_made(modes):
    rng, history, steps, room = np.random.default_rng(0), ActionHistory(5, modes), [], 0
    for asked in (3, 4, 2, 9, 30):
        known, room = min(room, len(steps)), max(room, asked)
        history.make_room(asked)
        for _ in range(11):
            if known:
                some = rng.permutation(5)[:3]
                expected = np.transpose(steps[-known:])[some]
                np.testing.assert_array_equal(history.of(some, known), expected)
            steps.append(rng.integers(modes, size=5))
            history.rows[history.turn] = steps[-1]
            history.next()
            known = min(known + 1, room)
