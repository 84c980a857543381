"""mmwave-loc watch: an episode filtered by several policies, in a window or as a video."""

from dataclasses import dataclass
from pathlib import Path

from experiments.console.options import ModeArgs


@dataclass
class Args(ModeArgs):
    """Play an episode filtered by several policies, in a window or as a video.

    mmwave-loc watch --policies speed-rule ppo --seed 3 --out ride.gif
    """

    policies: tuple[str, ...] = ("speed-rule", "ppo")
    """up to three policies, as for compare: names, policy
    files (.safetensors), folders of runs, and
    module:function"""
    out: Path | None = None
    """write a video to this .gif or .mp4 file instead of opening a window"""
    fps: int = 10
    """epochs per second; in a window, space pauses"""
    render_size: int = 480
    """height and width of each policy's picture, px, 480 to 1080"""
    render_theme: str = "light"
    """colors: light or dark"""
    seed: int = 0
    """seed of the episode; mmwave-loc compare runs the same episode for this seed"""
    begin: float = 0.0
    """time to begin at, s from the start of the episode"""
    end: float = float("inf")
    """time to end at, s from the start of the episode (inf: its end)"""


MOST = 3  # maximum number of policies to show
FASTEST = 50  # maximum number of pictures per second in a GIF


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import progress, say, tracked
    from experiments.evaluation.contenders import contender_of, seeds_from, task_of
    from experiments.evaluation.runner import histories_of
    from mmwave_env.rendering.video import write_video

    _check(args)
    from mmwave_env.rendering.picture import Playback  # needs pygame

    contenders = [contender_of(args, name) for name in args.policies]
    with progress("filtering"):
        ((episode, histories),) = histories_of(task_of(args), seeds_from(1, args.seed), contenders)
    time_s = histories[0].time_s.tolist()  # row 0, the prior, is at the episode's start
    rows = [row for row, time in enumerate(time_s) if args.begin <= time <= args.end]
    if not rows:
        raise ValueError(
            f"begin, end: found {args.begin:g} to {args.end:g} s, expected part of the "
            f"episode, 0 to {time_s[-1]:g} s"
        )
    say(f"{episode.name}, seed {args.seed}, {time_s[rows[0]]:g} to {time_s[rows[-1]]:g} s")
    for name, history in zip(args.policies, histories, strict=True):
        error = history.error_m[rows]
        say(f"{name}: {error.mean():.1f} m off on average, {error.max():.1f} m at most")
    modes = [contender.actions for contender in contenders]
    playback = Playback(histories, modes, args.policies, args.render_size, args.render_theme)
    if args.out:
        pictures = map(playback.draw, tracked(rows, "drawing"))
        write_video(args.out, pictures, playback.draw(rows[-1]), args.fps)
        say(f"written to {args.out}: {len(rows)} pictures")
        return
    from mmwave_env.rendering.window import Window

    window = Window(args.render_size * len(contenders), args.render_size, args.fps)
    for row in rows:
        window.paused |= row == rows[-1]  # after the last row, wait for the user
        window.show(playback.draw(row))
        if not window.is_open:
            break
    window.close()


def _check(args: Args) -> None:
    """Check, before any work, that the episodes can be shown."""
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
