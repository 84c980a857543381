"""Minari: episodes of a shipped switcher as a dataset, with infos, and the same ones made again."""

import gymnasium as gym
import minari
import numpy as np

from policies import LearnedSwitch

switch = LearnedSwitch("ppo-handset")
env = gym.make("mmwave_env:MmWaveLoc-v0", radio="handset", infos="fixed")
env = minari.DataCollector(env, record_infos=True)
for seed in range(20):
    switch.reset(np.ones(1, bool))
    observation, over = env.reset(seed=seed)[0], False
    while not over:
        observation, _, _, over, _ = env.step(switch(observation[None])[0])
dataset = env.create_dataset("mmwave/ppo-v0", description="a learned switcher", eval_env=env.spec)

ukf, ppo, fixed = dataset.recover_environment(), [], []
for seed, episode in enumerate(dataset.iterate_episodes()):
    ukf.reset(seed=seed)
    steps = [ukf.step(1) for _ in episode.actions]
    ppo.append((episode.rewards.mean(), episode.infos["ate_m"][-1]))
    fixed.append((np.mean([reward for _, reward, *_ in steps]), steps[-1][4]["ate_m"]))
for name, found in (("ppo", ppo), ("fixed-ukf", fixed)):
    print("{}: reward {:.3f}, ATE {:.3f} m".format(name, *np.mean(found, axis=0)))
