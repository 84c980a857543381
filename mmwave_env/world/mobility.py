"""Kinds of users: their target speeds, their limits and their phases of walking or driving."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from math import inf
from pathlib import Path
from typing import Annotated

from mmwave_env.io.files import AnyPath, shipped_json
from mmwave_env.io.lookup import as_name, choose, quoted
from mmwave_env.io.records import (
    Bound,
    Name,
    Probability,
    Record,
    Size,
    between,
    counts,
    object_from,
    read_object,
    require_fields,
)
from mmwave_env.world.kinematics import FAR
from mmwave_env.world.travel import (
    NO_GAIT,
    PhasePlan,
    TravelGait,
    TravelPhase,
    TravelPlan,
    blank_plan,
)

FASTEST_MPS = 100.0  # faster than any user in streets
ROOM = 3  # compiled programs have room for at least 3 phases with 3 gaits each

Speed = Annotated[float, Bound(f"0 to {FASTEST_MPS:g} m/s", least=0.0, most=FASTEST_MPS)]
Duration = Annotated[float, Bound("a number >= 0.001", least=1e-3, most=inf)]
Rate = Annotated[float, between(1e-3, 1e3, "m/s^2")]
Range = tuple[Rate, Rate]
Wait = Annotated[float, between(0.0, 1e6, "s")]


@dataclass(frozen=True)
class Gait:
    """A target speed that is kept for a while.

    Attributes:
        low_mps, high_mps: limits between which the target speed is uniformly distributed.
        mean_s: mean of the exponentially distributed duration; by default the gait never ends.
        weight: relative frequency with which this gait is chosen.
    """

    low_mps: Speed
    high_mps: Speed
    mean_s: Duration = inf
    weight: Annotated[float, between(1e-6, 1e6)] = 1.0

    def __post_init__(self) -> None:
        require_fields(self)
        if self.low_mps > self.high_mps:
            raise ValueError(f"high_mps: found {self.high_mps}, expected low_mps or more")


@dataclass(frozen=True)
class Limits(Record):
    """The limits of a traveler's motion, some of them drawn from ranges as an episode begins.

    Attributes:
        acceleration_mps2: range from which the acceleration limit is drawn.
        braking_mps2: range from which the braking limit is drawn.
        lateral_mps2: range from which the limit of lateral acceleration, in corners, is drawn.
        jerk_mps3: limit of the rate at which the acceleration changes.
        corner_radius_m: radius of arcs at crossings; at most half the distance between crossings.
        red_light_probability: probability of a red light at a crossing.
        red_light_s: range from which the duration of each red light is drawn.
    """

    ordered = ("acceleration_mps2", "braking_mps2", "lateral_mps2", "red_light_s")

    acceleration_mps2: Range
    braking_mps2: Range
    lateral_mps2: Range
    jerk_mps3: Annotated[float, between(1e-3, 1e4, "m/s^3")]
    corner_radius_m: Annotated[float, between(1e-2, 1e6, "m")]
    red_light_probability: Probability = 0.0
    red_light_s: tuple[Wait, Wait] = (5.0, 25.0)


@dataclass(frozen=True)
class Phase(Record):
    """A part of an episode with one style of moving.

    Attributes:
        limits: limits of the motion.
        gaits: target speeds; one gait at a time is chosen at random.
        duration_s: range of the duration; by default the phase lasts until the episode ends.
    """

    ordered = ("duration_s",)

    limits: Limits
    gaits: Annotated[tuple[Gait, ...], Size(1, 10)]
    duration_s: tuple[Duration, Duration] = (inf, inf)


@dataclass(frozen=True)
class Mobility:
    """A kind of user.

    Attributes:
        name: name of the kind of user, which is also the name of its episodes.
        phases: phases in order of time. All but the last need a ``duration_s``; the last must not
            have one, unless ``ends_as_it_began``.
        blocks: crossings are this many times closer together for this user than in the scene.
        ends_as_it_began: whether the first phase is repeated at the end of the episode.
    """

    name: Name
    phases: Annotated[tuple[Phase, ...], Size(1, 20)]
    blocks: Annotated[int, counts(1, 1000)] = 1
    ends_as_it_began: bool = False

    def __post_init__(self) -> None:
        require_fields(self, f" of mobility {quoted(self.name)}")
        last = len(self.phases) - 1
        for i, phase in enumerate(self.phases):
            if phase.duration_s[1] == inf and (i < last or (self.ends_as_it_began and i == 0)):
                raise ValueError(f"phases[{i}].duration_s: found none, expected [low, high]")
        if self.phases[last].duration_s[0] < inf and not self.ends_as_it_began:
            raise ValueError(
                f"phases[{last}].duration_s: found a range, expected none: the last phase lasts "
                "until the episode ends"
            )


# The kinds of the package, by name. More kinds would change "mixed", the default scenario.
MOBILITIES = {
    name: object_from(Mobility, {"name": name} | content)
    for name, content in shipped_json("mobilities").items()
}
MIXED = "mixed"


def mobilities_of(scenario: AnyPath) -> tuple[Mobility, ...]:
    """Return the kinds of users that a scenario draws with equal probabilities.

    Raises:
        ValueError: the scenario is unknown, and the message lists the known ones; or
            :func:`read_mobility` refuses the file.
    """
    if str(scenario).endswith(".json"):
        return (read_mobility(scenario),)
    kinds: dict[str, tuple[Mobility, ...]] = {name: (m,) for name, m in MOBILITIES.items()}
    kinds[MIXED] = tuple(MOBILITIES.values())
    return choose(kinds, str(scenario), "scenario", ", or a .json or .csv file")


def read_mobility(path: AnyPath) -> Mobility:
    """Read a kind of user from a JSON file with the fields of :class:`Mobility`, in nested objects.

    "name" is by default the name of the file.

    Raises:
        ValueError: the file is wrong; the message names the file and the error.
        FileNotFoundError: the file does not exist.
    """
    name = {"name": as_name(Path(path).stem)}
    return read_object(path, "mobility", lambda content: object_from(Mobility, name | content))


def plans_of(mobilities: Sequence[Mobility], block_m: float) -> list[TravelPlan]:
    """Return one travel plan per kind of user, for streets at least ``block_m`` apart.

    All plans are padded to equal numbers of phases and gaits; the padding has no effect.

    Raises:
        ValueError: corners do not fit between two crossings.
    """
    acts = [m.phases + m.phases[:1] * m.ends_as_it_began for m in mobilities]
    room = max(ROOM, *(len(phases) for phases in acts))
    gaits = max(ROOM, *(len(phase.gaits) for phases in acts for phase in phases))
    plans = []
    for mobility, phases in zip(mobilities, acts, strict=True):
        apart = block_m / mobility.blocks
        radius = max(phase.limits.corner_radius_m for phase in phases)
        if 2.0 * radius > apart:
            raise ValueError(
                f"corner_radius_m of mobility {mobility.name!r}: found {radius}, expected at most "
                f"half of the {apart:g} m between crossings"
            )
        listed = [_phase_plan(phase, gaits) for phase in phases]
        if mobility.ends_as_it_began:
            listed[-2] = listed[-2]._replace(ends_early=1.0)
        unused = blank_plan(room - len(listed), gaits).phases
        plans.append(TravelPlan(float(mobility.blocks), listed + unused))
    return plans


def _phase_plan(phase: Phase, gaits: int) -> PhasePlan:
    """Return the plan of a phase, filled up to ``gaits`` gaits."""
    wanted = [TravelGait(*(min(value, FAR) for value in astuple(gait))) for gait in phase.gaits]
    wanted += [NO_GAIT] * (gaits - len(wanted))
    duration = [min(end, FAR) for end in phase.duration_s]  # FAR is longer than any episode
    *limits, red = astuple(phase.limits)
    return PhasePlan(TravelPhase._make([*limits, list(red), duration, wanted]), 0.0)
