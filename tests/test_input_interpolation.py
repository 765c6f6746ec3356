"""Inputs that change linearly within a step: FMI 1.0 and 2.0."""

import contextlib
import logging
from contextlib import closing

import exchange_tools
import numpy as np
import pytest
import values_tools
import wine_tools
from pool_kinds import POOLS, require_same_after_restoring

import fmugym
from fmugym import FMU, ConfigError
from fmugym import pool as pools
from fmugym.pool import PoolSpec
from fmugym.pool.spec import whole_number_of_steps
from fmugym.trial import opening

LOG = logging.getLogger("fmugym.test")
ABLE = 'canInterpolateInputs="true"'
EULER = 1e-3  # the step of the FMUs
H = 0.1
both_versions = pytest.mark.parametrize("version", [1, 2])
all_kinds = pytest.mark.parametrize("kind", [*POOLS, "wine"])


class Env(fmugym.FMUEnv):
    def _is_done(self):
        return False


CONFIG = {
    "model_input_names": ["u"],
    "model_output_names": ["x"],
    "bounds": {"u": (-10, 10)},
    "time_step": H,
    "input_interpolation": "linear",
}


@pytest.fixture
def fmu_path(tmp_path):
    def make(version=2, flags=ABLE, interface="CoSimulation", model="dahlquist"):
        path = tmp_path / f"{model}{version}.fmu"
        return exchange_tools.exchange_fmu(path, model, version, (interface,), flags)

    return make


@pytest.fixture
def make_pool(request, fmu_path):
    made = []

    def make(kind, version, n=2, **spec):
        if kind == "native" and not pools.has_native_pool():
            pytest.skip("the C extension was not built")
        building = contextlib.nullcontext
        if kind == "wine":
            request.getfixturevalue("wine")
            building = wine_tools.building_for_windows
        with building():
            path = fmu_path(version)
        fmu = FMU(path, probe_timeout=None)
        u = fmu.variable("u")
        spec = PoolSpec((u,), (fmu.variable("x"),), H, ramped=(u,), **spec)
        pool = opening.make_pool(fmu, spec, n, LOG, **POOLS.get(kind, {}))
        pool.k = fmu.variable("k")
        made.append(pool)
        return pool

    yield make
    for pool in made:
        pool.close()


def step(pool, u):
    outputs, statuses = pool.step(np.atleast_2d(np.asarray(u, float)))
    assert not statuses.any(), pool.failure(0)
    return outputs[0].copy()


def change(first, last):
    """The integral of a ramp by the FMU's Euler steps."""
    steps = whole_number_of_steps(H, EULER)
    part = np.arange(steps) / steps
    return H * (first + (last - first) * np.mean(part))


@all_kinds
@both_versions
@pytest.mark.parametrize("substeps", [1, 5])
def test_an_integrator(make_pool, kind, version, substeps):
    """With k = 0, x is the integral of u."""
    pool = make_pool(kind, version, substeps=substeps)
    for _ in range(2):  # episodes
        pool.reset((pool.k,), np.zeros((1, 2)))
        assert not pool.statuses.any(), pool.failure(0)
        x, before = np.ones(2), np.zeros(2)
        for u in np.array([[1.0, -2.0], [1.0, 0.5], [4.0, 0.5], [0.0, 0.0]]):
            x, before = x + change(before, u), u
            np.testing.assert_allclose(step(pool, u), x, rtol=1e-12)


@all_kinds
def test_a_restored_state_goes_on_alike(make_pool, kind):
    pool = make_pool(kind, 2)
    pool.reset((), np.zeros((0, 2)))
    require_same_after_restoring(pool, step)


@both_versions
def test_all_pools_give_the_same_numbers(make_pool, version):
    if not pools.has_native_pool():
        pytest.skip("the C extension was not built")
    rows = []
    for kind in POOLS:
        pool = make_pool(kind, version, substeps=3)
        pool.reset((), np.zeros((0, 2)))
        random = np.random.default_rng(2)
        rows.append([step(pool, random.uniform(-1, 1, 2)) for _ in range(20)])
    np.testing.assert_array_equal(rows[0], rows[1])


@both_versions
def test_environments(fmu_path, version):
    path, config = fmu_path(version), CONFIG | {"model_parameters": {"k": 0.0}}
    with (
        closing(Env(path, config)) as env,
        closing(fmugym.FMUVectorEnv(lambda: Env(path, config), num_envs=3)) as envs,
        closing(Env(path, config | {"input_interpolation": {"u": "hold"}})) as holding,
    ):
        env.reset(seed=1)
        envs.reset(seed=1)
        holding.reset(seed=1)
        x, held, before = 1.0, 1.0, 0.0
        for u in (2.0, -1.0, 5.0, 5.0):
            x, held, before = x + change(before, u), held + H * u, u
            action = np.array([u], np.float32)
            assert env.step(action)[0] == pytest.approx([x], rel=1e-6)
            assert envs.step(np.tile(action, (3, 1)))[0] == pytest.approx(
                np.full((3, 1), x), rel=1e-6
            )
            assert holding.step(action)[0] == pytest.approx([held], rel=1e-6)
        snapshot = env.save_state() if version == 2 else None
        if snapshot is not None:
            first = env.step(np.array([1.0]))[0]
            env.restore_state(snapshot)
            assert env.step(np.array([1.0]))[0] == first


class TestRefusals:
    @pytest.mark.parametrize(
        ("version", "flags", "interface"),
        [(2, "", "CoSimulation"), (1, "", "CoSimulation"), (3, ABLE, "CoSimulation")],
    )
    def test_fmus_that_cannot(self, fmu_path, version, flags, interface):
        with pytest.raises(ConfigError, match="interpolate inputs"):
            Env(fmu_path(version, flags, interface), CONFIG)

    def test_model_exchange(self, fmu_path):
        with pytest.raises(ConfigError, match="interpolate inputs"):
            Env(fmu_path(2, "", "ModelExchange"), CONFIG)

    def test_arrays_are_taken_by_elements(self, tmp_path):
        """The array stands for v[1] and v[2]; the FMU cannot interpolate."""
        path = values_tools.feedthrough_fmu(tmp_path / "feedthrough.fmu", 2)
        config = {"model_input_names": "v", "model_output_names": "w", "time_step": H}
        with pytest.raises(ConfigError, match=r"'v\[1\]' can only hold"):
            Env(path, config | {"input_interpolation": "linear"})

    def test_parameters(self, fmu_path):
        config = CONFIG | {"model_input_names": ["u", "k"], "bounds": {"u": (0, 1), "k": (0, 1)}}
        with pytest.raises(ConfigError, match=r"'k' cannot be linear.*tunable parameter"):
            Env(fmu_path(2), config)

    def test_unknown_names_and_kinds(self, fmu_path):
        with pytest.raises(ConfigError, match="'v'"):
            Env(fmu_path(2), CONFIG | {"input_interpolation": {"v": "linear"}})
        with pytest.raises(ConfigError, match="'cubic'"):
            Env(fmu_path(2), CONFIG | {"input_interpolation": "cubic"})
        with pytest.raises(ConfigError, match="input_interpolation"):
            Env(fmu_path(2), CONFIG | {"input_interpolation": 3})
