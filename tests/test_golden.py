"""No number has changed: golden traces are computed again and compared with what was written."""

import pytest

from tests.golden.traces import TRACES
from tests.golden.write import FOLDER, differences, text_of

SLOW = ["rollout-per-mode"]  # many modes take long to compile


def written(name):
    return (FOLDER / f"{name}.csv").read_text("utf-8")


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=[pytest.mark.slow] if k in SLOW else []) for k in TRACES]
)
def test_no_number_has_changed(name):
    differing = differences(name, written(name), text_of(TRACES[name]()))
    advice = "If this is meant: `make golden`, and say why."
    assert not differing, "\n".join([*differing[:9], advice])


def test_every_file_is_one_of_a_trace_and_shows_what_it_is_for():
    assert {path.stem for path in FOLDER.glob("*.csv")} == set(TRACES)
    assert sum(len(written(name)) for name in TRACES) < 130_000
    for name in ("rollout-diverging", "rollout-vector"):
        ends = [line.split(";")[3:5] for line in written(name).splitlines()[2:]]
        assert ["True", "False"] in ends, name


@pytest.mark.parametrize(
    ("column", "a", "b", "differing"),
    [
        ("var vy", "0.5", "0.5000005", 1),
        ("var vy", "0.5", "0.50000000000005", 0),
        ("var vy", "0.5", "nan", 1),
        ("observation 3", "0.5", "0.500001", 0),
        ("observation 3", "0.5", "0.5001", 1),
        ("episode_key", "11749869230777074271", "11749869230777074272", 1),
        ("truncated", "True", "False", 1),
    ],
)
def test_observations_are_of_single_precision_and_whole_numbers_and_words_exact(
    column, a, b, differing
):
    old, new = (f"# header\nrow;{column}\n0;{cell}\n" for cell in (a, b))
    assert len(differences("rollout", old, new)) == differing
    assert differences("rollout", old, "# header\nrow\n0\n") == ["rollout: rows or columns differ"]
