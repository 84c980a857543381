"""An agent of one's own beside those that are known, in one call: :func:`compare`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.evaluation.comparison import Comparison, compare_scores
from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import score_contenders
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.filters.mode_files import default_modes
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import scene_from

Act = Callable[[NDArray[np.float32]], NDArray[Any]]


class Acting:
    """A function from observations to actions as a policy, which remembers nothing.

    Args:
        name: of the policy, for errors.
        act: observations (n, features) -> actions (n,).
    """

    def __init__(self, name: str, act: Act) -> None:
        self.name, self.act = name, act

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Nothing to forget."""

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """Actions (n,).

        Raises:
            ValueError: the function returned something else.
        """
        actions = np.asarray(self.act(observation))
        n = len(observation)
        if actions.shape != (n,) or actions.dtype.kind not in "iu":
            raise ValueError(
                f"actions of {self.name}: found shape {actions.shape} of {actions.dtype}, "
                f"expected ({n},) of integers, one for each row of the observations"
            )
        return actions.astype(np.int64)


def compare(
    policies: Mapping[str, Act],
    beside: Sequence[str] = ("fixed-ukf", "speed-rule", "imm"),
    scenario: str = "mixed",
    radio: str = "handset",
    episodes: int = 200,
    seed: int = 0,
) -> Comparison:
    """Agents of one's own and known contenders on the same episodes of the default environment.

    Args:
        policies: by name, functions from observations (n, features), of ``n`` episodes at once,
            to actions (n,): numbers of modes. What they see and choose from is that of
            ``gymnasium.make("MmWaveLoc-v0", scenario=..., radio=...)``.
        beside: names of contenders, see :func:`~experiments.evaluation.contenders.contenders`.
        scenario, radio: as of the environment.
        episodes: how many; 1000 or more to publish.
        seed: of the first; test seeds start at 0 and belong to no training.

    Returns:
        The metrics of all, and their paired differences; ``print`` shows it as Markdown.

    Raises:
        ValueError: unknown scenario, radio or contender, a name twice, no episodes, or actions
            that are no numbers of modes, one for each episode.
    """
    source = SimulatedSource(scene_from("street"), radio_from(radio), scenario)
    own = [_contender(name, act, radio) for name, act in policies.items()]
    scores = score_contenders([*own, *beside], source, radio, episodes, seed)
    return compare_scores(
        scores, list(policies), scenario=source.name, radio=radio, episodes=episodes, seed=seed
    )


def _contender(name: str, act: Act, radio: str) -> Contender:
    return Contender(name, default_modes(radio), lambda table: Acting(name, act))
