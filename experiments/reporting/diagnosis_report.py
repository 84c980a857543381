"""Report that localize --diagnose prints about likely mistakes."""

from collections.abc import Sequence
from typing import Any

from experiments.console.tables import grid
from mmwave_env.localization.diagnosis import AS_IT_IS, Finding


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _verdict(findings: Sequence[Finding]) -> str:
    """Return a sentence on what is wrong and how to correct it."""
    best = findings[0]
    if best.contradictions:
        return (
            "None of these makes the log consistent. Look at the scene, at angles in the frame of "
            "the antenna instead of the map (docs/data.md, Angles), and at the radio."
        )
    if best.hypothesis == AS_IT_IS:
        return "The log is consistent as it is."
    return (
        f"The log is consistent if {best.hypothesis}. It was not changed. To mend it, {best.cure} "
        "(docs/data.md)."
    )


def diagnosis_markdown(findings: Sequence[Finding]) -> str:
    """Return a verdict and a table of the hypotheses that allow a track, the best first."""
    header = ["hypothesis", "anchors", "Doppler", "consistent"]
    rows = [
        [
            f.hypothesis,
            _number(f.worst_anchor),
            _number(f.nis_per_dof.get("Doppler")),
            "no" if f.contradictions else "yes",
        ]
        for f in findings
        if f.nis_per_dof
    ]
    others = sum(not f.nis_per_dof for f in findings)
    impossible = f" {others} other mistakes allow no track; --json names them." if others else ""
    return (
        f"{_verdict(findings)}\n\n{grid(header, rows)}\n\nMedian NIS / dof, of the anchor that is "
        "farthest from 1, and of the Doppler shift. Consistent also asks for a user mostly below "
        f"the base station and for an SNR and a Doppler shift that can be.{impossible}\n"
    )


def diagnosis_figures(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the verdict and the contradictions of every hypothesis, for a JSON file."""
    hypotheses = [
        {**f._asdict(), "contradictions": [c._asdict() for c in f.contradictions]} for f in findings
    ]
    return {"verdict": _verdict(findings), "hypotheses": hypotheses}
