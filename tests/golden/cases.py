"""What the golden results are of: pools and tasks that play a few steps of many FMUs.

Each case is a function of a folder for FMUs and of the keyword arguments of ``NativePool``. Of a
pool it returns the outputs after each call: those of a reset and of some steps of two instances, a
reset of the first of them alone, more steps, and the steps after a snapshot once more; where FMUs
fail, the statuses of all calls, too. Of a task it returns what is observed, rewards and ends.
"""

import logging
import re
import shutil
from contextlib import closing
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path

import c_fmus
import clocks_tools
import exchange_tools
import gymnasium as gym
import numpy as np
import system_tools
import user_tasks
import values_tools
import zoo_tools
from plants import PLANTS
from pool_tools import sampled

import fmugym
from fmugym import FMU, FMUGymError
from fmugym.envs.house import HOUSE_TASK
from fmugym.fmi.bundled import BUNDLED_FMUS, bundled_fmu
from fmugym.fmi.systems.system import SystemFMU
from fmugym.fmi.systems.system_plan import MASTERS
from fmugym.pool import PoolSpec
from fmugym.pool.native_pool import NativePool
from fmugym.pool.pool_spec import SOLVERS, START_TIME

LOG = logging.getLogger("fmugym.test")
ROOT = Path(__file__).parents[2]
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


def played(fmu, inputs, outputs, starts, time_step, options, samplings=None, **spec):
    """Open a pool of two instances and play."""
    given, read = (tuple(map(fmu.variable, names)) for names in (inputs, outputs))
    read = sampled(read, samplings)
    start = tuple(START_TIME if name is START_TIME else fmu.variable(name) for name in starts)
    with closing(NativePool(fmu, PoolSpec(given, read, time_step, **spec), 2, LOG, **options)) as p:
        return play(p, start, len(inputs))


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


WAYS = {
    "means": {"samplings": ("mean", "max")},
    "integrals": {"samplings": ("integral", "min")},
    "warm-up": {"warm_up_steps": 3, "start_time": 2.0, "stop_time": 9.0, "tolerance": 1e-5},
}


def way(name, version, folder, **options):
    """Co-simulation: what a step gives of its substeps, and how an episode begins."""
    fmu = FMU(bundled_fmu("Pendulum", version))
    starts = [START_TIME] if name == "warm-up" else ["theta_0"]
    spec = {"substeps": 4, **WAYS[name]}
    return played(fmu, ["tau"], ["q", "q_dot"], starts, 0.05, options, **spec)


CLOCKED = {
    "in equations": ("ModelExchange", False),
    "in event mode": ("CoSimulation", True),
}
KINDS = {"decimals": clocks_tools.CLOCKS, "fractions": clocks_tools.FRACTIONS}


def clocks(where, kind, folder, **options):
    """Clocks of FMI 3.0, and events between them."""
    interface, event_mode = CLOCKED[where]
    path = folder / f"clocks {where} {kind}.fmu"
    fmu = FMU(clocks_tools.clocks_fmu(path, interface, event_mode, clocks=KINDS[kind]))
    counts = [f"{what} {name}" for what in ("count of", "last") for name in clocks_tools.CLOCKS]
    outputs = ["x", "sample", "alarms", *counts]
    return played(fmu, ["command", "plain"], outputs, ["period"], 0.17, options)


def arrays(interface, folder, **options):
    """Arrays of FMI 3.0."""
    path = folder / f"arrays {interface}.fmu"
    fmu = FMU(values_tools.state_space_fmu(path, (interface,)))
    outputs = ["y[1]", "y[2]", "x[1]", "x[2]"]
    return played(fmu, ["u[1]"], outputs, ["A[1,1]", "A[2,1]"], 0.1, options, max_step=0.01)


def types(version, folder, **options):
    """Numbers of all types."""
    fmu = FMU(values_tools.feedthrough_fmu(folder / f"types {version}.fmu", version))
    kinds, whats = values_tools.TYPES[version], ("in", "out", "parameter")
    names = [[f"{kind}_{what}" for kind in kinds] for what in whats]
    return played(fmu, *names, 0.1, options)


FAULTS = {
    **{f"status {n} of {c}": ("status", c, n) for n in (1, 2, 3) for c in ("step", "set", "get")},
    "status 3 of reset": ("status", "reset", 3),
    "not a number": ("not_a_number", "step", 0),
    "infinite": ("infinite", "step", 0),
}


def fault(name, version, folder, **options):
    """Both instances begin to fail in their second step."""
    path = folder / f"zoo{version}"
    path.mkdir(exist_ok=True)
    fmu = FMU(zoo_tools.zoo_fmu(path, version))
    what, call, status = FAULTS[name]
    wrong = zoo_tools.parameters(what, call, status=status)
    variables = tuple(map(fmu.variable, ("u", "y", *wrong)))
    made = PoolSpec(variables[:1], variables[1:2], 0.5, fault_retries=int(version > 1))
    starts = np.repeat([[value] for value in wrong.values()], 2, axis=1)
    with closing(NativePool(fmu, made, 2, LOG, **options)) as pool:
        calls = [
            partial(pool.reset, variables[2:], starts),
            *[partial(pool.step, np.ones((1, 2)))] * 3,
        ]
        return np.array([faulty(*call()) for call in calls * 2])


def faulty(outputs, statuses):
    """The outputs of a call and its faults; warnings are not told by all pools."""
    faults = np.where(statuses > 1, statuses, 0)
    return [*np.where(faults > 2, np.nan, outputs), faults]


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


def of_docs(name, folder):
    """A task file that stands in a page, or in the examples."""
    page, _, title = name.partition(" ")
    path = folder / f"{page}-{title}.toml"
    if page == "examples":
        path.write_text((ROOT / page / title).read_text(encoding="utf-8"), encoding="utf-8")
    else:
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        text = re.sub(r"^pi = .*\n", "", text, flags=re.M)  # 179b934 reads no ranges of its numbers
        found = re.findall(r"```toml\n(.*?)```", text, re.S)
        path.write_text(next(one for one in found if title in one), encoding="utf-8")
        for fmu in ("house.fmu", "House.fmu"):
            shutil.copy(bundled_fmu("House"), folder / fmu)
        shutil.copy(HOUSE_TASK.with_name("house_year.csv"), folder)
    return fmugym.load(path)


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
    found |= {name: partial(of_user, name) for name in names}
    pages = ("systems.md [system]", "task-file.md fmu =", "tutorial.md fmu =")
    files = ("examples cart_pole.toml", "examples pendulum.toml")
    return found | {name: partial(of_docs, name) for name in (*pages, *files)}


def cases():
    """The functions by name."""
    found = {f"bundled {m} {v}": partial(bundled, m, v) for m, v in BUNDLED_FMUS}
    for model, version, solver in product(MODELS, (1, 2, 3), SOLVERS):
        found[f"exchange {model} {version} {solver}"] = partial(exchange, model, version, solver)
    for name, version, master in product(("pendulum", "masses", "tank"), (2, 3), MASTERS):
        found[f"system {name} {version} {master}"] = partial(system, name, version, master)
    for name, version in product(WAYS, ("1.0", "2.0", "3.0")):
        found[f"way {name} {version}"] = partial(way, name, version)
    for where, kind in product(CLOCKED, KINDS):
        found[f"clocks {where} {kind}"] = partial(clocks, where, kind)
    for name, version in product(FAULTS, (1, 2, 3)):
        found[f"fault {name} {version}"] = partial(fault, name, version)
    found |= {f"types {v}": partial(types, v) for v in (1, 2, 3)}
    found |= {f"arrays {i}": partial(arrays, i) for i in ("CoSimulation", "ModelExchange")}
    for name, make in tasks().items():
        found |= {f"single {name}": partial(single, make), f"vector {name}": partial(vector, make)}
    return found
