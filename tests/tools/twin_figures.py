"""Train on surrogates of FMUs, and compare: ``python tests/tools/twin_figures.py --seeds 5``.

``fmugym train`` may take few steps of the FMU in all, tuning included, or a few minutes of an FMU
that is really slow. Rewards of the test must reach what is wanted, in the median and in the worst
of the seeds; costs stay within their limits; and no agent is worse than the tuned controller: the
paired 95 % interval never lies below 0.
"""

import argparse
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from statistics import median
from time import monotonic
from typing import NamedTuple

import numpy as np
from example_tools import EXAMPLES

import fmugym
from fmugym.cli.task_arguments import maker_of
from fmugym.records.episode_statistics import confidence
from fmugym.training.search_training import Searching

sys.path.extend((str(EXAMPLES), str(EXAMPLES.parent / "benchmarks")))
import training
import two_zones


class Goal(NamedTuple):
    """What is to be reached by so many steps, or else by so many minutes."""

    task: str
    steps: float
    median: float | None = None
    worst: float | None = None
    minutes: float | None = None


GOALS = {
    "house": Goal("fmugym/House-v0", 2000, -260, -263),
    "house of 6000": Goal("fmugym/House-v0", 6000, -259, -261),
    "pendulum": Goal("fmugym/Pendulum-v0", 6000, -400, -700),
    "two zones": Goal("two_zones.toml", 6000),
    "drive": Goal("noisy_drive.toml", 6000),
    "slow room": Goal("slow_room.toml", np.inf, minutes=5.0),
}
"""Without rewards, the tuned controller is to be beaten."""

SLOW = 0.05
MOST_SECONDS = 600
"""A step of the slow room in s, and for how long its training and test may last."""


def write_tasks(folder):
    """Write the tasks of two zones, of a drive with noise, and of a slow room, with their FMUs."""
    two_zones.make_task(folder)
    noise = {"w": 0.1, "w_motor": 0.1, "twist": 0.002}
    variables = training.DRIVE["variables"]
    variables = {
        n: one | ({"noise": noise[n]} if n in noise else {}) for n, one in variables.items()
    }
    tasks = {"noisy_drive": training.DRIVE | {"variables": variables}, "slow_room": training.ROOM}
    source = (EXAMPLES.parent / "benchmarks" / "plant_room.py").read_text()
    begin = '"""Step by explicit Euler."""\n'
    wait = f"{begin}        end = time.process_time() + {SLOW}\n"
    wait += "        while time.process_time() < end:\n            pass\n"
    assert begin in source
    (folder / "slow.py").write_text(
        source.replace(begin, wait).replace("import math", "import math\nimport time")
    )
    drive = EXAMPLES.parent / "benchmarks" / "plant_drive.py"
    for script in (drive, folder / "slow.py"):
        build = [sys.executable, "-m", "pythonfmu", "build", "-f", script, "-d", folder]
        subprocess.run(build, check=True, capture_output=True)
    for name, task in tasks.items():
        fmugym.Task.from_dict(task, folder).write(folder / f"{name}.toml")


def trained(goal, folder, seed):
    """The facts of an agent."""
    task = goal.task if "/" in goal.task else str(folder / goal.task)
    make_env = partial(maker_of(task), physical=True)
    with make_env() as env:
        names = [] if env.resolved is None else [*env.task.document.get("scenarios", {})]
    tests = {name: partial(make_env, scenario=name) for name in names} or {"test": make_env}
    place = folder / f"{goal.task.replace('/', '_')}_{goal.steps:g}_{seed}"
    limits = {"minutes": goal.minutes} if goal.minutes else {"steps": goal.steps}
    return Searching(make_env, tests, place, seed=seed, **limits).run()


def gain_of(facts):
    """The mean of paired differences to the tuned controller, and half of its interval."""
    agent, base = (facts["test"][facts[name]]["rewards"] for name in ("agent", "baseline"))
    differences = [np.subtract(agent[name], base[name]).tolist() for name in agent]
    return sum(map(np.mean, differences)), confidence(*differences) or 0.0


def failures(name, goal, folder, seeds):
    """Train, print a line for each seed, and yield what is missed."""
    rewards = []
    for seed in seeds:
        begin = monotonic()
        facts = trained(goal, folder, seed)
        took, (mean, half) = monotonic() - begin, gain_of(facts)
        own = facts["test"][facts["agent"]]
        rewards.append(own["total_reward"])
        costs = ", ".join(
            f"{cost} {value:.3g}" for cost, value in own["mean_costs"].items() if value
        )
        sys.stdout.write(
            f"{name}, seed {seed}: {facts['agent']} {rewards[-1]:.5g}, gain {mean:.3g} +- "
            f"{half:.2g}, {facts['steps']} steps, {facts['rounds']} rounds, {took:.0f} s; {costs}\n"
        )
        sys.stdout.flush()
        if facts["steps"] > goal.steps:
            yield f"{name}, seed {seed}: {facts['steps']} steps"
        if mean + half < 0 or (goal.median is None and mean - half <= 0):
            yield f"{name}, seed {seed}: the tuned controller is not beaten"
        if goal.minutes and took > MOST_SECONDS:
            yield f"{name}, seed {seed}: {took:.0f} s"
        if "surrogate" not in facts:
            yield f"{name}, seed {seed}: no surrogate was used"
    for what, reached, wanted in (
        ("median", median(rewards), goal.median),
        ("worst", min(rewards), goal.worst),
    ):
        if wanted is not None and reached < wanted:
            yield f"{name}: {what} {reached:.5g}, wanted {wanted}"


def main(argv=None):
    """Print a line for each seed, and what is missed; returns how much that is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--only", action="append", choices=GOALS)
    options = parser.parse_args(argv)
    seeds = range(options.first, options.first + options.seeds)
    with tempfile.TemporaryDirectory() as folder:
        write_tasks(Path(folder))
        missed = [
            text
            for name in options.only or GOALS
            for text in failures(name, GOALS[name], Path(folder), seeds)
        ]
    sys.stdout.write(("\n".join(missed) or "nothing is missed") + "\n")
    return len(missed)


if __name__ == "__main__":
    sys.exit(main())
