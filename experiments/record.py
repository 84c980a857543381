"""mmwave-loc record: one user of a grid, or of a dynamic scenario, as a recording of its own."""

from experiments.arguments.record import Args
from experiments.cli.main import run
from experiments.cli.options import way_of
from experiments.evaluation.terminal import progress, say
from mmwave_env.episodes.deepmimo import read_deepmimo
from mmwave_env.episodes.deepmimo.along import record_along
from mmwave_env.episodes.deepmimo.formats import is_scenario, open_scenario
from mmwave_env.episodes.deepmimo.writer import write_deepmimo
from mmwave_env.episodes.recorded import Recording
from mmwave_env.models.scene import scene_from


def main(args: Args) -> None:
    """Run the command."""
    if not args.overwrite and is_scenario(args.out):
        raise ValueError(f"out: found a scenario in {args.out}, expected a folder without one; "
                         "--overwrite replaces it, --out names another folder")  # fmt: skip
    if (args.along is None) == (args.user is None):
        found = "neither" if args.user is None else "both"
        raise ValueError(f"along, user: found {found}, expected --along, the way through a grid, "
                         "or --user of a dynamic scenario")  # fmt: skip
    with progress("recording"):
        recording = _of_user(args) if args.along is None else _along(args, args.along)
    several = args.base_station is None and len(open_scenario(args.scenario).stations) > 1
    names = write_deepmimo(args.out, recording, stations=several)
    counts = recording.visible[:, : recording.layout.anchors].sum(axis=0).tolist()
    for anchor, seen in zip(recording.anchors_m.round(2).tolist(), counts, strict=True):
        say(f"anchor at {anchor}: seen in {seen} of {len(recording)} epochs")
    say(f"written to {args.out}/: {', '.join(names)}")


def _of_user(args: Args) -> Recording:
    """Of one user through the scenes of a dynamic scenario."""
    if not open_scenario(args.scenario).is_dynamic:
        raise ValueError(f"user: found {args.user} of {args.scenario}, which is static, expected "
                         "--along, a way through its grid")  # fmt: skip
    return read_deepmimo(
        args.scenario, args.virtual_anchors,
        users=args.user, dt_s=args.dt, base_station=args.base_station,
    )  # fmt: skip


def _along(args: Args, along: str) -> Recording:
    """Of those along a way through a grid; says how far they are from it."""
    way = way_of(along, scene_from(args.scene), args.dt, args.episode_steps, args.seed)
    sampled = record_along(
        args.scenario, way, args.dt, args.interpolate, args.within,
        args.virtual_anchors, base_station=args.base_station,
    )  # fmt: skip
    error = sampled.error_m
    say(f"{len(error)} epochs from {sampled.users} users; measured {error.mean():.3f} m from the "
        f"way, at most {error.max():.3f} m")  # fmt: skip
    return sampled.recording


if __name__ == "__main__":
    run("record")
