"""Measure a system of three bundled FMUs: beside their own steps, and beside FMPy's container."""

from __future__ import annotations

import logging
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import fmpy
import numpy as np
from cart_poles import require_native_pool
from fmpy.fmi3 import FMU3Slave
from measure import Effort, MissingError, Run, Sample, Stopwatch, by_turns, ratio, wall_rate
from tables import Table, rate, times

from fmugym import FMU, bundled_fmu
from fmugym.pool import Pool, PoolSpec
from fmugym.pool.local import local_pool
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import MASTERS, Component, Evaluation, Group, Link, SystemPlan

__all__ = ["tables"]

STEP = 0.05
SIZE = 1024
BATCH = 20
"""Steps between two looks at the clock."""

NAMES = ("a", "b", "c")
HEAT = 0.29
"""The input of every heat pump; in the system, two of them get it from the house before."""

LINKS = (("a", "T_air", "b", "T_out"), ("b", "T_air", "c", "T_out"))
"""Component and output, component and input."""

OWN = "the three FMUs, each in a pool of its own"
CONTAINER = "FMPy's container in a Python loop (Jacobi)"


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    header = ["one thread", f"{SIZE:,} systems", "to their own steps", "one system", "to FMPy"]
    table = Table("Steps/s of systems of three houses (FMI 3.0, a step of 50 ms)", header)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        try:
            require_native_pool()
        except MissingError as reason:
            table.rows.append([str(reason), *[""] * (len(header) - 1)])
            return [table]
        _add(table, by_turns(_runs(stack, Path(folder)), effort))
    return [table]


def _runs(stack: ExitStack, folder: Path) -> dict[str, Run]:
    runs = {OWN: _run(_step_all([_alone(stack) for _ in NAMES]), SIZE)}
    for master in MASTERS:
        for count in (1, SIZE):
            runs[f"{master} {count}"] = _run(_step_all([_system(stack, master, count)]), count)
    runs[CONTAINER] = _run(_stepping(stack, _container(folder)), 1)
    return runs


def _alone(stack: ExitStack) -> Pool:
    fmu = FMU(bundled_fmu("House", "3.0"))
    return _pool(stack, fmu, ["u"], ["T_air", "T_w"], SIZE)


def _system(stack: ExitStack, master: str, count: int) -> Pool:
    path = bundled_fmu("House", "3.0")
    plan = SystemPlan(
        "houses",
        tuple(Component(name, path) for name in NAMES),
        tuple(Link(*link) for link in LINKS),
        tuple(Group((name,)) for name in NAMES),
        tuple(Evaluation((index,)) for index in range(len(LINKS))),
        master,
    )
    inputs = [f"{name}.u" for name in NAMES]
    outputs = [f"{name}.{own}" for name in NAMES for own in ("T_air", "T_w")]
    return _pool(stack, SystemFMU(plan), inputs, outputs, count)


def _pool(stack: ExitStack, fmu: FMU, inputs: list[str], outputs: list[str], count: int) -> Pool:
    spec = PoolSpec(tuple(map(fmu.variable, inputs)), tuple(map(fmu.variable, outputs)), STEP)
    pool = local_pool(fmu, spec, count, logging.getLogger(__name__), threads=1)
    stack.callback(pool.close)
    pool.reset((), np.empty((0, count)))
    pool.inputs[:] = HEAT
    return pool


def _step_all(pools: Sequence[Pool]) -> Callable[[int], None]:
    def step(_: int) -> None:
        for pool in pools:
            if pool.step_own():
                raise RuntimeError(pool.failure(0))

    return step


def _run(step: Callable[[int], None], count: int) -> Run:
    def run(seconds: float) -> Sample:
        watch, done = Stopwatch(), 0
        while watch.wall < seconds:
            watch.start()
            for number in range(BATCH):
                step(number)
            watch.stop()
            done += BATCH
        return watch.sample(done * count)

    return run


def _container(folder: Path) -> Path:
    tests = str(Path(__file__).parent.parent / "tests")
    if tests not in sys.path:
        sys.path.append(tests)
    from container_tools import container

    names = [(name, variable) for variable in ("T_air", "T_w", "u") for name in NAMES]
    path: Path = container(folder, bundled_fmu("House", "3.0"), NAMES, LINKS, names, STEP)
    return path


def _stepping(stack: ExitStack, path: Path) -> Callable[[int], None]:
    """Set three inputs, step and get six outputs, as the pool does."""
    description = fmpy.read_model_description(str(path), validate=False)
    fmu = FMU3Slave(
        guid=description.instantiationToken,
        unzipDirectory=fmpy.extract(str(path)),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="container",
    )
    fmu.instantiate()
    stack.callback(fmu.freeInstance)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    references = {v.name: v.valueReference for v in description.modelVariables}
    inputs = [references[f"{name}.u"] for name in NAMES]
    outputs = [references[f"{n}.{v}"] for n in NAMES for v in ("T_air", "T_w")]
    values, count = [HEAT] * len(NAMES), 0

    def step(_: int) -> None:
        nonlocal count
        fmu.setFloat64(inputs, values)
        fmu.doStep(count * STEP, STEP)
        fmu.getFloat64(outputs)
        count += 1

    return step


def _add(table: Table, samples: dict[str, list[Sample]]) -> None:
    own, base = samples[OWN], samples[CONTAINER]
    table.rows.append([OWN, rate(wall_rate(own)), times(1.0), "", ""])
    for master in MASTERS:
        many, one = samples[f"{master} {SIZE}"], samples[f"{master} 1"]
        cells = [rate(wall_rate(many)), times(ratio(many, own))]
        cells += [rate(wall_rate(one)), times(ratio(many, base))]
        table.rows.append([f'a system, `"{master}"`', *cells])
        table.data.append({"way": master, "many": wall_rate(many), "one": wall_rate(one)})
    table.rows.append([CONTAINER, "", "", rate(wall_rate(base)), times(1.0)])
    table.data.append({"way": CONTAINER, "one": wall_rate(base)})
