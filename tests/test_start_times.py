"""Start times that differ from episode to episode: pools, environments and declared tasks."""

import logging

import exchange_tools
import numpy as np
import pytest
import wine_tools

from fmugym import FMU
from fmugym import pool as pools
from fmugym.pool import PoolSpec
from fmugym.pool.spec import START_TIME
from fmugym.trial import opening

LOG = logging.getLogger("fmugym.test")
KINDS = {
    "python": {"backend": "python"},
    "native": {"backend": "native"},
    "process": {"backend": "auto", "isolation": "process", "workers": 2},
    "wine": {},
}
STEP = 0.25
STARTS = np.array([0.0, 1.5, 86400.25])
OUTPUTS = ("x", "now", "sine", "seconds")
SUNS = [("ModelExchange", 1), ("ModelExchange", 2), ("ModelExchange", 3)]
SUNS += [("CoSimulation", 2), ("CoSimulation", 3)]
all_kinds = pytest.mark.parametrize("kind", KINDS)
all_suns = pytest.mark.parametrize(("interface", "version"), SUNS)


@pytest.fixture(scope="session")
def sun(tmp_path_factory):
    """Write FMUs that tell their time, each once."""
    folder, made = tmp_path_factory.mktemp("suns"), {}

    def make(interface="CoSimulation", version=2):
        key = interface, version
        if key not in made:
            path = folder / f"{interface}{version}.fmu"
            made[key] = exchange_tools.exchange_fmu(path, "sun", version, (interface,))
        return made[key]

    return make


@pytest.fixture
def make_pool(request, sun):
    """Make pools that are closed after the test."""
    made = []

    def make(kind, interface="CoSimulation", version=2, n=3, **spec):
        if kind == "native" and not pools.has_native_pool():
            pytest.skip("the C extension was not built")
        path = sun(interface, version)
        if kind == "wine":
            request.getfixturevalue("wine")
            if interface == "CoSimulation":
                pytest.skip("the sun for Windows is one for model exchange")
            path = wine_tools.exchange_fmu(path.with_suffix(".win.fmu"), "sun", version)
        fmu = FMU(path, probe_timeout=None)
        spec = PoolSpec(
            inputs=(), outputs=tuple(map(fmu.variable, OUTPUTS)), time_step=STEP, **spec
        )
        pool = opening.make_pool(fmu, spec, n, LOG, **KINDS[kind])
        pool.x = fmu.variable("x")
        made.append(pool)
        return pool

    yield make
    for pool in made:
        pool.close()


def start(pool, times, x=None):
    """Reset a pool with the start time of each instance, and the state if it is given."""
    variables, rows = (START_TIME,), [times]
    if x is not None:
        variables, rows = (pool.x, START_TIME), [x, times]
    pool.reset(variables, np.array(rows, np.float64))
    assert not pool.statuses.any(), pool.failure(0)


def steps(pool, count):
    for _ in range(count):
        pool.step()
        assert not pool.statuses.any(), pool.failure(0)


def require(pool, starts, count, x=0.0):
    """Each FMU is where the closed form is after so many steps from its own start time."""
    times = starts + count * STEP
    found = dict(zip(OUTPUTS, pool.outputs, strict=True))
    np.testing.assert_allclose(found["now"], times, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["sine"], np.sin(times), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["x"], x + np.sin(times) - np.sin(starts), atol=2e-3)
    np.testing.assert_array_equal(found["seconds"], np.floor(times) - np.floor(starts))


@all_kinds
@all_suns
def test_each_instance_begins_at_its_own_time(make_pool, kind, interface, version):
    pool = make_pool(kind, interface, version)
    start(pool, STARTS)
    require(pool, STARTS, 0)
    steps(pool, 5)
    require(pool, STARTS, 5)
    pool.reset((), np.zeros((0, 3)))  # without one, episodes begin at that of the spec
    steps(pool, 1)
    require(pool, np.zeros(3), 1)
    for times in (STARTS, STARTS, STARTS[::-1]):  # which may find kept initial states
        start(pool, times, np.array([0.5, 0.0, -0.5]))
        steps(pool, 5)
        require(pool, times, 5, np.array([0.5, 0.0, -0.5]))


@all_kinds
@all_suns
def test_snapshots_keep_it(make_pool, kind, interface, version):
    if version == 1:
        pytest.skip("FMI 1.0 has no FMU states")
    pool = make_pool(kind, interface, version)
    start(pool, STARTS)
    steps(pool, 2)
    snapshot = pool.save()
    start(pool, STARTS + 100.0)
    steps(pool, 1)
    pool.restore(snapshot, np.array([True, False, True]))
    steps(pool, 1)
    mixed = np.where([True, False, True], STARTS, STARTS + 100.0)
    np.testing.assert_allclose(pool.outputs[1], mixed + np.array([3, 2, 3]) * STEP, atol=1e-9)


@all_kinds
@all_suns
def test_saved_states_take_it_to_other_instances_and_pools(make_pool, kind, interface, version):
    pool = make_pool(kind, interface, version)
    start(pool, STARTS)
    steps(pool, 3)
    bundle = pool.save_instances(np.arange(3))
    other = make_pool("python" if kind == "native" else kind, interface, version)
    start(other, STARTS + 7.0)
    sources, indices = np.array([2, 0]), np.array([0, 1])
    other.restore_instances(bundle.take([0, 1, 2]), sources, indices)
    assert not other.statuses.any(), other.failure(0)
    steps(other, 2)
    expected = [STARTS[2] + 5 * STEP, STARTS[0] + 5 * STEP, STARTS[2] + 7.0 + 2 * STEP]
    np.testing.assert_allclose(other.outputs[1], expected, atol=1e-9)
