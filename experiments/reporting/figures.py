"""Pictures in the project's style (publication.mplstyle), with one function for each picture.

There are pictures of position errors (CDF), of the consistency of filters, and
of a track from above, with its errors and modes (filters) over time.
"""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtr, chdtri

from mmwave_env.io.files import Json, atomic_path, require_writable
from mmwave_env.io.lookup import printable, require_extra
from mmwave_env.localization.localizer import Track
from mmwave_env.localization.position_errors import SHARES, error_sizes
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.ellipses import axes_of, ellipse
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.theme import THEMES, hex_of

STYLE = Path(__file__).with_name("publication.mplstyle")
UNDATED: dict[str, dict[str, Any]] = {  # metadata without dates, so equal pictures give equal files
    ".png": {},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
COLORS = [hex_of(color) for color in THEMES["light"].modes]  # colors of modes, as in videos

PHONE_IN = 4.6  # width of a picture for a phone, or for a column of text


def require_picture(option: str, path: Path) -> None:
    """Refuse, before any work, a picture file that can't be written; errors name ``option``.

    Raises:
        ValueError: the name does not end with .png, .svg or .pdf.
        MissingExtraError: matplotlib is not installed.
        OSError: the file can't be written.
    """
    if path.suffix.lower() not in UNDATED:
        raise ValueError(
            f"{option}: found {path}, expected a name that ends with {', '.join(UNDATED)}"
        )
    require_extra("matplotlib", "plot", f"{option}, a picture,")
    require_writable(path)


@contextmanager
def picture(path: Path, width_in: float, height_in: float) -> Iterator[Any]:
    """Yield a matplotlib figure to draw into, and write it to a .png, .svg or .pdf file at the end.

    The figure has the project's style, whatever matplotlib settings the user has. The file is
    written completely or not at all.
    """
    from matplotlib import style
    from matplotlib.figure import Figure
    from matplotlib.rcsetup import cycler

    # line styles distinguish more lines than there are colors
    looks = {"axes.prop_cycle": cycler(ls=["-", "--", ":"]) * cycler(color=COLORS)}
    with style.context([STYLE, looks], after_reset=True):
        figure = Figure(figsize=(width_in, height_in))
        yield figure
        suffix = path.suffix.lower()
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format=suffix[1:], metadata=UNDATED[suffix])


def labelled(axes: Sequence[Any]) -> list[Any]:
    """Return one artist in panels for each label, in the order of the labels."""
    artists: dict[str, Any] = {}
    for panel in axes:
        handles, labels = panel.get_legend_handles_labels()
        artists |= zip(labels, handles, strict=True)
    return [*artists.values()]


@contextmanager
def panels(path: Path) -> Iterator[Any]:
    """Yield the two panels of a picture, one above the other; at the end, draw a common legend."""
    with picture(path, PHONE_IN, PHONE_IN) as figure:
        axes = figure.subplots(2, 1)
        yield axes
        artists = labelled(axes)
        figure.legend(handles=artists, loc="outside lower left", ncols=2)
        figure.set_figheight(1.26 * PHONE_IN + 0.3 + 0.1 * (len(artists) + 1))


def plain_numbers(axis: Any) -> None:
    """Label a logarithmic axis 1, 10, 100, ... or, if it spans few decades, 1, 2, 5, 10, ..."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    wide = high / max(low, 1e-300) > 1e3
    axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:,g}")
    axis.set_minor_formatter(NullFormatter())


SMALLEST_M = 1e-3  # smaller errors are drawn at this value, since the axis is logarithmic
BOUNDS = "95 % bounds if consistent"
_SHARES = np.linspace(0.0, 0.999, 400)


def draw_error_cdf(errors_m: Mapping[str, Array], path: Path) -> None:
    """Draw the distributions (CDF) of contenders' horizontal and vertical errors (..., 3), m."""
    with panels(path) as both:
        for i, (axes, kind) in enumerate(zip(both, ("horizontal", "vertical"), strict=True)):
            for name, errors in errors_m.items():
                # the error of a known height is 0
                values = np.maximum(error_sizes(errors)[..., i], SMALLEST_M)
                axes.plot(np.quantile(values, _SHARES), _SHARES, label=printable(name))
            low = min(np.interp(0.03, line.get_ydata(), line.get_xdata()) for line in axes.lines)
            axes.set(xscale="log", ylim=(0.0, 1.0), xlabel=f"{kind} position error (m)")
            axes.set_xlim(left=low)
            axes.set_yticks(SHARES, [f"{100.0 * share:.0f} %" for share in SHARES])
            axes.set_ylabel("share of epochs with a smaller error")
            plain_numbers(axes.xaxis)


def draw_consistency(time_s: Array, nees: Mapping[str, Array], dof: int, path: Path) -> None:
    """Draw the NEES over time with its chi-square bounds, and the distribution of the NEES.

    Args:
        time_s: (T,) times since the first epoch of an episode.
        nees: contender -> NEES (n, T) of n episodes; each value sums over ``dof`` coordinates.
        path: file to write.
    """
    episodes = len(next(iter(nees.values())))
    low, high = chdtri(episodes * dof, [0.975, 0.025]) / (episodes * dof)
    with panels(path) as (over_time, whole):
        over_time.axhspan(low, high, color="0.7", lw=0.0, label=BOUNDS)
        whole.axline((0.0, 0.0), slope=1.0, color="0.5", lw=4.0, alpha=0.6, label="consistent")
        for name, values in nees.items():
            over_time.plot(time_s, values.mean(axis=0) / dof)
            inside = np.sort(chdtr(dof, values), axis=None)
            whole.plot(
                _SHARES,
                np.searchsorted(inside, _SHARES, "right") / inside.size,
                label=printable(name),
            )
        over_time.set(
            xlabel="time since the start (s)",
            yscale="log",
            ylabel=f"mean NEES / {dof}, of {episodes:,} episodes",
        )
        plain_numbers(over_time.yaxis)
        whole.set(
            xlabel="probability p",
            ylabel="share of NEES below\nthe chi-square p-quantile",
            xlim=(0.0, 1.0),
            ylim=(0.0, 1.0),
        )


TITLE_LETTERS = 80  # maximum number of characters in a line of the title
POINTS = 6000  # maximum number of epochs in a picture; a longer track is thinned
ELLIPSES = 15  # maximum number of ellipses along a track
_MOST_ENLARGED = 100.0  # largest factor by which ellipses are enlarged to be visible
_VISIBLE = 0.02  # smallest visible semi-axis of an ellipse, as a share of the track's extent


def draw_trajectory(
    track: Track,
    truth_m: Array,
    scene: Scene,
    path: Path,
    title: str,
    learned: Sequence[Json],
) -> None:
    """Draw a track from above, its error over time, and its modes.

    Args:
        track: the track.
        truth_m: (T, 3) true positions, NaN where unknown.
        scene: scene whose anchors and walls are drawn.
        path: file to write.
        title: title of the picture.
        learned: figures about images of a learned map, as :func:`learn_map` returns them.
    """
    shown = slice(None, None, -(-len(track) // POINTS))
    track = track.part(shown)
    truth_m = truth_m[shown].copy()
    time = track.time_s - track.time_s[0]
    begins = np.diff(track.segment, prepend=0) > 0
    truth_m[begins] = np.nan  # lines break at gaps
    time[begins] = np.nan
    heights = [5.0, 1.8, 0.2 * len(track.modes) + 0.1]
    with picture(path, 10.0, sum(heights) + 1.2) as figure:
        above, errors, modes = figure.subplots(3, 1, height_ratios=heights)
        _draw_above(above, track, truth_m, scene, learned)
        error = np.linalg.norm(track.smooth_x[:, :3] - truth_m, axis=1)
        sigma = np.sqrt(track.smooth_P[:, [0, 2, 5]].sum(axis=1))  # of x, y and z
        errors.fill_between(
            time, 0.0, 2.0 * sigma, color="C2", alpha=0.35, lw=0.0, label="2 standard deviations"
        )
        if np.isfinite(error).any():
            errors.plot(time, error, color="black", lw=0.8, label="error")
        errors.set(ylabel="position error (m)", ylim=(0.0, None))
        errors.tick_params(labelbottom=False)
        errors.sharex(modes)
        modes.step(time, track.mode, where="post", color="black", lw=0.8)
        modes.set_yticks(range(len(track.modes)), map(printable, track.modes))
        modes.set_xlabel("time since the first epoch (s)")
        figure.legend(handles=labelled([above, errors]), loc="outside right center")
        figure.suptitle(
            "\n".join(textwrap.wrap(printable(title), TITLE_LETTERS, break_on_hyphens=False)),
            x=0.02,
            ha="left",
        )


def _draw_above(
    axes: Any, track: Track, truth_m: Array, scene: Scene, learned: Sequence[Json]
) -> None:
    from matplotlib.collections import LineCollection

    position = track.smooth_x[:, :2]
    mode = track.mode
    steps = np.stack([position[:-1], position[1:]], axis=1)
    whole = np.diff(track.segment) == 0  # other steps join two segments
    if np.isfinite(truth_m).any():
        axes.plot(*truth_m[:, :2].T, color="black", alpha=0.25, label="truth", lw=4.0)
    for number in np.unique(mode):
        axes.add_collection(
            LineCollection(
                steps[whole & (mode[1:] == number)],
                color=f"C{number}",
                lw=1.4,
                label=f"estimate, {printable(track.modes[number])}",
            )
        )
    _draw_ellipses(axes, track)
    axes.plot(*position[0], "o", color="black", ms=5, label="start")
    _draw_scene(axes, position, scene, learned)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_adjustable("datalim")


def _draw_ellipses(axes: Any, track: Track) -> None:
    """Draw 95 % ellipses at a few epochs, enlarged if they are too small to be visible."""
    at = np.unique(np.linspace(0, len(track.time_s) - 1, ELLIPSES).astype(int))
    P = track.smooth_P[at]
    deviations = np.sqrt(chdtri(2, 0.05))
    typical = np.median(deviations * axes_of(P)[0])
    wanted = _VISIBLE * np.ptp(track.smooth_x[:, :2], axis=0).max()
    enlarged = int(np.clip(wanted / max(typical, 1e-9), 1.0, _MOST_ENLARGED))
    for ring in ellipse(track.smooth_x[at, :2], P, enlarged * deviations, 48):
        axes.fill(*ring.T, fc="none", ec="black", lw=0.8, ls="-")
    axes.plot(
        [],
        [],
        "o",
        mfc="none",
        mec="black",
        mew=0.8,
        ms=8,
        label="95 % ellipses" + (f",\nenlarged {enlarged} times" if enlarged > 1 else ""),
    )


def _draw_scene(axes: Any, position: Array, scene: Scene, learned: Sequence[Json]) -> None:
    """Draw anchors and walls, learned ones with their uncertainty.

    Those that are farther outside the track's box than its extent, or 30 m, are left out.
    """
    low = position.min(axis=0)
    high = position.max(axis=0)
    margin = max((high - low).max(), 30.0)

    def is_near(point: Array) -> bool:
        return bool(((low - margin < point) & (point < high + margin)).all())

    for number, anchor in enumerate(scene.anchors_m[:, :2], 1):
        if is_near(anchor):
            axes.plot(*anchor, "^", color="black", ms=8, mfc="white" if number > 1 else "black")
            axes.annotate(
                f"anchor {number}" if number > 1 else "gNB",
                anchor,
                (7, 0),
                textcoords="offset points",
                va="center",
            )
    walls = [
        (np.array(wall.unit_normal), wall.offset_m, {"label": "wall", "color": "0.75", "lw": 4.0})
        for wall in scene.walls
    ]
    look = {"label": "learned wall,\n± 2 standard deviations", "color": "C3", "ls": "--"}
    for image in learned:
        normal = np.array(image["wall"]["normal"])
        # the wall is halfway between the base station and its image
        sigma = 0.5 * float(np.linalg.norm(normal * image["sigma_m"][:2]))
        for deviations, width in ((-2.0, 0.6), (2.0, 0.6), (0.0, 1.4)):
            offset_m = image["wall"]["offset_m"] + deviations * sigma
            walls.append((normal, offset_m, look | {"lw": width}))
    middle = 0.5 * (low + high)
    for normal, offset_m, style in walls:
        foot = middle + (offset_m - normal @ middle) * normal
        if is_near(foot):
            axes.axline(foot, foot + [-normal[1], normal[0]], **style)
