"""A study of what the shipped corrector learned, for docs/corrections.png and docs/learning.md.

The policy `corrector` corrects the positions of the policy `guided` with a network. In about two
minutes, ``PYTHONPATH=. python docs/site/corrections.py`` draws the picture and prints the tables.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.evaluation.contenders import contender_from, draw_episodes
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runner import run_contender, score
from experiments.reporting.figures import picture
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import Correction
from mmwave_env.metrics import scored
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode
from mmwave_env.world.simulated import SimulatedSource
from policies import Corrector

# numbers of test episodes in play() and in without_groups()
EPISODES = 1000
FEWER = 500
NAMES = ("speed-rule", "imm-best", "guided", "corrector")
AROUND = np.arange(-6, 16)  # epochs shown around an event
GROUPS = {  # group of features -> words that the names of its features begin with
    "residuals of ranges": ("range residual",),
    "residuals of azimuths of arrival": ("azimuth residual",),
    "residuals of azimuths of departure": ("departure residual",),
    "residuals of elevations": ("elevation residual",),
    "standard deviations of measurements": (
        "range deviation", "azimuth deviation", "departure deviation", "elevation deviation",
    ),
    "SNR and which quantities were measured": ("measured", "last SNR"),
    "standard deviations of the belief": (
        "deviation", "velocity deviation", "correlation", "position variance", "velocity variance",
    ),
    "turn, speed and step": ("turn", "last step", "last speed"),
    "spread of the Doppler shift": ("last Doppler spread",),
    "probabilities of the modes": ("probability",),
    "normalized innovations and gates": ("NIS", "verdict"),
}  # fmt: skip


class Played(NamedTuple):
    """Episodes of the default street, and the errors of contenders in them.

    Attributes:
        episodes: episodes, all equally long.
        truth: (n, T, 6) true positions and velocities.
        errors: contender -> (n, T, 3) estimates minus truth, m.
    """

    episodes: list[Episode]
    truth: Array
    errors: dict[str, Array]


def play(radio: str, names: Sequence[str] = NAMES, count: int = EPISODES) -> Played:
    """Play contenders on test episodes with a radio."""
    episodes = draw_episodes(SimulatedSource(SCENES["street"], RADIOS[radio]), range(count))
    truth = np.stack([
        np.concatenate([e.truth_position_m, e.truth_velocity_mps], axis=1) for e in episodes
    ])  # fmt: skip
    errors = {}
    for name in names:
        contender = contender_from(name, radio)
        errors[name] = run_contender(contender, episodes)["error"]
    return Played(episodes, truth, errors)


def in_motion(played: Played, vectors: Array) -> Array:
    """Return vectors (n, T, 3) as parts along and across the true horizontal velocity, and up."""
    heading = np.arctan2(played.truth[..., 4], played.truth[..., 3])
    cosine = np.cos(heading)
    sine = np.sin(heading)
    x, y, up = np.moveaxis(vectors, -1, 0)
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, up], axis=-1)


def events(played: Played) -> dict[str, NDArray[np.bool_]]:
    """Return, by kind of event, a mask (n, T) of the epochs in which events begin."""
    speed = np.linalg.norm(played.truth[..., 3:5], axis=-1)
    moving = speed > 0.5  # m/s
    visible = np.stack([e.visible[:, : e.layout.anchors].all(axis=1) for e in played.episodes])
    lies = np.stack([_lying(e) for e in played.episodes])
    return {
        "The user stops": _begins(~moving),
        "The user pulls away": _begins(moving),
        "A link is missing": _begins(~visible),
        "A range is 5 standard deviations wrong": _begins(lies),
    }


def _begins(state: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (n, T) of the epochs in which ``state`` begins after 5 epochs without it."""
    begins = state.copy()
    for back in range(1, 6):
        begins[:, back:] &= ~state[:, :-back]
    begins[:, : -AROUND[0]] = False
    begins[:, -AROUND[-1] :] = False
    return begins


def _lying(episode: Episode) -> NDArray[np.bool_]:
    """Return a mask (T,): whether a measured range is over 5 standard deviations wrong."""
    assert episode.truth_position_m is not None
    ways = episode.truth_position_m[:, None] - episode.scene_anchors_m
    rows = slice(0, episode.layout.doppler, 4)
    wrong = episode.measurement[:, rows] - np.linalg.norm(ways, axis=-1)
    far = np.abs(wrong) > 5.0 * np.abs(episode.sigma[:, rows])
    return np.asarray((far & episode.visible[:, : episode.layout.anchors]).any(axis=1))


def draw(played: Played, path: Path) -> None:
    """Draw mean 3D errors, and mean sizes of corrections along the motion, around each event."""
    correction = played.errors["corrector"] - played.errors["guided"]
    along = in_motion(played, correction)[..., 0]
    with picture(path, 9.0, 6.0) as figure:
        panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
        for axes, (title, begins) in zip(panels, events(played).items(), strict=True):
            where = np.argwhere(begins)[:, :, None] + np.stack([0 * AROUND, AROUND])
            episode = where[:, 0]
            epoch = where[:, 1]
            for name in NAMES[1:]:
                length = np.linalg.norm(played.errors[name][episode, epoch], axis=-1)
                axes.plot(AROUND, length.mean(0), label=name)
            shift = np.abs(along[episode, epoch]).mean(0)
            axes.plot(AROUND, shift, "--", color="0.4", label="size of the correction along")
            axes.axvline(0.0, color="0.7", linewidth=1.0, zorder=0)
            axes.set_title(f"{title} ({len(where)} times)")
        for axes in panels[2:]:
            axes.set_xlabel("epochs (s) after the event")
        for axes in panels[::2]:
            axes.set_ylabel("mean error (m)")
        panels[0].set_ylim(bottom=0.0)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=4)


class Without(Corrector):
    """A corrector that reads some of its features from another episode.

    Args:
        path: policy file.
        table: table of the observations.
        begins: words that the names of these features begin with.
    """

    def __init__(self, path: str, table: Observation, begins: tuple[str, ...]) -> None:
        super().__init__(path, table)
        names = [column.name for column in table.columns]
        self._others = [i for i, name in enumerate(names) if name.startswith(begins)]

    def correct(self, observation: NDArray[np.float32]) -> Correction:
        """Correct with some columns from the same epoch of another episode."""
        mixed = observation.copy()
        mixed[:, self._others] = np.roll(observation, 1, axis=0)[:, self._others]
        return super().correct(mixed)


def without_groups(radio: str) -> Iterator[tuple[str, Array]]:
    """Yield the rewards (n,) that corrections add: with all features, then without each group."""
    episodes = draw_episodes(SimulatedSource(SCENES["street"], RADIOS[radio]), range(FEWER))

    def rewards(name: str, policy: Callable[[Observation], Any] | None = None) -> Array:
        contender = contender_from(name, radio)
        if policy:
            contender = replace(contender, policy=policy)
        return score(contender, episodes)["reward"]

    guided = rewards("guided")
    yield "all features", rewards("corrector") - guided
    for group, begins in GROUPS.items():
        policy = lambda table, begins=begins: Without("corrector", table, begins)  # noqa: E731
        yield f"without {group}", rewards("corrector", policy) - guided


def print_errors(played: Played, radio: str) -> None:
    """Print the table of mean absolute errors along, across and up."""
    print(f"| {radio} | along (m) | across (m) | up (m) |\n|---|---|---|---|")
    for name, error in played.errors.items():
        size = np.abs(in_motion(played, error))[:, scored(error.shape[1])].mean(axis=(0, 1))
        print(f"| `{name}` | " + " | ".join(f"{value:.3f}" for value in size) + " |")


if __name__ == "__main__":
    for kind in ("handset", "standard"):
        shown = play(kind)
        if kind == "handset":
            draw(shown, Path(__file__).parents[1] / "corrections.png")
        print_errors(shown, kind)
        print()
    print("| features | minus guided |\n|---|---|")
    for label, gain in without_groups("handset"):
        (interval,) = bootstrap([gain])
        print(f"| {label} | {interval} |")
