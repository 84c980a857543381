"""Networks to train: of correctors, with a fast recurrent unit, and of tanh layers.

PyTorch's own recurrent unit calls some fifty small functions per epoch, and spends more time on the
calls than on the numbers. Here the epochs are one compiled loop, forwards and backwards, with the
gradient by hand. The products with the input, and the gradients of all weights, take all epochs at
once.
"""

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from experiments.training.hyperparameters import CorrectorHyperparameters
from mmwave_env.compiler.disk_cache import compiled
from policies.network import squash
from policies.policy_file import CORRECTIONS


@compiled
def _advance(incoming, weight, bias, states, gates, own):  # type: ignore[no-untyped-def]
    """Fill the states of n tracks, epoch after epoch, and what their gradient needs.

    Args:
        incoming: (3, T, n, units) products with the input: reset gates, update gates, candidates.
        weight, bias: (3, units, units) and (3, units) of the products with the state.
        states: (T + 1, n, units) filled from the second on; the first is the state at the start.
        gates: (3, T, n, units) filled with both gates and with the candidates.
        own: (T, n, units) filled with the states' part of the candidates, before the reset gate.
    """
    half = np.float32(0.5)
    for t in range(len(own)):
        for k in range(2):
            gate = gates[k, t]
            gate[:] = half * (incoming[k, t] + np.dot(states[t], weight[k]) + bias[k])
            squash(gate.ravel())  # the logistic function of 2 z is (1 + tanh z) / 2
            gate[:] = half + half * gate
        own[t] = np.dot(states[t], weight[2]) + bias[2]
        candidate = gates[2, t]
        candidate[:] = incoming[2, t] + gates[0, t] * own[t]
        squash(candidate.ravel())
        states[t + 1] = candidate + (states[t] - candidate) * gates[1, t]


@compiled
def _retreat(slope, weight, states, gates, own, of_incoming, of_past):  # type: ignore[no-untyped-def]
    """Fill the gradients of the products of all epochs, from the last to the first.

    Args:
        slope: (T, n, units) gradient of the loss with respect to the states after each epoch, as
            far as no later epoch is concerned.
        weight: (3, units, units) of the products with the state, transposed.
        states, gates, own: as in :func:`_advance`.
        of_incoming, of_past: (3, T, n, units) filled with the gradients of the products with the
            input and with the state.
    """
    full = np.float32(1.0)
    later = np.zeros_like(own[0])  # gradient through the next epoch
    for t in range(len(own) - 1, -1, -1):
        reset = gates[0, t]
        update = gates[1, t]
        candidate = gates[2, t]
        whole = slope[t] + later
        of_candidate = whole * (full - update) * (full - candidate * candidate)
        of_incoming[0, t] = of_candidate * own[t] * reset * (full - reset)
        of_incoming[1, t] = whole * (states[t] - candidate) * update * (full - update)
        of_incoming[2, t] = of_candidate
        of_past[:2, t] = of_incoming[:2, t]
        of_past[2, t] = of_candidate * reset
        later = whole * update
        for k in range(3):
            later += np.dot(of_past[k, t], weight[k])


class _Recurrence(torch.autograd.Function):
    """The states of a unit, given the products with its input."""

    @staticmethod
    def forward(ctx: Any, incoming: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Return the states (T, n, units) after each epoch; the state at the start is zero."""
        _, epochs, n, units = incoming.shape
        states = incoming.new_zeros(epochs + 1, n, units)
        gates = torch.empty_like(incoming)
        own = torch.empty_like(states[1:])
        arrays = (incoming, weight.mT.contiguous(), bias, states, gates, own)
        _advance(*(part.detach().numpy() for part in arrays))
        ctx.save_for_backward(weight, states, gates, own)
        return states[1:]

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        """Return the gradients of the arguments of :meth:`forward`."""
        weight, states, gates, own = ctx.saved_tensors
        of_incoming = torch.empty_like(gates)
        of_past = torch.empty_like(gates)
        arrays = (slope.contiguous(), weight, states, gates, own, of_incoming, of_past)
        _retreat(*(part.detach().numpy() for part in arrays))
        flat = of_past.flatten(1, 2)
        return of_incoming, flat.mT @ states[:-1].flatten(0, 1), flat.sum(1)


class RecurrentUnit(nn.GRU):
    """A gated recurrent unit of one layer: ``torch.nn.GRU`` to rounding, in half the time."""

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]
        """Return the states (T, n, units), or (T, n, 2 units) if bidirectional, for inputs."""
        forwards, *backwards = self.all_weights
        states = _states(x, *forwards)
        for weights in backwards:
            states = torch.cat([states, _states(x.flip(0), *weights).flip(0)], -1)
        return states


def _states(
    x: Tensor, of_input: Tensor, of_state: Tensor, input_bias: Tensor, state_bias: Tensor
) -> Tensor:
    """Return the states (T, n, units) of a unit with these weights and biases."""
    parts = zip(of_input.chunk(3), input_bias.chunk(3), strict=True)  # two gates, then candidates
    incoming = torch.stack([nn.functional.linear(x, *part) for part in parts])
    weight = torch.stack(of_state.chunk(3))
    bias = torch.stack(state_bias.chunk(3))
    return _Recurrence.apply(incoming, weight, bias)  # type: ignore[no-untyped-call,no-any-return]


class CorrectorNetwork(nn.Module):
    """A network: a tanh layer, a gated recurrent unit, and a head with outputs for an ensemble.

    With ``two_way``, a second recurrent unit reads the epochs backwards.
    """

    def __init__(self, features: int, hyper: CorrectorHyperparameters, two_way: bool) -> None:
        super().__init__()
        self.front = nn.Linear(features, hyper.front)
        self.gru = RecurrentUnit(hyper.front, hyper.units, bidirectional=two_way)
        self.head = nn.Linear((1 + two_way) * hyper.units + hyper.front, hyper.head)
        self.out = nn.Linear(hyper.head, hyper.members * CORRECTIONS)
        with torch.no_grad():
            self.out.weight *= 0.1  # at first, corrections are small
            self.out.bias.zero_()

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Map features (T, n, F) to shifts and log factors of sigmas: (T, n, members, 3) each."""
        front = torch.tanh(self.front(features))
        memory = self.gru(front)
        head = torch.tanh(self.head(torch.cat([memory, front], -1)))
        answer = self.out(head).unflatten(-1, (-1, CORRECTIONS))
        return answer[..., :3], answer[..., 3:]


def perceptron(*sizes: int) -> nn.Sequential:
    """Return linear layers, with tanh between them, for these numbers of inputs and neurons."""
    layers: list[nn.Module] = []
    for ends in pairwise(sizes):
        layers += [nn.Linear(*ends), nn.Tanh()]
    return nn.Sequential(*layers[:-1])
