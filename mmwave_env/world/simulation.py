"""The simulation of a world, epoch by epoch: moving users, the channel, the measurements.

The functions compute with plain numbers, so that they can also run on SIMD lanes, one user per
lane. All random numbers come from generators that a key seeds, so a key determines the episode.
"""

from collections.abc import Callable
from functools import cache, lru_cache, partial
from typing import Any, NamedTuple

from numba import types

from mmwave_env.compiler.disk_cache import compiled_callback
from mmwave_env.compiler.lanes import WIDTH, kernel, number_at
from mmwave_env.compiler.program import Program
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import blank_site, exact_rows
from mmwave_env.models.radio import Radio, deviations
from mmwave_env.models.random_scene import RandomScene, RandomSurvey
from mmwave_env.models.scene import Scene, SceneNumbers
from mmwave_env.numerics.linalg import dot, plus, times
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Vector, floor, sqrt, where, wrap
from mmwave_env.numerics.pytree import flatten, select, tree_at
from mmwave_env.numerics.random import STATE_WORDS, Dice, seeded
from mmwave_env.numerics.tape import fingerprint
from mmwave_env.world.channel import (
    Channel,
    ChannelState,
    channel_epoch,
    channel_of,
    initial_state,
)
from mmwave_env.world.episode import Incoming, blank_incoming
from mmwave_env.world.kinematics import STILL, Net, Traveler, move, state_of
from mmwave_env.world.travel import (
    TravelPhase,
    TravelPlan,
    attend,
    blank_plan,
    draw_phases,
    set_off,
)


class WorldSettings(NamedTuple):
    """The settings that are the same in all episodes of a source."""

    hz_per_mps: Number  # carrier frequency divided by the speed of light
    channel: Channel  # constants of the channel, from radio and scene
    dt: Number  # time between epochs, s
    drift_hz: Number  # standard deviation of the change of the oscillator's bias per epoch
    step_s: Number  # length of a substep
    stride: Number  # number of substeps in an epoch
    offered: Vector  # (rows,) 1 where the receiver measures the row; empty if it measures all
    # empty if the user's clock is synchronized; else (3,): how much of the range bias remains from
    # one epoch to the next, 1 or 0; a number that, times the sum of the oscillator biases (Hz) in
    # both epochs, is its drift (m); the standard deviation (m) of the noise that is added to it
    clock: Vector
    # empty if the survey is exact; else (1,): correlation of slow errors in successive epochs
    slow: Vector


class Clock(NamedTuple):
    """The state of the user's clock between two epochs."""

    dice: Numbers  # (4,) state of the clock's own random generator
    bias_m: Number  # range bias in the coming epoch: the speed of light times the clock's offset


class Survey(NamedTuple):
    """Errors of the survey that the receiver's links share; see ``models/random_scene.py``."""

    dice: Numbers  # (4,) state of the survey's own random generator
    offsets: Numbers  # (4,) what is added to the rows of every link
    size: Number  # standard deviation of slow errors, in units of each row's noise
    slow: Numbers  # (4 L,) slow errors in the coming epoch, in these units, of variance 1


class ReceiverState(NamedTuple):
    """The state of links and receiver between two epochs."""

    dice: Numbers  # (4,) state of the receiver's own random generator
    anchors: Matrix  # (L, 3) positions, m
    is_first: Number  # 1 before the first epoch
    channel: ChannelState  # state of the links
    bias_hz: Number  # oscillator bias in the coming epoch
    clock: list[Clock]  # empty if the user's clock is synchronized
    survey: list[Survey]  # empty if the survey is exact


class UserState(NamedTuple):
    """The state of a simulated user between two epochs."""

    dice: Numbers  # (4,) state of the user's own random generator
    net: Net  # net of streets
    phases: list[TravelPhase]  # phases of the episode
    traveler: Traveler  # state in the coming epoch


class WorldState(NamedTuple):
    """The state of a simulated episode between two epochs."""

    measured: Incoming  # the epoch just measured
    settings: WorldSettings
    receiver: ReceiverState
    user: UserState


class OnAWay(NamedTuple):
    """The state of a simulated episode of a user on a given way (trajectory)."""

    truth: Numbers  # (6,) true position and velocity, loaded from a table
    # measured, settings, receiver: as in :class:`WorldState`
    measured: Incoming
    settings: WorldSettings
    receiver: ReceiverState


def measure(w: Any, truth: Numbers, layout: Layout) -> Any:
    """Simulate channel and measurement of an epoch, and the receiver's next state.

    Args:
        w: a :class:`WorldState` or an :class:`OnAWay`; the result is of the same type.
        truth: (6,) true position (m) and velocity (m/s).
        layout: which quantity is in which row of a measurement.
    """
    settings: WorldSettings = w.settings
    receiver: ReceiverState = w.receiver
    is_first = receiver.is_first > 0.5
    dice = Dice(receiver.dice)
    position = truth[:3]
    velocity = truth[3:]
    radio = settings.channel
    speed = sqrt(dot(velocity, velocity))
    exact = exact_rows(position, velocity, receiver.anchors, settings.hz_per_mps, layout)
    distance = [exact[layout.link(a)][0] for a in range(layout.anchors)]
    channel, reception = channel_epoch(radio, receiver.channel, is_first, dice, distance, speed)
    sigma = deviations(radio.floor_variance, radio.bound_variance, reception.snr_db, layout)
    added = [value for link in reception.bias for value in link] + [receiver.bias_hz]
    added += [0.0] * (layout.size - len(added))
    for clock in receiver.clock:
        for a in range(layout.anchors):
            added[4 * a] = added[4 * a] + clock.bias_m
    for errors in receiver.survey:
        for row, slow in enumerate(errors.slow):
            added[row] = added[row] + errors.offsets[row % 4] + errors.size * sigma[row] * slow
    z = [e + s * dice.normal() + b for e, s, b in zip(exact, sigma, added, strict=True)]
    z = [wrap(wrap(v)) if row in layout.angles else v for row, v in enumerate(z)]
    visible = [*reception.detected, reception.detected[0]]
    if layout.odometry:
        visible.append(where(speed < radio.odometry_slowest_mps, 0.0, 1.0))
    present = [v for v, k in zip(visible, layout.widths, strict=True) for _ in range(k)]
    if layout.partial:
        present = times(present, settings.offered)
    measured = Incoming(
        dt=where(is_first, 0.0, settings.dt),
        z=_where_measured(present, z, 0.0),
        signed_sigma=_where_measured(present, sigma, -1.0),
        snr_db=_where_measured(visible[: layout.anchors], reception.snr_db, 0.0),
        doppler_spread_hz=reception.doppler_spread_hz,
        truth=truth,
        doppler_of=blank_incoming(layout).doppler_of,
    )
    bias_hz = receiver.bias_hz + settings.drift_hz * dice.normal()
    both_hz = receiver.bias_hz + bias_hz
    receiver = receiver._replace(
        dice=dice.state, is_first=0.0, channel=channel, bias_hz=bias_hz,
        clock=[_run_on(clock, both_hz, *settings.clock) for clock in receiver.clock],
        survey=[_slowly_changed(errors, *settings.slow) for errors in receiver.survey],
    )  # fmt: skip
    return w._replace(measured=measured, receiver=receiver)


def _run_on(
    clock: Clock, both_hz: Number, remains: Number, half_step: Number, sigma_m: Number
) -> Clock:
    """Return the clock one epoch later; the other arguments are as in :class:`WorldSettings`.

    The range bias changes by noise, and by a drift due to the oscillator biases of both epochs.
    """
    dice = Dice(clock.dice)
    bias_m = remains * clock.bias_m + half_step * both_hz
    bias_m = bias_m + sigma_m * dice.normal()
    return Clock(dice.state, bias_m)


def _slowly_changed(errors: Survey, keep: Number) -> Survey:
    """Return the survey's errors one epoch later, which keep this share of the slow errors."""
    dice = Dice(errors.dice)
    fresh = sqrt(1.0 - keep * keep)
    changed = [keep * error + fresh * dice.normal() for error in errors.slow]
    return errors._replace(dice=dice.state, slow=changed)


def _where_measured(measured: Vector, rows: Vector, otherwise: float) -> Numbers:
    """Return the values ``rows``, replaced by ``otherwise`` where ``measured`` is 0."""
    return [where(s > 0.5, value, otherwise) for s, value in zip(measured, rows, strict=True)]


def _observe(w: WorldState, layout: Layout) -> WorldState:
    """Measure an epoch at the traveler's position."""
    (x, y), (vx, vy) = state_of(w.user.traveler)
    return measure(w, [x, y, w.user.net.height, vx, vy, 0.0], layout)  # type: ignore[no-any-return]


def _apply_events(w: WorldState) -> WorldState:
    """Let the traveler react to an event (new target speed, crossing or phase), if one is due."""
    user = w.user
    dice = Dice(user.dice)
    due = user.traveler.due > 0.5
    traveler = attend(dice, user.traveler, user.phases, user.net)
    changed = user._replace(dice=dice.state, traveler=traveler)
    return w._replace(user=select(due, changed, user))


def _move(w: WorldState) -> WorldState:
    traveler = move(w.user.traveler, w.user.net, w.settings.step_s)
    return w._replace(user=w.user._replace(traveler=traveler))


def blank_world(layout: Layout, phases: int, gaits: int, inexact: bool) -> WorldState:
    """Return a placeholder world with valid numbers, to be overwritten.

    ``inexact`` tells whether the survey may have errors.
    """
    still = STILL._replace(radius=1.0, jerk=1.0)
    channel = channel_of(Radio("blank"), Scene("blank", (0.0, 0.0, 10.0)), layout, 1.0)
    anchors = blank_site(layout).anchors
    dice = [0.0] * STATE_WORDS
    acts = draw_phases(Dice(dice), blank_plan(phases, gaits).phases, 0.0)
    clock = [Clock(dice, 0.0)] if layout.has_bias else []
    offered = [1.0] * layout.size if layout.partial else []
    drift = [1.0, 1.0, 1.0] if layout.has_bias else []
    survey = [Survey(dice, [0.0] * 4, 0.0, [0.0] * layout.doppler)] if inexact else []
    return WorldState(
        measured=blank_incoming(layout),
        settings=WorldSettings(1.0, channel, 1.0, 1.0, 1.0, 1.0, offered, drift, [1.0] * inexact),
        receiver=ReceiverState(
            dice, anchors, 1.0, initial_state(layout.anchors), 0.0, clock, survey
        ),
        user=UserState(dice, Net(1.0, 1.0, 1.0, 0.0, 0.0, 1.5), acts, still),
    )


class World(Program[WorldState]):
    """The simulation of a user's epochs: each epoch is measured, then the user moves on.

    The compiled code is called by a :class:`~mmwave_env.compiler.program.Feed`; the user moves in
    substeps.

    Args:
        layout: which quantity is in which row of a measurement.
        phases: maximum number of phases.
        gaits: maximum number of gaits (target speeds) in a phase.
        inexact: whether the survey may have errors.
    """

    def __init__(self, layout: Layout, phases: int, gaits: int, inexact: bool) -> None:
        blank = blank_world(layout, phases, gaits, inexact)
        super().__init__(partial(_observe, layout=layout), blank)

    @property
    def parts(self) -> tuple[Callable[[WorldState], WorldState], ...]:
        """Return the functions for measurement, events and motion; the last two run per substep."""
        return self.function, _apply_events, _move

    def _compile(self) -> Any:
        """Return the compiled :attr:`parts` as one function, which skips events if none is due."""
        sizes = [len(flatten(part)) for part in self.template]
        # the rows at which three parts end: the measured epoch; the settings; receiver and user
        ends = (sizes[0], sizes[0] + sizes[1], sum(sizes))
        parts = self.parts
        observe, apply_events, substep = [kernel(part, self.template, ends) for part in parts]
        row = 8 * WIDTH  # bytes
        due = row * (self.index.user.traveler.due - ends[1])
        stride = row * (self.index.settings.stride - ends[0])

        def on_addresses(measured, settings, kept):  # type: ignore[no-untyped-def]
            places = (measured, settings, kept)
            observe(places)
            for _ in range(int(number_at(settings + stride))):
                most = 0.0
                for lane in range(WIDTH):
                    most = max(most, number_at(kept + due + 8 * lane))
                if most > 0.5:
                    apply_events(places)
                substep(places)

        names = [fingerprint(part, self.template) for part in parts]
        on_addresses.__qualname__ = f"World.{'.'.join(names)}"
        signature = types.void(types.int64, types.int64, types.int64)
        return compiled_callback(signature, on_addresses)


# The world that all sources with the same arguments share. It is never dropped, because a Feed
# holds only the address of the compiled code.
world_of = cache(World)


@lru_cache(maxsize=8)
def on_a_way(layout: Layout, inexact: bool) -> Program[OnAWay]:
    """Return the program that simulates an epoch of a user on a given way."""
    measured, settings, receiver, _ = blank_world(layout, 1, 1, inexact)
    template = OnAWay(measured.truth, measured, settings, receiver)
    return Program(lambda w: measure(w, w.truth, layout), template)


class AsMeasured(NamedTuple):
    """An epoch that is measured but not filtered."""

    measured: Incoming


@lru_cache(maxsize=8)
def as_measured(layout: Layout) -> Program[AsMeasured]:
    """Return the program that passes on the epochs of a world unchanged."""
    return Program(lambda w: w, AsMeasured(blank_incoming(layout)))


# Each key seeds four streams of random numbers. So the trajectory is the same with any radio, and
# a clock offset or a wrong survey changes neither the trajectory nor the receiver's noise.
USER = 0
RECEIVER = 1
CLOCK = 2
SURVEY = 3


class StartState(NamedTuple):
    """A key, the parameters of an episode's beginning, and what is drawn before its first epoch."""

    key: Numbers  # (1,) bits of the key
    plans: list[TravelPlan]  # kinds of users; empty if ways are given
    scene: SceneNumbers  # the scene; not used if every episode draws its own
    duration_s: Number  # duration of the episode
    prior_deviation: Numbers  # (7,) standard deviations; (8,) with a clock offset
    first_bias_hz: Number  # standard deviation of the oscillator's first bias
    # drawn from them
    receiver: ReceiverState
    user: UserState  # not used if a way is given
    choice: Number  # index of the kind of user; if ways are given, a number in [0, 1)
    # (7,) true state at the first epoch, followed by the range bias (m) if the clock has an offset;
    # if ways are given, the position and velocity in it are meaningless
    first: Numbers
    # (7,) error of the prior's mean; with a clock offset (8,), ending with minus the range bias
    prior_noise: Numbers
    mapped: Matrix  # (L, 3) positions of the anchors on the map, which filters use


def begin(w: StartState, streets: RandomScene | None, survey: RandomSurvey | None) -> StartState:
    """Draw the beginning of an episode.

    Keep the order of the draws: otherwise every key would give another episode. ``streets`` is the
    random scene from which the episode draws its own scene, or None if the scene is fixed.
    ``survey`` is the distribution of survey errors, or None if the survey is exact.
    """
    dice = Dice(seeded(w.key[0], USER))
    others = Dice(seeded(w.key[0], RECEIVER))
    scene = streets.draw_numbers(dice) if streets else w.scene
    user = w.user
    position = [0.0, 0.0]
    velocity = [0.0, 0.0]
    if w.plans:
        choice = floor(float(len(w.plans)) * dice.uniform())
        plan = tree_at(choice, w.plans)
        block = scene.block_m / plan.closer
        east = floor(scene.extent_m[0] / block + 0.5)
        north = floor(scene.extent_m[1] / block + 0.5)
        x, y = scene.origin_m
        net = Net(block, east, north, x, y, scene.height_m)
        phases = draw_phases(dice, plan.phases, w.duration_s)
        traveler = set_off(dice, phases, net)
        user = UserState(dice.state, net, phases, traveler)
        position, velocity = state_of(traveler)
    else:
        choice = dice.uniform()
    bias_hz = w.first_bias_hz * others.normal()
    noise = [deviation * others.normal() for deviation in w.prior_deviation[:7]]
    first = [*position, user.net.height, *velocity, 0.0, bias_hz]
    receiver = w.receiver._replace(dice=others.state, anchors=scene.anchors, bias_hz=bias_hz)
    for deviation in w.prior_deviation[7:]:
        own = Dice(seeded(w.key[0], CLOCK))
        bias_m = deviation * own.normal()
        receiver = receiver._replace(clock=[Clock(own.state, bias_m)])
        first = [*first, bias_m]
        noise = [*noise, 0.0 - bias_m]
    mapped = scene.anchors
    if survey:
        own = Dice(seeded(w.key[0], SURVEY))
        offsets, moves, size = survey.draw_numbers(own, len(scene.anchors))
        mapped = [plus(at, by) for at, by in zip(scene.anchors, moves, strict=True)]
        slow = [own.normal() for _ in range(4 * len(scene.anchors))]
        receiver = receiver._replace(survey=[Survey(own.state, offsets, size, slow)])
    return w._replace(
        receiver=receiver, user=user, choice=choice, first=first, prior_noise=noise, mapped=mapped
    )


@lru_cache(maxsize=8)
def start_program(
    layout: Layout,
    kinds: int,
    phases: int,
    gaits: int,
    streets: RandomScene | None,
    survey: RandomSurvey | None,
) -> Program[StartState]:
    """Return the program that runs :func:`begin` on SIMD lanes.

    ``kinds`` is the number of kinds of users, 0 if ways are given. ``phases`` and ``gaits`` are as
    in :class:`World`, and ``streets`` and ``survey`` are as in :func:`begin`.
    """
    world = blank_world(layout, phases, gaits, survey is not None)
    state = [0.0] * layout.state_size
    template = StartState(
        key=[0.0],
        plans=[blank_plan(phases, gaits)] * kinds,
        scene=SceneNumbers(world.receiver.anchors, 1.0, [1.0, 1.0], [0.0, 0.0], 0.0),
        duration_s=1.0,
        prior_deviation=state,
        first_bias_hz=0.0,
        receiver=world.receiver,
        user=world.user,
        choice=0.0,
        first=state,
        prior_noise=state,
        mapped=world.receiver.anchors,
    )
    return Program(partial(begin, streets=streets, survey=survey), template)
