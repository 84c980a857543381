"""What inspect prints."""

from typing import Any

from experiments.evaluation.markdown import grid
from experiments.evaluation.text import escaped


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def _lines(f: dict[str, Any]) -> list[str]:
    step, speed = f["step_s"], f["speed_mps"]
    lines = [f"format: {f['format']}"]
    if f["timed"]:
        lines.append(
            f"{f['epochs']} epochs, {f['first_s']:.10g} to {f['last_s']:.10g} s: "
            f"{f['duration_s']:.6g} s"
        )
    if f["timed"] and step is not None:
        uneven = f", {f['uneven_steps']} of them uneven" if f["uneven_steps"] else ""
        lines.append(
            f"rate: {1.0 / step:.4g} Hz, steps of {step:.4g} s{uneven}; the longest is "
            f"{f['longest_step_s']:.4g} s"
        )
    positions = f["positions"]
    lines.append(f"positions: {positions['from']}; {positions['known']} known")
    if speed:
        shares = ", ".join(f"{v:.2f} m/s at {name}" for name, v in speed.items() if name != "max")
        lines.append(f"speed: {shares}, {speed['max']:.2f} m/s at most")
    if f["line_of_sight"] is not None:
        lines.append(f"line of sight: in {_percent(f['line_of_sight'])} of the epochs")
    return [*lines, *(f"{what}: {fact}" for what, fact in f["facts"].items())]


def _anchors(anchors: list[dict[str, Any]]) -> str:
    rows = [
        [
            f"{number}{', base station' if number == 1 else ''}",
            *(f"{x:.2f}" for x in anchor["position_m"]),
            f"{anchor['seen']} ({_percent(anchor['share'])})",
        ]
        for number, anchor in enumerate(anchors, start=1)
    ]
    return grid(["anchor", "x m", "y m", "z m", "seen"], rows) + "\n"


def summary_markdown(figures: dict[str, Any]) -> str:
    """The figures of a data set, as :meth:`Summary.figures` has them, as Markdown."""
    parts = ["".join(f"- {escaped(line)}\n" for line in _lines(figures))]
    if figures["anchors"]:
        parts.append(_anchors(figures["anchors"]))
    problems = figures["problems"]
    said = "".join(f"- {escaped(problem)}\n" for problem in problems)
    parts.append(f"{len(problems)} problem{'s' * (len(problems) != 1)} found:\n\n{said}"
                 if problems else "No problems found.\n")  # fmt: skip
    return "\n".join(parts)
