"""What the golden results are of: pools and tasks that play a few steps of many FMUs.

Each case is a function of a folder for FMUs and of the keyword arguments of ``local_pool``. Of a
pool it returns the outputs after each call: those of a reset and of some steps of two instances, a
reset of the first of them alone, more steps, and the steps after a snapshot once more. Of a task it
returns what is observed, rewards and ends.
"""

import logging
from contextlib import closing
from dataclasses import replace
from functools import cache, partial
from itertools import product

import c_fmus
import exchange_tools
import gymnasium as gym
import numpy as np
import system_tools
import user_tasks
from plants import PLANTS

import fmugym
from fmugym import FMU, FMUGymError
from fmugym.archive.bundled import BUNDLED, bundled_fmu
from fmugym.pool import PoolSpec
from fmugym.pool.local import local_pool
from fmugym.pool.spec import SOLVERS
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import MASTERS

LOG = logging.getLogger("fmugym.test")
MODELS = {
    "dahlquist": ("u", 0.25),
    "ball": (None, 0.1),
    "van_der_pol": (None, 0.25),
    "stair": (None, 0.75),
    "robertson": (None, 0.01),
    "friction": (None, 0.3),
    "circuit": (None, 0.07),
    "tank": ("u", 0.1),
    "prothero": (None, 0.25),
    "relay": (None, 0.3),
}
"""By model for model exchange: its input, and a step in s within which events happen."""


def play(pool, variables, inputs, seed=0):
    """The outputs after each call, shape (calls, k, 2)."""
    rng, rows = np.random.default_rng(seed), []
    starts = rng.uniform(0.5, 0.8, (len(variables), 2))
    actions = rng.uniform(-1, 1, (12, inputs, 2))

    def note(outputs, statuses):
        rows.append(np.where(statuses > 2, np.nan, outputs))

    note(*pool.reset(variables, starts))
    for action in actions[:4]:
        note(*pool.step(action))
    note(*pool.reset(variables, starts[:, ::-1], mask=np.array([True, False])))
    for action in actions[4:8]:
        note(*pool.step(action))
    try:
        snapshot = pool.save()
    except FMUGymError:  # the FMU cannot save its state
        snapshot = None
    for action in actions[8:]:
        note(*pool.step(action))
    if snapshot is not None:
        pool.restore(snapshot)
        for action in actions[8:]:
            note(*pool.step(action))
    return np.array(rows)


def played(fmu, inputs, outputs, starts, time_step, options, **spec):
    """Open a pool of two instances and play."""
    variables = [tuple(map(fmu.variable, names)) for names in (inputs, outputs, starts)]
    made = PoolSpec(variables[0], variables[1], time_step, **spec)
    with closing(local_pool(fmu, made, 2, LOG, **options)) as pool:
        return play(pool, variables[2], len(inputs))


def bundled(model, version, folder, **options):
    """Co-simulation."""
    given, outputs, start, _ = PLANTS[model]
    step = 900.0 if model == "House" else 0.05
    fmu = FMU(bundled_fmu(model, version))
    return played(fmu, [given], outputs, [start], step, options, substeps=2)


def exchange(model, version, solver, folder, **options):
    """Model exchange: solvers and events."""
    given, step = MODELS[model]
    fmu = FMU(exchanged(folder, model, version))
    outputs = exchange_tools.names(model)[: 2 * len(exchange_tools.STATES[model]) or None]
    inputs = [given] if given else []
    return played(fmu, inputs, outputs, [], step, options, solver=solver, max_step=0.01)


@cache
def exchanged(folder, model, version):
    return exchange_tools.exchange_fmu(folder / f"{model}{version}.fmu", model, version)


def system(name, version, master, folder, **options):
    """Systems: masters, substeps, loops."""
    path = linear(folder, version)
    plan, outputs = {
        "pendulum": (system_tools.parted_pendulum(path), ["pendulum.theta", "damper.y1"]),
        "masses": (system_tools.masses([path, path], (1, 2)), ["first.y1", "second.y2"]),
        "tank": (system_tools.tank([path, path]), ["tank.y1", "control.y1"]),
    }[name]
    return played(SystemFMU(replace(plan, master=master)), [], outputs, [], 0.1, options)


@cache
def linear(folder, version):
    return system_tools.linear_fmu(folder / f"linear{version}.fmu", version)


# Tasks.


def flat(value):
    """The numbers of an observation or action of any space."""
    if isinstance(value, dict):
        return np.concatenate([flat(value[key]) for key in sorted(value)])
    return np.asarray(value, np.float64).ravel()


def single(make, folder, **_):
    """Two episodes of at most 6 steps."""
    rows = []
    with closing(make(folder)) as env:
        env.action_space.seed(3)
        for seed in (5, 6):
            observation, _ = env.reset(seed=seed)
            rows.append([*flat(observation), 0.0, 0.0, 0.0])
            for _ in range(6):
                observation, reward, *ends, _ = env.step(env.action_space.sample())
                rows.append([*flat(observation), reward, *map(float, ends)])
                if any(ends):
                    break
    return np.array(rows)


def vector(make, folder, **_):
    """8 steps of two environments."""
    with closing(fmugym.FMUVectorEnv(partial(make, folder), 2)) as envs:
        envs.action_space.seed(3)
        observations, _ = envs.reset(seed=7)
        rows = [flat(observations)]
        for _ in range(8):
            observations, rewards, *ends, _ = envs.step(envs.action_space.sample())
            rows.append(np.concatenate([flat(observations), rewards, *map(flat, ends)]))
    return np.concatenate(rows)


def made(name, folder):
    return gym.make(f"fmugym/{name}").unwrapped


def of_user(name, folder):
    if name != "Building":
        return getattr(user_tasks, name)()
    return user_tasks.Building(building(folder))


@cache
def building(folder):
    return c_fmus.build_building(folder)


def tasks():
    """Functions that make environments, by name."""
    ids = ("CartPole-v0", "CloudPendulum-v0", "House-v0", "ModelicaCartPole-v0", "Pendulum-v0")
    found = {name: partial(made, name) for name in ids}
    names = ("SwingUp", "Tracking", "Uncompiled", "Goal", "Building")
    return found | {name: partial(of_user, name) for name in names}


def cases():
    """The functions by name."""
    found = {f"bundled {m} {v}": partial(bundled, m, v) for m, v in BUNDLED}
    for model, version, solver in product(MODELS, (1, 2, 3), SOLVERS):
        found[f"exchange {model} {version} {solver}"] = partial(exchange, model, version, solver)
    for name, version, master in product(("pendulum", "masses", "tank"), (2, 3), MASTERS):
        found[f"system {name} {version} {master}"] = partial(system, name, version, master)
    for name, make in tasks().items():
        found |= {f"single {name}": partial(single, make), f"vector {name}": partial(vector, make)}
    return found
