"""Steps per second of one environment, beside Gymnasium's own and FMPy's wrappers, in one run.

    python benchmarks/single.py

Every configuration steps the same cart-pole with the same actions, resets included, for a short
while in each of several rounds; the table shows medians over the rounds, and ratios within them.
"""

from __future__ import annotations

import argparse
import math
import shutil
import statistics
import time
from collections.abc import Callable

import fmpy
import gymnasium as gym
import numpy as np
from fmpy.fmi2 import FMU2Slave

import fmugym

BALANCING = [0, 1, 1, 0]
"""Actions that keep the pole up for some 40 steps."""


def step_environment(env: gym.Env, count: int) -> None:
    """Step an environment, with a reset where an episode ends."""
    env.reset()
    for index in range(count):
        _, _, terminated, truncated, _ = env.step(BALANCING[index & 3])
        if terminated or truncated:
            env.reset()


def fmpy_loop(fmu_path: str, count: int) -> Callable[[], None]:
    """A loop over FMPy's wrappers as its documentation shows it: set, step, get, no rewards."""
    description = fmpy.read_model_description(fmu_path)
    folder = fmpy.extract(fmu_path)
    references = {v.name: v.valueReference for v in description.modelVariables}
    fmu = FMU2Slave(
        guid=description.guid,
        modelIdentifier=description.coSimulation.modelIdentifier,
        unzipDirectory=folder,
    )
    fmu.instantiate()
    shutil.rmtree(folder, ignore_errors=True)  # the library stays loaded
    force, parameters = [references["f"]], [references[n] for n in ("m_pole", "max_step")]
    outputs = [references[n] for n in ("x", "x_dot", "phi", "phi_dot")]

    def run() -> None:
        fmu.reset()
        fmu.setReal(parameters, [0.1, 1.0])
        fmu.setInteger([references["solver"]], [1])
        fmu.setReal([references["theta_0"]], [math.pi / 2])
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        for index in range(count):
            fmu.setReal(force, [10.0 * (2 * BALANCING[index & 3] - 1)])
            fmu.doStep(currentCommunicationPoint=0.02 * index, communicationStepSize=0.02)
            fmu.getReal(outputs)

    return run


def seconds_per_step(run: Callable[[], None], count: int) -> float:
    """Wall-clock time of one step, in seconds."""
    start = time.perf_counter()
    run()
    return (time.perf_counter() - start) / count


def measure(rounds: int, count: int) -> dict[str, list[float]]:
    """Times per step in seconds by configuration, one for each round."""
    made = {
        "fmugym CartPole-v0, gym.make": gym.make("fmugym/CartPole-v0"),
        "Gymnasium CartPole-v1, gym.make": gym.make("CartPole-v1"),
        "fmugym CartPole-v0, bare class": gym.make("fmugym/CartPole-v0").unwrapped,
        "Gymnasium CartPole-v1, bare class": gym.make("CartPole-v1").unwrapped,
    }
    runs: dict[str, Callable[[], None]] = {
        name: lambda env=env: step_environment(env, count) for name, env in made.items()
    }
    runs["FMPy's wrappers in a loop"] = fmpy_loop(str(fmugym.bundled_fmu("CartPole")), count)
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            times[name].append(seconds_per_step(run, count))
    for env in made.values():
        env.close()
    return times


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=10_000, help="steps per round")
    arguments = parser.parse_args()
    times = measure(arguments.rounds, arguments.steps)
    base = times["Gymnasium CartPole-v1, gym.make"]
    print(f"{'configuration':36} {'us a step':>10} {'steps/s':>10} {'speed / Gymnasium make':>24}")
    for name, values in times.items():
        ratio = statistics.median(np.divide(base, values))
        median = statistics.median(values)
        print(f"{name:36} {1e6 * median:10.2f} {1 / median:10,.0f} {ratio:24.2f}")


if __name__ == "__main__":
    main()
