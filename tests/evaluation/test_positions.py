"""Figures of positions as tables show them."""

import pytest

from experiments.console.tables import HEADERS
from experiments.evaluation.positions import HEADER, exceeded, meters, percent, positions_markdown
from mmwave_env.localization.position_errors import PositionErrors


@pytest.mark.parametrize(
    ("share", "shown"),
    [(None, "-"), (0.0, "0.0 %"), (1.0, "100.0 %"), (0.5, "50.0 %"), (0.0123, "1.2 %"),
     (1e-3, "0.10 %"), (0.00089, "0.089 %"), (0.99911, "99.911 %"), (0.9988, "99.88 %"),
     (1e-9, "0.0 %")],
)  # fmt: skip
def test_rare_shares_keep_two_digits(share, shown):
    assert percent(share) == shown


@pytest.mark.parametrize(
    ("value", "shown"),
    [(None, "-"), (0.0, "0.00"), (0.01234, "0.0123"), (0.2, "0.200"), (10.0, "10.0"),
     (99.96, "100"), (1234.4, "1234")],
)  # fmt: skip
def test_distances_have_three_digits(value, shown):
    assert meters(value) == shown


def test_a_share_stands_before_its_interval():
    assert exceeded({"share": 0.0027, "ci95": [0.0021, 0.0035]}) == "0.27 % [0.21, 0.35]"
    assert exceeded({"share": None, "ci95": None}) == "-"


def test_a_table_has_a_row_for_each_kind_of_error_also_where_there_are_none():
    header, rule, *rows = positions_markdown(
        "policy", {"a|b": PositionErrors().figures()}, 1e-3
    ).splitlines()[:4]
    assert header == f"| policy | {' | '.join(HEADER)} |" and not set(HEADER) & {*HEADERS.values()}
    assert rule.count("|") == header.count("|")
    cells = " | -" * len(HEADER)
    assert rows == [rf"| a\|b, horizontal{cells} |", rf"| a\|b, vertical{cells} |"]
