"""The beginning of an episode: everything that is drawn before its first epoch.

The functions of numbers run on lanes, one episode per lane. They draw, from a key, the world that
:mod:`mmwave_env.world.simulation` steps.
"""

from functools import lru_cache, partial
from typing import NamedTuple

from mmwave_env.compiler.program import Program
from mmwave_env.models.measurement import STATE_SIZE, Layout
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import SceneNumbers
from mmwave_env.numerics.numbers import Number, floor
from mmwave_env.numerics.pytree import tree_at
from mmwave_env.numerics.random import Dice, seeded
from mmwave_env.world.kinematics import Net, state_of
from mmwave_env.world.simulation import ReceiverState, UserState, blank_world
from mmwave_env.world.travel import TravelPlan, blank_plan, draw_phases, set_off

# Streams of a key: the way of a user does not depend on the receiver or on the rate of epochs.
USER, RECEIVER = 0, 1


class FirstDraws(NamedTuple):
    """The draws for the beginning of an episode."""

    receiver: ReceiverState
    user: UserState  # not used if a way is given
    choice: Number  # number of the kind of user; if a way is given, uniform in [0, 1) to choose it
    first: list[Number]  # (7,) true state at the first epoch; 0 if a way is given
    prior_noise: list[Number]  # (7,) error of the prior's mean


class Beginning(NamedTuple):
    """A key and the parameters from which an episode begins."""

    key: list[Number]  # (1,) bits of the key
    plans: list[TravelPlan]  # kinds of users; none if a way is given
    scene: SceneNumbers  # the scene, unless scenes are drawn
    duration_s: Number  # duration of the episode
    prior_deviation: list[Number]  # (7,) standard deviation of the prior's mean
    first_bias_hz: Number  # standard deviation of the oscillator's first bias
    begun: FirstDraws


def begin(w: Beginning, streets: RandomScene | None) -> Beginning:
    """Draw the beginning of an episode; the episode of a key depends on the order of the draws."""
    dice, others = Dice(seeded(w.key[0], USER)), Dice(seeded(w.key[0], RECEIVER))
    scene = streets.draw_numbers(dice) if streets else w.scene
    user, position, velocity = w.begun.user, [0.0, 0.0], [0.0, 0.0]
    if w.plans:
        choice = floor(float(len(w.plans)) * dice.uniform())
        plan = tree_at(choice, w.plans)
        block = scene.block_m / plan.closer
        east, north = (floor(extent / block + 0.5) for extent in scene.extent_m)
        x, y = scene.origin_m
        net = Net(block, east, north, x, y, scene.height_m)
        phases = draw_phases(dice, plan.phases, w.duration_s)
        user = UserState([], net, phases, set_off(dice, phases, net))
        user = user._replace(dice=dice.state)
        position, velocity = state_of(user.traveler)
    else:
        choice = dice.uniform()
    bias_hz = w.first_bias_hz * others.normal()
    noise = [deviation * others.normal() for deviation in w.prior_deviation]
    first = [*position, user.net.height, *velocity, 0.0, bias_hz]
    receiver = w.begun.receiver._replace(dice=others.state, anchors=scene.anchors, bias_hz=bias_hz)
    return w._replace(begun=FirstDraws(receiver, user, choice, first, noise))


@lru_cache(maxsize=8)
def beginning(
    layout: Layout, kinds: int, phases: int, gaits: int, streets: RandomScene | None
) -> Program[Beginning]:
    """Return the program of :func:`begin` for lanes.

    Args:
        layout: gives the number of anchors.
        kinds: number of kinds of users; 0 if a way is given.
        phases, gaits: greatest numbers of phases and gaits.
        streets: the random scene to draw scenes from; None for a fixed scene.
    """
    world = blank_world(layout, phases, gaits)
    state = [0.0] * STATE_SIZE
    template = Beginning(
        key=[0.0],
        plans=[blank_plan(phases, gaits)] * kinds,
        scene=SceneNumbers(world.receiver.anchors, 1.0, [1.0, 1.0], [0.0, 0.0], 0.0),
        duration_s=1.0,
        prior_deviation=state,
        first_bias_hz=0.0,
        begun=FirstDraws(world.receiver, world.user, 0.0, state, state),
    )
    return Program(partial(begin, streets=streets), template)
