"""mmwave-loc learned: docs/learning.md's tables and figures, from recorded runs, on test seeds."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from experiments import transfer
from experiments.arguments.shared import EpisodeArgs, WorldArgs
from experiments.arguments.transfer import Args as TransferArgs
from experiments.cli.doc_pages import page_to_renew, renewed
from experiments.cli.main import run
from experiments.cli.options import provenance, source_of
from experiments.cli.reporting import results
from experiments.evaluation.contenders import BEST_IMM, contender_from
from experiments.evaluation.decisions import Decisions
from experiments.evaluation.intervals import over_seeds_and_episodes
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.runner import score_contenders
from experiments.evaluation.runs import Run
from experiments.evaluation.seeds import Selection, draw_episodes
from experiments.evaluation.terminal import tracked
from experiments.figures.events import draw_decisions
from experiments.learning.ablate import VARIANTS
from experiments.learning.arguments.learned import Args
from experiments.learning.curves import draw_curves
from experiments.learning.study_tables import STUDIES, study_tables
from experiments.learning.trust import Trust
from mmwave_env.files import require_writable, write_json, write_text
from policies import TUNED_IMMS

RADIOS = ("handset", "standard")
PAGE_RIVALS = (
    "speed-rule", "fixed-ekf", "fixed-ukf", "fixed-ckf", "fixed-ekf-robust", "fixed-ukf-robust",
    "imm", *TUNED_IMMS, BEST_IMM,
)  # fmt: skip
SHIPPED = "as-shipped"
GUIDED = "guided"  # the policy for all places
RECORDED_SHARE = 20  # a recording is drawn for one in so many episodes, in the tables of transfer
TRUSTING = (GUIDED, "guided-ppo")  # runs with beliefs per mode, judged on docs/benchmark.md


def runs_of(args: Args, radio: str) -> list[str]:
    """Folders of the recorded runs of a radio profile."""
    return [str(args.runs / f"{kind}-{radio}") for kind in ("ppo", "ppo-extended")]


def tables(args: Args) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Title, Markdown and JSON of every table; figures are drawn on the way."""
    yield trainings(args)
    for radio in RADIOS:
        what = EpisodeArgs(radio=radio, episodes=args.episodes, seed=args.seed)
        names, figure = [*runs_of(args, radio), *PAGE_RIVALS], args.out / f"profiles-{radio}.png"
        found = results(what, names, pictures={"figure": figure})
        found.draw()
        text, content = found.text, found.json
        content |= {"decisions": around_events(args, radio)}
        text = text.partition("\n\n")[2].rstrip("\n")  # titles of pages are the pages' own
        yield radio, text.replace(f"{args.runs}/", ""), content
    yield trust(args, RADIOS[0])
    for radio in RADIOS:
        elsewhere = TransferArgs(
            radio=radio, policies=tuple(runs_of(args, radio)), episodes=args.episodes // 4,
            draws=args.episodes // RECORDED_SHARE, seed=args.seed,
        )  # fmt: skip
        yield f"transfer, {radio}", *transfer.tried(elsewhere)
    yield ablations(args)
    yield from study_tables(args.runs, args.episodes // 2, args.seed)


def trainings(args: Args) -> tuple[str, str, dict[str, Any]]:
    """How long trainings took, and a figure of their course."""
    rows, content = [], {}
    names = [name for radio in RADIOS for name in runs_of(args, radio)]
    for name in (*names, *(str(args.runs / kind) for kind in TRUSTING)):
        found = Run.read(name).outcomes
        beaten = [one["beat_rule"] for one in found]
        seconds = [one["seconds"] for one in beaten if one]
        rows.append([
            Path(name).name, str(len(found)), f"{found[0]['timesteps']:,}",
            f"{median(one['seconds'] for one in found):.0f} s",
            f"{median(seconds):.1f} s (at most {max(seconds):.1f})" if all(beaten) else "not all",
            f"{median(one['timesteps'] for one in beaten if one):,.0f}",
        ])  # fmt: skip
        content[name] = found
    draw_curves([Path(name) for name in names], args.out / "curves.png")
    header = ["run", "seeds", "steps each", "wall time each", "beat the rule after", "steps"]
    return "trainings", grid(header, rows), content


def around_events(args: Args, radio: str) -> dict[str, Any]:
    """What a few contenders choose around stops and pull-aways, as JSON, and a figure of it."""
    guided, switcher = (str(args.runs / name) for name in (GUIDED, f"ppo-extended-{radio}"))
    names = [guided, BEST_IMM, switcher, "speed-rule"]
    decisions = Decisions({name: name for name in names})
    source = source_of(WorldArgs(radio=radio))
    selection = Selection(range(args.seed, args.seed + args.episodes))
    score_contenders(names, source, radio, selection, watch=[decisions.add])
    draw_decisions(decisions, args.out / f"decisions-{radio}.png")
    return decisions.json


def trust(args: Args, radio: str) -> tuple[str, str, dict[str, Any]]:
    """Whom the policy for all places trusts around events, and a figure of it."""
    guided, best = (contender_from(name, radio) for name in (str(args.runs / GUIDED), BEST_IMM))
    seeds = range(args.seed, args.seed + max(1, args.episodes // 2))
    found = Trust.measured(guided, best, draw_episodes(source_of(WorldArgs(radio=radio)), seeds))
    found.draw(args.out / f"trust-{radio}.png")
    return f"trust, {radio}", str(found), found.json


def ablations(args: Args) -> tuple[str, str, dict[str, Any]]:
    """What each variant of the training is worth."""
    source = source_of(WorldArgs())
    files = {
        name: Run.read(str(folder)).policies
        for name in VARIANTS
        if (folder := args.runs / "ablation" / name).is_dir()
    }
    names, episodes = [*chain(*files.values()), "imm"], args.episodes // 4
    selection = Selection(range(args.seed, args.seed + episodes))
    scores = score_contenders(names, source, "handset", selection)
    found = {name: np.stack([scores[f]["reward"] for f in each]) for name, each in files.items()}
    rows, content = [], {}
    for name, rewards in found.items():
        columns = {"reward": rewards, "minus imm": rewards - scores["imm"]["reward"]}
        if name != SHIPPED and len(rewards) == len(found[SHIPPED]):
            columns[f"minus {SHIPPED}"] = rewards - found[SHIPPED]
        intervals = {key: over_seeds_and_episodes(values) for key, values in columns.items()}
        rows.append([name, str(len(rewards)), *map(str, intervals.values())])
        content[name] = {key: interval.json for key, interval in intervals.items()}
    rows[0] += [""] * (5 - len(rows[0]))
    header = ["variant", "seeds", "reward", "minus imm", f"minus {SHIPPED}"]
    return "ablations", grid(header, rows), content


def main(args: Args) -> None:
    """Run the command."""
    if args.episodes < RECORDED_SHARE:
        raise ValueError(
            f"episodes: found {args.episodes}, expected at least {RECORDED_SHARE}, of which "
            "recordings get one"
        )
    require_writable(args.out / "tables.md")
    page = page_to_renew(args.docs) if args.docs else ""
    if args.docs:
        args = replace(args, out=args.docs.with_suffix(""))
    bodies, content = {}, {}
    total = 7 + len(STUDIES)
    for title, text, figures in tracked(tables(args), "learned", total):
        bodies[title], content[title] = text, figures
    everything = "\n\n".join(f"### {title}\n\n{text}" for title, text in bodies.items()) + "\n"
    if args.docs:
        write_text(args.docs, renewed(page, bodies))
    else:
        write_text(args.out / "tables.md", everything)
    if args.json:
        write_json(args.json, provenance("learned", args) | content)
    show(everything)


if __name__ == "__main__":
    run("learned")
