"""Train on the two zones, and compare: ``python tests/tools/zones_figures.py --minutes 4``.

``fmugym train`` gets the task of ``examples/two_zones.py``, which has no controller. The table of
controllers that it guesses and tunes must beat the three that were written by hand, and the agent
must beat the table: the paired 95 % intervals over the test's episodes lie above 0 for each seed.
"""

import argparse
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from example_tools import EXAMPLES

import fmugym
from fmugym.records.episode_statistics import confidence
from fmugym.records.evaluation import HELD_OUT_SEED
from fmugym.training.search_training import Searching

if str(EXAMPLES) not in sys.path:
    sys.path.append(str(EXAMPLES))
import two_zones

EPISODES = 100


def by_hand(path, episodes=EPISODES):
    """The rewards of the controllers by hand in the episodes of the test."""
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + episodes)
    return two_zones.rewards_of(two_zones.ByHand(), path, seeds)


def trained(path, folder, episodes=EPISODES, **options):
    """The facts of an agent, and the rewards of it and of its baseline in the test."""
    make_env = partial(fmugym.load, path, physical=True)
    make_test = {"test": make_env}
    facts = Searching(make_env, make_test, folder, episodes=episodes, **options).run()
    names = facts["agent"], facts["baseline"]
    return facts, *(facts["test"][name]["rewards"]["test"] for name in names)


def gain(rewards, others):
    """The mean of paired differences, and half the width of its interval."""
    differences = np.subtract(rewards, others)
    return float(differences.mean()), confidence(differences.tolist())


def main(argv=None):
    """Print a line for each seed; returns how many gains are not sure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args(argv)
    unsure = 0
    with tempfile.TemporaryDirectory() as folder:
        path = two_zones.make_task(Path(folder))
        hand = by_hand(path)
        for seed in range(options.seeds):
            own = Path(folder) / f"agent_{seed}"
            facts, agent, table = trained(path, own, minutes=options.minutes, seed=seed)
            rewards = {"by hand": hand, facts["baseline"]: table, facts["agent"]: agent}
            gains = gain(table, hand), gain(agent, table)
            unsure += sum(mean <= half for mean, half in gains)
            means = ", ".join(f"{name} {np.mean(one):.4g}" for name, one in rewards.items())
            told = ", ".join(f"{mean:.3g} +- {half:.2g}" for mean, half in gains)
            sys.stdout.write(f"seed {seed}, round {facts['rounds']}: {means}; gains {told}\n")
            sys.stdout.flush()
    return unsure


if __name__ == "__main__":
    sys.exit(main())
