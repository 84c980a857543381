"""mmwave-loc demo: the tables of docs/results.md, on simulated and on ray-traced streets."""

from experiments.arguments.demo import Args
from experiments.arguments.report import Args as ReportArgs
from experiments.arguments.shared import EpisodeArgs
from experiments.cli.main import run
from experiments.cli.options import all_contenders, provenance
from experiments.cli.reporting import results
from experiments.evaluation.markdown import show
from experiments.evaluation.protocol import RECORDINGS
from experiments.evaluation.terminal import note, say
from experiments.webpage.page import write_page
from mmwave_env.files import write_json, write_text

SHOWN = ("fixed-ekf", "fixed-ukf", "speed-rule", "imm-best", "ppo-extended", "guided")


def main(args: Args) -> None:
    """Run the command."""
    runs = [EpisodeArgs(episodes=args.episodes, percentiles=args.percentiles)]
    runs += [
        EpisodeArgs(data=name, episodes=args.draws, percentiles=args.percentiles)
        for name in RECORDINGS
    ]
    tables, everything, made = [], {}, provenance("demo", args)
    for one in runs:
        what = (
            f"{one.data or 'mixed'}: {len(all_contenders(one))} policies, {one.episodes} episodes"
        )
        note(f"{what} each")
        result, text, content, _ = results(one, all_contenders(one))
        show(str(result.of(SHOWN)))
        tables.append(text)
        everything[result.scenario] = made | content
        write_json(args.out / f"{result.scenario}.json", everything[result.scenario])
    write_text(args.out / "tables.md", "\n".join(tables))
    if args.json:
        write_json(args.json, everything)
    files = tuple(args.out / f"{scenario}.json" for scenario in everything)
    report = ReportArgs(results=files, out=args.out / "report.html")
    note("the web page: some episodes again, epoch by epoch")
    write_page(report)
    say(f"All {len(all_contenders(runs[0]))} policies and all paired differences are in")
    say(f"{args.out / 'tables.md'}, with every figure in {', '.join(map(str, files))}.")
    say(f"{report.out} is a web page of them, with episodes to play: open it in a browser.")
    say("README.md and docs/results.md say what the columns mean.")
    say("next: mmwave-loc list policies, or mmwave-loc compare --policies ppo imm --radio standard")


if __name__ == "__main__":
    run("demo")
