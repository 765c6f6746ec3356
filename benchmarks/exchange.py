"""Measure model exchange beside co-simulation of the same models, and beside FMPy's CVode."""

from __future__ import annotations

import logging
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import fmpy
import numpy as np
from cart_poles import require_native_pool
from fmpy.fmi2 import FMU2Model
from fmpy.sundials import CVodeSolver
from measure import Effort, MissingError, Run, Sample, Stopwatch, by_turns, ratio, wall_rate
from tables import Table, rate, times

from fmugym import FMU
from fmugym.pool import PoolSpec
from fmugym.pool.native_pool import NativePool

__all__ = ["tables"]

STEP = 0.05
TOLERANCE = 1e-6
SIZE = 1024
BATCH = {1: 500, SIZE: 20}
"""Steps between two looks at the clock, which take as long as a step of one instance."""


class Model(NamedTuple):
    """A model of ``tests/exchange``: its file, how a table calls it, states and inputs."""

    name: str
    text: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]


MODELS = (
    Model("van_der_pol", "Van der Pol, no input", ("x1", "x2"), ()),
    Model("dahlquist", "x' = u - x, u jumps", ("x",), ("u",)),
)
WAYS: dict[str, dict[str, Any]] = {
    "co-simulation, Euler of 1 ms": {},
    "model exchange, Euler of 10 ms": {"solver": "euler", "max_step": 0.01},
    "model exchange, RK4 of 10 ms": {"solver": "rk4", "max_step": 0.01},
    "model exchange, Dormand-Prince": {"solver": "dormand_prince"},
    "model exchange, Rosenbrock": {"solver": "rosenbrock"},
}
CVODE = "model exchange, FMPy's CVode in a loop"


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    header = ["a step of 50 ms", "one instance", "to FMPy", f"a pool of {SIZE:,}", "to FMPy"]
    table = Table("Steps/s of light models by model exchange (tolerance 1e-6)", header)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        for model in MODELS:
            try:
                require_native_pool()
                path = _build(model, Path(folder))
            except MissingError as reason:
                table.rows.append([str(reason), *[""] * (len(header) - 1)])
                return [table]
            table.rows.append([f"**{model.text}**", "", "", "", ""])
            _add(table, model, by_turns(_runs(stack, model, path), effort))
    return [table]


def _build(model: Model, folder: Path) -> Path:
    """Build an FMU with both interfaces.

    Raises:
        MissingError: If there is no compiler.
    """
    tests = str(Path(__file__).parent.parent / "tests" / "tools")
    if tests not in sys.path:
        sys.path.append(tests)
    from exchange_tools import exchange_fmu

    try:
        interfaces = ("ModelExchange", "CoSimulation")
        path: Path = exchange_fmu(folder / f"{model.name}.fmu", model.name, interfaces=interfaces)
    except (OSError, subprocess.CalledProcessError) as error:
        raise MissingError(f"needs a C compiler: {error}") from None
    return path


def _runs(stack: ExitStack, model: Model, path: Path) -> dict[str, Run]:
    runs = {}
    for way, spec in WAYS.items():
        for count in (1, SIZE):
            runs[f"{way} {count}"] = _pool_run(stack, model, path, spec, count)
    runs[CVODE] = _run(_cvode(stack, model, path), 1)
    return runs


def _pool_run(
    stack: ExitStack, model: Model, path: Path, options: dict[str, Any], count: int
) -> Run:
    fmu = FMU(path, interface="model_exchange" if options else "co_simulation")
    spec = PoolSpec(
        tuple(map(fmu.variable, model.inputs)),
        tuple(map(fmu.variable, model.states)),
        STEP,
        tolerance=TOLERANCE,
        **options,
    )
    pool = NativePool(fmu, spec, count, logging.getLogger(__name__))
    stack.callback(pool.close)
    pool.reset((), np.empty((0, count)))
    inputs, step_own = pool.inputs, pool.step_own

    def step(number: int) -> None:
        if len(inputs):
            inputs[:] = number % 2
        if step_own():
            raise RuntimeError(pool.failure(0))

    return _run(step, count)


def _run(step: Callable[[int], None], count: int) -> Run:
    def run(seconds: float) -> Sample:
        watch, done = Stopwatch(), 0
        while watch.wall < seconds:
            watch.start()
            for number in range(BATCH[count]):
                step(number)
            watch.stop()
            done += BATCH[count]
        return watch.sample(done * count)

    return run


def _cvode(stack: ExitStack, model: Model, path: Path) -> Callable[[int], None]:
    """Step as ``fmpy.simulate_fmu`` does; new inputs are an event."""
    description = fmpy.read_model_description(str(path))
    references = {v.name: v.valueReference for v in description.modelVariables}
    folder = fmpy.extract(str(path))
    fmu = FMU2Model(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.modelExchange.modelIdentifier,
        instanceName="fmpy",
    )
    fmu.instantiate()
    stack.callback(fmu.freeInstance)
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    _settle(fmu)
    solver = _solver(fmu, description)
    inputs = [references[name] for name in model.inputs]
    states = [references[name] for name in model.states]
    time = 0.0

    def step(number: int) -> None:
        nonlocal time
        if inputs:
            fmu.enterEventMode()
            fmu.setReal(inputs, [float(number % 2)])
            _settle(fmu)
            solver.reset(time)
        _, _, time = solver.step(time, time + STEP)
        fmu.setTime(time)
        fmu.completedIntegratorStep()
        fmu.getReal(states)

    return step


def _settle(fmu: FMU2Model) -> None:
    again = True
    while again:
        again = fmu.newDiscreteStates()[0]
    fmu.enterContinuousTimeMode()


def _solver(fmu: FMU2Model, description: Any) -> CVodeSolver:
    return CVodeSolver(
        nx=description.numberOfContinuousStates,
        nz=description.numberOfEventIndicators,
        get_x=fmu.getContinuousStates,
        set_x=fmu.setContinuousStates,
        get_dx=fmu.getDerivatives,
        get_z=fmu.getEventIndicators,
        get_nominals=fmu.getNominalsOfContinuousStates,
        set_time=fmu.setTime,
        input=None,
        startTime=0.0,
        maxStep=math.inf,
        relativeTolerance=TOLERANCE,
    )


def _add(table: Table, model: Model, samples: dict[str, list[Sample]]) -> None:
    base = samples[CVODE]
    for way in WAYS:
        one, many = samples[f"{way} 1"], samples[f"{way} {SIZE}"]
        cells = [(rate(wall_rate(own)), times(ratio(own, base))) for own in (one, many)]
        table.rows.append([way, *cells[0], *cells[1]])
        table.data.append(
            {"model": model.name, "way": way, "one": wall_rate(one), "many": wall_rate(many)}
        )
    table.rows.append([CVODE, rate(wall_rate(base)), times(1.0), "", ""])
    table.data.append({"model": model.name, "way": CVODE, "one": wall_rate(base)})
