"""The protocol that all policies follow."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Policy(Protocol):
    """A map from a batch of observations to a batch of actions."""

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the past of environments in which an episode begins, where ``mask`` is True."""
        return  # a policy without a memory has no past to forget

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return actions (n,) for observations (n, features)."""
        ...
