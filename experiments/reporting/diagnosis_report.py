"""The report of ``localize --diagnose``: facts about a log, and its likely mistakes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.console.output import grid
from mmwave_env.io.files import Json
from mmwave_env.localization.readings import AS_IT_IS, Finding
from mmwave_env.logs.log import Log
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.scene import Scene

UNSEEN = "protection levels do not hold, even where NIS is near 1"
_ALIKE = 0.02  # difference of mean log-likelihoods of hypotheses that can't be told apart
_UNEVEN = 0.1  # tolerated difference between a time step and the usual step, as a fraction


def log_facts(log: Log, scene: Scene) -> Json:
    """Return facts about a log: its times, how often each anchor is measured, and problems."""
    links = log.visible_links
    steps = np.diff(log.time_s)
    step_s = float(np.median(steps)) if len(steps) else None
    usual_s = step_s or 0.0
    irregular: dict[str, Any] = {
        f"gaps of more than {GAP_S:g} s, after which a new track begins": steps > GAP_S,
        f"steps that differ from {usual_s:.4g} s by more than 10 %": abs(steps - usual_s)
        > _UNEVEN * usual_s,
        "epochs in which no anchor was measured": ~links.any(axis=1),
    }
    for name, incomplete in zip(log.layout.group_names, log.incomplete.T, strict=True):
        irregular[f"epochs in which {name} lacks some values and so counts as missing"] = incomplete
    problems = [f"{words}: {epochs.sum()}" for words, epochs in irregular.items() if epochs.any()]
    counts = links.sum(axis=0).tolist()
    problems += [
        f"anchor {a + 1} was never measured" for a, count in enumerate(counts) if not count
    ]
    if log.damage:
        problems.append(str(log.damage))
    return {
        "epochs": len(log),
        "first_s": float(log.time_s[0]),
        "last_s": float(log.time_s[-1]),
        "step_s": step_s,
        "anchors": [
            {"position_m": anchor, "seen": count, "share": count / len(log)}
            for anchor, count in zip(scene.anchors_m.tolist(), counts, strict=True)
        ],
        "problems": problems,
    }


def facts_markdown(facts: Json) -> str:
    """Return the facts about a log as Markdown."""
    step_s = facts["step_s"]
    rate = f", {1.0 / step_s:.4g} Hz" if step_s else ""
    times = f"{facts['first_s']:.13g} to {facts['last_s']:.13g} s{rate}"
    rows = [
        [
            f"{number}{', base station' if number == 1 else ''}",
            *(f"{x:.2f}" for x in anchor["position_m"]),
            f"{anchor['seen']} ({anchor['share']:.1%})",
        ]
        for number, anchor in enumerate(facts["anchors"], start=1)
    ]
    anchors = grid(["anchor", "x m", "y m", "z m", "seen"], rows)
    problems = facts["problems"] or ["no problems in the file's format"]
    listed = "".join(f"- {problem}\n" for problem in problems)
    return f"- {facts['epochs']} epochs, {times}\n\n{anchors}\n\n{listed}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def verdict(findings: Sequence[Finding]) -> str:
    """Return sentences on what is wrong with the log and how to correct it."""
    best = findings[0]
    if best.shared:
        doubts = [f" Even without this: {doubt}." for doubt in best.contradictions]
        return (
            f"The log looks as if {best.hypothesis}; {UNSEEN}.{''.join(doubts)} It was not "
            f"changed. To correct it, {best.cure} (docs/world-off.md)."
        )
    if best.contradictions:
        as_it_is = next(f.contradictions for f in findings if f.hypothesis == AS_IT_IS)
        return (
            f"No hypothesis makes the log consistent. {'; '.join(map(str, as_it_is))}. Check the "
            "scene, the radio, the receiver's clock (--clock offset if it is its own, --clock free "
            "if it jumps), and whether the angles are in the antenna's frame instead of the map's "
            "(docs/data.md, Angles)."
        )
    if best.hypothesis == AS_IT_IS:
        return "The log is consistent as it is."
    others = [f" It fits as well if {f.hypothesis}; then, {f.cure}." for f in _alike(findings)]
    return (
        f"The log is consistent if {best.hypothesis}. It was not changed. To correct it, "
        f"{best.cure} (docs/data.md).{''.join(others)}"
    )


def _alike(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings that are as consistent and likely as the first one."""
    best = findings[0].log_likelihood
    return [
        f
        for f in findings[1:]
        if not f.contradictions
        and best is not None
        and f.log_likelihood is not None
        and abs(f.log_likelihood - best) < _ALIKE
    ]


def diagnosis_markdown(findings: Sequence[Finding], notes: Sequence[str]) -> str:
    """Return a verdict, notes, and a table of hypotheses that lead to a track, the best first."""
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
    listed = [f"- {note}\n" for note in notes]
    if listed:
        listed.append("\n")
    others = sum(not f.nis_per_dof for f in findings)
    impossible = f" {others} other hypotheses give no track; --json lists them." if others else ""
    if findings[0].shared:  # other hypotheses do not see what links share
        return f"{verdict(findings)}\n\n{''.join(listed)}"
    return (
        f"{verdict(findings)}\n\n{''.join(listed)}{grid(header, rows)}\n\n"
        'The column "anchors" shows the median NIS / dof of the anchor whose median is farthest '
        'from 1; the column "Doppler" shows the median NIS / dof of the Doppler shift. In a '
        "consistent log, the user is also mostly below the base station, and SNR and Doppler shift "
        f"are plausible. Of several rows with yes, the first is the most likely.{impossible}\n"
    )
