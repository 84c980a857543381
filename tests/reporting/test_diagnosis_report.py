"""Tests of the report of a diagnosis: its verdict, its notes and its table."""

import pytest

from experiments.reporting.log_report import diagnosis_markdown, verdict
from mmwave_env.localization.contradictions import Contradiction
from mmwave_env.localization.readings import AS_IT_IS, Finding
from mmwave_env.models.scene import SCENES

DOUBT = Contradiction("anchor 2", "NIS / dof 9", "0.2 to 5")
FITS = {"anchor 1": 1.1, "anchor 2": 0.6, "Doppler": None}
AS_IS = Finding(AS_IT_IS, FITS, -1.0, [], "", SCENES["street"])
WRONG = AS_IS._replace(contradictions=[DOUBT])
TURNED = AS_IS._replace(hypothesis="azimuths are turned", cure="write it", shared=True)
NEGATED = AS_IS._replace(hypothesis="signs differ", cure="negate")
CASES = {  # words of the verdict -> findings
    "The log is consistent as it is.": [AS_IS],
    "The log is consistent if signs differ. It was not changed. To correct it, negate": [
        NEGATED,
        WRONG,
    ],
    "No hypothesis makes the log consistent. anchor 2: found NIS / dof 9, expected": [WRONG],
    "The log looks as if azimuths are turned; protection levels do not hold": [TURNED, AS_IS],
    "is near 1. Even without this: anchor 2: found NIS / dof 9, expected 0.2 to 5. It was not": [
        TURNED._replace(contradictions=[DOUBT]),
        WRONG,
    ],
}


@pytest.mark.parametrize("words", CASES)
def test_the_verdict_is_about_the_best_finding(words):
    assert words in verdict(CASES[words])


def test_notes_stand_between_verdict_and_table():
    findings = [NEGATED, WRONG]
    text = diagnosis_markdown(findings, ["the clock jumps"])
    said, note, table, *_ = text.split("\n\n")
    assert said == verdict(findings) and note == "- the clock jumps"
    rows = [line.split(" | ") for line in table.splitlines()]
    assert rows[2] == ["| signs differ", "0.6", "-", "yes |"]
    assert rows[3] == ["| as it is", "0.6", "-", "no |"]
    assert "\n\n- " not in diagnosis_markdown([AS_IS], [])


def test_a_shared_error_needs_no_table_of_hypotheses_that_do_not_see_it():
    assert "| as it is" not in diagnosis_markdown([TURNED, AS_IS], [])
