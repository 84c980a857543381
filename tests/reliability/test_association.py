"""What hidden anchors cost: the study's figures, and the study in small."""

import json

import pytest

from experiments.reliability.association import Outcome, summary
from tests.cli import assert_one_clear_line, command, succeed


def test_a_summary_counts_what_happened():
    one = Outcome(1.0, 1.05, 100, 4, 0, 200, 190, 5)
    two = Outcome(3.0, 3.75, 300, 0, 20, 600, 570, 3)
    found = summary([one, two])
    assert found["ratio"] == pytest.approx(4.8 / 4.0)
    assert found["median_ratio"] == pytest.approx(1.15)
    assert found["difference_m"]["mean"] == pytest.approx(0.4)
    shares = ("episodes_within_10_percent", "wrong_epochs_share", "untracked_epochs_share",
              "found_links_share", "wrong_links_share")  # fmt: skip
    assert [found[name] for name in shares] == pytest.approx([0.5, 0.01, 0.05, 0.95, 0.01])


def test_no_episodes_are_refused():
    done = command("association", "--episodes", "0")
    assert_one_clear_line(done, "episodes: found 0, expected at least 1")


@pytest.mark.slow
def test_a_short_study_keeps_the_tracks(tmp_path):
    file = tmp_path / "association.json"
    shown = succeed("association", "--episodes", "2", "--seed", "5000000", "--json", file)
    cases = json.loads(file.read_text())["cases"]
    assert len(cases) == 7 and all(f"| {name} |" in shown for name in cases)
    assert cases["all simulated"]["episodes"] == 8
    assert cases["all simulated"]["ratio"] < 1.1
    assert all(case["wrong_epochs_share"] < 0.02 for case in cases.values())
