"""What localize --diagnose prints."""

from collections.abc import Sequence
from typing import Any

from experiments.evaluation.markdown import grid
from mmwave_env.localization.diagnosis import AS_IT_IS, Finding


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _verdict(findings: Sequence[Finding]) -> str:
    """One sentence."""
    best = findings[0]
    if best.contradictions:
        return (
            "None of these makes the log consistent. Look at the scene, at angles in the frame of "
            "the antenna instead of the map (docs/data.md, Angles), and at the radio."
        )
    if best.hypothesis == AS_IT_IS:
        return "The log is consistent as it is."
    return f"The log is consistent if {best.hypothesis}. It was not changed."


def diagnosis_markdown(findings: Sequence[Finding]) -> str:
    """A verdict and a table of all hypotheses, the best first."""
    groups = next((list(f.nis_per_dof) for f in findings if f.nis_per_dof), [])
    header = ["hypothesis", *groups, "log-likelihood", "consistent"]
    rows = [
        [
            f.hypothesis,
            *(_number(f.nis_per_dof.get(group)) for group in groups),
            _number(f.log_likelihood),
            "no" if f.contradictions else "yes",
        ]
        for f in findings
    ]
    return (
        f"{_verdict(findings)}\n\n{grid(header, rows)}\n\nMedian NIS / dof of each group, 1 if "
        "right; log-likelihood of the numbers in the file, per epoch. - : no track is possible.\n"
    )


def diagnosis_figures(findings: Sequence[Finding]) -> dict[str, Any]:
    """The same for a JSON file, with what contradicts each hypothesis."""
    hypotheses = [
        {**f._asdict(), "contradictions": [c._asdict() for c in f.contradictions]} for f in findings
    ]
    return {"verdict": _verdict(findings), "hypotheses": hypotheses}
