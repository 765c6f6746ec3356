"""An FMU that makes intermediate updates (``exchange/updating.c``), and what it computes."""

import re

import exchange_tools
import fmu_tools
import numpy as np

NAMES = ("tentative_points", "after_the_step", "before_the_step", "backwards", "no_time")
NAMES += ("in_a_thread", "in_an_update", "no_get", "no_set", "no_inputs", "no_outputs")
NAMES += ("for_another",)
MISCHIEFS = {name: number for number, name in enumerate(NAMES, 1)}
"""What the parameter ``mischief`` lets the FMU do, in the order of the C file."""

PROVIDES = 'providesIntermediateUpdate="true"'


def updating_fmu(path, internal_step=0.03, updated=("x", "y", "u"), flags=PROVIDES, more=()):
    """Write the FMU: x' = u - k x and y = x + u, with updates at both ends of internal steps.

    Args:
        path: Its file.
        internal_step: That of its explicit Euler method; the last one of a step is shorter.
        updated: The variables with the attribute ``intermediateUpdate``.
        flags: More attributes of the interface.
        more: More arguments of the compiler.
    """
    options = (f"-DINTERNAL_STEP={internal_step}", *more)
    exchange_tools.exchange_fmu(path, "updating", 3, ("CoSimulation",), flags, options)
    files = fmu_tools.read_fmu(path)
    xml = files["modelDescription.xml"]
    xml = xml.decode() if isinstance(xml, bytes) else xml
    for name in updated:
        xml = re.sub(f'(<Float64 name="{name}")', r'\1 intermediateUpdate="true"', xml)
    return fmu_tools.write_fmu(path, files | {"modelDescription.xml": xml})


def points_of(begin, size, internal_step):
    """The beginnings and lengths of internal steps."""
    times, time = [], begin
    while time < begin + size - 1e-12:
        step = min(internal_step, begin + size - time)
        times.append((time, step))
        time += step
    return times


def simulate(x, k, inputs, begin, size, internal_step=0.03):
    """The points that the FMU tells of a step, by Euler's method.

    Args:
        x: The state at the beginning.
        k: The parameter.
        inputs: The input as a function of time.
        begin: When the step begins.
        size: Its length.
        internal_step: That of the FMU.

    Returns:
        The times of the points, and x and y there.
    """
    rows = []
    for time, step in points_of(begin, size, internal_step):
        u = inputs(time)
        x = x + step * (u - k * x)
        rows.append((time + step, x, x + u))
    return np.array(rows).T


def mean(begin, times, values):
    """The mean of straight lines through points; before the first one, its value holds."""
    area = (times[0] - begin) * values[0] + np.trapezoid(values, times)
    return area / (times[-1] - begin)
