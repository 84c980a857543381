"""`studies` as a user types it, and what its tables are made of."""

import shutil

import pytest

from experiments.learning.arguments.studies import Args
from experiments.learning.studies import (
    DEFAULTS,
    EVOLUTION,
    TRAININGS,
    bank_without,
    options_of,
    record_of,
)
from experiments.learning.study_tables import STUDIES, rows_of
from experiments.training.places import place_from
from mmwave_env.filters.bank import bank_from, best_bank
from mmwave_env.filters.mode_files import modes_from
from tests.cli import assert_one_clear_line, command
from tests.paths import ROOT

RECORDED = ROOT / "docs" / "learning"


def test_shared_beliefs_are_trained_with_the_modes_of_the_best_bank(tmp_path):
    options = options_of(Args(out=tmp_path, total_timesteps=7, seeds=2), "shared")
    assert (options.algo, options.beliefs, options.total_timesteps) == ("ppo", "shared", 7)
    assert (options.out, options.seeds, options.resume) == (tmp_path / "shared", 2, False)
    assert modes_from(options.modes) == best_bank().modes
    assert options_of(Args(out=tmp_path), "ppo").modes == ()  # the default is that bank


def test_a_bank_that_is_there_is_not_tuned_again(tmp_path):
    """Banks without some modes lie beside the run."""
    first = options_of(Args(out=tmp_path), "shared").modes
    (tmp_path / "no-turn-bank.json").write_bytes((tmp_path / "shared-bank.json").read_bytes())
    (path,) = options_of(Args(out=tmp_path), "no-turn").modes
    assert bank_from(path) == bank_from(first)


@pytest.mark.slow
def test_a_bank_without_a_mode_is_tuned_anew():
    pytest.importorskip("cmaes")
    bank = bank_without(("turn",), place_from("street:handset"), 30)
    assert [mode.name for mode in bank.modes] == ["stand", "cruise", "accelerate", "brake"]
    assert bank.transition is not None and bank.modes[0] != best_bank().modes[0]


def test_a_mode_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="mode: found 'hover', expected one of stand, "):
        bank_without(("hover",), place_from("street:handset"), 1)


def test_what_is_recorded_is_left_as_it_is(tmp_path):
    names = [*TRAININGS, EVOLUTION, DEFAULTS]
    for name in names:
        record = record_of(tmp_path, name)
        record.parent.mkdir()
        record.write_text("{}")
    done = command("studies", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("is there already") == len(names)
    assert not list(tmp_path.glob("*.json"))  # no bank was made


def test_an_unknown_training_is_one_line(tmp_path):
    done = command("studies", "--trainings", "everything", "--out", tmp_path)
    assert_one_clear_line(done, "trainings: found 'everything', expected one of shared, ppo")


def test_tables_show_what_is_recorded(tmp_path):
    """Nothing but the policy that was there before: its row, and none of trainings."""
    shutil.copytree(RECORDED / "guided", tmp_path / "guided")
    rows = set(rows_of(tmp_path))
    assert {"imm-best", *STUDIES["trust"].rows} == rows
    assert rows <= set(rows_of(RECORDED))


def test_every_row_of_every_table_is_of_a_training():
    made = {*TRAININGS, EVOLUTION, *STUDIES["trust"].rows}
    for study in STUDIES.values():
        assert {name.removeprefix("imm ") for name in (study.reference, *study.rows)} <= made
