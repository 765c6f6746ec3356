"""A short form of ``python tests/tools/fuzz_systems.py``, and random systems against FMPy."""

import itertools
import random

import fmpy_master
import fuzz_driver
import fuzz_systems
import numpy as np
from system_tools import (
    closing_pools,  # noqa: F401  # the fixture "make"
    linear_fmu,
)

from fmugym.pool.native_pool import NativePool


def test_each_does_what_it_does_alone():
    tally = fuzz_driver.run(fuzz_systems.program, 40, seed="tests")
    assert tally.failures == []
    assert tally.total("accepted") > 15


def test_a_difference_is_reported(monkeypatch):
    """The fuzzing is able to fail: here the last bit of what systems together do is another one."""
    step = NativePool.step

    def changed(pool, *arguments):
        outputs, statuses = step(pool, *arguments)
        if pool.num_instances > 1:
            np.nextafter(outputs, np.inf, out=outputs)
        return outputs, statuses

    monkeypatch.setattr(NativePool, "step", changed)
    failures = fuzz_driver.run(fuzz_systems.program, 5, seed="tests").failures
    assert any("step" in failure for failure in failures)


def sound_systems(fmus):
    """Random systems of FMI 2.0 and 3.0 without faults and algebraic loops."""
    for seed in itertools.count():
        system, versions = fuzz_systems.make_system(random.Random(seed), fmus)
        plan = system.plan
        is_sound = not any("limit" in dict(component.starts) for component in plan.components)
        is_sound &= not any(one.loop for one in (*plan.groups, *plan.initialization))
        if is_sound and 1 not in versions:
            yield system


def test_each_does_what_a_loop_over_fmpy_does(make, tmp_path):
    fmus = {v: linear_fmu(tmp_path / f"linear{v}.fmu", v) for v in (1, 2, 3)}
    rng, lengths = np.random.default_rng(0), []
    for system in itertools.islice(sound_systems(fmus), 20):
        variables = system.as_fmu().description.variables
        inputs = [name for name, variable in variables.items() if variable.causality == "input"]
        outputs = [f"{name}.{what}" for name in system.components for what in ("y1", "y2", "u1")]
        pool = make(system, inputs, outputs)
        values = rng.uniform(-1, 1, (10, len(inputs), 1))
        pool.reset((), np.zeros((0, 1)))
        rows = [pool.outputs[:, 0].copy(), *(pool.step(row)[0][:, 0].copy() for row in values)]
        steps = [dict(zip(inputs, row[:, 0], strict=True)) for row in values]
        expected = fmpy_master.play(system.plan, outputs, steps, 0.1)
        np.testing.assert_allclose(rows, expected, rtol=1e-9, atol=1e-12)
        lengths.append(len(system.components))
    assert set(lengths) == {1, 2, 3, 4}
