"""mmwave-loc tune: process noise of modes, or a whole bank, on tuning seeds."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from experiments.console.options import TUNING_SEED, JsonArgs, WorldArgs

if TYPE_CHECKING:
    Objective = Callable[["Mode"], "Array"]
    from mmwave_env.filters.modes import Mode
    from mmwave_env.models.measurement import Layout
    from mmwave_env.numerics.arrays import Array
    from mmwave_env.world.episode import Episode


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Tune the process noise of modes by likelihood or by position error.

    With --bank the five modes of imm-best, with their transition, by the reward of the IMM over
    them, on all streets at 1 Hz and 10 Hz (extra "tune").

    mmwave-loc tune --radio handset --out modes.json
    mmwave-loc tune --bank --radio phone.json --episodes 900 --evaluations 500 --out bank.json
    """

    radio: str = "handset"
    """handset, standard, high or a JSON file"""
    modes: tuple[str, ...] = ("ekf", "ukf")
    """what to tune: ekf, ukf, ckf, ekf-robust, ukf-robust, mode files"""
    scenarios: tuple[str, ...] = ("pedestrian", "vehicle")
    """kind of user each mode is tuned on, in the same order; names, JSON files or CSV files"""
    free: tuple[str, ...] = ("sigma_v", "sigma_p")
    """what to tune: sigma_p, sigma_v, sigma_pz, sigma_vz, sigma_b_mps, spread_gain"""
    objective: Literal["likelihood", "rmse"] = "likelihood"
    """likelihood of the measurements (needs no truth), or root mean square position error"""
    diagonal: bool = False
    """process noise as the paper prints it: a plain diagonal, no coupling"""
    episodes: int = 300
    """how many"""
    seed: int = TUNING_SEED
    """seed of the first episode; never a test seed"""
    bank: bool = False
    """tune a bank, in place of modes one by one"""
    evaluations: int = 1000
    """of a bank, at most"""
    out: Path | None = None
    """write the tuned modes to this mode file, for --modes and modes="""


# Where each part of the process noise is looked for, in the units of Mode.
RANGES = {
    "sigma_p": (0.01, 2.0), "sigma_v": (0.1, 4.0), "sigma_pz": (0.001, 0.2),
    "sigma_vz": (0.001, 0.2), "sigma_b_mps": (0.01, 0.5), "spread_gain": (1e-4, 0.1),
}  # fmt: skip
OF_MODES = ("modes", "scenarios", "free", "objective", "diagonal")  # options that banks have not
POINTS = (6, 11)  # of the surface, along the second and the first parameter
STEP = 0.3  # of the first simplex, in logarithms: a third


def likelihood(history: "dict[str, Array]", layout: "Layout") -> "Array":
    """Mean log-likelihood per epoch (episodes,) of the innovations, outliers capped.

    Unmodeled blockage would otherwise decide. The constant -(rows / 2) log(2 pi) is left out.
    """
    import numpy as np
    from scipy.special import chdtri

    from experiments.tuning.scores import CAP
    from mmwave_env.metrics import scored
    from mmwave_env.numerics.arrays import Array

    nis, log_likelihood = history["memory.nis"], history["log_likelihood"]
    rows = [group.stop - group.start for group in layout.groups]
    excess = np.maximum(nis - chdtri(rows, 1.0 - CAP), 0.0).sum(axis=-1)
    capped = log_likelihood + 0.5 * excess
    per_epoch: Array = capped[:, scored(nis.shape[1])].mean(axis=-1)
    return per_epoch


def negative_mean_square(history: "dict[str, Array]", layout: "Layout") -> "Array":
    """Minus the mean square position error (episodes,), m^2."""
    import numpy as np

    from mmwave_env.metrics import scored
    from mmwave_env.numerics.arrays import Array

    error = history["error"]
    mean: Array = np.square(error[:, scored(error.shape[1])]).sum(axis=-1).mean(axis=-1)
    return -mean


OBJECTIVES = {
    "likelihood": (likelihood, ("memory.nis", "log_likelihood"), "log-likelihood per epoch"),
    "rmse": (negative_mean_square, ("error",), "minus the mean square error, m^2"),
}


def objective_of(name: str, mode: "Mode", episodes: "Sequence[Episode]") -> "Objective":
    """From a mode to what is maximized, per episode; the mode's algorithm is that of ``mode``."""
    from mmwave_env.engines.track_engine import Tracker
    from mmwave_env.filters.modes import Mode
    from mmwave_env.filters.pipeline import Pipeline
    from mmwave_env.numerics.arrays import Array

    function, names, _ = OBJECTIVES[name]
    layout = episodes[0].layout
    tracker = Tracker(Pipeline((mode,), layout), len(episodes))
    tracker.load(episodes)

    def evaluate(tried: Mode) -> Array:
        tracker.tune([tried.tuning])
        return function(tracker.run(*names), layout)

    return evaluate


def tune(
    mode: "Mode", free: Sequence[str], objective: "Objective"
) -> "tuple[Mode, list[Array], Array]":
    """The best tuning, and the surface that leads there.

    The best point of a logarithmic grid over the first two parameters is the start of a
    Nelder-Mead search over all of them.

    Returns:
        The mode; the axes of the surface; its values, (len(axis),) or (len(axis), len(axis)).
    """
    import numpy as np
    from scipy.optimize import minimize

    from experiments.console.progress import tracked
    from mmwave_env.filters.modes import Mode

    axes = [np.geomspace(*RANGES[name], POINTS[-1 - i]) for i, name in enumerate(free[:2])]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))

    def at(values: Iterable[float]) -> Mode:
        return replace(mode, **{k: float(v) for k, v in zip(free, values, strict=False)})  # type: ignore[arg-type]

    surface = np.array([
        objective(at(point)).mean() for point in tracked(points, mode.name)
    ])  # fmt: skip
    start = [getattr(at(points[np.nanargmax(surface)]), name) for name in free]
    bounds = np.log([RANGES[name] for name in free])
    corner = np.clip(np.log(np.maximum(start, 1e-12)), *(bounds.T + [[0.0], [-STEP]]))
    found = minimize(
        lambda logarithms: -np.nan_to_num(objective(at(np.exp(logarithms))).mean(), nan=-np.inf),
        corner,
        method="Nelder-Mead",
        bounds=bounds,
        options={
            "initial_simplex": corner + STEP * np.eye(len(free) + 1, len(free), k=-1),
            "xatol": 0.005,
            "fatol": 1e-5,
        },
    )
    best = at([float(f"{v:.3g}") for v in np.exp(found.x)])
    return best, axes, surface.reshape([len(axis) for axis in axes])


def surface_table(free: Sequence[str], axes: "Sequence[Array]", surface: "Array") -> str:
    """The surface as Markdown: the first parameter to the right, the second down."""
    from experiments.console.tables import grid

    header = [" / ".join(reversed(free[:2])), *(f"{v:.3g}" for v in axes[0])]
    lines = surface.reshape(len(axes[0]), -1).T
    labels = [f"{v:.3g}" for v in axes[1]] if len(axes) > 1 else [""]
    rows = [[a, *(f"{v:.3f}" for v in line)] for a, line in zip(labels, lines, strict=True)]
    return grid(header, rows)


def _tune_bank(args: Args) -> None:
    """Tune a bank, and write and say what it came to."""
    from experiments.console.progress import say
    from experiments.console.provenance import provenance
    from experiments.evaluation.intervals import Interval
    from experiments.tuning.banks import tuned_bank
    from mmwave_env.files import write_json
    from mmwave_env.models.radio import radio_from

    for field in fields(Args):
        if field.name in OF_MODES and getattr(args, field.name) != field.default:
            raise ValueError(f"{field.name}: found beside --bank, expected one of them")
    name = radio_from(args.radio).name
    bank = tuned_bank(args.radio, args.episodes, args.seed, args.evaluations)
    reward, gain = (Interval.of(bank["held_out"][what]) for what in ("reward", "minus imm"))
    say(f"{name}: reward {reward}, minus imm {gain}, on as many episodes that nothing was tuned on")
    made = provenance("tune", args)
    if args.json:
        write_json(args.json, made | bank)
    if args.out:
        write_json(args.out, {"command": made["command"]} | bank)


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.progress import say
    from experiments.console.provenance import provenance
    from experiments.console.tables import show
    from experiments.console.text import escaped
    from experiments.evaluation.asked import source_of
    from experiments.evaluation.intervals import bootstrap
    from experiments.evaluation.seeds import draw_episodes, require_tuning_seed
    from mmwave_env.files import require_writable, write_json
    from mmwave_env.filters.mode_files import as_written, modes_from
    from mmwave_env.lookup import choose
    from mmwave_env.models.radio import radio_from

    require_tuning_seed(args.seed)
    if args.out:
        require_writable(args.out)
        if args.out.resolve() == Path(args.radio).resolve():
            raise ValueError(f"out: found {args.out}, which is the radio, expected another file")
    if args.bank:
        _tune_bank(args)
        return
    radio = radio_from(args.radio)
    profile, base = radio.name, radio.base  # one that nobody has tuned yet starts from its base
    modes = modes_from(args.modes, base)
    if len(args.scenarios) != len(modes):
        raise ValueError(
            f"scenarios: found {len(args.scenarios)}, expected {len(modes)}, one for each of the "
            f"modes {', '.join(mode.name for mode in modes)}"
        )
    if not args.free or len(set(args.free)) < len(args.free):
        raise ValueError(f"free: found {args.free}, expected at least one name and none twice")
    for name in args.free:
        choose(RANGES, name, "free")
    tuned, figures = [], []
    for mode, scenario in zip(modes, args.scenarios, strict=True):
        source = source_of(WorldArgs(scenario=scenario, radio=args.radio))
        episodes = draw_episodes(source, range(args.seed, args.seed + args.episodes))
        started = replace(mode, coupling=mode.coupling and not args.diagonal)
        objective = objective_of(args.objective, started, episodes)
        best, axes, surface = tune(started, args.free, objective)
        tuned.append(best)
        value = bootstrap(objective(best)[:, None])[0]
        what = OBJECTIVES[args.objective][2]
        show(f"### {escaped(mode.name)} on {escaped(source.name)}, {escaped(profile)}: {what}\n")
        show(surface_table(args.free, axes, surface))
        found = ", ".join(f"{name} {getattr(best, name):g}" for name in args.free)
        say("", f"best: {found}: {value}", "")
        figures.append({
            "mode": mode.name, "scenario": scenario, "objective": what, **value.json,
            "axes": {name: axis.tolist() for name, axis in zip(args.free, axes, strict=False)},
            "surface": surface.tolist(),
        })  # fmt: skip
    made = provenance("tune", args)
    result = {"command": made["command"], "modes": [as_written(mode) for mode in tuned]}
    if args.json:
        write_json(args.json, made | result | {"tuned": figures})
    if args.out:
        write_json(args.out, result)
