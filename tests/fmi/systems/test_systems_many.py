"""Many systems that step together: each does what it does alone, whatever happens to the others."""

import re

import numpy as np
import pytest
from system_tools import (
    closing_pools,  # noqa: F401  # the fixture "make"
    compiled,  # noqa: F401  # the fixture "fmus"
    linear,
    system,
)

from fmugym.fmi import Status
from fmugym.fmi.systems.system_plan import Evaluation, Group, Link, Loop, SystemPlan

NAMES = ("a", "b", "c")
COUNT = 150
"""More than step together."""

FAULTS = (0, 0, 0, 1, 2, 3, 4)
STARTS = tuple(f"{name}.{what}" for name in NAMES for what in ("x1_0", "fails", "status"))
OUTPUTS = tuple(f"{name}.{what}" for name in NAMES for what in ("y1", "t", "u1"))
OSCILLATOR = {"a": [[0, 1], [-4, -0.1]], "b": [[0, 0], [1, 0]], "c": [[1, 0], [0, 1]]}


def oscillators(fmus, versions, steps, master, feedthrough=0.0):
    parts = [
        linear(name, fmus[version], steps=number, d=[[feedthrough, 0], [0, 0]], **OSCILLATOR)
        for name, version, number in zip(NAMES, versions, steps, strict=True)
    ]
    links = (
        Link("a", "y1", "b", "u1", 0.5, 0.1),
        Link("b", "y1", "c", "u1"),
        Link("c", "y2", "a", "u2"),
    )
    return system(parts, links, name="chain", master=master)


def loop(fmus, master):
    """The first two are an algebraic loop."""
    plan = oscillators(fmus, (2, 3, 1), (1, 1, 1), master, 0.3)
    links = (*plan.links, Link("b", "y1", "a", "u1", -0.5))
    circle = Loop()
    evaluations = (Evaluation((0, 3), circle), Evaluation((1,)), Evaluation((2,)))
    groups = (Group(("a", "b"), circle), Group(("c",)))
    return SystemPlan("chain", plan.components, links, groups, evaluations, master)


PLANS = {
    "plain": lambda fmus, master: oscillators(fmus, (2, 3, 1), (1, 1, 1), master),
    "multirate": lambda fmus, master: oscillators(fmus, (3, 2, 2), (1, 3, 1), master),
    "loop": loop,
}


def starts_of(rng):
    """Some components are to fail, some to grow beyond all numbers."""
    values = np.zeros((len(STARTS), COUNT))
    for column in values.T:
        of_parts = column.reshape(len(NAMES), 3)
        of_parts[:, 0] = rng.uniform(-1, 1, len(NAMES))
        of_parts[rng.integers(3), 1:] = rng.uniform(0.1, 0.8), rng.choice(FAULTS)
        if rng.random() < 0.1:
            of_parts[rng.integers(3), 0] = 1.5e308
    return values


def told(pool, statuses):
    """What the pool says of its failures, without the numbers of the systems."""
    failures = [
        pool.failure(i) if status > Status.WARNING else "" for i, status in enumerate(statuses)
    ]
    return [re.sub(r"chain_\d+", "chain", text) for text in failures]


def run(pool, columns=slice(None)):
    """Two episodes, of which half of the second begin while the first go on.

    Returns:
        For each call the outputs, statuses and failures of each system.
    """
    rng, rows = np.random.default_rng(1), []
    start = tuple(map(pool.variable, STARTS))

    def note(outputs, statuses):
        texts = told(pool, statuses)
        rows.append(list(zip(map(bytes, outputs.T), statuses.tolist(), texts, strict=True)))

    for mask in (np.ones(COUNT, bool), np.arange(COUNT) % 2 == 0):
        note(*pool.reset(start, starts_of(rng)[:, columns], mask[columns]))
        for _ in range(8):
            note(*pool.step(rng.uniform(-1, 1, (1, COUNT))[:, columns]))
    return rows


@pytest.mark.parametrize(
    ("name", "master"),
    [("plain", "jacobi"), ("multirate", "gauss_seidel"), ("loop", "gauss_seidel")],
)
def test_each_does_what_it_does_alone(make, fmus, name, master):
    plan = PLANS[name](fmus, master)
    together = run(make(plan, ["c.u2"], OUTPUTS, COUNT))
    seen = {status for row in together for _, status, _ in row}
    assert seen >= {
        0,
        Status.DISCARD,
        Status.ERROR,
        Status.FATAL,
        Status.TERMINATED,
        Status.NOT_FINITE,
    }
    for i in range(COUNT):
        alone = run(make(plan, ["c.u2"], OUTPUTS), slice(i, i + 1))
        assert [row[0] for row in alone] == [row[i] for row in together]
