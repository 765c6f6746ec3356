"""Whether instances of an FMU disturb each other.

By the standard they do not. Some FMUs keep part of their state in global variables of their library
all the same, so that each instance needs a library of its own (``private_libraries`` of
``NativePool``).
"""

from __future__ import annotations

import logging

import numpy as np

from fmugym.archive.description import Variable
from fmugym.archive.fmu import FMU
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.status import Status
from fmugym.pool.base import FloatArray, Pool, PoolSpec
from fmugym.pool.local import local_pool
from fmugym.trial.trial import Candidate

__all__ = ["default_spec", "shares_globals", "start_inputs"]

logger = logging.getLogger(__name__)

_DEFAULT_STEP_SIZE = 0.01
"""Where the FMU names none, in seconds."""

_MOST_OUTPUTS = 1000


def shares_globals(
    fmu: FMU, spec: PoolSpec | None = None, steps: int = 10, *, private_libraries: bool = False
) -> bool:
    """Compare an instance run alone with one run beside another, which gets other inputs.

    Each trial loads a copy of the FMU's library of its own. FMUs may still share what lies outside
    of their library: files, other libraries, licences.

    Args:
        fmu: The FMU; neither extracted nor closed.
        spec: What to do in a step; by default all inputs are written and all outputs read.
        steps: How many steps to do.
        private_libraries: Whether each instance has a copy of the library of its own.

    Returns:
        Whether the two instances are not independent of each other.

    Raises:
        FMULoadError: If not even one instance can be made.
        SimulationError: If an instance alone fails.
    """
    spec = default_spec(fmu) if spec is None else spec
    alone = _run(fmu, spec, 1, steps, private_libraries)
    try:
        beside = _run(fmu, spec, 2, steps, private_libraries)
    except (FMULoadError, SimulationError) as error:
        logger.info("%s: a second instance fails: %s", fmu.path.name, error)
        return True
    return alone.tobytes() != beside.tobytes()


def default_spec(fmu: FMU) -> PoolSpec:
    """What to do with an FMU of which nothing is known: all inputs, outputs, its own step size."""
    description = fmu.description
    numeric = [v for v in description.variables.values() if v.numeric]
    outputs = [v for v in numeric if v.causality == "output"] or [
        v for v in numeric if v.causality == "local"
    ]
    return PoolSpec(
        inputs=tuple(v for v in numeric if v.causality == "input"),
        outputs=tuple(outputs[:_MOST_OUTPUTS]),
        time_step=description.step_size or _DEFAULT_STEP_SIZE,
        start_time=description.start_time,
    )


def _run(fmu: FMU, spec: PoolSpec, count: int, steps: int, private_libraries: bool) -> FloatArray:
    """Step ``count`` instances of a new copy; returns what the first one did."""
    log = logging.getLogger(__name__)
    twin = Candidate.of(fmu).open()
    pool = local_pool(twin, spec, count, log, threads=1, private_libraries=private_libraries)
    try:
        return _trajectory(pool, spec, steps)
    finally:
        pool.close()


def _trajectory(pool: Pool, spec: PoolSpec, steps: int) -> FloatArray:
    count = pool.num_instances
    rows = []
    for step in range(steps + 1):
        if step == 0:
            outputs, statuses = pool.reset((), np.zeros((0, count)))
        else:
            outputs, statuses = pool.step(start_inputs(spec, count))
        if statuses[0] > Status.WARNING:
            raise SimulationError(pool.failure(0))
        rows.append(outputs[:, 0].copy())
    return np.array(rows)


def start_inputs(spec: PoolSpec, count: int) -> FloatArray:
    """Start values for the first instance, the other end of the range for the second.

    Args:
        spec: What the inputs are.
        count: 1 or 2.

    Returns:
        Shape (inputs, count).
    """
    values = [[variable.start_number, _other(variable)] for variable in spec.inputs]
    return np.array(values, np.float64).reshape(-1, 2)[:, :count]


def _other(variable: Variable) -> float:
    if variable.kind == "boolean":
        return 1.0 - variable.start_number
    if variable.items:
        return float(next((v for _, v in variable.items if v != variable.start_number), 0))
    for bound in (variable.maximum, variable.minimum):
        if np.isfinite(bound) and bound != variable.start_number:
            return bound
    return variable.start_number + 1.0
