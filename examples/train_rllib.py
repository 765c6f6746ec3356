"""Train PPO of RLlib on the cart-pole FMU, on this machine or on a Ray cluster.

    pip install -e ".[rllib]"
    python examples/train_rllib.py
    python examples/train_rllib.py --address auto --runners 8    # on a cluster that runs already

Each env runner steps its environments in one call of the native pool. A runner that dies, or whose
node does, is replaced, and the training goes on.
"""

import argparse
import time

import gymnasium
import numpy as np
import ray
import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from fmugym.training.rllib import register_task

ENVS, BATCH, GOAL = 16, 2048, 475.0
RETURN = "episode_return_mean"


def config_of(runners: int, steps: int, seed: int) -> PPOConfig:
    """PPO for the cart-pole: one small network, and a learning rate that falls to nothing."""
    return (
        PPOConfig()
        .environment("cart-pole")
        .env_runners(
            num_env_runners=runners,
            num_envs_per_env_runner=ENVS,
            gym_env_vectorize_mode="vector_entry_point",
        )
        .fault_tolerance(restart_failed_env_runners=True)
        .training(
            train_batch_size_per_learner=BATCH,
            minibatch_size=512,
            num_epochs=8,
            entropy_coeff=0.001,
            lr=[[0, 5e-3], [steps, 1e-5]],
            gamma=0.98,
            lambda_=0.8,
            clip_param=0.2,
            vf_clip_param=1e4,
            use_kl_loss=False,
            grad_clip=0.5,
        )
        .rl_module(
            model_config=DefaultModelConfig(
                fcnet_hiddens=[64], fcnet_activation="tanh", vf_share_layers=True
            )
        )
        .debugging(seed=seed)
    )


def train(algorithm: Algorithm, steps: int) -> None:
    """Train, and tell how long episodes are."""
    start = time.perf_counter()
    while True:
        result = algorithm.train()["env_runners"]
        done = int(result["num_env_steps_sampled_lifetime"])
        took = time.perf_counter() - start
        print(f"{done:7d} steps, {took:4.0f} s: episodes of {result[RETURN]:.0f} steps", flush=True)
        if done >= steps:
            return


def play(algorithm: Algorithm, num_envs: int = 64) -> float:
    """The mean length of one new episode in each of several environments."""
    policy = algorithm.get_module()
    env = gymnasium.make_vec("fmugym/CartPole-v0", num_envs=num_envs)
    observations, _ = env.reset(seed=1_000_000)
    lengths = np.zeros(num_envs, int)
    playing = np.ones(num_envs, bool)
    while playing.any():
        with torch.no_grad():
            logits = policy.forward_inference({"obs": torch.from_numpy(observations)})
        actions = logits["action_dist_inputs"].argmax(dim=1).numpy()
        observations, _, terminated, truncated, _ = env.step(actions)
        lengths += playing
        playing &= ~(terminated | truncated)
    env.close()
    return float(lengths.mean())


def main() -> None:
    """Train, then play."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--address", help="a Ray cluster; by default, one is started here")
    parser.add_argument("--runners", type=int, default=2)
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    ray.init(address=arguments.address, log_to_driver=False)
    register_task("cart-pole", "fmugym/CartPole-v0")
    algorithm = config_of(arguments.runners, arguments.steps, arguments.seed).build_algo()
    train(algorithm, arguments.steps)
    print(f"mean of 64 new episodes: {play(algorithm):.1f} of 500 steps ({GOAL} counts as solved)")
    algorithm.stop()


if __name__ == "__main__":
    main()
