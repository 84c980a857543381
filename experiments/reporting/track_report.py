"""The report that ``localize`` prints about a track."""

from collections.abc import Iterator

from experiments.console.output import escaped, grid
from experiments.evaluation.positions import KINDS, positions_markdown
from mmwave_env.filters.modes import DESIGN_LIMIT_MPS
from mmwave_env.io.files import Json
from mmwave_env.metrics import HEADERS, INFO_KEYS
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.prior import GAP_S

MOST_NAMED = 5  # number of restarts whose times are named


def _decimals(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _restarts(times_s: list[float]) -> str:
    """Return how often a track restarted, and when at first."""
    words = [f"{time_s:.13g} s" for time_s in times_s]
    if len(words) > MOST_NAMED:
        words[MOST_NAMED:] = ["..."]
    return f"restarted {_times(len(times_s))} ({', '.join(words)})"


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
        event = f"{_restarts(f['restarted_s'])} after" if f["restarts"] else "ended at"
        gaps = f"gaps of more than {GAP_S:g} s, or where the next epochs contradicted a start"
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
    rows = []
    for image in learned["images"]:
        pairs = zip(image["position_m"], image["sigma_m"], strict=True)
        wall = image["wall"]
        rows.append(
            [
                f"anchor {image['anchor']}",
                *(f"{x:.1f} ± {sigma:.1f}" for x, sigma in pairs),
                str(image["paths"]),
                "{:.3f} x {:+.3f} y = {:.1f}".format(*wall["normal"], wall["offset_m"]),
            ]
        )
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
            str(g["seen"]),
            f"{g['rejected']} ({_percent(g['rejected_share'])})" if g["seen"] else "-",
            str(g["incomplete"]),
            _decimals(g["nis_per_dof"]),
            _decimals(g["nis_in_bounds"]),
        ]
        for name, g in groups.items()
    ]
    return grid(header, rows)


def _accuracy(truth: Json, epochs: int) -> str:
    metrics = [name for name in INFO_KEYS if name != "divergence_rate"]
    header = ["track", *(HEADERS[m].replace("in 95", "NEES in 95") for m in metrics)]
    rows = [[name, *(_decimals(row[m]) for m in metrics)] for name, row in truth["tracks"].items()]
    low, high = truth["nees_interval"]
    kinds = {n: {k: row[k] for k in KINDS if k in row} for n, row in truth["tracks"].items()}
    over = "" if truth["rpe_s"] is None else f"RPE is computed over {truth['rpe_s']:.3g} s; "
    return (
        f"{grid(header, rows)}\n\n{truth['scored']} of {epochs} epochs have a true position. {over}"
        f"NEES should be {truth['nees_expected']} on average, and 95 % of its values should be "
        f"within [{low:.2f}, {high:.2f}].\n\n"
        f"{positions_markdown('track', kinds, truth['risk'], truth['levels'])}"
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
