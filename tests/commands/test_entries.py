"""Lists of names are folded where a terminal ends."""

import pytest

from experiments.cli.entries import entries


@pytest.mark.parametrize("width", [40, 60, 80])
def test_entries_are_folded_between_words_and_below_their_meaning(width):
    found = {"ekf": "short", "imm-best": "tuned IMM over modes that stand, cruise" * 3}
    whole = entries(found, 20)
    assert [line.split(maxsplit=1) for line in whole] == [[n, w.strip()] for n, w in found.items()]
    lines = entries(found, 20, width)
    assert max(map(len, lines)) <= width and " ".join(lines).split() == " ".join(whole).split()
    assert all(line[:20].strip() in ("ekf", "imm-best", "") for line in lines)
