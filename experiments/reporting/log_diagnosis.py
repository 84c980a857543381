"""Report of ``mmwave-loc localize --diagnose``: facts about a log, and its likely mistakes."""

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from experiments.console.options import AUTO, LogArgs
from experiments.console.progress import progress
from experiments.console.provenance import provenance
from experiments.console.tables import grid, show
from experiments.reporting.log_choice import modes_of
from mmwave_env.io.files import Json, write_json
from mmwave_env.localization.diagnosis import AS_IT_IS, Finding, diagnose
from mmwave_env.localization.radio_choice import nearest_radio
from mmwave_env.logs.log import LogBlock, read_log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.logs.truth import Truth
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.mobility import FASTEST_MPS

_UNEVEN = 0.1  # tolerated difference between a time step and the usual step, as a fraction


class _Sums:
    """Running sums over the epochs of a log, because a long log may not fit in memory."""

    def __init__(self, anchors: int) -> None:
        self.epochs = 0
        self.links = np.zeros(anchors, np.int64)
        self.irregular: Counter[str] = Counter()  # number of irregular epochs, by description
        self.first_s = self.last_s = self.step_s = np.nan  # step_s: the first block's median step
        self.distance_m = self.moving_s = self.fastest_mps = 0.0
        self._before = np.empty((0, 4))  # time and true position of the last epoch

    def add(self, block: LogBlock, position_m: Array) -> None:
        """Add a block with its true positions (T, 3), NaN where unknown."""
        rows = np.column_stack([block.time_s, position_m])
        changes = np.diff(np.concatenate([self._before, rows]), axis=0)
        steps = changes[:, 0]
        moved = np.linalg.norm(changes[:, 1:], axis=1)
        self.first_s = self.first_s if self.epochs else float(block.time_s[0])
        self._before = rows[-1:]
        self.last_s = float(block.time_s[-1])
        self.epochs += len(rows)
        if np.isnan(self.step_s) and len(steps):
            self.step_s = float(np.median(steps))
        known = np.isfinite(moved) & (steps <= GAP_S)
        speed = moved[known] / steps[known]
        self.distance_m += float(moved[known].sum())
        self.moving_s += float(steps[known].sum())
        self.fastest_mps = max(self.fastest_mps, float(speed.max(initial=0.0)))
        links = block.visible[:, : block.layout.anchors]
        self.links += links.sum(axis=0)
        uneven = abs(steps - self.step_s) > _UNEVEN * self.step_s
        counted = {
            f"gaps of more than {GAP_S:g} s, after which a new track begins": steps > GAP_S,
            f"steps that differ from {self.step_s:.4g} s by more than 10 %": uneven,
            f"steps of the ground truth faster than {FASTEST_MPS:g} m/s": speed > FASTEST_MPS,
            "epochs in which no anchor was measured": ~links.any(axis=1),
        } | {
            f"epochs in which {name} lacks some values and so counts as missing": incomplete
            for name, incomplete in zip(block.layout.group_names, block.incomplete.T, strict=True)
        }
        self.irregular.update({words: int(epochs.sum()) for words, epochs in counted.items()})

    def problems(self) -> list[str]:
        """Return a phrase about each kind of irregularity, with its count."""
        never = [f"anchor {a + 1} was never measured" for a in np.flatnonzero(self.links == 0)]
        return [f"{words}: {count}" for words, count in self.irregular.items() if count] + never


def diagnosed(args: LogArgs, log: Path, scene: Scene, truth_file: Path | None) -> None:
    """Show facts about a log, and whether undoing a likely mistake makes the log consistent.

    Raises:
        LogError: the log is damaged.
        ValueError: no epoch determines a position with which a track could begin.
    """
    read = partial(read_log, odometry=False, limits=False)
    try:
        blocks = read(log, scene)
    except LogError:  # columns are missing
        blocks = read(log, scene, partial=True, snr_db=args.snr)
    first = next(blocks)
    radio = nearest_radio(first, scene) if args.radio == AUTO else args.radio
    with progress("looking for likely mistakes"):
        findings = diagnose(first, scene, radio_from(radio), modes_of(args, radio)[-1])
        truth = Truth(truth_file) if truth_file else None
        facts, damage = log_facts(chain([first], blocks), scene, truth)
    if args.json:
        hypotheses = [
            {**f._asdict(), "contradictions": [c._asdict() for c in f.contradictions]}
            for f in findings
        ]
        figures = {"facts": facts, "verdict": _verdict(findings), "hypotheses": hypotheses}
        write_json(args.json, provenance("localize", args) | figures)
    show(f"{facts_markdown(facts)}\n{diagnosis_markdown(findings)}")
    if damage:
        raise damage


def log_facts(
    blocks: Iterable[LogBlock], scene: Scene, truth: Truth | None
) -> tuple[Json, LogError | None]:
    """Read a log to its end or to its first error; return facts about it, and the error."""
    sums = _Sums(len(scene.anchors_m))
    damage = None
    try:
        for block in blocks:
            unknown = np.full((len(block), 3), np.nan)
            sums.add(block, truth.at(block.time_s).position_m if truth else unknown)
    except LogError as error:
        damage = error
    epochs = max(sums.epochs, 1)
    speed = None
    if sums.moving_s:
        speed = {"mean": sums.distance_m / sums.moving_s, "max": sums.fastest_mps}
    return {
        "epochs": sums.epochs,
        "first_s": sums.first_s,
        "last_s": sums.last_s,
        "step_s": None if np.isnan(sums.step_s) else sums.step_s,
        "speed_mps": speed,
        "anchors": [
            {"position_m": anchor.tolist(), "seen": int(count), "share": float(count / epochs)}
            for anchor, count in zip(scene.anchors_m, sums.links, strict=True)
        ],
        "problems": sums.problems() + [str(damage)] * (damage is not None),
    }, damage


def facts_markdown(facts: Json) -> str:
    """Return the facts about a log as Markdown."""
    f = facts
    step = facts["step_s"]
    speed = facts["speed_mps"]
    rate = f", {1.0 / step:.4g} Hz" if step else ""
    lines = [f"{f['epochs']} epochs, {f['first_s']:.12g} to {f['last_s']:.12g} s{rate}"]
    if speed:
        mean = speed["mean"]
        most = speed["max"]
        lines.append(f"true speed: {mean:.2f} m/s on average, {most:.2f} m/s at most")
    rows = [
        [
            f"{number}{', base station' if number == 1 else ''}",
            *(f"{x:.2f}" for x in anchor["position_m"]),
            f"{anchor['seen']} ({anchor['share']:.1%})",
        ]
        for number, anchor in enumerate(f["anchors"], start=1)
    ]
    table = grid(["anchor", "x m", "y m", "z m", "seen"], rows)
    lists = lines, f["problems"] or ["no problems in the file's format"]
    above, below = ("".join(f"- {line}\n" for line in items) for items in lists)
    return f"{above}\n{table}\n\n{below}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _verdict(findings: Sequence[Finding]) -> str:
    """Return sentences on what is wrong with the log and how to correct it."""
    best = findings[0]
    if best.contradictions:
        as_it_is = next(f.contradictions for f in findings if f.hypothesis == AS_IT_IS)
        return (
            f"No hypothesis makes the log consistent. {'; '.join(map(str, as_it_is))}. Check the "
            "scene, the radio, and whether the angles are in the antenna's frame instead of the "
            "map's (docs/data.md, Angles)."
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
