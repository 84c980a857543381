"""mmwave-loc extremes: numbers at the ends of the envelope, two at a time, and beyond them.

An ordinary episode is taken to the extremes of each quantity that the envelope bounds, and of every
two at once; modes of every kind filter all of them. Within the envelope beliefs stay finite and
positive definite. Beyond it an episode or a mode is refused, so that nothing is silently NaN.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import combinations

import numpy as np

from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.terminal import say
from experiments.reliability.arguments.extremes import Args
from mmwave_env.engines.track_engine import Tracker
from mmwave_env.episodes.episode import Episode
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.files import write_json
from mmwave_env.filters.mode_files import named_modes
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models import envelope
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.arrays import Array, Mask
from mmwave_env.records import Bound

ASIDE = 0.01  # how far within an end or beyond it, as a share of it
FAR = (1e30, 1e150, 1e300, np.nan)  # an infinite sigma is no error, but a row that is missing
SHOWN = 5  # failures on the terminal
SINGULAR = 1e-9  # rounding of a smallest eigenvalue of a correlation matrix


@dataclass(frozen=True)
class Quantity:
    """Something that the envelope bounds, and how an episode gets another value of it."""

    name: str
    bound: Bound
    put: Callable[[Episode, float], Episode]

    @property
    def within(self) -> list[float]:
        """Values just within the ends; 0 is one itself."""
        return [end - out for end, out in self._ends()]

    @property
    def beyond(self) -> list[float]:
        """Values just outside, and far outside."""
        return [end + (out or -1.0) for end, out in self._ends()] + list(FAR)

    def _ends(self) -> list[tuple[float, float]]:
        """Both ends, and a small step out of each."""
        least, most = self.bound.least, self.bound.most
        assert least is not None and most is not None
        return [(least, -ASIDE * abs(least)), (most, ASIDE * abs(most))]


def _prior_mean(states: slice) -> Callable[[Episode, float], Episode]:
    def put(episode: Episode, value: float) -> Episode:
        mean = episode.prior_mean.copy()
        mean[states] = value
        return replace(episode, prior_mean=mean)

    return put


def _prior_deviation(states: Sequence[int]) -> Callable[[Episode, float], Episode]:
    def put(episode: Episode, value: float) -> Episode:
        P = episode.prior_covariance.copy()
        P[states, states] = value * value if abs(value) < 1e150 else value  # diagonal as drawn
        return replace(episode, prior_covariance=P)

    return put


def _sigma(rows: Callable[[Episode], list[int]]) -> Callable[[Episode, float], Episode]:
    def put(episode: Episode, value: float) -> Episode:
        sigma = episode.sigma.copy()
        sigma[:, rows(episode)] = value
        return replace(episode, sigma=sigma)

    return put


def _steps(episode: Episode, value: float) -> Episode:
    return replace(episode, time_s=np.arange(len(episode), dtype=np.float64) * value)


def _place(episode: Episode, value: float) -> Episode:
    """Everything moved, anchors and user: a survey's coordinates."""
    mean = episode.prior_mean.copy()
    mean[:3] += value
    return replace(episode, scene_anchors_m=episode.scene_anchors_m + value, prior_mean=mean)


QUANTITIES = (
    Quantity("step", envelope.STEP_S, _steps),
    Quantity("anchors and user at", envelope.POSITION_M, _place),
    Quantity("prior position", envelope.POSITION_M, _prior_mean(slice(3))),
    Quantity("prior velocity", envelope.VELOCITY_MPS, _prior_mean(slice(3, 6))),
    Quantity("prior bias", envelope.BIAS_HZ, _prior_mean(slice(6, 7))),
    Quantity("deviation of position", envelope.POSITION_SIGMA_M, _prior_deviation([0, 1, 2])),
    Quantity("deviation of one axis", envelope.POSITION_SIGMA_M, _prior_deviation([0])),
    Quantity("deviation of velocity", envelope.VELOCITY_SIGMA_MPS, _prior_deviation([3, 4, 5])),
    Quantity("deviation of bias", envelope.BIAS_SIGMA_HZ, _prior_deviation([6])),
    Quantity("sigma of ranges", envelope.RANGE_SIGMA_M, _sigma(lambda e: [0, 4, 8])),
    Quantity("sigma of angles", envelope.ANGLE_SIGMA_RAD, _sigma(lambda e: e.layout.angles)),
    Quantity("sigma of azimuths", envelope.ANGLE_SIGMA_RAD, _sigma(lambda e: [1, 3, 5, 7, 9, 11])),
    Quantity("sigma of Doppler", envelope.DOPPLER_SIGMA_HZ, _sigma(lambda e: [e.layout.doppler])),
    Quantity(
        "Doppler spread", envelope.DOPPLER_SPREAD_HZ,
        lambda e, value: replace(e, doppler_spread_hz=np.full(len(e), value)),
    ),
    Quantity("Hz per m/s", envelope.HZ_PER_MPS, lambda e, value: replace(e, hz_per_mps=value)),
)  # fmt: skip
ORDINARY = named_modes()
QUIET = dict.fromkeys(("sigma_p", "sigma_v", "sigma_pz", "sigma_vz", "sigma_b_mps"), 0.0)
LOUD = dict.fromkeys(QUIET, envelope.PROCESS_NOISE.most)
WIDE = dict.fromkeys(("widen_p", "widen_v"), envelope.WIDENING.most)
CHANGES = {
    "": {}, "without gates": {"gate": None}, "no noise": QUIET, "most noise": LOUD,
    "most noise without gates": LOUD | {"gate": None}, "widest": WIDE,
    "most noise by spread": {"spread_gain": envelope.PROCESS_NOISE.most},
}  # fmt: skip


def modes() -> Iterator[Mode]:
    """The named modes, and each with the most and least that its tuning may be."""
    for mode in ORDINARY.values():
        for what, change in CHANGES.items():
            yield replace(mode, name=f"{mode.name} {what}".strip(), **change)  # type: ignore[arg-type]


@dataclass
class Tally:
    """What happened, tracks of a mode on an episode each."""

    within: int = 0  # tracks on episodes within the envelope
    sound: int = 0  # of them: finite and positive definite after every epoch
    beyond: int = 0  # episodes and modes beyond the envelope
    refused: int = 0  # of them
    failures: list[str] = field(default_factory=list)

    @property
    def rows(self) -> list[str]:
        """A table, Markdown."""
        return [
            "| numbers | tried | sound | refused | let through, or NaN or indefinite |",
            "|---|---|---|---|---|",
            f"| within the envelope, at its ends, one and two at a time | {self.within:,} | "
            f"{self.sound:,} | - | {self.within - self.sound:,} |",
            f"| beyond | {self.beyond:,} | - | {self.refused:,} | {self.beyond - self.refused:,} |",
        ]


def within(episode: Episode) -> dict[str, Episode]:
    """The episode with every quantity at its ends, and every two, by what was done."""
    single = [(q, value) for q in QUANTITIES for value in q.within]
    both = (pair for pair in combinations(single, 2) if pair[0][0].put is not pair[1][0].put)
    found = {}
    for changes in [*((one,) for one in single), *both]:
        changed = episode
        for quantity, value in changes:
            changed = quantity.put(changed, value)
        found[", ".join(f"{quantity.name} {value:g}" for quantity, value in changes)] = changed
    return found


def sound(x: Array, P: Array) -> Mask:
    """Which tracks (n,) of x (n, T, 7) and packed P (n, T, 28) are finite and positive definite."""
    finite: Mask = np.isfinite(np.concatenate([x, P], axis=2)).all(axis=(1, 2))
    full, (i, j) = np.zeros((*P.shape[:2], 7, 7)), np.tril_indices(7)
    full[..., i, j] = full[..., j, i] = np.where(finite[:, None, None], P, np.eye(7)[i, j])
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", full), 1e-300))
    least = np.linalg.eigvalsh(full / scale[..., :, None] / scale[..., None, :])[..., 0]
    good: Mask = finite & (least > -SINGULAR).all(axis=1)
    return good


def try_within(episode: Episode, tally: Tally) -> None:
    """Filter all of them with modes of every kind."""
    cases = within(episode)
    for mode in modes():
        tracker = Tracker(Pipeline((mode,), episode.layout), len(cases))
        tracker.load(list(cases.values()))
        good = sound(**tracker.run("x", "P"))
        tally.within += len(cases)
        tally.sound += int(np.count_nonzero(good))
        tally.failures += [
            f"{mode.name}: {case}" for case, fine in zip(cases, good, strict=True) if not fine
        ]


def try_beyond(episode: Episode, tally: Tally) -> None:
    """Ask for what is outside of the envelope."""
    asked: list[tuple[str, Callable[[], object]]] = [
        (f"{q.name} {v:g}", partial(q.put, episode, v)) for q in QUANTITIES for v in q.beyond
    ]
    tunings = [(name, envelope.PROCESS_NOISE) for name in (*QUIET, "spread_gain")]
    tunings += [(name, envelope.WIDENING) for name in WIDE]
    asked += [
        (f"{name} {v:g}", partial(Mode, "loud", **{name: v}))  # type: ignore[arg-type]
        for name, bound in tunings
        for v in Quantity(name, bound, _steps).beyond
    ]
    for what, make in asked:
        tally.beyond += 1
        try:
            make()
        except ValueError:
            tally.refused += 1
        else:
            tally.failures.append(f"{what}: accepted")


def main(args: Args) -> None:
    """Run the command."""
    if args.epochs < 2:
        raise ValueError(f"epochs: found {args.epochs}, expected at least 2")
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], epochs=args.epochs)
    episode, tally = source.sample(np.random.default_rng(args.seed)), Tally()
    try_within(episode, tally)
    with np.errstate(all="ignore"):  # what an episode is made of, too
        try_beyond(episode, tally)
    say(*tally.rows, *tally.failures[:SHOWN])
    if args.json:
        write_json(args.json, provenance("extremes", args) | {"found": asdict(tally)})
    if tally.failures:
        sys.exit(1)


if __name__ == "__main__":
    run("extremes")
