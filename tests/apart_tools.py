"""Plans and pools of systems with components in processes of their own."""

import contextlib
import logging
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from process_tools import start_values
from system_tools import linear, linear_fmu, system

import fmugym
from fmugym import (
    Component,
    Connection,
    FMUSystem,
    bundled_fmu,
)
from fmugym.pool import PoolSpec
from fmugym.pool.local import local_pool
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import Component as Planned
from fmugym.systems.plan import Link

LOG = logging.getLogger("fmugym.test")
MASSES = ["first.y1", "second.y2"]

where_they_run = pytest.mark.skipif(
    os.name == "nt", reason="they have processes of their own on Unix only"
)


@pytest.fixture(scope="module", name="fmus")
def compiled(tmp_path_factory):
    """The FMU of linear equations by FMI version."""
    folder = tmp_path_factory.mktemp("linear")
    return {v: linear_fmu(folder / f"linear{v}.fmu", v) for v in (1, 2, 3)}


@pytest.fixture(name="make")
def closing_pools():
    """Make pools of plans that are closed after the test."""
    with contextlib.ExitStack() as stack:

        def make(plan, outputs, count=2, inputs=(), time_step=0.1, threads=2, **options):
            private = options.pop("private_libraries", False)
            fmu = SystemFMU(plan)
            variables = tuple(map(fmu.variable, inputs)), tuple(map(fmu.variable, outputs))
            spec = PoolSpec(*variables, time_step, **options)
            pool = local_pool(fmu, spec, count, LOG, threads=threads, private_libraries=private)
            pool.variable = fmu.variable
            return stack.enter_context(contextlib.closing(pool))

        yield make


def apart(plan, *names):
    """The same plan with these components in processes of their own."""
    components = tuple(replace(c, isolate=c.name in names) for c in plan.components)
    return replace(plan, components=components)


def reset(pool, names=(), values=None):
    variables = tuple(map(pool.variable, names))
    values = np.zeros((0, pool.num_instances)) if values is None else np.array(values, float)
    return pool.reset(variables, values)[1]


def play(pool, steps=10):
    """Reset and step; the outputs, shape (steps + 1, k, N)."""
    assert not reset(pool).any(), pool.failure(0)
    rows = [pool.outputs.copy()]
    for _ in range(steps):
        outputs, statuses = pool.step()
        assert not statuses.any(), pool.failure(0)
        rows.append(outputs.copy())
    return np.array(rows)


def children():
    """The processes that this one has started and that run workers of components."""
    found = []
    for process in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if process.name.isdigit():
                status = (process / "status").read_text()
                command = (process / "cmdline").read_bytes()
                if f"PPid:\t{os.getpid()}\n" in status and b"serve_component" in command:
                    found.append(int(process.name))
    return found


def is_running(process):
    """Whether there is such a process, and it is more than a note that it has ended."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False


def with_fault(fmus, faulty, *, isolate=True):
    """A component of which every fault can be asked for, after a sound one."""
    parts = (
        linear("sound", fmus[2], (1.0, 0.0), a=[[-1, 0], [0, 0]], c=np.eye(2)),
        Planned("bad", faulty, isolate=isolate),
    )
    return system(parts, [Link("sound", "y1", "bad", "u")])


NAMES = [f"bad.{name}" for name in start_values()]


def asking_for(*faults, stage="step"):
    """One column of start values for each instance."""
    return np.array([list(start_values(one, stage).values()) for one in faults], float).T


class Chain(fmugym.FMUEnv):
    """Pushes the first pendulum of a chain."""

    def __init__(self, source, **options):
        config = {
            "model_input_names": ["a.tau"],
            "model_output_names": ["a.theta", "b.theta"],
            "model_parameters": {"b.q_0": fmugym.Uniform(-0.2, 0.2)},
            "time_step": 0.02,
            "bounds": {"a.tau": (-1, 1)},
            "max_episode_steps": 20,
        }
        super().__init__(source, config, **options)

    def _is_done(self):
        return abs(self.out["b.theta"]) > 10


def chain(first, second=None, **options):
    """Two pendulums, of which the first drives the second."""
    components = {"a": Component(first, **options), "b": second or bundled_fmu("Pendulum")}
    connection = Connection("a.theta", "b.tau", gain=0.5, convert_units=False)
    return FMUSystem(components, [connection], step_size=0.02)


def episodes(env, seed=3):
    """The observations of a vector environment over the end of its episodes."""
    env.action_space.seed(seed)
    first, _ = env.reset(seed=seed)
    return np.array([first, *(env.step(env.action_space.sample())[0] for _ in range(30))])
