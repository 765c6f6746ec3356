"""Episodes as FMPy plays them: each on a fresh instance of a fresh copy of the library.

And as environments play them, for a comparison.
"""

import logging
from dataclasses import replace

import numpy as np

from fmugym import FMU
from fmugym.fmi import Status
from fmugym.pool import PoolSpec
from fmugym.pool.rig.fmpy_pool import FMPyInstance
from fmugym.pool.rig.rig import FaultError

LOG = logging.getLogger("fmugym.test.fresh")


def play(path, outputs, rows, step_size, start_values=None, **times):
    """Play an episode.

    Args:
        path: The FMU.
        outputs: Names.
        rows: For each step the inputs by name.
        step_size: In seconds.
        start_values: Values by name that are set before the initialization.
        times: Others of a ``PoolSpec``, such as the start time and the tolerance.

    Returns:
        The outputs of the start and of each step; fewer if the FMU asked to stop. If the FMU cannot
        be read before its first step, the outputs of the start are those of the model description.
    """
    fmu = FMU(path)
    inputs = tuple(map(fmu.variable, rows[0]))
    spec = PoolSpec(inputs, tuple(map(fmu.variable, outputs)), step_size, **times)
    try:
        return played(fmu, spec, rows, start_values or {})
    except FaultError as failure:
        if "reading the outputs" not in str(failure):
            raise
        return played(fmu, replace(spec, blind_start=True), rows, start_values or {})
    finally:
        fmu.close()


def played(fmu, spec, rows, start_values):
    instance = FMPyInstance(fmu, spec, LOG, fmu.prepare_libraries()[0])
    try:
        results = [as_floats(instance.reset(start_values))]
        for row in rows:
            values, status = instance.step(row)
            results.append(as_floats(values))
            if status == Status.TERMINATED:
                break
        return results
    finally:
        instance.stop()


def as_floats(values):
    return [float(value) for value in values]


def episode(env, actions):
    """What an environment that was reset gives: the outputs as above, until its episode ends."""
    rows = [list(env.state)]
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        rows.append(list(env.state))
        if terminated or truncated:
            break
    return rows


def episodes(envs, actions):
    """The same of each environment of a vector environment, until the first episode ends."""
    rows = [np.array(envs.get_attr("state"))]
    for action in actions:
        _, _, terminated, truncated, _ = envs.step(action)
        rows.append(np.array(envs.get_attr("state")))
        if (terminated | truncated).any():
            break
    return np.swapaxes(rows, 0, 1).tolist()
