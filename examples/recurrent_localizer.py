"""A network that learns to localize without a filter, as an estimator for comparisons.

python examples/recurrent_localizer.py 10000000 120
mmwave-loc compare --policies examples.recurrent_localizer:Localizer fixed-ukf imm imm-best

The first command trains on 120 lots (batches) of episodes, whose seeds begin at 10 000 000, and
writes localizer.safetensors, which the second command reads. The network gets the formulas of the
measurements and the noise that the receiver states, but must learn from episodes how users move. In
every epoch it moves its last position by its last velocity and compares the measurements with the
values expected there. Then a recurrent layer chooses which shares of these differences are added to
position, velocity and oscillator bias. The layer also chooses a weight for every measured direction
d; the sum of weight * d d' is the inverse of the position's covariance.
"""

import sys
from dataclasses import replace

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from experiments.evaluation.agents import Estimator
from experiments.evaluation.protocol import TRAINED, sites
from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import measurement_of
from mmwave_env.models.measurement import blank_site, groups_of
from mmwave_env.numerics.linalg import pack
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import blank_incoming, columns_of
from mmwave_env.world.keys import keys_of

FILE = "localizer.safetensors"
EPISODES = 8  # number of episodes in a lot from each training site of the benchmark
STEPS_S = (1.0, 1.0, 1.0, 0.5, 0.25, 0.1)  # seconds between epochs in training, equally probable
EPOCHS = 20  # number of epochs between two optimizer steps; gradients flow through these epochs
# widths of layers
FRONT = 32
MEMORY = 48


def rows_of(x, site, epoch, layout):
    """Return the rows (n, 3 L + 1, 10) of an epoch with L links, linearized at states x (n, 7).

    The rows are range, azimuth and elevation of every link, then the Doppler shift. The columns are
    innovation, variance, visibility and, from the fourth on, the gradient (7,) of the measurement.
    """
    state = [*x.detach().double().numpy().T]
    stated = measurement_of(Mode("as stated"), initial_memory(layout, 1), epoch, site, layout)
    groups = groups_of(state, stated)[: layout.anchors + 1]
    rows = [
        np.broadcast_arrays(state[0], innovation, variance, visible, *gradient[:7])[1:]
        for group, visible in zip(groups, epoch.visible, strict=False)
        for innovation, variance, gradient in zip(*group[:3], strict=True)
    ]
    return torch.from_numpy(np.array(rows, np.float32)).permute(2, 0, 1)


class Network(nn.Module):
    """A recurrent layer for the user, and layers that all links share."""

    def __init__(self):
        super().__init__()
        self.link = nn.Linear(15, FRONT)
        self.recurrent = nn.GRUCell(FRONT + 7, MEMORY)
        self.head = nn.Linear(FRONT + MEMORY, FRONT)
        self.gains = nn.Linear(FRONT, 9)
        self.of_doppler = nn.Linear(MEMORY, 2)
        with torch.no_grad():  # begin with shares that hardly depend on the input
            for layer in (self.gains, self.of_doppler):
                layer.weight *= 0.1
            first = [-0.5, -0.5, -3.0, -1.5, -1.5, -5.0, 0.0, 0.0, 0.0]
            self.gains.bias.copy_(torch.tensor(first))

    def forward(self, x, kept, rows, others):
        """Return new states, the next ``kept``, and inverse covariances of positions (n, 3, 3).

        Args:
            x: (n, 7) predicted states.
            kept: (n, MEMORY + 1) memory, then the standard deviation, m, of a fix from one epoch.
            rows: (n, 3 L + 1, 10) from :func:`rows_of`.
            others: (n, 2) seconds since the previous epoch, and Doppler spread, Hz.
        """
        (innovation, variance, visible) = rows[..., :3].unbind(-1)
        gradient = rows[..., 3:]
        innovation = visible * (innovation - (gradient @ (x - x.detach())[..., None])[..., 0])
        miss = innovation[:, -1:]
        noise = variance[:, -1:] ** 0.5
        heard = visible[:, -1:]
        toward = gradient[:, -1, 3:6]
        hz = toward.norm(dim=-1, keepdim=True).clamp(min=1.0)  # Hz per m/s
        slope = gradient[:, :-1, :3].norm(dim=-1).clamp(min=1e-6)  # per meter
        basis = gradient[:, :-1, :3] / slope[..., None]
        known = visible[:, :-1] * (slope > 1e-6)
        gap = innovation[:, :-1] / slope
        sigma = variance[:, :-1] ** 0.5 / slope
        information = known / sigma**2
        total = ((basis @ basis.mT) ** 2 @ information[..., None])[..., 0].clamp(min=1e-9)
        share = information / total
        count = known.sum(1, keepdim=True)
        scale = ((known / total).sum(1, keepdim=True) / count.clamp(min=1.0)) ** 0.5
        scale = torch.where(count > 0.0, scale, kept[:, -1:])
        speeds = torch.asinh((basis @ x[:, 3:6, None])[..., 0])
        parts = [torch.asinh(gap / sigma), known * sigma.log(), share, speeds, known]
        links = torch.tanh(self.link(torch.stack(parts, -1).unflatten(1, (-1, 3)).flatten(2)))
        whole = [torch.asinh(miss / noise), heard * (noise / hz).log(), heard, scale.log()]
        whole += [others[:, :1], torch.asinh(others[:, 1:] / hz)]
        whole += [torch.asinh(x[:, 3:6].norm(dim=-1, keepdim=True))]
        memory = self.recurrent(torch.cat([links.mean(1), *whole], 1), kept[:, :-1])
        of_user = memory[:, None].expand(-1, links.shape[1], -1)
        gains = self.gains(torch.tanh(self.head(torch.cat([links, of_user], -1))))
        gains = gains.unflatten(-1, (3, 3)).transpose(1, 2).flatten(2)  # (n, 3, 3 L)
        shares = torch.sigmoid(gains[:, :2]) * torch.tensor([[2.0], [1.0]])
        step, push = ((share * gap)[:, None] * shares.clamp(max=1.0) @ basis).unbind(1)
        faster, drift = (torch.sigmoid(self.of_doppler(memory) - 1.0) * miss).split(1, dim=1)
        x = x + torch.cat([step, push + faster * toward / hz**2, drift], 1)
        weight = gains[:, 2].clamp(-5.0, 5.0).exp() / scale**2
        inverse = basis.mT @ (weight[..., None] * basis) + 1e-4 * torch.eye(3)
        return x, torch.cat([memory, scale], 1), inverse


def beliefs(network, layout, site, epochs):
    """Yield states (n, 7), and inverse covariances of positions (n, 3, 3)."""
    x = torch.from_numpy(np.stack(site.prior_x[:7], axis=1).astype(np.float32))
    kept = torch.cat([x.new_zeros(len(x), MEMORY), x.new_ones(len(x), 1)], 1)
    for number, epoch in enumerate(epochs):
        if number % EPOCHS == 0:
            x = x.detach()
            kept = kept.detach()
        others = np.broadcast_arrays(epoch.dt, epoch.doppler_spread_hz, site.prior_x[0])[:2]
        others = torch.from_numpy(np.array(others, np.float32).T)
        x = torch.cat([x[:, :3] + others[:, :1] * x[:, 3:6], x[:, 3:]], 1)
        x, kept, inverse = network(x, kept, rows_of(x, site, epoch, layout), others)
        yield x, inverse


class Localizer(Estimator):
    """A trained network, read from a file. Variances of velocity and bias are placeholders."""

    at_once = True

    def __init__(self, file=FILE):
        self._network = Network()
        self._network.load_state_dict(load_file(file))

    def track(self, pipeline, site, epochs):
        """Yield means and packed covariances."""
        P = np.tile(np.eye(len(site.prior_x)), (len(site.prior_x[0]), 1, 1))
        with torch.no_grad():
            for x, inverse in beliefs(self._network, pipeline.layout, site, epochs):
                P[:, :3, :3] = np.linalg.inv(inverse.double().numpy())
                spread = pack([[*row] for row in np.moveaxis(P, 0, -1)])
                yield [*x.double().numpy().T, *site.prior_x[7:]], spread


def loss_of(error, inverse):
    """Return the loss of errors (..., 3): the reward's costs, and a tenth of -log(density)."""
    squared = (error[..., None, :] @ inverse @ error[..., None])[..., 0, 0].clamp(min=1e-6)
    length = (error.square().sum(-1) + 1e-6) ** 0.5
    density = 0.5 * squared.clamp(max=50.0) - 0.5 * torch.logdet(inverse)
    return (length.clamp(max=30.0) + 0.2 * (squared / 3.0).log().abs() + 0.1 * density).mean()


def lots(seed, count):
    """Yield layout, site, epochs and true positions (T, n, 3) of lots, for training."""
    rng = np.random.default_rng(seed)
    sources = [s.source() for s in sites() if s.kind == TRAINED]
    for first in range(seed, seed + count * EPISODES, EPISODES):
        keys = keys_of(range(first, first + EPISODES))
        some = [replace(s, dt=float(rng.choice(STEPS_S))).sample_batch(keys) for s in sources]
        layout = some[0].layout
        blank = blank_incoming(some[0].layout)
        table = np.concatenate([batch.table for batch in some]).transpose(1, 2, 0)
        site = np.concatenate([batch.site for batch in some]).T
        epochs = (unflatten(blank, iter(rows)).epoch(layout) for rows in table)
        truth = torch.from_numpy(table[:, columns_of(layout).truth[:3]].astype(np.float32))
        yield layout, unflatten(blank_site(layout), iter(site)), epochs, truth.mT


def train(seed, count):
    """Return a network trained on lots of episodes."""
    torch.manual_seed(seed)
    network = Network()
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, count)
    for number, (*world, truth) in enumerate(lots(seed, count), 1):
        states = beliefs(network, *world)
        losses = []
        for true in truth.split(EPOCHS):
            x, inverse = map(torch.stack, zip(*(next(states) for _ in true), strict=True))
            loss = loss_of(true - x[..., :3], inverse)
            optimizer.zero_grad()
            loss.backward()
            if nn.utils.clip_grad_norm_(network.parameters(), 1.0).isfinite():
                optimizer.step()
            losses.append(loss.item())
        schedule.step()
        print(f"lot {number} of {count}: loss {np.mean(losses):.3f}")
    return network


if __name__ == "__main__":
    torch.set_num_threads(1)
    save_file(train(int(sys.argv[1]), int(sys.argv[2])).state_dict(), FILE)
