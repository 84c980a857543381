"""What a policy is."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Policy(Protocol):
    """Maps a batch of observations to a batch of actions."""

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the past of the environments (n,) in which an episode begins."""
        return  # one without a memory forgets nothing

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """Actions (n,) for observations (n, features)."""
        ...
