"""The reports that ``localize`` prints: about a track, or about a log and its likely mistakes."""

from collections.abc import Iterator, Sequence

import numpy as np

from experiments.console.output import escaped, grid
from experiments.evaluation.positions import positions_markdown
from mmwave_env.filters.modes import DESIGN_LIMIT_MPS
from mmwave_env.io.files import Json
from mmwave_env.localization.readings import AS_IT_IS, Finding
from mmwave_env.logs.log import Log
from mmwave_env.metrics import HEADERS, INFO_KEYS
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.scene import Scene


def _number(value: float | None, digits: str = ".3f") -> str:
    return "-" if value is None else f"{value:{digits}}"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _course(f: Json) -> Iterator[str]:
    """Yield sentences about the course of a track."""
    speed = f["speed_mps"]
    epochs = f["epochs"]
    yield (
        f"{epochs} epochs, {f['first_s']:.13g} to {f['last_s']:.13g} s; estimated speed "
        f"{speed['mean']:.2f} m/s on average, {speed['max']:.2f} m/s at most"
    )
    if f["skipped"]:
        yield f"{f['skipped']} epochs before the first position were skipped"
    if f["restarts"] or f["dropped"]:
        event = f"restarted {_times(f['restarts'])} after" if f["restarts"] else "ended at"
        gaps = f"gaps of more than {GAP_S:g} s, or where epochs contradicted the track"
        if "association" in f:
            gaps += ", or where another track explained the paths better"
        yield f"{event} {gaps}; {f['dropped']} epochs skipped"
    shares = ", ".join(f"{escaped(name)} {_percent(n / epochs)}" for name, n in f["modes"].items())
    switches = f", switched {_times(f['switches'])}" if len(f["modes"]) > 1 else ""
    yield f"modes {escaped(f['rule'])}: {shares} of the epochs{switches}"
    yield f"measurement noise of the radio profile {escaped(f['radio'])}"
    expected = " and ".join(f"{size:.2f} m {axis}" for axis, size in f["expected_rmse_m"].items())
    yield f"expected error (RMS, by the track's covariances): {expected}"
    if f["range_step_m"]:
        yield (
            f"ranges come in steps of {f['range_step_m']:.3g} m; their noise contains the rounding"
        )
    yield f"estimated height {f['height_m']:.2f} m on average, above the zero of the scene"
    if "clock" in f:
        ahead = f["clock"]["range_bias_m"] / SPEED_OF_LIGHT * 1e9
        deviation = f["clock"]["deviation_m"] / SPEED_OF_LIGHT * 1e9
        side = "behind" if ahead < 0.0 else "ahead"
        yield f"in the end the user's clock is {abs(ahead):.1f} ± {deviation:.1f} ns {side}"
    fast = speed["epochs_above_design_limit"]
    if f["algorithm_1"] and len(f["modes"]) > 1 and fast:
        yield (
            f"warning: {fast} epochs are above {DESIGN_LIMIT_MPS:g} m/s, outside the design window "
            f"of the speed rule; {escaped(list(f['modes'])[1])} ran in them"
        )
    if "association" in f:
        counts = f["association"]
        between = counts["without_track"]
        yield (
            f"{counts['paths']} paths, {counts['false']} of them false; the track was found "
            f"{_times(counts['starts'])}"
        )
        if counts["incomplete"]:
            yield f"{counts['incomplete']} paths with only some of their values were left out"
        if between["epochs"]:
            yield (
                f"{between['epochs']} epochs have no track; their {between['paths']} paths were "
                "assigned to no anchor"
            )


def _learned_map(learned: Json) -> str:
    """Return the images of a learned map with their walls, and the share of explained paths."""
    rows = [
        [
            f"anchor {image['anchor']}",
            *map("{:.1f} ± {:.1f}".format, image["position_m"], image["sigma_m"]),
            image["paths"],
            "{:.3f} x {:+.3f} y = {:.1f}".format(
                *image["wall"]["normal"], image["wall"]["offset_m"]
            ),
        ]
        for image in learned["images"]
    ]
    table = grid(["learned", "x m", "y m", "z m", "paths", "wall between"], rows) if rows else ""
    share = _percent(learned["explained"] / learned["paths"])
    return (
        f"{table}\n\nWhile the map was learned, the base station and its images explained {share} "
        f"of {learned['paths']} paths, and a track began {_times(learned['starts'])}.\n"
    )


def _groups(groups: Json) -> str:
    header = ["measured", "seen", "rejected", "incomplete", "NIS / dof", "NIS in 95 % bounds"]
    rows = [
        [
            name,
            g["seen"],
            f"{g['rejected']} ({_percent(g['rejected_share'])})" if g["seen"] else "-",
            g["incomplete"],
            _number(g["nis_per_dof"]),
            _number(g["nis_in_bounds"]),
        ]
        for name, g in groups.items()
    ]
    return grid(header, rows)


def _accuracy(truth: Json, epochs: int) -> str:
    metrics = [name for name in INFO_KEYS if name != "divergence_rate"]
    header = ["track", *(HEADERS[m].replace("in 95", "NEES in 95") for m in metrics)]
    rows = [[name, *(_number(row[m]) for m in metrics)] for name, row in truth["tracks"].items()]
    low, high = truth["nees_interval"]
    over = "" if truth["rpe_s"] is None else f"RPE is computed over {truth['rpe_s']:.3g} s; "
    return (
        f"{grid(header, rows)}\n\n{truth['scored']} of {epochs} epochs have a true position. {over}"
        f"NEES should be {truth['nees_expected']} on average, and 95 % of its values should be "
        f"within [{low:.2f}, {high:.2f}].\n\n"
        f"{positions_markdown('track', truth['tracks'], truth['risk'], truth['levels'])}"
    )


def track_markdown(figures: Json) -> str:
    """Return, as Markdown, the results that ``localize`` collects about a track."""
    parts = ["".join(f"- {line}\n" for line in _course(figures))]
    if "map" in figures:
        parts.append(_learned_map(figures["map"]))
    if "association" in figures:
        counts = figures["association"]
        rows = [[name, n, counts["missed"][name]] for name, n in counts["associated"].items()]
        parts.append(grid(["anchor", "paths", "missed"], rows) + "\n")
    parts.append(_groups(figures["groups"]) + "\n")
    if "truth" in figures:
        parts.append(_accuracy(figures["truth"], figures["epochs"]))
    if figures["written"]:
        files = (f"{escaped(path)} ({content})" for path, content in figures["written"].items())
        parts.append(f"Written: {', '.join(files)}\n")
    return "\n".join(parts)


# --- the report of --diagnose

UNSEEN = "protection levels do not hold, even where NIS is near 1"
_ALIKE = 0.02  # difference of mean log-likelihoods of hypotheses that can't be told apart
_UNEVEN = 0.1  # tolerated difference between a time step and the usual step, as a fraction


def log_facts(log: Log, scene: Scene) -> Json:
    """Return facts about a log: its times, how often each anchor is measured, and problems."""
    links = log.visible_links
    steps = np.diff(log.time_s)
    step_s = float(np.median(steps)) if len(steps) else None
    usual_s = step_s or 0.0
    irregular = {
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
            _number(f.worst_anchor, ".3g"),
            _number(f.nis_per_dof.get("Doppler"), ".3g"),
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
        "are plausible. Rows judge the first epochs, the row as it is also the whole track. Of "
        f"several rows with yes, the first is the most likely.{impossible}\n"
    )
