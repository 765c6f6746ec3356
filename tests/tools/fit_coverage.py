"""Fit houses to logs with noise: ``python tests/tools/fit_coverage.py --count 200``.

Each log is that of a house of other parameters: two weeks of winter, with set points that jump at
random, and white noise of the sensors. The 95 % interval of each parameter must cover the truth in
90 to 99 % of the logs, and the residuals must look like noise in all but a few.
"""

import argparse
import sys
from contextlib import closing
from functools import partial

import numpy as np

import fmugym
from fmugym.envs.house import HOUSE_TASK
from fmugym.records.log_fit import fit_logs
from fmugym.records.plant_log import PlantLog

PARAMETERS = ("UA", "C_w", "c_m", "H_ve", "A_sol", "cop_factor", "P_max")
NOISE = {"T": 0.1, "T_floor": 0.3, "power": 0.03}
"""In K, K and kW."""

UNITS = {"T": "K", "T_floor": "K", "power": "kW"}
LEAST, MOST = 0.90, 0.99
STEP, DAY = 900.0, 96


def measured(env):
    """Outputs, as in ``UNITS``, and inputs of a house."""
    return env.out["T_op"], env.out["T_w"], env.out["P"] / 1000.0, *env.inputs


def house_log(values, seed, days=14, noise=NOISE):
    """The log of a house with some parameters, by name in the FMU's units."""
    rng = np.random.default_rng(seed)
    times = {"clock": "11-06", "episode_length": f"{days}d"}
    task = {"extends": str(HOUSE_TASK), **times, "parameters": {"T_start": 20.0, **values}}
    wanted = np.repeat(rng.uniform(18.0, 23.0, 4 * days), DAY // 4)
    rows = []
    with closing(fmugym.load(task, physical=True)) as env:
        names = [variable.name for variable in env.pool_spec.inputs]
        env.reset(seed=0)
        rows.append(measured(env))
        for setpoint in wanted:
            part_load = np.clip(0.3 + 0.5 * (setpoint + 273.15 - env.out["T_op"]), 0.0, 1.0)
            env.step(np.array([part_load], np.float32))
            rows.append(measured(env))
    columns = dict(zip([*UNITS, *names], np.array(rows, np.float64).T, strict=True))
    for name in names:  # from those that have led to a row to those that hold from it on
        columns[name] = np.append(columns[name][1:], columns[name][-1])
    columns |= {n: columns[n] + rng.normal(0.0, std, len(rows)) for n, std in noise.items()}
    return PlantLog(np.arange(len(rows)) * STEP, columns, UNITS, np.zeros(len(rows)))


def houses(count):
    """Parameters up to a fifth from those of the FMU, and logs of houses with them."""
    with closing(fmugym.load(HOUSE_TASK)) as env:
        own = {name: env.fmu.variable(name).start_number for name in PARAMETERS}
    for seed in range(count):
        factors = np.random.default_rng([1, seed]).uniform(0.8, 1.2, len(own))
        true = {name: value * f for (name, value), f in zip(own.items(), factors, strict=True)}
        yield true, house_log(true, seed)


def fitted(log, parameters=PARAMETERS, **options):
    """The fit of a house to a log, with both start values."""
    make_env = partial(fmugym.load, HOUSE_TASK)
    starts = {"T_m_0": None, "T_w_0": "T_floor"}
    return fit_logs(make_env, [log], dict.fromkeys(parameters), starts=starts, **options)


def main():
    """Count how often intervals cover, print that, and judge it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    count = parser.parse_args().count
    covered, noise = dict.fromkeys(PARAMETERS, 0), 0
    for done, (true, log) in enumerate(houses(count), 1):
        fit = fitted(log, candidates=1)
        for name, (low, high) in fit.confidence_intervals().items():
            covered[name] += int(low <= true[name] <= high)
        noise += all(one.is_noise for one in fit.correlations.values())
        if done % 20 == 0 or done == count:
            sys.stdout.write(f"{done} logs: covered {covered}, noise {noise}\n")
    is_right = all(LEAST <= found / count <= MOST for found in covered.values())
    return 0 if is_right and noise >= 0.97 * count else 1


if __name__ == "__main__":
    sys.exit(main())
