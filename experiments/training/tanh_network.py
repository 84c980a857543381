"""Tanh networks of PyTorch on numpy: the same numbers, without a graph of operations.

The networks of a switcher are so small that most of PyTorch's time goes to what stands around
their products. Here a block of rows goes forth and back while it is in the cache.
"""

from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

Rows = NDArray[np.float32]

ROWS = 1024  # that are worked on at once: their activations stay in the second-level cache


class _Layer(NamedTuple):
    """A linear layer and the gradient of what is minimized: views of PyTorch's own memory."""

    weight: Rows  # (outputs, inputs)
    bias: Rows  # (outputs,)
    weight_gradient: Rows
    bias_gradient: Rows
    part: Rows  # (outputs, inputs): of the gradient, from one block


class Gradients:
    """The gradients of some parameters, side by side in memory, and room to compute them.

    Networks run by turns, so they have one room for all: it stays in the cache.

    Args:
        parameters: get these gradients by :meth:`hand_over`.

    Attributes:
        flat: all of them.
    """

    def __init__(self, parameters: list[nn.Parameter]) -> None:
        self._rooms: dict[tuple[str, int, int], Rows] = {}
        self.flat = np.zeros(sum(one.numel() for one in parameters), np.float32)
        ends = np.cumsum([one.numel() for one in parameters]).tolist()
        self._views = {
            cast(torch.Tensor, one): self.flat[end - one.numel() : end].reshape(one.shape)
            for one, end in zip(parameters, ends, strict=True)
        }

    def of(self, linear: nn.Linear) -> _Layer:
        """A layer with the part of the gradients that is its own."""
        weight, bias = linear.weight, linear.bias
        return _Layer(
            weight.detach().numpy(), bias.detach().numpy(),
            self._views[weight], self._views[bias], np.zeros(weight.shape, np.float32),
        )  # fmt: skip

    def room(self, way: str, depth: int, width: int) -> Rows:
        """Memory (ROWS, width) for a way through the layers at a depth."""
        return self._rooms.setdefault((way, depth, width), np.zeros((ROWS, width), np.float32))

    def hand_over(self) -> None:
        """Let the parameters have them as their ``grad``, which an optimizer reads."""
        for parameter, view in self._views.items():
            parameter.grad = torch.from_numpy(view)

    def shorten(self, longest: float) -> None:
        """Scale them to that norm if they are longer, as ``clip_grad_norm_`` does."""
        norm = float(np.sqrt(self.flat @ self.flat))
        if (factor := longest / (norm + 1e-6)) < 1.0:
            self.flat *= np.float32(factor)


class TanhNetwork:
    """Linear layers with tanh between them.

    Args:
        hidden: linear layers, each followed by a tanh.
        head: the last layer.
        gradients: where those of these layers are.
    """

    def __init__(self, hidden: nn.Module, head: nn.Linear, gradients: Gradients) -> None:
        linear = [layer for layer in hidden.children() if isinstance(layer, nn.Linear)]
        widths = [layer.out_features for layer in linear]
        self._layers = [gradients.of(layer) for layer in linear]
        self._head = gradients.of(head)
        self._inputs = linear[0].in_features
        self._activations = [gradients.room("forth", i, width) for i, width in enumerate(widths)]
        self._slopes = [gradients.room("back", i, width) for i, width in enumerate(widths)]
        self._outputs = np.zeros((head.out_features, ROWS), np.float32)
        self._ones = np.ones(ROWS, np.float32)

    def forward(self, rows: Rows) -> Rows:
        """What comes out (outputs, k) of up to :data:`ROWS` rows (k, more or all inputs).

        It is overwritten by the next call.
        """
        k, values = len(rows), rows[:, : self._inputs]
        for layer, room in zip(self._layers, self._activations, strict=True):
            values = np.matmul(values, layer.weight.T, out=room[:k])
            values += layer.bias
            np.tanh(values, out=values)
        outputs = np.matmul(self._head.weight, values.T, out=self._outputs[:, :k])
        outputs += self._head.bias[:, None]
        return outputs

    def backward(self, rows: Rows, slopes: Rows) -> None:
        """Add to the gradients what some rows contribute, the latest of :meth:`forward`.

        No other network with these gradients may have run in between.

        Args:
            rows: (k, more or all inputs).
            slopes: (outputs, k) of what is minimized, by what came out.
        """
        k, head = len(rows), self._head
        before = [rows[:, : self._inputs], *(room[:k] for room in self._activations)]
        ones = self._ones[:k]
        head.weight_gradient[...] += np.matmul(slopes, before[-1], out=head.part)
        head.bias_gradient[...] += slopes @ ones
        back = np.matmul(slopes.T, head.weight, out=self._slopes[-1][:k])
        for i in reversed(range(len(self._layers))):
            layer, after = self._layers[i], before[i + 1]
            after *= after  # nobody needs it any more
            after *= back
            back -= after  # times 1 - tanh^2
            layer.weight_gradient[...] += np.matmul(back.T, before[i], out=layer.part)
            layer.bias_gradient[...] += ones @ back
            if i:
                back = np.matmul(back, layer.weight, out=self._slopes[i - 1][:k])

    def all(self, rows: Rows) -> Rows:
        """What comes out (outputs, k) of any number of rows (k, more or all inputs)."""
        found = np.empty((len(self._outputs), len(rows)), np.float32)
        for first in range(0, len(rows), ROWS):
            found[:, first : first + ROWS] = self.forward(rows[first : first + ROWS])
        return found
