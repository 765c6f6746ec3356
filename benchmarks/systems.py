"""Measure systems of three bundled FMUs: beside their own steps, and beside FMPy's container."""

from __future__ import annotations

import logging
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import fmpy
import numpy as np
from cart_poles import require_native_pool
from fmpy.fmi3 import FMU3Slave
from measure import Effort, MissingError, Run, Sample, Stopwatch, by_turns, ratio, wall_rate
from tables import Table, rate, times

from fmugym import FMU, bundled_fmu
from fmugym.fmi.systems.system import SystemFMU
from fmugym.fmi.systems.system_plan import (
    MASTERS,
    ComponentPlan,
    Evaluation,
    Group,
    Link,
    SystemPlan,
)
from fmugym.pool import Pool, PoolSpec
from fmugym.pool.native_pool import NativePool

__all__ = ["tables"]

SIZE = 1024
BATCH = 20
"""Steps between two looks at the clock."""

NAMES = ("a", "b", "c")


class Model(NamedTuple):
    """The FMU of all three components, in FMI 3.0.

    Attributes:
        name: Of the bundled FMU.
        told: What the table calls it.
        step: The communication step size in seconds.
        value: What is written to the inputs that are not connected.
        input, outputs: The variables that the pool exchanges.
        link: The output that goes to an input of the next component.
        starts: Start values.
    """

    name: str
    told: str
    step: float
    value: float
    input: str
    outputs: tuple[str, str]
    link: tuple[str, str]
    starts: tuple[tuple[str, float], ...] = ()

    @property
    def path(self) -> Path:
        """The file."""
        return bundled_fmu(self.name, "3.0")

    @property
    def links(self) -> tuple[tuple[str, str, str, str], ...]:
        """Component and output, component and input."""
        pairs = pairwise(NAMES)
        return tuple((one, self.link[0], other, self.link[1]) for one, other in pairs)

    @property
    def inputs(self) -> list[str]:
        """The inputs of the system: those that no component writes."""
        driven = {f"{other}.{name}" for _, _, other, name in self.links}
        return [name for name in (f"{one}.{self.input}" for one in NAMES) if name not in driven]

    def inputs_of(self, name: str) -> list[str]:
        """The inputs of a component that anyone sets."""
        driven = [self.link[1]] if name in NAMES[1:] else []
        return list(dict.fromkeys((self.input, *driven)))

    @property
    def read(self) -> list[str]:
        """The outputs of the system."""
        return [f"{one}.{name}" for one in NAMES for name in self.outputs]


MODELS = (
    Model(
        *("House", "houses (a step of 50 ms)", 0.05, 0.29),
        *("u", ("T_air", "T_w"), ("T_air", "T_out")),
    ),
    Model(
        *("Pendulum", "pendulums (a step of explicit Euler)", 0.02, 0.0),
        *("tau", ("q", "q_dot"), ("q", "tau")),
        (("solver", 1), ("max_step", 1.0)),
    ),
)

OWN = "the three FMUs, each in a pool of its own"
CONTAINER = "FMPy's container in a Python loop (Jacobi)"


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    return [_table(model, effort) for model in MODELS]


def _table(model: Model, effort: Effort) -> Table:
    header = ["one thread", f"{SIZE:,} systems", "to their own steps", "to FMPy", "one system"]
    table = Table(f"Steps/s of systems of three {model.told}", [*header, "to FMPy"])
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        try:
            require_native_pool()
        except MissingError as reason:
            table.rows.append([str(reason), *[""] * len(header)])
            return table
        _add(table, by_turns(_runs(stack, model, Path(folder)), effort))
    return table


def _runs(stack: ExitStack, model: Model, folder: Path) -> dict[str, Run]:
    alone = [_alone(stack, model, name) for name in NAMES]
    runs = {OWN: _run(_step_all(alone), SIZE, lambda: _pass_on(model, alone))}
    for master in MASTERS:
        for count in (1, SIZE):
            runs[f"{master} {count}"] = _run(
                _step_all([_system(stack, model, master, count)]), count
            )
    runs[CONTAINER] = _run(_stepping(stack, model, _container(folder, model)), 1)
    return runs


def _alone(stack: ExitStack, model: Model, name: str) -> Pool:
    fmu = FMU(model.path)
    return _pool(stack, model, fmu, model.inputs_of(name), list(model.outputs), SIZE)


def _pass_on(model: Model, pools: Sequence[Pool]) -> None:
    """Let FMUs without connections take the same way as those of a system.

    How long a step takes depends on its values: the sine of a pendulum at rest is faster than that
    of one that turns.
    """
    source, target = model.link
    for (one, other), name in zip(pairwise(pools), NAMES[1:], strict=True):
        values = one.outputs[model.outputs.index(source)]
        other.inputs[model.inputs_of(name).index(target)] = values


def _system(stack: ExitStack, model: Model, master: str, count: int) -> Pool:
    plan = SystemPlan(
        model.name,
        tuple(ComponentPlan(name, model.path) for name in NAMES),
        tuple(Link(*link) for link in model.links),
        tuple(Group((name,)) for name in NAMES),
        tuple(Evaluation((index,)) for index in range(len(model.links))),
        master,
    )
    return _pool(stack, model, SystemFMU(plan), model.inputs, model.read, count)


def _pool(
    stack: ExitStack, model: Model, fmu: FMU, inputs: list[str], outputs: list[str], count: int
) -> Pool:
    spec = PoolSpec(tuple(map(fmu.variable, inputs)), tuple(map(fmu.variable, outputs)), model.step)
    pool = NativePool(fmu, spec, count, logging.getLogger(__name__), threads=1)
    stack.callback(pool.close)
    of_one = {f"{one}.{name}": value for one in NAMES for name, value in model.starts}
    starts = of_one if isinstance(fmu, SystemFMU) else dict(model.starts)
    values = np.repeat(np.array([list(starts.values())], float).T, count, axis=1)
    pool.reset(tuple(map(fmu.variable, starts)), values)
    pool.inputs[:] = model.value
    return pool


def _step_all(pools: Sequence[Pool]) -> Callable[[int], None]:
    def step(_: int) -> None:
        for pool in pools:
            if pool.step_own():
                raise RuntimeError(pool.failure(0))

    return step


def _run(
    step: Callable[[int], None], count: int, prepare: Callable[[], None] = lambda: None
) -> Run:
    def run(seconds: float) -> Sample:
        watch, done = Stopwatch(), 0
        while watch.wall < seconds:
            prepare()
            watch.start()
            for number in range(BATCH):
                step(number)
            watch.stop()
            done += BATCH
        return watch.sample(done * count)

    return run


def _container(folder: Path, model: Model) -> Path:
    tests = str(Path(__file__).parent.parent / "tests" / "tools")
    if tests not in sys.path:
        sys.path.append(tests)
    from container_tools import container

    own = [*model.outputs, model.input, *(name for name, _ in model.starts)]
    names = {f"{one}.{variable}": (one, variable) for variable in own for one in NAMES}
    path: Path = container(folder, model.path, NAMES, model.links, names, model.step)
    return path


def _stepping(stack: ExitStack, model: Model, path: Path) -> Callable[[int], None]:
    """Set the inputs, step and get six outputs, as the pool does."""
    description = fmpy.read_model_description(str(path), validate=False)
    fmu = FMU3Slave(
        guid=description.instantiationToken,
        unzipDirectory=fmpy.extract(str(path)),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="container",
    )
    fmu.instantiate()
    stack.callback(fmu.freeInstance)
    known = {v.name: v for v in description.modelVariables}
    for name, value in model.starts:
        for one in NAMES:
            variable = known[f"{one}.{name}"]
            setter = fmu.setFloat64 if variable.type == "Float64" else fmu.setInt64
            setter([variable.valueReference], [value])
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    inputs = [known[name].valueReference for name in model.inputs]
    outputs = [known[name].valueReference for name in model.read]
    values, count = [model.value] * len(inputs), 0

    def step(_: int) -> None:
        nonlocal count
        fmu.setFloat64(inputs, values)
        fmu.doStep(count * model.step, model.step)
        fmu.getFloat64(outputs)
        count += 1

    return step


def _add(table: Table, samples: dict[str, list[Sample]]) -> None:
    own, base = samples[OWN], samples[CONTAINER]
    table.rows.append([OWN, rate(wall_rate(own)), times(1.0), "", "", ""])
    for master in MASTERS:
        many, one = samples[f"{master} {SIZE}"], samples[f"{master} 1"]
        cells = [rate(wall_rate(many)), times(ratio(many, own)), times(ratio(many, base))]
        cells += [rate(wall_rate(one)), times(ratio(one, base))]
        table.rows.append([f'a system, `"{master}"`', *cells])
        table.data.append({"way": master, "many": wall_rate(many), "one": wall_rate(one)})
    table.rows.append([CONTAINER, "", "", "", rate(wall_rate(base)), times(1.0)])
    table.data.append({"way": CONTAINER, "one": wall_rate(base)})
