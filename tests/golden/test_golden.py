"""Tests that new runs reproduce the golden traces, which are the stored outputs of earlier runs."""

import pytest

from tests.golden.traces import TRACES
from tests.golden.write import FOLDER, differences, text_of
from tests.paths import representative

QUICK = TRACES.keys() - {"rollout-per-mode", "memory"}  # their many modes take long to compile


def written(name):
    return (FOLDER / f"{name}.csv").read_text("utf-8")


@pytest.mark.parametrize("name", representative(TRACES, *QUICK))
def test_a_golden_trace_is_reproduced(name):
    differing = differences(name, written(name), text_of(TRACES[name]()))
    advice = "If the change is intended, run `make golden` and say why."
    assert not differing, "\n".join([*differing[:9], advice])


def test_every_trace_has_a_small_file_and_some_episodes_terminate():
    assert {path.stem for path in FOLDER.glob("*.csv")} == set(TRACES)
    assert sum(len(written(name)) for name in TRACES) < 130_000
    for name in ("rollout-diverging", "rollout-vector"):
        ends = [line.split(";")[3:5] for line in written(name).splitlines()[2:]]
        assert ["True", "False"] in ends, name


@pytest.mark.parametrize(
    ("column", "a", "b", "differing"),
    [
        ("var vy", "0.5", "0.5000005", 1),
        ("var vy", "0.5", "nan", 1),
        ("observation 3", "0.5", "0.500001", 0),
        ("observation 3", "0.5", "0.5001", 1),
        ("episode_key", "11749869230777074271", "11749869230777074272", 1),
        ("truncated", "True", "False", 1),
    ],
)
def test_observations_are_compared_in_single_precision_but_integers_and_words_exactly(
    column, a, b, differing
):
    old, new = (f"# header\nrow;{column}\n0;{cell}\n" for cell in (a, b))
    assert len(differences("rollout", old, new)) == differing
    assert differences("rollout", old, "# header\nrow\n0\n") == ["rollout: rows or columns differ"]
