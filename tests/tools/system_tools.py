"""Systems of FMUs with linear equations (``zoo/linear.c``), their exact solutions, and pools."""

from pathlib import Path

import model_tools
import numpy as np
import pytest
from pool_tools import open_pool, start, step

from fmugym import bundled_fmu
from fmugym.fmi.systems import FMUSystem
from fmugym.fmi.systems.system import SystemFMU
from fmugym.fmi.systems.system_plan import (
    MASTERS,
    ComponentPlan,
    Evaluation,
    Group,
    Link,
    SystemPlan,
)

by_each_master = pytest.mark.parametrize("master", MASTERS)

STATES = {
    1: 'canHandleVariableCommunicationStepSize="true"',
    2: 'canGetAndSetFMUstate="true" canSerializeFMUstate="true" '
    'canHandleVariableCommunicationStepSize="true"',
    3: 'canGetAndSetFMUState="true" canHandleVariableCommunicationStepSize="true"',
}
MATRICES = ("a", "b", "c", "d")
VARIABLES = (
    ("t", "output", ""),
    *((f"u{i}", "input", 'start="0"') for i in (1, 2)),
    *((f"y{i}", "output", "") for i in (1, 2)),
    *((f"x{i}_0", "parameter", 'start="0"') for i in (1, 2)),
    *((f"{m}{i}{j}", "parameter", 'start="0"') for m in MATRICES for i in (1, 2) for j in (1, 2)),
    *((name, "parameter", 'start="0"') for name in ("limit", "fails", "status")),
)


@pytest.fixture(name="make")
def closing_pools(opened):
    """Make pools of plans that are closed after the test."""

    def make(plan, inputs=(), outputs=(), count=1, time_step=0.1, **options):
        fmu = plan.as_fmu() if isinstance(plan, FMUSystem) else SystemFMU(plan)
        return opened(open_pool(fmu, inputs, outputs, time_step, count, **options))

    return make


def links_of(system):
    return [(k.source, k.output, k.target, k.input, k.gain, k.offset) for k in system.links]


def play(pool, steps, inputs=None):
    """Reset and step; the outputs, shape (steps + 1, k)."""
    rows = [start(pool).outputs[:, 0].copy()]
    given = [()] * steps if inputs is None else inputs
    return np.array(rows + [step(pool, *given[i])[:, 0] for i in range(steps)])


@pytest.fixture(scope="module", name="fmus")
def compiled(tmp_path_factory):
    """The FMU of linear equations by FMI version."""
    folder = tmp_path_factory.mktemp("linear")
    return {v: linear_fmu(folder / f"linear{v}.fmu", v) for v in (1, 2, 3)}


def linear_fmu(path, version=2):
    """Write the FMU."""
    flags = STATES[version]
    return model_tools.model_fmu(path, "linear", version, "{linear}", VARIABLES, flags=flags)


def linear(name, path, x0=(0.0, 0.0), steps=1, interface=None, **matrices):
    """A component; the matrices a to d are nested lists, or zero."""
    starts = {"x1_0": x0[0], "x2_0": x0[1]}
    for letter, matrix in matrices.items():
        if letter in MATRICES:
            matrix = np.array(matrix, float)
            starts |= {f"{letter}{i + 1}{j + 1}": matrix[i, j] for i, j in np.ndindex(2, 2)}
        else:
            starts[letter] = matrix
    values = tuple((key, float(value)) for key, value in starts.items())
    return ComponentPlan(name, Path(path), interface, steps, values)


def system(components, links, loop=None, name="system", **options):
    """A plan whose components step in their order, or together if there is a loop."""
    names = tuple(component.name for component in components)
    links = tuple(links)
    if loop is None:
        groups = tuple(Group((one,)) for one in names)
        evaluations = tuple(Evaluation((i,)) for i in range(len(links)))
    else:
        groups, evaluations = (Group(names, loop),), (Evaluation(tuple(range(len(links))), loop),)
    return SystemPlan(name, tuple(components), links, groups, evaluations, **options)


# A damper of its own turns the pendulum without friction into the one with friction.

FRICTION = 0.004  # N m s


def _pendulum(damping):
    starts = (("q_0", 0.5), ("c", 0.0), ("solver", 3.0), ("b", damping))
    return ComponentPlan("pendulum", bundled_fmu("Pendulum"), starts=starts)


def parted_pendulum(linear_path):
    """The same in two parts."""
    damper = linear("damper", linear_path, d=[[-FRICTION, 0], [0, 0]])
    links = (
        Link("pendulum", "theta_dot", "damper", "u1"),
        Link("damper", "y1", "pendulum", "tau"),
    )
    return system([_pendulum(0.0), damper], links)


# Two masses between springs, coupled by a spring with a damper.

MASS, STIFFNESS, COUPLING, DAMPING = (1.0, 2.0), (4.0, 3.0), 5.0, 0.4
POSITIONS = (1.0, -0.5)


def masses(paths, steps=(1, 1), **options):
    """The first tells its position and velocity, the second the force of the coupling."""
    k1, k2, k, d = *STIFFNESS, COUPLING, DAMPING
    first = linear(
        "first",
        paths[0],
        (POSITIONS[0], 0.0),
        steps[0],
        a=[[0, 1], [-k1 / MASS[0], 0]],
        b=[[0, 0], [1 / MASS[0], 0]],
        c=np.eye(2),
    )
    m = MASS[1]
    second = linear(
        "second",
        paths[1],
        (POSITIONS[1], 0.0),
        steps[1],
        a=[[0, 1], [-(k2 + k) / m, -d / m]],
        b=[[0, 0], [k / m, d / m]],
        c=[[k, d], [1, 0]],
        d=[[-k, -d], [0, 0]],
    )
    links = (
        Link("first", "y1", "second", "u1"),
        Link("first", "y2", "second", "u2"),
        Link("second", "y1", "first", "u1"),
    )
    return system((first, second), links, **options)


def masses_exactly(times):
    """The positions of both masses, shape (2, times)."""
    k1, k2, k, d = *STIFFNESS, COUPLING, DAMPING
    m1, m2 = MASS
    matrix = np.array(
        [
            [0, 1, 0, 0],
            [-(k1 + k) / m1, -d / m1, k / m1, d / m1],
            [0, 0, 0, 1],
            [k / m2, d / m2, -(k2 + k) / m2, -d / m2],
        ]
    )
    start = np.array([POSITIONS[0], 0.0, POSITIONS[1], 0.0])
    from scipy.linalg import expm  # which trainings of other libraries do without

    return np.array([(expm(matrix * t) @ start)[[0, 2]] for t in times]).T


# A tank with a controller: h' = (u - c h) / area, u = gain (goal - h) + integral.

AREA, OUTFLOW, GAIN, RATE, GOAL = 2.0, 0.3, 1.5, 0.4, 1.2


def tank(paths, steps=(1, 1), **options):
    """The controller follows the level at once."""
    plant = linear(
        "tank",
        paths[0],
        (0.2, 0.0),
        steps[0],
        a=[[-OUTFLOW / AREA, 0], [0, 0]],
        b=[[1 / AREA, 0], [0, 0]],
        c=[[1, 0], [0, 0]],
    )
    control = linear(
        "control",
        paths[1],
        (0.0, 0.0),
        steps[1],
        b=[[RATE, 0], [0, 0]],
        c=[[1, 0], [0, 0]],
        d=[[GAIN, 0], [0, 0]],
    )
    links = (
        Link("tank", "y1", "control", "u1", -1.0, GOAL),
        Link("control", "y1", "tank", "u1"),
    )
    return system((plant, control), links, **options)


def tank_exactly(times):
    """The level, shape (1, times)."""
    matrix = np.array(
        [[-(OUTFLOW + GAIN) / AREA, 1 / AREA, GAIN * GOAL / AREA], [-RATE, 0, RATE * GOAL], [0] * 3]
    )
    start = np.array([0.2, 0.0, 1.0])
    from scipy.linalg import expm  # as above

    return np.array([(expm(matrix * t) @ start)[:1] for t in times]).T
