"""TorchRL: PPO on the native vector environment, which TorchRL itself resets (no autoreset)."""

import gymnasium as gym
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, ObservationNorm, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from experiments.evaluation.compare import compare

torch.set_num_threads(1)
torch.manual_seed(0)
envs = gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=64, autoreset_mode="Disabled")
env = GymWrapper(envs, categorical_action_encoding=True)
env = TransformedEnv(env, ObservationNorm(in_keys=["observation"], standard_normal=True))
env.transform.init_stats(num_iter=200, reduce_dim=(0, 1), cat_dim=1)
check_env_specs(env)
env.set_seed(10_000_000)
features = env.observation_spec["observation"].shape[-1]
net = MLP(features, envs.single_action_space.n, num_cells=[64, 64])
chooser = TensorDictModule(net, ["observation"], ["logits"])
actor = ProbabilisticActor(
    chooser, ["logits"], distribution_class=torch.distributions.Categorical, return_log_prob=True
)
critic = ValueOperator(MLP(features, 1, num_cells=[64, 64]), ["observation"])
collector = Collector(env, actor, frames_per_batch=4096, total_frames=200_000)
ppo = ClipPPOLoss(actor, critic, entropy_coeff=0.001, normalize_advantage=True)
gae = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
optimizer = torch.optim.Adam(ppo.parameters(), lr=1e-3)
for frames in collector:
    for _ in range(10):
        losses = ppo(gae(frames).reshape(-1))
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()


def act(observations):
    return net(env.transform(torch.tensor(observations))).argmax(1).numpy()


print(compare({"torchrl-ppo": act}, beside=("fixed-ukf",), episodes=200))
