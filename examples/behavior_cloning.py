"""Minari: behavior cloning of the policy `guided`, from a data set of at least 10 episodes.

python examples/minari_collect.py guided --episodes 300 --id mmwave-loc/guided-v0
python examples/behavior_cloning.py mmwave-loc/guided-v0
"""

import sys

import minari
import numpy as np
import torch

from experiments.evaluation.compare import compare

torch.manual_seed(0)
torch.set_num_threads(1)  # the network is too small for more threads to help
dataset = minari.load_dataset(sys.argv[1])
episodes = [(episode.observations[:-1], episode.actions) for episode in dataset]
held = len(episodes) // 10
learned = [torch.tensor(np.concatenate(parts)) for parts in zip(*episodes[:-held], strict=True)]
held_out = [torch.tensor(np.concatenate(parts)) for parts in zip(*episodes[-held:], strict=True)]
network = torch.nn.Sequential(
    torch.nn.Linear(dataset.observation_space.shape[0], 64),
    torch.nn.Tanh(),
    torch.nn.Linear(64, int(dataset.action_space.n)),
)
optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
for _ in range(20):
    for batch in torch.randperm(len(learned[0])).split(256):
        loss = torch.nn.functional.cross_entropy(network(learned[0][batch]), learned[1][batch])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def act(observations):
    return network(torch.tensor(observations)).argmax(1).numpy()


alike = np.mean(act(held_out[0].numpy()) == held_out[1].numpy())
print(f"The clone acts like its teacher in {alike:.1%} of the epochs of held-out episodes.\n")
beside = ("fixed-ukf", "speed-rule", "imm-best", "guided")
print(compare({"cloned": act}, beside, beliefs="per-mode", episodes=1000))
