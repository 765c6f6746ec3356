"""Train PPO of TorchRL on the cart-pole FMU, with all environments in one batch.

    pip install torchrl
    python examples/train_torchrl.py

TorchRL's collector, estimator and loss do the work; the environments step in one call of the
native pool. The program prints the mean return while it trains, and plays 100 episodes at the end.
"""

import argparse
import time

import gymnasium
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import fmugym  # noqa: F401  # registers the environments

ENVS, STEPS, EPOCHS, BATCHES = 64, 32, 8, 4


def network(outputs: int) -> nn.Module:
    """A network with one hidden layer."""
    return nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, outputs))


def make_env(seed: int) -> TransformedEnv:
    """64 cart-poles that also sum up their rewards."""
    envs = gymnasium.make_vec("fmugym/CartPole-v0", num_envs=ENVS, autoreset_mode="disabled")
    env = GymWrapper(envs, categorical_action_encoding=True)
    env.set_seed(seed)
    return TransformedEnv(env, RewardSum())


def train(actor: ProbabilisticActor, steps: int, seed: int) -> None:
    """Improve the policy by proximal policy optimization."""
    critic = ValueOperator(network(1), in_keys=["observation"])
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.001)
    advantage = GAE(gamma=0.98, lmbda=0.8, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-3)
    collector = Collector(make_env(seed), actor, frames_per_batch=ENVS * STEPS, total_frames=steps)
    for number, data in enumerate(collector, 1):
        for group in optimizer.param_groups:
            group["lr"] = 5e-3 * (1 - number * ENVS * STEPS / steps) + 1e-5
        update(loss, advantage, optimizer, data)
        ended = data["next", "done"]
        if ended.any() and number % 5 == 0:
            mean = data["next", "episode_reward"][ended].mean().item()
            print(f"{number * ENVS * STEPS:7d} steps: episodes of {mean:.0f} steps")
    collector.shutdown()


def update(
    loss: ClipPPOLoss, advantage: GAE, optimizer: torch.optim.Optimizer, data: object
) -> None:
    """Go through a batch of steps several times."""
    for _ in range(EPOCHS):
        advantage(data)
        flat = data.reshape(-1)
        for chosen in torch.randperm(len(flat)).chunk(BATCHES):
            losses = loss(flat[chosen])
            optimizer.zero_grad()
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()


def evaluate(actor: ProbabilisticActor) -> float:
    """The mean length of an episode in each of 64 new environments."""
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        data = make_env(1_000_000).rollout(500, actor, break_when_any_done=False)
    first = data["next", "done"].int().argmax(dim=1).squeeze(-1)
    return (first + 1).float().mean().item()


def main() -> None:
    """Train, then play."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=50 * ENVS * STEPS)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(1)
    actor = ProbabilisticActor(
        TensorDictModule(network(2), in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    start = time.perf_counter()
    train(actor, arguments.steps, arguments.seed)
    print(f"trained in {time.perf_counter() - start:.1f} s")
    print(f"mean of new episodes: {evaluate(actor):.1f} of 500 steps")


if __name__ == "__main__":
    main()
