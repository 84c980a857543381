"""No number has changed: golden traces are computed again and compared with what was written."""

import json
import math

import pytest

from tests.golden import write
from tests.golden.comparison import ADVICE, differences, machine, message
from tests.golden.text import GENERATOR, cells
from tests.golden.traces import KINDS
from tests.golden.write import FOLDER, MACHINE, changes, read, same_machine

TRACE = "track-ekf.canyon28_vehicle.csv"
ROLLOUTS = sorted(FOLDER.glob("rollout-*.csv"))
SLOW = ("rollout-extended", "rollout-per-mode")  # many modes take long to compile
AUTORESET = ("next-step", "same-step", "disabled")


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.slow] if k in SLOW else []) for k in KINDS]
)
def test_no_number_has_changed(kind):
    told = changes(read(kind), KINDS[kind](), same_machine())
    assert not told, "\n".join(["", *told, ADVICE])


def test_there_are_no_files_but_those_of_a_kind_and_they_name_their_generator():
    paths = [path for path in FOLDER.iterdir() if path.suffix in (".csv", ".json", ".txt")]
    assert {path.name.split(".")[0] for path in paths} == {"machine", *KINDS}
    for path in paths:
        assert path.suffix == ".json" or path.read_text("utf-8").startswith(f"# {GENERATOR}"), path
    assert sum(path.stat().st_size for path in paths) < 1.3e6


def test_the_rollouts_show_what_they_are_for():
    """Both kinds of ends, resets, masks and what an episode ended with."""
    rollouts = {path.name: cells(path.name, path.read_text("utf-8")) for path in ROLLOUTS}
    assert len(rollouts) == 24

    def where(column, *values):
        """The files that have one of these values in a column."""
        found = ((name, key, cell) for name, it in rollouts.items() for key, cell in it.items())
        return {name for name, (_, at), cell in found if at == column and cell in values}

    vectors = {name for name in rollouts if name.split(".")[1] in AUTORESET}
    assert len(vectors) == 8
    assert len(where("terminated", "T")) == 4 and len(where("truncated", "T")) == 20
    same_step = {f"rollout-{group}.same-step.csv" for group in ("high", "per-mode", "standard")}
    assert same_step == where("final_obs", "in row final")
    for action in "012345":  # trust none, and each of five modes
        assert any("per-mode" in name for name in where("action", action)), action
    assert where("episode_name", "~None") == vectors, "masks"
    for name in vectors:
        rows = {row for row, _ in rollouts[name]}
        assert {f"0 reset {i}" for i in range(3)} | {"4 reset 1"} <= rows
    ended = {name for name, it in rollouts.items() if any(at == "ate_m" for _, at in it)}
    assert ended == where("terminated", "T") | where("truncated", "T")


# --- what the comparison notices


@pytest.fixture
def old():
    return (FOLDER / TRACE).read_text("utf-8")


def changed(text, column, by):
    """The text, and one whose last row has another number in a column."""
    *before, last = text.splitlines()
    at = text.splitlines()[1].split(",").index(column)
    row = last.split(",")
    row[at] = repr(by(float(row[at])))
    return "\n".join([*before, ",".join(row)]) + "\n"


def test_a_change_of_the_last_digit_is_found_and_told(old):
    new = changed(old, "var vy", lambda v: math.nextafter(v, math.inf))
    (found,) = differences(TRACE, old, new, exact=True)
    before, after = (cells(TRACE, text)["119", "var vy"] for text in (old, new))
    assert before != after and len(before) > 15
    assert found == f"row '119', column 'var vy': {before} became {after}"
    (told,) = changes({TRACE: old}, {TRACE: new}, exact=True)
    assert told.startswith(f"{TRACE}: 1 differences\n  row '119', column 'var vy'")


@pytest.mark.parametrize(
    ("column", "factor", "count"),
    [("px", 1e-13, 0), ("px", 1e-6, 1), ("nis 0", -1e-13, 0), ("nis 0", -1e-6, 1)],
)
def test_on_another_machine_1e_13_is_rounding_and_1e_6_is_not(old, column, factor, count):
    new = changed(old, column, lambda v: v * (1.0 + factor))
    assert new != old
    assert len(differences(TRACE, old, new, exact=False)) == count
    assert len(differences(TRACE, old, new, exact=True)) == 1


@pytest.mark.parametrize(("b", "count"), [("0.500001", 0), ("0.5001", 1), ("nan", 1), ("", 1)])
def test_observations_are_single_precision(b, count):
    old, new = (f"row,observation 3\n0 reset,{cell}\n" for cell in ("0.5", b))
    assert len(differences("rollout.csv", old, new, exact=False)) == count


@pytest.mark.parametrize(("a", "b"), [("aa-r", "aara"), ("T", "F"), ("~0.0", "0.0"), ("ekf", "")])
@pytest.mark.parametrize("exact", [True, False])
def test_words_and_masks_are_compared_as_they_are(a, b, exact):
    old, new = (f"row,reward\n0 reset,{cell}\n" for cell in (a, b))
    assert differences("rollout.csv", old, old, exact) == []
    assert differences("rollout.csv", old, new, exact) == [
        f"row '0 reset', column 'reward': {a} became {b}"
    ]


@pytest.mark.parametrize("exact", [True, False])
def test_rows_columns_and_files_that_come_or_go_are_told(old, exact):
    *lines, last = old.splitlines(keepends=True)
    shorter = "".join(lines)
    columns = len(last.split(","))
    for a, b in ((old, shorter), (shorter, old)):
        assert len(differences(TRACE, a, b, exact)) == columns
    swapped = "".join([*lines[:-1], last, lines[-1]])
    assert differences(TRACE, old, swapped, exact) == ["a comment, or the order of rows or columns"]
    assert changes({}, {TRACE: old}, exact) == [f"{TRACE}: is new"]
    assert changes({TRACE: old}, {}, exact) == [f"{TRACE}: nothing writes it any more"]


def test_json_is_compared_by_path():
    old, new = (json.dumps({"imm": {"reward": [1.5, number]}}) for number in (2.25, 2.5))
    assert differences("compare.json", old, new, exact=False) == [
        "row 'imm/reward', column '1': 2.25 became 2.5"
    ]


def test_of_many_differences_a_few_are_shown_and_all_are_counted():
    told = message(TRACE, [f"row '{k}'" for k in range(400)])
    assert "400 differences" in told and "row '4'" in told and "row '5'" not in told
    assert "... and 395 more" in told


@pytest.fixture
def folder(old, monkeypatch, tmp_path):
    """A folder with a file that differs and one left over, for the command to write to."""
    (tmp_path / TRACE).write_text(changed(old, "px", lambda v: v * (1.0 + 1e-13)))
    (tmp_path / "track-ekf.gone.csv").write_text("")
    (tmp_path / MACHINE).write_text(machine())
    monkeypatch.setattr(write, "FOLDER", tmp_path)
    monkeypatch.setattr(write, "KINDS", {"track-ekf": lambda: {TRACE: old}})
    return tmp_path


def test_the_command_writes_what_a_check_then_finds(old, folder, capsys):
    before = {path: path.read_text() for path in folder.iterdir()}
    with pytest.raises(SystemExit, match="make golden"):
        write.main(["--check"])
    assert {path: path.read_text() for path in folder.iterdir()} == before
    shown = capsys.readouterr().out
    assert f"{TRACE}: 1 differences\n  row '119', column 'px'" in shown
    assert "track-ekf.gone.csv: nothing writes it any more\n2 files differ" in shown
    write.main([])
    assert {path.name: path.read_text() for path in folder.iterdir()} == {
        TRACE: old, MACHINE: machine(),
    }  # fmt: skip
    write.main(["--check"])
    assert "0 files differ, compared to the last digit" in capsys.readouterr().out


def test_a_check_on_another_kind_of_machine_allows_for_rounding(folder, capsys):
    (folder / "track-ekf.gone.csv").unlink()
    (folder / MACHINE).write_text("processor abacus\n")
    write.main(["--check"])
    assert "0 files differ, compared to a tolerance" in capsys.readouterr().out
