"""A simulated world, epoch by epoch: users on their way, the channel, what a receiver measures.

Functions of numbers that run on lanes, a user to a lane. All randomness comes from the generator
of the lane's own, which a key of 64 bits seeds: an episode is a function of its key.
"""

from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any, NamedTuple

from numba import types
from numba.core.compiler_lock import global_compiler_lock

from mmwave_env.compiler.disk_cache import compiled_callback
from mmwave_env.compiler.fingerprint import fingerprint
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import Program, tree_kernel
from mmwave_env.compiler.transpose import number_at
from mmwave_env.models.channel import (
    Channel,
    ChannelState,
    channel_epoch,
    channel_of,
    draw_channel,
    initial_state,
)
from mmwave_env.models.measurement import Layout, exact_rows
from mmwave_env.models.radio import Radio, deviations
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.linalg import dot
from mmwave_env.numerics.numbers import Number, Vector, sqrt, where, wrap
from mmwave_env.numerics.pytree import flatten, indices, select
from mmwave_env.numerics.random import STATE_WORDS, Dice
from mmwave_env.world.episode import Incoming, blank_incoming
from mmwave_env.world.kinematics import Net, Traveler, move, state_of
from mmwave_env.world.travel import Gait, Phase, attend


class WorldSettings(NamedTuple):
    """What is the same in all episodes of a source."""

    hz_per_mps: Number  # carrier frequency over the speed of light
    channel: Channel  # radio and scene
    drift_hz: Number  # standard deviation of the oscillator's change over a step
    # step_s, stride: length of a substep, and how many make an epoch
    step_s: Number
    stride: Number


class ReceiverState(NamedTuple):
    """Links and receiver between two epochs."""

    dice: list[Number]  # (4,) state of the generator
    anchors: list[list[Number]]  # (L, 3) positions, m
    is_first: Number  # 1 before the first epoch
    channel: ChannelState  # of the links
    bias_hz: Number  # of the oscillator, in the coming epoch


class UserState(NamedTuple):
    """A user who is simulated, between two epochs."""

    dice: list[Number]  # (4,) state of the generator, another than the receiver's
    net: Net  # of the streets
    phases: list[Phase]  # of the episode
    traveler: Traveler  # in the coming epoch


class WorldState(NamedTuple):
    """A simulated episode between two epochs."""

    measured: Incoming  # the epoch just measured; dt is filled in by those who know the time
    settings: WorldSettings
    receiver: ReceiverState
    user: UserState


def measure(
    truth: list[Number], settings: WorldSettings, receiver: ReceiverState, layout: Layout
) -> tuple[Incoming, ReceiverState]:
    """An epoch of a user: the channel, then what a receiver measures.

    Args:
        truth: (6,) position (m) and velocity (m/s).
        settings: radio and scene.
        receiver: links and receiver before it.
        layout: rows of the measurements.
    """
    is_first, dice = receiver.is_first > 0.5, Dice(receiver.dice)
    position, velocity, radio = truth[:3], truth[3:], settings.channel
    speed = sqrt(dot(velocity, velocity))
    exact = exact_rows(position, velocity, receiver.anchors, settings.hz_per_mps, layout)
    distance = [exact[layout.link(a)][0] for a in range(layout.anchors)]
    draws = draw_channel(dice, layout.anchors)
    channel, reception = channel_epoch(radio, receiver.channel, is_first, draws, distance, speed)
    sigma = deviations(radio.floor_variance, radio.bound_variance, reception.snr_db, layout)
    added = [value for link in reception.bias for value in link] + [receiver.bias_hz]
    added += [0.0] * (layout.size - len(added))
    z = [e + s * dice.normal() + b for e, s, b in zip(exact, sigma, added, strict=True)]
    z = [wrap(wrap(v)) if row in layout.angles else v for row, v in enumerate(z)]
    visible = [*reception.detected, reception.detected[0]]
    if layout.odometry:
        visible.append(where(speed < radio.odometry_slowest_mps, 0.0, 1.0))
    measured = Incoming(
        dt=0.0,
        z=_where_seen(visible, z, 0.0, layout),
        signed_sigma=_where_seen(visible, sigma, -1.0, layout),
        snr_db=[
            where(v > 0.5, snr, 0.0) for v, snr in zip(visible, reception.snr_db, strict=False)
        ],
        doppler_spread_hz=reception.doppler_spread_hz,
        truth=truth,
    )
    bias_hz = receiver.bias_hz + settings.drift_hz * dice.normal()
    return measured, receiver._replace(
        dice=dice.state, is_first=0.0, channel=channel, bias_hz=bias_hz
    )


def _where_seen(visible: Vector, rows: Vector, otherwise: float, layout: Layout) -> list[Number]:
    """The rows (rows,) of the groups that are visible (groups,), else a constant."""
    seen = [v > 0.5 for v, k in zip(visible, layout.widths, strict=True) for _ in range(k)]
    return [where(s, value, otherwise) for s, value in zip(seen, rows, strict=True)]


def _observe(w: WorldState, layout: Layout) -> WorldState:
    """An epoch where the traveler is."""
    (x, y), (vx, vy) = state_of(w.user.traveler)
    truth = [x, y, w.user.net.height, vx, vy, 0.0]
    measured, receiver = measure(truth, w.settings, w.receiver, layout)
    return w._replace(measured=measured, receiver=receiver)


def _attend(w: WorldState) -> WorldState:
    """What happens to the travelers to whom something does."""
    user = w.user
    dice, due = Dice(user.dice), user.traveler.due > 0.5
    traveler = attend(dice, user.traveler, user.phases, user.net)
    changed = user._replace(
        dice=select(due, dice.state, user.dice), traveler=select(due, traveler, user.traveler)
    )
    return w._replace(user=changed)


def _move(w: WorldState) -> WorldState:
    traveler = move(w.user.traveler, w.user.net, w.settings.step_s)
    return w._replace(user=w.user._replace(traveler=traveler))


def blank_world(layout: Layout, phases: int, gaits: int) -> WorldState:
    """A world that is sound but nowhere, to be overwritten."""
    still = Traveler(*[0.0] * len(Traveler._fields))._replace(radius=1.0, jerk=1.0)
    gait = Gait(0.0, 0.0, 1.0, 1.0)
    phase = Phase(1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, [gait] * gaits)
    channel = channel_of(Radio("blank"), Scene("blank", (0.0, 0.0, 10.0)), layout, 1.0)
    anchors, dice = [[0.0, 0.0, 10.0 + a] for a in range(layout.anchors)], [0.0] * STATE_WORDS
    return WorldState(
        measured=blank_incoming(layout),
        settings=WorldSettings(1.0, channel, 1.0, 1.0, 1.0),
        receiver=ReceiverState(dice, anchors, 1.0, initial_state(layout.anchors), 0.0),
        user=UserState(dice, Net(1.0, 1.0, 1.0, 0.0, 0.0, 1.5), [phase] * phases, still),
    )


class World:
    """Epochs of a user who is simulated: measured where the user is, who then moves on.

    Args:
        layout: rows of the measurements.
        phases, gaits: how many there is room for.

    Attributes:
        template: a workspace of floats.
        index: the same tree with row numbers as leaves.
        ends: the rows where the measured epoch, the settings and what is kept end.
    """

    def __init__(self, layout: Layout, phases: int, gaits: int) -> None:
        self._layout = layout
        self.template = blank_world(layout, phases, gaits)
        self.index: WorldState = indices(self.template)
        sizes = [len(flatten(part)) for part in self.template]
        self.ends = (sizes[0], sizes[0] + sizes[1], sum(sizes))
        self._compiled: Any = None

    def epoch(self, w: WorldState) -> WorldState:
        """An epoch; on floats for reference."""
        observed, happened, moved = self.parts
        w = observed(w)
        for _ in range(int(w.settings.stride)):
            w = moved(happened(w))
        return w

    def on_lanes(self) -> int:
        """The address of a C function that is an epoch, as a Feed wants it."""
        with global_compiler_lock:
            if self._compiled is None:
                self._compiled = self._compile()
        return self._compiled.address  # type: ignore[no-any-return]

    @property
    def parts(self) -> tuple[Callable[[WorldState], WorldState], ...]:
        """What an epoch consists of: it is measured, something happens now and then, users move."""

        def observed(w: WorldState) -> WorldState:
            return _observe(w, self._layout)

        return observed, _attend, _move

    def _compile(self) -> Any:
        """Of parts: what happens now and then runs only where it happens to any lane."""
        parts, ends = self.parts, self.ends
        look, happen, substep = (tree_kernel(part, self.template, ends) for part in parts)
        row = 8 * WIDTH  # bytes
        due = row * (self.index.user.traveler.due - ends[1])
        stride = row * (self.index.settings.stride - ends[0])

        def on_addresses(measured, settings, kept):  # type: ignore[no-untyped-def]
            places = (measured, settings, kept)
            look(places)
            for _ in range(int(number_at(settings + stride))):
                most = 0.0
                for lane in range(WIDTH):
                    most = max(most, number_at(kept + due + 8 * lane))
                if most > 0.5:
                    happen(places)
                substep(places)

        names = [fingerprint(part, self.template) for part in parts]
        on_addresses.__qualname__ = f"World.{'.'.join(names)}"
        signature = types.void(types.int64, types.int64, types.int64)
        return compiled_callback(signature, on_addresses)


@cache  # for good: feeds know no more than the address of what is compiled
def world_of(layout: Layout, phases: int, gaits: int) -> World:
    """The world of drawn users, compiled once for all sources that are set up alike."""
    return World(layout, phases, gaits)


class OnAWay(NamedTuple):
    """A simulated episode of a user whose way is given."""

    truth: list[Number]  # (6,) of the epoch, loaded
    measured: Incoming  # as of :class:`WorldState`
    settings: WorldSettings
    receiver: ReceiverState


@lru_cache(maxsize=8)
def on_a_way(layout: Layout) -> Program[OnAWay]:
    """The epoch of a user whose way is given."""

    def function(w: OnAWay) -> OnAWay:
        measured, receiver = measure(w.truth, w.settings, w.receiver, layout)
        return w._replace(measured=measured, receiver=receiver)

    measured, settings, receiver, _ = blank_world(layout, 1, 1)
    return Program(function, OnAWay(measured.truth, measured, settings, receiver))


class AsMeasured(NamedTuple):
    """An epoch that nobody filters."""

    measured: Incoming


@lru_cache(maxsize=8)
def as_measured(layout: Layout) -> Program[AsMeasured]:
    """What runs behind a world whose epochs are wanted as they are."""
    return Program(lambda w: w, AsMeasured(blank_incoming(layout)))
