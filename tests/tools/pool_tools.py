"""Pools: opened by the names of variables, reset with values by name, and stepped."""

import logging
from dataclasses import replace

import numpy as np

from fmugym.pool import PoolSpec, opening
from fmugym.pool.native_pool import NativePool
from fmugym.pool.opening import PoolOptions

LOG = logging.getLogger("fmugym.test")
KINDS = {
    "native": {"backend": "native"},
    "process": {"isolation": "process", "workers": 1},
}
"""The arguments by which ``PoolOptions`` makes each kind."""


def sampled(variables, samplings):
    """Variables with these samplings; as they are for None."""
    if samplings is None:
        return variables
    return tuple(replace(v, sampling=how) for v, how in zip(variables, samplings, strict=True))


def open_pool(
    fmu,
    inputs=(),
    outputs=(),
    time_step=0.1,
    n=1,
    options=None,
    private=False,
    samplings=None,
    **spec,
):
    """Open a pool, in this process or with options of ``PoolOptions``.

    Args:
        fmu: The FMU; ``pool.variable`` looks up its variables.
        inputs, outputs: Names.
        time_step: In s.
        n: How many instances.
        options: Of ``PoolOptions``; None for a pool in this process.
        private: Whether each instance of a pool in this process has a library of its own.
        samplings: One for each output; None for the last values of all.
        spec: Others of a ``PoolSpec``.
    """
    given, read = (tuple(map(fmu.variable, names)) for names in (inputs, outputs))
    read = sampled(read, samplings)
    spec = PoolSpec(given, read, time_step, **spec)
    if options is None:
        pool = NativePool(fmu, spec, n, LOG, private_libraries=private)
    else:
        pool = opening.open_pool(fmu, spec, n, LOG, PoolOptions(**options))
    pool.variable = fmu.variable
    return pool


def reset(pool, values=None, mask=None):
    """Reset with start values by name, a number for all instances or one for each."""
    values = values or {}
    rows = [np.broadcast_to(value, pool.num_instances) for value in values.values()]
    array = np.array(rows, float).reshape(len(rows), pool.num_instances)
    return pool.reset(tuple(map(pool.variable, values)), array, mask)


def start(pool, values=None):
    """Reset all instances, of which none may fail; returns the pool."""
    reset(pool, values)
    assert not pool.statuses.any(), pool.failure(int(pool.statuses.argmax()))
    return pool


def step(pool, *inputs):
    """Step all instances, of which none may fail, with a number or a row of each input.

    Returns:
        A copy of the outputs, shape (k, N).
    """
    rows = [np.broadcast_to(value, pool.num_instances) for value in inputs]
    outputs, statuses = pool.step(np.array(rows, float) if rows else None)
    assert not statuses.any(), pool.failure(int(statuses.argmax()))
    return outputs.copy()
