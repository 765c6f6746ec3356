"""Run environments for a long time and look whether anything grows: ``python tests/tools/soak.py``.

Each soak does one thing again and again and takes samples of what its processes have. Growth is
what the second half of the samples shows: a straight line through the medians of ten groups of
them, by least squares, with the standard error that follows from what it leaves over.
"""

import argparse
import gc
import itertools
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
from fmu_tools import PlainEnv
from zoo_tools import ZooEnv, parameters, resident_bytes, zoo_fmu

import fmugym
from fmugym.envs.cart_pole import START_VALUES, CartPoleEnv
from fmugym.fmi.bundled import FMI_VERSIONS

SAMPLES = 200
GROUPS = 10
NUM_ENVS = 64
ISOLATED = {"isolation": "process", "workers": 2}
RESOLUTION = {"memory": 2 * 2**20}
"""In bytes; Python alone makes its table of interned strings smaller or larger by 0.3 to 1.9 MB now
and then. The rest is counted."""


# What processes have

RESOURCES = (
    *("memory", "descriptors", "threads", "child processes"),
    *("shared memory", "temporary folders"),
)


def resources():
    """What this process and its children have now, in the order of ``RESOURCES``."""
    family = [os.getpid(), *descendants(os.getpid())]
    return (
        sum(map(resident_bytes, family)),
        sum(entries(f"/proc/{pid}/fd") for pid in family),
        sum(entries(f"/proc/{pid}/task") for pid in family),
        len(family) - 1,
        sum("fmugym" in name for name in os.listdir("/dev/shm")),
        entries(tempfile.gettempdir()),
    )


def descendants(pid):
    """The children of a process, and theirs."""
    family, parents = [pid], parent_of_each()
    for one in family:
        family += [child for child, parent in parents.items() if parent == one]
    return family[1:]


def parent_of_each():
    """The parents of all processes."""
    stats = {int(pid): read(f"/proc/{pid}/stat") for pid in os.listdir("/proc") if pid.isdigit()}
    return {pid: int(text.rpartition(")")[2].split()[1]) for pid, text in stats.items() if text}


def read(path):
    """What a file of the system tells; nothing of a process that has just ended."""
    try:
        return Path(path).read_text()
    except OSError:
        return ""


def entries(folder):
    try:
        return len(os.listdir(folder))
    except OSError:
        return 0


# What is done; each yields after some of it, and tells how much that was.


def single_steps(count):
    """Steps of one environment, with resets where episodes end."""
    env = gymnasium.make("fmugym/CartPole-v0").unwrapped
    env.reset(seed=0)
    for size in portions(count):
        for index in range(size):
            if any(env.step(index & 1)[2:4]):
                env.reset()
        yield
    env.close()


def vector_steps(count, **options):
    """Steps of 64 environments, which reset themselves."""
    env = gymnasium.make_vec("fmugym/CartPole-v0", num_envs=NUM_ENVS, **options)
    env.reset(seed=0)
    actions = np.arange(NUM_ENVS) & 1
    for size in portions(count // NUM_ENVS):
        for _ in range(size):
            env.step(actions)
        yield
    env.close()


def isolated_steps(count):
    """The same in two worker processes."""
    return vector_steps(count, **ISOLATED)


def resets(count):
    """Resets with drawn start values, and four times each with the same, which may be restored."""
    env = CartPoleEnv()
    same = {"model_parameters": dict.fromkeys(START_VALUES, 0.01)}
    env.reset(seed=0)
    for size in portions(count):
        for index in range(size):
            env.reset(options=same if index & 4 else None)
            env.step(1)
        yield
    env.close()


def snapshots(count):
    """States saved and restored, also in another environment, and played again for FMI 1.0."""
    envs = [CartPoleEnv(fmi_version=version) for version in FMI_VERSIONS]
    twins = [CartPoleEnv(fmi_version=version) for version in FMI_VERSIONS]
    for env in envs:
        env.reset(seed=0)
        env.step(1)
    for size in portions(count):
        for index in range(size):
            env, twin = envs[index % 3], twins[index % 3]
            snapshot = env.save_state()
            twin.restore_state(snapshot)
            env.step(index & 1)
            env.restore_state(twin.save_state())
        yield
    for env in (*envs, *twins):
        env.close()


def rollouts(count):
    """Rollouts of 64 candidates, 10 steps each."""
    envs = fmugym.FMUVectorEnv(CartPoleEnv, NUM_ENVS)
    actions = np.random.default_rng(0).integers(0, 2, (NUM_ENVS, 10))
    with CartPoleEnv() as env:
        env.reset(seed=0)
        for size in portions(count // NUM_ENVS // 10):
            for _ in range(size):
                envs.rollout(env.save_state(), actions)
            yield
    envs.close()


def cycles(count, **config):
    """Environments opened, used and closed, of each FMI version in turn."""
    given = {"model_input_names": "f", "model_output_names": "x", "time_step": 0.02}
    for size in portions(count):
        for index in range(size):
            path = fmugym.bundled_fmu("CartPole", FMI_VERSIONS[index % 3])
            env = PlainEnv(path, given | config)
            env.reset()
            env.step(1.0)
            env.close()
        yield


def isolated_cycles(count):
    """The same with a worker process each."""
    return cycles(count, isolation="process")


def crashes(count):
    """A worker that dies of SIGSEGV in each second step, and the reset by the next one."""
    with tempfile.TemporaryDirectory() as folder:
        values = parameters("segv", at=2)
        env = ZooEnv(zoo_fmu(folder, 2), model_parameters=values, isolation="process")
        env.logger.disabled = True  # of each death one warning
        for size in portions(count):
            for _ in range(size):
                env.reset()
                env.step([1.0])
                assert env.step([1.0])[3]
            env.reset()  # samples are to be of a worker that is ready
            yield
        env.close()


def portions(count):
    """Divide what is to be done by the samples."""
    bounds = [count * index // SAMPLES for index in range(SAMPLES + 1)]
    return [end - begin for begin, end in itertools.pairwise(bounds)]


class Soak(NamedTuple):
    """What to do, and how often by default."""

    run: Callable
    option: str
    share: float = 1.0


OPTIONS = {"steps": 10_000_000, "resets": 1_000_000, "cycles": 10_000, "crashes": 1_000}
SOAKS = {
    "steps": Soak(single_steps, "steps"),
    "vector steps": Soak(vector_steps, "steps"),
    "isolated vector steps": Soak(isolated_steps, "steps"),
    "resets": Soak(resets, "resets"),
    "snapshots": Soak(snapshots, "resets"),
    "rollouts": Soak(rollouts, "steps"),
    "open and close": Soak(cycles, "cycles"),
    "open and close, isolated": Soak(isolated_cycles, "cycles", 0.4),
    "crash and restart": Soak(crashes, "crashes"),
}


# What grows


class Growth(NamedTuple):
    """In the second half of a soak, with its standard error."""

    amount: float
    error: float

    def is_zero(self, resolution):
        """Whether it is nothing within measurement: three standard errors, and the resolution."""
        return self.amount <= 3.0 * self.error + resolution


def growth(samples):
    """How much a line through the second half of the samples rises."""
    half = samples[len(samples) // 2 :]
    size = len(half) // GROUPS
    medians = [statistics.median(half[i * size : (i + 1) * size]) for i in range(GROUPS)]
    x, y = np.linspace(-0.5, 0.5, GROUPS), np.array(medians) - statistics.fmean(medians)
    slope = float(x @ y / (x @ x))
    rest = y - slope * x
    error = math.sqrt(float(rest @ rest) / (GROUPS - 2) / float(x @ x))
    return Growth(slope, error)


def measure(work):
    """Do the work; returns the growth of each resource."""
    samples = np.zeros((SAMPLES, len(RESOURCES)))  # they are not to grow themselves
    for sample, _ in zip(samples, work, strict=True):
        gc.collect()
        sample[:] = resources()
    return {name: growth(column) for name, column in zip(RESOURCES, samples.T, strict=True)}


def run(name, count):
    """Run a soak in a temporary folder of its own; returns the growth and the time in s."""
    before, begin = tempfile.tempdir, time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        tempfile.tempdir = folder
        try:
            grown = measure(SOAKS[name].run(count))
        finally:
            tempfile.tempdir = before
    return grown, time.perf_counter() - begin


def leaks(grown):
    """The names of what has grown."""
    return [name for name, one in grown.items() if not one.is_zero(RESOLUTION.get(name, 0.0))]


def row(name, count, duration, grown):
    """A line of the document's table."""
    memory = grown["memory"]
    others = sum(abs(one.amount) for other, one in grown.items() if other != "memory")
    cells = (
        name,
        f"{count:,}",
        f"{duration:.0f} s",
        f"{memory.amount / 1024:.1f} ± {memory.error / 1024:.1f} KiB",
        f"{others:g}",
    )
    return f"| {' | '.join(cells)} |"


def say(text):
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def report(name, count):
    """Be a process that runs a soak and tells of it; ends with 1 if anything has grown."""
    gc.collect()
    gc.freeze()  # what is there already need not be looked at for each sample
    grown, duration = run(name, count)
    say(row(name, count, duration, grown))
    for other in leaks(grown):
        say(f"{other} grew by {grown[other]}")
    sys.exit(1 if leaks(grown) else 0)


def main():
    """Run soaks in processes of their own, so that none finds what another has left."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in OPTIONS.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--only", choices=SOAKS, nargs="+", default=tuple(SOAKS))
    arguments = vars(parser.parse_args())
    say("| soak | how often | time | memory | all that is counted |\n|---|---|---|---|---|")
    troubled = False
    for name in arguments["only"]:
        count = round(SOAKS[name].share * arguments[SOAKS[name].option])
        process = get_context("fork").Process(target=report, args=(name, count))
        process.start()
        process.join()
        troubled |= process.exitcode != 0
    return int(troubled)


if __name__ == "__main__":
    sys.exit(main())
