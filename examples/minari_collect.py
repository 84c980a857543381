"""Minari: a data set with observations, actions and rewards of policies in the same episodes.

python examples/minari_collect.py guided none random --episodes 100 --id mmwave-loc/mixed-v0

A policy is one of: `guided`; `guided-ppo`; the file of a policy with a belief per mode; `none` (the
plain IMM); `trust-NAME`, which always raises the probability of the mode NAME; `random`. The
environment has the modes of the first learned policy; without a learned policy, it has the modes of
`guided`. The shell variable MINARI_DATASETS_PATH names the folder of the data sets. The episodes
have training seeds, so policies that learn from the data set can be judged on test episodes.
"""

import argparse
from importlib.metadata import version

import gymnasium as gym
import minari
import numpy as np

from mmwave_env.filters.bank import bank_as_written
from policies import LearnedSwitch

FIRST_SEED = 10_000_000


def player(name, learned, actions, rng):
    """Return a function act(observations (1, features), episode_begins) that returns an action."""
    if name in learned:
        policy = learned[name]

        def act(observations, begins):
            if begins:
                policy.reset(np.array([True]))
            return policy.act(observations)[0]

        return act
    if name == "random":
        return lambda *_: rng.integers(len(actions))
    if name == "none" or name.removeprefix("trust-") in actions:
        index = actions.index(name.removeprefix("trust-"))
        return lambda *_: index
    raise SystemExit(f"policies: found {name!r}, expected one of none, random, {actions[1:]}")


def is_file(name):
    return name.endswith(".safetensors") or name.startswith("guided")


def played(env, act, seed):
    """Play an episode; return the sum of rewards and the mean position error in m."""
    observation, _ = env.reset(seed=seed)
    earned = 0.0
    errors = []
    ended = False
    begins = True
    while not ended:
        action = np.int64(act(observation[None], begins))
        observation, reward, terminated, truncated, info = env.step(action)
        earned = earned + reward
        ended = terminated or truncated
        begins = False
        errors.append(info["position_error_m"])
    return earned, float(np.nanmean(errors))


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("policies", nargs="+")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--id", default="mmwave-loc/mixed-v0")
    parser.add_argument("--radio", default="handset")
    parser.add_argument("--scenario", default="mixed")
    args = parser.parse_args()
    learned = {name: LearnedSwitch(name) for name in args.policies if is_file(name)}
    bank = next(iter(learned.values()), LearnedSwitch("guided")).bank(args.radio)
    env = gym.make(
        "mmwave_env:MmWaveLoc-v0",
        scenario=args.scenario,
        radio=args.radio,
        beliefs="per-mode",
        modes=bank_as_written(bank),
    )
    env = minari.DataCollector(env, record_infos=False)
    actions = ["none", *(mode.name for mode in bank.modes)]
    means = {}
    for name in args.policies:
        act = player(name, learned, actions, np.random.default_rng(0))
        rows = [played(env, act, FIRST_SEED + k) for k in range(args.episodes)]
        means[name], error_m = np.mean(rows, axis=0)
        print(f"{name}: return {means[name]:.1f}, position error {error_m:.3f} m")
    scores = {}
    if "random" in means:  # minari.get_normalized_score needs these scores
        scores = {"ref_min_score": means["random"], "ref_max_score": max(means.values())}
        scores["num_episodes_average_score"] = args.episodes
    names = ", ".join(args.policies)
    dataset = env.create_dataset(
        args.id,
        algorithm_name=names,
        author="mmwave-loc",
        description=f"{names}, each in the same {args.episodes} episodes",
        requirements=[f"mmwave-loc=={version('mmwave-loc')}"],
        **scores,
    )
    played_by = [{"policy": name} for name in args.policies for _ in range(args.episodes)]
    dataset.storage.update_episode_metadata(played_by)


if __name__ == "__main__":
    main()
