"""The protocol that all policies follow."""

from typing import Protocol

from mmwave_env.numerics.numbers import Array32, Index, Mask


class Policy(Protocol):
    """A map from a batch of observations to a batch of actions."""

    def reset(self, mask: Mask) -> None:
        """Forget the past of environments where ``mask`` is True: a new episode begins there."""
        return  # a policy without a memory has no past to forget

    def __call__(self, observation: Array32) -> Index:
        """Return actions (n,) for observations (n, features)."""
        ...
