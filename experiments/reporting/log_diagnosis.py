"""Report of ``mmwave-loc localize --diagnose``: facts about a log, and its likely mistakes."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.console.options import AUTO, LogArgs
from experiments.console.progress import progress
from experiments.console.provenance import provenance
from experiments.console.tables import grid, show
from experiments.reporting.log_choice import modes_of
from mmwave_env.io.files import Json, write_json
from mmwave_env.localization.contradictions import Contradiction
from mmwave_env.localization.diagnosis import AS_IT_IS, Finding, diagnose
from mmwave_env.localization.radio_choice import nearest_radio
from mmwave_env.logs.log import Log, read_log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import Scene

_UNEVEN = 0.1  # tolerated difference between a time step and the usual step, as a fraction


def diagnosed(
    args: LogArgs, path: Path, scene: Scene, doubts: Callable[[], list[Contradiction]]
) -> None:
    """Show facts about a log, and whether undoing a likely mistake makes the log consistent.

    If its first epochs are consistent as they are, ``doubts`` returns what contradicts its track.

    Raises:
        LogError: the log is damaged.
        ValueError: no epoch determines a position with which a track could begin.
    """
    log = _read(path, scene, args.snr)
    radio = nearest_radio(log, scene) if args.radio == AUTO else args.radio
    with progress("looking for likely mistakes"):
        findings = diagnose(log, scene, radio_from(radio), modes_of(args, radio)[-1])
        best = findings[0]
        if best.hypothesis == AS_IT_IS and not best.contradictions:
            findings[0] = best._replace(contradictions=doubts())
        facts = log_facts(log, scene)
    if args.json:
        hypotheses = [
            {**f._asdict(), "contradictions": [c._asdict() for c in f.contradictions]}
            for f in findings
        ]
        figures = {"facts": facts, "verdict": _verdict(findings), "hypotheses": hypotheses}
        write_json(args.json, provenance("localize", args) | figures)
    show(f"{facts_markdown(facts)}\n{diagnosis_markdown(findings)}")
    if log.damage:
        raise log.damage


def _read(path: Path, scene: Scene, snr_db: float | None) -> Log:
    read = partial(read_log, odometry=False, limits=False)
    with suppress(LogError):  # columns may be missing
        log = read(path, scene)
        if log.visible[:, 0].any():
            return log
    return read(path, scene, partial=True, snr_db=snr_db)


def log_facts(log: Log, scene: Scene) -> Json:
    """Return facts about a log: its times, how often each anchor is measured, and problems."""
    links = log.visible[:, : log.layout.anchors]
    steps = np.diff(log.time_s)
    step_s = float(np.median(steps)) if len(steps) else None
    irregular: dict[str, Any] = {
        f"gaps of more than {GAP_S:g} s, after which a new track begins": steps > GAP_S
    }
    if step_s:
        words = f"steps that differ from {step_s:.4g} s by more than 10 %"
        irregular[words] = abs(steps - step_s) > _UNEVEN * step_s
    irregular["epochs in which no anchor was measured"] = ~links.any(axis=1)
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


def _verdict(findings: Sequence[Finding]) -> str:
    """Return sentences on what is wrong with the log and how to correct it."""
    best = findings[0]
    if best.contradictions:
        as_it_is = next(f.contradictions for f in findings if f.hypothesis == AS_IT_IS)
        return (
            f"No hypothesis makes the log consistent. {'; '.join(map(str, as_it_is))}. Check the "
            "scene, the radio, the receiver's clock (--clock offset if it is its own), and whether "
            "the angles are in the antenna's frame instead of the map's (docs/data.md, Angles)."
        )
    if best.hypothesis == AS_IT_IS:
        return "The log is consistent as it is."
    return (
        f"The log is consistent if {best.hypothesis}. It was not changed. To correct it, "
        f"{best.cure} (docs/data.md)."
    )


def diagnosis_markdown(findings: Sequence[Finding]) -> str:
    """Return a verdict and a table of the hypotheses that lead to a track, the best first."""
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
    impossible = f" {others} other hypotheses give no track; --json lists them." if others else ""
    return (
        f"{_verdict(findings)}\n\n{grid(header, rows)}\n\n"
        'The column "anchors" shows the median NIS / dof of the anchor whose median is farthest '
        'from 1; the column "Doppler" shows the median NIS / dof of the Doppler shift. In a '
        "consistent log, the user is also mostly below the base station, and SNR and Doppler shift "
        f"are plausible. Of several rows with yes, the first is the most likely.{impossible}\n"
    )
