"""The example half_batches.py: its halves give what one vector environment gives."""

import importlib
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(name="example")
def fixture_example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module("half_batches")


def test_returns_are_those_of_one_vector_environment(example):
    weights = np.random.default_rng(0).normal(size=(6, example.FEATURES))
    halves = [example.Half(3), example.Half(3)]
    returns = example.evaluate(halves, weights, 5)
    whole = gymnasium.make_vec("fmugym/Pendulum-v0", num_envs=6)
    observations, _ = whole.reset(seed=[5] * 6)
    expected = np.zeros(6)
    for _ in range(example.STEPS):
        torques = np.sum(weights * example.features(observations), axis=1, keepdims=True)
        actions = np.clip(torques, -2.0, 2.0).astype(np.float32)
        observations, rewards, *_ = whole.step(actions)
        expected += rewards
    assert returns.tolist() == expected.tolist()
    for envs in (whole, *(half.envs for half in halves)):
        envs.close()


def test_the_program_finds_better_policies():
    options = ["--num-envs", "60", "--rounds", "7", "--compare"]
    command = [sys.executable, EXAMPLES / "half_batches.py", *options]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (0, "")
    *rounds, last, ratio = ended.stdout.splitlines()
    means = [float(line.split()[-1]) for line in rounds]
    assert len(means) == 7
    assert max(means[3:]) > means[0] + 200
    assert last.startswith("weights:")
    assert float(ratio.split()[0]) > 0.0
    assert ratio.endswith("times the rate without overlap")
