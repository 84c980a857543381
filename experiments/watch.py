"""mmwave-loc watch: an episode as contenders filter it, in a window or as a video."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.console.options import ModeArgs

if TYPE_CHECKING:
    from experiments.evaluation.contenders import Contender
    from mmwave_env.models.scene import Streets
    from mmwave_env.numerics.numbers import Array
    from mmwave_env.rendering.history import History
    from mmwave_env.task import Task
    from mmwave_env.world.episode import Episode


@dataclass(kw_only=True)
class Args(ModeArgs):
    """Play an episode as policies go through it, one beside the other, in a window or as a video.

    mmwave-loc watch --policies speed-rule ppo --seed 3 --out ride.gif
    """

    policies: tuple[str, ...] = ("speed-rule", "ppo")
    """up to three, as of compare: names of mmwave-loc list policies, policy files (.safetensors),
    folders of runs, and module:function"""
    out: Path | None = None
    """write a video, a .gif or .mp4 file, in place of a window"""
    fps: int = 10
    """epochs a second; in a window, the keys in its title change it"""
    render_size: int = 480
    """height and width of the picture of a policy, px, 480 to 1080"""
    render_theme: str = "light"
    """light or dark"""
    seed: int | None = None
    """seed of the episode (0 where none is given), the same that compare runs"""
    key: int | None = None
    """key of a simulated episode in place of a seed, as --episodes-csv of compare tells it"""
    begin: float | None = None
    """second of the episode to begin at; the beginning where none is given"""
    end: float | None = None
    """second of the episode to end at; the end where none is given"""


MOST = 3  # most policies to show
FASTEST = 50  # most pictures per second of a GIF


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.progress import progress, say
    from experiments.evaluation.asked import contender_of, task_of
    from experiments.evaluation.histories import history_of
    from experiments.evaluation.runner import Scoring

    _check(args)
    contenders = [contender_of(args, name) for name in args.policies]
    task = task_of(args)
    scoring, (episode, streets, title) = Scoring.of(task), _drawn(task, args.seed, args.key)
    with progress("filtering"):
        histories = [history_of(c, episode, scoring, streets) for c in contenders]
    rows = _between(histories[0].time_s, args.begin, args.end)
    first, last = histories[0].time_s[[rows[0], rows[-1]]]
    say(f"{title}, {first:g} to {last:g} s")
    for contender, history in zip(contenders, histories, strict=True):
        error = history.error_m[rows]
        off = f"{error.mean():.1f} m off on average, {error.max():.1f} m at most"
        say(f"{contender.name}: {off}")
    _show(args, contenders, histories, rows)


def _check(args: Args) -> None:
    """Refuse, before any work, options that can't be shown."""
    from mmwave_env.rendering.theme import require_drawable
    from mmwave_env.rendering.video import require_video

    if not 1 <= len(args.policies) <= MOST:
        raise ValueError(f"policies: found {len(args.policies)}, expected 1 to {MOST}")
    if not 1 <= args.fps <= FASTEST:
        raise ValueError(f"fps: found {args.fps}, expected 1 to {FASTEST}")
    require_drawable(args.render_size, args.render_theme, "watch")
    if args.out:
        require_video("out", args.out)
    else:
        from mmwave_env.rendering.window import require_display

        require_display("window", "write a video with --out FILE.gif")


def _drawn(
    task: "Task", seed: int | None, key: int | None
) -> "tuple[Episode, Streets | None, str]":
    """Return the episode of a seed or key, its streets where they are known, and its title."""
    import numpy as np

    from experiments.evaluation.seeds import Selection
    from mmwave_env.world.keys import key_from
    from mmwave_env.world.simulated import SimulatedSource

    if key is None:
        selection = Selection.of(1, seed, 1)
        (episode,), keys = selection.draw(task.source), selection.keys(task.source)
        which = f"seed {selection.seeds[0]}"
    elif seed is not None:
        raise ValueError(f"key: found beside seed {seed}, expected one of them")
    elif not isinstance(task.source, SimulatedSource):
        raise ValueError("key: found one, but recorded episodes have none: expected a seed")
    else:
        keys, which = np.array([key_from(key)], np.uint64), f"key {key}"
        (episode,) = task.source.episodes(keys)
    streets = task.streets_of(0 if keys is None else int(keys[0]))
    return episode, streets, f"{episode.name}, {which}"


def _between(time_s: "Array", begin: float | None, end: float | None) -> list[int]:
    """Return the rows of a history between two times, from the prior on by default."""
    import numpy as np

    low, high = -np.inf if begin is None else begin, np.inf if end is None else end
    rows: list[int] = np.flatnonzero((time_s >= low) & (time_s <= high)).tolist()
    if begin is not None and rows[:1] == [0]:
        del rows[0]
    if not rows:
        raise ValueError(
            f"begin, end: found {low:g} to {high:g} s, expected some of the 0 to "
            f"{time_s[-1]:g} s of the episode"
        )
    return rows


def _show(
    args: Args,
    contenders: "Sequence[Contender]",
    histories: "Sequence[History]",
    rows: Sequence[int],
) -> None:
    """Write the video, or play it in a window until it is closed or a key ends it."""
    from experiments.console.progress import progress, say
    from mmwave_env.rendering.picture import Playback
    from mmwave_env.rendering.video import write_video

    size, theme = args.render_size, args.render_theme
    modes, names = [c.actions for c in contenders], [c.name for c in contenders]
    playback = Playback(histories, modes, names, size, theme)
    if args.out:
        with progress("drawing") as report:
            write_video(args.out, playback.draw, rows, args.fps, report)
        say(f"written to {args.out}: {len(rows)} pictures")
        return
    from mmwave_env.rendering.window import Window

    window = Window(size * len(contenders), size)
    window.speed = args.fps
    for row in rows:
        window.paused |= row == rows[-1]  # until a key is pressed or the window is closed
        window.show(playback.draw(row))
        if not window.is_open:
            break
    window.close()
