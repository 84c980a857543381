"""docs/errors.md: its table is what its command prints, its columns are those of the file."""

import re
import shlex

import pytest

from experiments.evaluation.epochs_parquet import COLUMNS, GROUP_COLUMNS
from mmwave_env.localization.protection import Region
from tests.cli import succeed
from tests.paths import ROOT, numbers

PAGE = (ROOT / "docs" / "errors.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_table_is_what_the_command_prints(tmp_path):
    (line,) = re.findall(r"^mmwave-loc (compare .* --stanford .*)$", PAGE, re.MULTILINE)
    words = shlex.split(line)
    words[-1] = str(tmp_path / "stanford.png")
    begin = "| policy | 50 % m"
    made = begin + succeed(*words).split(begin)[1]
    shown = begin + PAGE.split(begin)[1].split("<!-- end -->")[0]
    assert re.sub(r"[\d.]+", "", made).split() == re.sub(r"[\d.]+", "", shown).split()
    assert numbers(shown) == pytest.approx(numbers(made), rel=0.01, abs=0.02)
    assert (tmp_path / "stanford.png").exists()


def test_every_column_of_the_table_of_epochs_is_described():
    rows = re.findall(r"^\| `([\w.]+)` \| (\w+) \| (.*) \|$", PAGE, re.MULTILINE)
    described = {name: (kind, what) for name, kind, what in rows}
    assert described == COLUMNS | {f"..._{name}": one for name, one in GROUP_COLUMNS.items()}


def test_regions_are_named_as_in_pictures():
    shown = PAGE.split("| region |")[1].split("\n\n")[0]
    assert re.findall(r"^\| ([a-z ]+) \|", shown, re.MULTILINE) == [one.value for one in Region]
