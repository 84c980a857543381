"""mmwave-loc inspect: what a data set is, before anything is done with it."""

from experiments.arguments.inspect import Args
from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.markdown import show
from experiments.figures.canvas import require_picture
from experiments.figures.data_set import draw_data_set
from experiments.inspection.formats import Beside, data_set_of
from experiments.inspection.summary import Summary
from experiments.inspection.text import summary_markdown
from mmwave_env.files import write_json


def main(args: Args) -> None:
    """Run the command."""
    if args.plot:
        require_picture("plot", args.plot)
    found = data_set_of(args.data, Beside(args.scene, args.truth, args.radio))
    summary = Summary(len(found.anchors_m))
    for epochs in found.epochs:
        summary.add(epochs)
    figures = summary.figures(found)
    if args.json:
        write_json(args.json, provenance("inspect", args) | figures)
    show(summary_markdown(figures))
    if args.plot:
        draw_data_set(summary.drawn.rows, found.anchors_m, args.plot, args.data, found.timed)
    if found.damage:
        raise ValueError(f"{found.damage}; what is shown is of the {summary.count} epochs before")


if __name__ == "__main__":
    run("inspect")
