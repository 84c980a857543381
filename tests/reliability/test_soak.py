"""The soak: damage done to episodes, and numbers that are not sound are found."""

import json
import re

import numpy as np
import pytest

from experiments.cli.main import run
from experiments.reliability import damage, soak
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.filters.mode_files import named_modes
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.update import ekf
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.numbers import where
from tests.cli import assert_one_clear_line, command, succeed

SMALL = ("--steps", "1.2e4", "--num-envs", "16")


@pytest.mark.slow
def test_a_short_soak_tells_what_it_did(tmp_path):
    file = tmp_path / "soak.json"
    shown = succeed("soak", *SMALL, "--json", file)
    result = json.loads(file.read_text())
    assert result["command"] == "mmwave-loc soak --steps 12000.0 --num-envs 16"
    assert "numba" in result["versions"]
    assert result["asked"] == {"steps": 12000.0, "seed": 0, "num_envs": 16}
    found = result["found"]
    assert found["violations"] == [] and "violations: 0" in shown
    assert found["steps"] == 12_000 and found["episodes"] == 64 and found["drawn"] == 16
    assert found["links"] == 64 * 200 * 3 and 0.1 < found["missing"] / found["links"] < 0.5
    assert all(found["damage"].values()) and len(found["damage"]) == 5
    assert 0.0 < found["smallest_pivot"] < 1.0 and 0.0 < found["largest_error_m"] < np.inf
    assert "12,000 steps in 64 episodes (16 drawn, each run 4 times" in shown


def test_every_kind_of_user_and_radio_has_its_turn():
    args, tally = soak.Args(num_envs=1), soak.Tally()
    some = zip(range(15 * soak.RUNS), soak.runs(args, tally), strict=False)
    kinds = {name.partition(" (")[2] for _, (name, *_) in some}
    assert len(kinds) == 15 and tally.drawn == 15


def rotten(how):
    """A mode whose posterior is spoilt, in a way that depends on the epoch."""

    def update(x, P, measurement, gate):
        after = ekf(x, P, measurement, gate)
        bad = after.nis[0] > 1e3
        if how == "an indefinite P":
            entry = where(bad, 1.01 * after.P[0][0], after.P[0][1])
            rows = [list(row) for row in after.P]
            rows[0][1] = rows[1][0] = entry
            return after._replace(P=rows)
        if how == "a NaN in x":
            return after._replace(x=[*after.x[:6], where(bad, np.nan, after.x[6])])
        return after._replace(log_likelihood=where(bad, np.inf, after.log_likelihood))

    return Mode("rotten", update)


SOMETIMES = {
    "an indefinite P": "pivots of P",
    "a NaN in x": "candidates",  # seen before it is taken
    "a likelihood that no observation shows": "candidates",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "how",
    [pytest.param(how, marks=[pytest.mark.slow] if "P" in how else []) for how in SOMETIMES],
)
def test_a_violation_is_found_and_can_be_brought_back(how, monkeypatch, capsys, tmp_path):
    modes = {"ekf": named_modes()["ekf"], "rotten": rotten(how)}
    monkeypatch.setattr(soak, "named_modes", lambda: modes)
    told = []
    for _ in range(2):
        file = tmp_path / "soak.json"
        with pytest.raises(SystemExit) as left:
            run("soak", [*SMALL, "--seed", "5", "--json", str(file)])
        assert left.value.code == 1
        found = json.loads(file.read_text())["found"]
        told.append(found["violations"])
        shown = capsys.readouterr().out
        assert f"violations: {len(told[0])}" in shown and told[0][0] in shown
    assert told[0] == told[1]
    pattern = r"run \d+ \(scenario pedestrian, radio \w+\), epoch \d+, environment \d+ \(seed \d+\)"
    for line in told[0]:
        assert re.match(pattern, line), line
        assert SOMETIMES[how] in line[line.index("unsound") : line.index(":")]


@pytest.mark.parametrize(
    ("option", "found"), [("--steps", "0"), ("--steps", "inf"), ("--steps", "nan"),
                          ("--num-envs", "0")],
)  # fmt: skip
def test_nothing_to_do_is_refused(option, found):
    done = command("soak", option, found)
    assert_one_clear_line(done, f"{option[2:]}: found {found}, expected at least 1")


# --- damage


@pytest.fixture(scope="module")
def pair():
    """Episodes, and copies of them that are damaged."""
    source = SimulatedSource(SCENES["street"], RADIOS["handset"])
    episodes = [source.sample(np.random.default_rng(seed)) for seed in range(200)]
    return episodes, *damage.damaged(episodes, np.random.default_rng(0))


def longest(missing):
    """The most epochs in a row in which all of (T, k) is missing."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.all(axis=1), [0]])))
    return (edges[1::2] - edges[::2]).max(initial=0)


def test_links_are_missing_alone_together_and_for_long(pair):
    gone = [a.visible & ~b.visible for a, b in zip(*pair[:2], strict=True)]
    assert not any((b.visible & ~a.visible).any() for a, b in zip(*pair[:2], strict=True))
    dark = [longest(~b.visible[:, :3]) for b in pair[1]]
    assert 30 < sum(epochs >= 50 for epochs in dark) < 70  # of 200, 50 on average
    for group in range(4):
        stretch = [longest(~b.visible[:, [group]]) for b in pair[1]]
        assert sum(5 <= epochs < 50 for epochs in stretch) > 20
        assert 0.05 < np.mean([one[:, group] for one in gone]) < 0.5


@pytest.mark.parametrize(("T", "least"), [(200, 50), (50, 50), (30, 30), (1, 1)])
def test_the_dark_is_never_short(T, least):
    dark = damage._stretches(np.random.default_rng(0), (1000, T, 1), 0.25, damage.DARK)
    lengths = np.array([longest(one) for one in dark])
    assert (dark.sum(axis=(1, 2)) == lengths).all()  # each in one stretch
    assert 150 < np.count_nonzero(lengths) < 350
    assert lengths[lengths > 0].min() == least
    assert dark[:, 0].any() and dark[:, -1].any()


def test_what_was_visible_is_counted(pair):
    episodes, copies, done = pair
    before, after = (np.stack([one.visible for one in some]) for some in (episodes, copies))
    gone = before & ~after
    assert done["link-epochs taken away"] == gone[..., :3].sum()
    assert done["Doppler shifts taken away"] == gone[..., 3].sum()
    assert 0 < done["epochs darkened, in stretches of 50 and more"]
    assert done["epochs darkened, in stretches of 50 and more"] <= gone[..., :3].any(axis=-1).sum()


def test_numbers_are_broken_or_far_off_where_they_are_visible(pair):
    episodes, copies, done = pair
    broken, far = 0, 0
    for a, b in zip(episodes, copies, strict=True):
        finite, layout = np.isfinite(b.measurement), b.layout
        moved = finite & (b.measurement != a.measurement)
        assert (abs(b.measurement - a.measurement)[moved] > 1e-6).all()
        broken, far = broken + (~finite).sum(), far + moved.sum()
        for group, rows in enumerate(layout.groups):
            assert not (~finite | moved)[~b.visible[:, group], rows].any()
        angles = b.measurement[:, layout.angles]
        assert (abs(angles[np.isfinite(angles)]) <= np.pi).all()
        assert b.nonfinite <= (~finite).sum()
    assert broken == done["values NaN or infinite"]
    assert far == done["outliers of 10 to 1000 sigma"]


def test_the_same_generator_does_the_same_damage(pair):
    again, _ = damage.damaged(pair[0], np.random.default_rng(0))
    for a, b in zip(pair[1], again, strict=True):
        np.testing.assert_array_equal(a.measurement, b.measurement)
        np.testing.assert_array_equal(a.visible, b.visible)
