"""Inputs of systems that change linearly within a step."""

import exchange_tools
import numpy as np
import pytest
from system_tools import LOG, in_each_engine

from fmugym import (
    FMU,
    Component,
    ConfigError,
    Connection,
    FMUEnv,
    FMUSystem,
    FMUVectorEnv,
    bundled_fmu,
)
from fmugym.pool import PoolSpec, has_native_pool
from fmugym.pool.local import local_pool

ABLE = 'canInterpolateInputs="true"'


@pytest.fixture(scope="module", name="fmus")
def compiled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ramps")
    return {
        v: exchange_tools.exchange_fmu(
            folder / f"d{v}.fmu", "dahlquist", v, ("CoSimulation",), ABLE
        )
        for v in (1, 2)
    }


def run(pool, values):
    pool.reset((), np.zeros((0, pool.num_instances)))
    assert not pool.statuses.any(), pool.failure(0)
    rows = []
    for value in values:
        outputs, statuses = pool.step(np.full((1, pool.num_instances), value))
        assert not statuses.any(), pool.failure(0)
        rows.append(outputs.copy())
    return np.array(rows)


VALUES = (1.0, 3.0, 3.0, -2.0, 0.5)


@in_each_engine
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("substeps", [1, 4])
def test_a_component_does_what_the_fmu_does_alone(fmus, native, version, substeps):
    fmu = FMU(fmus[version], probe_timeout=None)
    u = fmu.variable("u")
    spec = PoolSpec((u,), (fmu.variable("x"),), 0.1, substeps=substeps, ramped=(u,))
    alone = local_pool(fmu, spec, 2, LOG)
    system = FMUSystem({"d": fmus[version]})
    pool = ramped_pool(system, "d.u", ["d.x"], native, substeps)
    try:
        expected, found = run(alone, VALUES), run(pool, VALUES)
    finally:
        alone.close()
        pool.close()
    assert found.tobytes() == expected.tobytes()


def ramped_pool(system, name, outputs, native, substeps=1):
    fmu = system.as_fmu()
    u = fmu.variable(name)
    spec = PoolSpec((u,), tuple(map(fmu.variable, outputs)), 0.1, substeps=substeps, ramped=(u,))
    return local_pool(fmu, spec, 2, LOG)


def two(fmus, versions=(1, 2)):
    """One name of the system for two components, of which one drives a third."""
    return FMUSystem(
        {"a": fmus[versions[0]], "b": fmus[versions[1]], "c": fmus[2]},
        [Connection("push", "a.u"), Connection("push", "b.u", gain=-2.0), "a.x -> c.u"],
    )


@in_each_engine
def test_a_name_of_the_system_is_one_line_for_all(fmus, native):
    pools = [
        ramped_pool(two(fmus), "push", ["a.x", "b.x", "c.x"], native),
        ramped_pool(FMUSystem({"a": fmus[1]}), "a.u", ["a.x"], native),
        ramped_pool(FMUSystem({"b": fmus[2]}), "b.u", ["b.x"], native),
    ]
    try:
        found = run(pools[0], VALUES)
        alone = run(pools[1], VALUES), run(pools[2], [-2.0 * value for value in VALUES])
    finally:
        for pool in pools:
            pool.close()
    assert np.array_equal(found[:, 0], alone[0][:, 0])
    assert np.array_equal(found[:, 1], alone[1][:, 0])
    assert np.abs(np.diff(found[:, 2], axis=0)).max() > 0


@pytest.mark.skipif(not has_native_pool(), reason="no C extension was built")
def test_a_component_in_a_process_of_its_own_has_them(fmus):
    pools = [
        ramped_pool(FMUSystem({"d": Component(fmus[2], isolate=isolate)}), "d.u", ["d.x"], True, 3)
        for isolate in (False, True)
    ]
    try:
        rows = [run(pool, VALUES) for pool in pools]
    finally:
        for pool in pools:
            pool.close()
    assert np.array_equal(*rows)


class Env(FMUEnv):
    def __init__(self, fmu, name="push"):
        config = {
            "model_input_names": [name],
            "model_output_names": ["a.x"],
            "bounds": {name: (-5, 5)},
            "time_step": 0.1,
            "substeps": 2,
            "input_interpolation": "linear",
        }
        super().__init__(fmu, config)

    def _is_done(self):
        return False


def test_environments_have_them_also_after_a_snapshot(fmus):
    system = two(fmus)
    envs, single = FMUVectorEnv(lambda: Env(system), 2), Env(system)
    envs.reset(seed=1)
    single.reset(seed=1)
    single.step(np.array([2.0], np.float32))
    envs.step(np.full((2, 1), 2.0, np.float32))
    snapshot = single.save_state()
    rows = [single.step(np.array([u], np.float32))[0] for u in (-1.0, 3.0)]
    single.restore_state(snapshot)
    for u, row in zip((-1.0, 3.0), rows, strict=True):
        assert np.array_equal(single.step(np.array([u], np.float32))[0], row)
        assert np.array_equal(envs.step(np.full((2, 1), u, np.float32))[0], [row, row])
    envs.close()
    single.close()


def test_components_that_cannot_are_refused(fmus):
    pendulum = bundled_fmu("Pendulum")
    system = FMUSystem({"a": fmus[2], "p": pendulum}, ["push -> a.u"])
    Env(system).close()
    with pytest.raises(ConfigError, match=r"component 'p'.*FMI 2\.0.*'p\.tau'"):
        Env(system, "p.tau")
    both = FMUSystem(
        {"a": fmus[2], "p": pendulum},
        [Connection("push", "a.u"), Connection("push", "p.tau", convert_units=False)],
    )
    with pytest.raises(ConfigError, match=r"component 'p'.*'push'"):
        Env(both)
