"""The example half_batches.py: its halves give what one vector environment gives."""

import gymnasium
import numpy as np
from example_tools import run_example


def test_returns_are_those_of_one_vector_environment(example):
    halving = example("half_batches")
    weights = np.random.default_rng(0).normal(size=(6, halving.FEATURES))
    halves = [halving.Half(3), halving.Half(3)]
    returns = halving.evaluate(halves, weights, 5)
    whole = gymnasium.make_vec("fmugym/Pendulum-v0", num_envs=6)
    observations, _ = whole.reset(seed=[5] * 6)
    expected = np.zeros(6)
    for _ in range(halving.STEPS):
        torques = np.sum(weights * halving.features(observations), axis=1, keepdims=True)
        actions = np.clip(torques, -2.0, 2.0).astype(np.float32)
        observations, rewards, *_ = whole.step(actions)
        expected += rewards
    assert returns.tolist() == expected.tolist()
    for envs in (whole, *(half.envs for half in halves)):
        envs.close()


def test_the_program_finds_better_policies():
    options = "--num-envs", "60", "--rounds", "7", "--compare"
    *rounds, last, ratio = run_example("half_batches.py", *options, warnings="default").splitlines()
    means = [float(line.split()[-1]) for line in rounds]
    assert len(means) == 7
    assert max(means[3:]) > means[0] + 200
    assert last.startswith("weights:")
    assert float(ratio.split()[0]) > 0.0
    assert ratio.endswith("times the rate without overlap")
