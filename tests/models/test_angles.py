"""Tests that the formulas in docs/data.md convert angles of other conventions to ours."""

import numpy as np
import pytest

from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import exact_rows
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
TABLE = PAGE.split("<!-- conversions:")[1].split("<!-- end of conversions")[0]
ROWS = [  # for each row: a description, then formulas of arrival, elevation and departure
    [cell.strip(" `") for cell in row.strip("|").split("|")]
    for row in TABLE.splitlines()
    if row.startswith("| ") and "you have" not in row
]


def between(p, q):
    """Return azimuth and elevation, in degrees, of the direction from p to q."""
    d = np.subtract(q, p)
    return np.degrees(np.arctan2(d[1], d[0])), np.degrees(np.arctan2(d[2], np.hypot(d[0], d[1])))


def reported(anchor, user):
    """Return a dict for each row: the angles (deg) that a receiver of this convention reports."""
    out, elevation = between(anchor, user)
    back, at_user = between(user, anchor)
    return [
        {"arrival": back, "elevation": at_user, "departure": out},
        {"zenith": 90.0 - elevation},
        {"arrival": 63.0 - out, "departure": 63.0 - back, "x_axis": 63.0},
        {"arrival": out - 25.0, "anchor_yaw": 25.0, "departure": back + 70.0, "user_yaw": -70.0},
    ]


@pytest.mark.parametrize("user", [(30.0, 9.0, 1.5), (-20.0, -4.0, 1.5), (3.0, -40.0, 12.0)])
def test_every_conversion_on_the_page_gives_our_angles(user):
    anchor = (1.0, 2.0, 10.0)
    rows = exact_rows(user, [0.0] * 3, [anchor], 1.0, Layout(1))
    right = np.degrees(rows[1:4])
    receivers = reported(anchor, user)
    assert len(ROWS) == len(receivers)
    for (_, *formulas), names in zip(ROWS, receivers, strict=True):
        for formula, angle in zip(formulas, right, strict=True):
            if formula:
                turn = eval(formula, {}, names) - angle
                assert (turn + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9), formula
