"""Guards in the process, in all pools: finite values, retries, health, leaks."""

import lawful_tools
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import MAJOR_VERSIONS
from gymnasium import spaces
from pool_tools import KINDS, open_pool, reset
from ways import in_way

from fmugym import FMU, ConfigError, SimulationError
from fmugym.environment.vector import FMUVectorEnv
from fmugym.fmi import Status

KB, MB = 2**10, 2**20
every_version = pytest.mark.parametrize("version", MAJOR_VERSIONS)
with_state = pytest.mark.parametrize("version", [2, 3])


@pytest.fixture(name="way", params=KINDS)
def fixture_way(request):
    """``PoolOptions`` for each pool."""
    return KINDS[request.param]


@pytest.fixture(name="lawful", scope="module")
def fixture_lawful(tmp_path_factory):
    """The paths of the lawful FMU by version."""
    folders = {version: tmp_path_factory.mktemp(f"lawful{version}") for version in MAJOR_VERSIONS}
    return {v: lawful_tools.lawful_fmu(folder, v) for v, folder in folders.items()}


@pytest.fixture(name="make")
def fixture_make(lawful, opened):
    """Make pools over the lawful FMU."""

    def make(version, num_instances, time_step=0.8, way=KINDS["native"], **spec):
        options = way | {"private_libraries": False}
        fmu = FMU(lawful[version])
        return opened(open_pool(fmu, ["u"], ["y"], time_step, num_instances, options, **spec))

    return make


@pytest.fixture(name="pool")
def fixture_pool(make, way):
    """Make pools of two instances of each kind."""
    return lambda version, **spec: make(version, 2, way=way, **spec)


def set_up(pool, mask=None, **values):
    """Reset with start values, one number for all instances or one for each."""
    return reset(pool, values, mask)


def step(pool, *inputs):
    return pool.step(np.array([inputs]))


class TestFiniteInputs:
    @every_version
    def test_only_the_instance_with_a_bad_one_is_not_stepped(self, pool, version):
        pool = pool(version)
        set_up(pool)
        outputs, status = step(pool, np.nan, 1.0)
        assert status.tolist() == [Status.NOT_FINITE, Status.OK]
        assert pool.failure(0) == "the inputs are not finite: u = nan"
        assert outputs.tolist() == [[0.0, 0.8]]
        outputs, status = step(pool, 1.0, -np.inf)
        assert status.tolist() == [Status.OK, Status.NOT_FINITE]
        assert outputs.tolist() == [[0.8, 0.8]]

    @pytest.mark.parametrize("hooks", ["arrays", "one by one"])
    def test_made_by_a_hook_from_integer_actions(self, lawful, opened, hooks):
        class Dividing(lawful_tools.LawfulEnv):
            def _get_action_space(self):
                return spaces.Discrete(2)

            def _get_inputs(self):
                return 1.0 / self.action

        envs = opened(FMUVectorEnv(in_way(hooks, lambda: Dividing(lawful[2])), 2))
        envs.reset(seed=0)
        with np.errstate(divide="ignore"), pytest.raises(ConfigError, match=r"finite"):
            envs.step(np.array([1, 0]))
        envs.reset(seed=0)
        assert envs.step(np.array([1, 1]))[0].tolist() == [[0.5]] * 2


class TestRetries:
    @with_state
    def test_smaller_and_smaller_steps(self, pool, version):
        """0.8 s is discarded, and 0.4; 0.2 is not."""
        pool = pool(version, fault_retries=3)
        set_up(pool, longest=[0.25, 0.0], k=2.0)
        for count in (1, 2):
            outputs, status = step(pool, 0.5, 0.5)
            assert status.tolist() == [Status.OK, Status.OK]
            np.testing.assert_allclose(outputs, [[0.8 * count] * 2], rtol=1e-15)
            assert pool.info()["retries"].tolist() == [2, 0]
        health = pool.health()
        assert health["retries"].tolist() == [4, 0]
        assert health["discards"].tolist() == [0, 0]
        assert health["steps"].tolist() == [2, 2]

    @with_state
    def test_what_no_retry_mends_is_a_fault(self, pool, version):
        pool = pool(version, fault_retries=2)
        set_up(pool, longest=[0.1, 0.0])
        outputs, status = step(pool, 1.0, 1.0)
        assert status.tolist() == [Status.DISCARD, Status.OK]
        assert outputs.tolist() == [[0.0, 0.8]]
        assert "the step at t = 0 s returned Discard" in pool.failure(0)
        assert pool.health()["discards"].tolist() == [1, 0]

    @with_state
    def test_in_substeps_as_by_hand(self, make, way, version):
        pool = make(version, 2, 0.7, way, substeps=3, fault_retries=4, start_time=0.1)
        set_up(pool, longest=[0.03, 0.1], k=[0.3, 0.7])
        rows = np.array([step(pool, 0.1 * i, -0.2)[0].copy() for i in range(5)])
        count = np.arange(1, 6)
        by_hand = [0.3 * 0.1 * (count - 1) * count / 2 * 0.7, -0.2 * 0.7 * 0.7 * count]
        np.testing.assert_allclose(rows[:, 0], np.transpose(by_hand), rtol=1e-13)
        assert (pool.health()["retries"] > 0).all()

    def test_are_told_in_the_info(self, lawful, opened):
        config = {"fault_retries": 2, "model_parameters": {"longest": 0.3}}
        env = opened(lawful_tools.LawfulEnv(lawful[2], **config))
        assert env.reset()[1]["retries"] == 0
        assert env.step([1.0])[4]["retries"] == 1
        envs = opened(FMUVectorEnv(lambda: lawful_tools.LawfulEnv(lawful[2], **config), 3))
        envs.reset(options={"model_parameters": {"longest": 0.0}})
        mask = np.array([False, True, False])
        envs.reset(options={"reset_mask": mask})
        assert envs.step(np.ones((3, 1)))[4]["retries"].tolist() == [0, 1, 0]

    def test_of_an_fmu_that_cannot(self, lawful):
        with pytest.raises(
            ConfigError, match=r"'fault_retries' needs an FMU that can get and set .* Lawful"
        ):
            lawful_tools.LawfulEnv(lawful[1], fault_retries=1)

    @pytest.mark.parametrize("count", [-1, 11, 1.5, True])
    def test_number(self, lawful, count):
        with pytest.raises(ConfigError, match="fault_retries must be an integer from 0 to 10, got"):
            lawful_tools.LawfulEnv(lawful[2], fault_retries=count)


class TestHealth:
    @every_version
    def test_counts(self, pool, version):
        pool = pool(version)
        set_up(pool, longest=[0.0, 0.5])
        for _ in range(3):
            step(pool, 1.0, np.nan)
        step(pool, 1.0, 1.0)
        set_up(pool, np.array([False, True]))
        step(pool, 1.0, 1.0)
        health = pool.health()
        assert health["resets"].tolist() == [1, 2]
        assert health["steps"].tolist() == [5, 2]
        assert health["not_finite"].tolist() == [0, 3]
        assert health["discards"].tolist() == [0, 1]
        pool.forget_health()
        assert not any(counts.any() for counts in pool.health().values())

    @in_turn({"version": MAJOR_VERSIONS, "code,kind": [(3, "errors"), (4, "fatals")]})
    def test_recovery(self, make_env, version, code, kind):
        """After Error by a reset, after Fatal by a new instance."""
        env = make_env(version, model_parameters={"fault": code, "fault_step": 2})
        for episode in (1, 2):
            env.reset()
            assert not env.step([1.0])[3]
            truncated, info = env.step([1.0])[3:]
            assert truncated
            assert info["fault_rate"] == 1.0
            assert env.health[kind] == episode
        env.reset(options={"model_parameters": {"fault": 0}})
        assert not any(env.step([1.0])[3] for _ in range(3))
        assert env.health["replacements"] == (2 if code == 4 else 0)
        env.reset()
        env.step([1.0])
        assert env.step([1.0])[4]["fault_rate"] == 0.75

    def test_of_a_closed_environment(self, make_env):
        env = make_env()
        env.close()
        with pytest.raises(SimulationError, match="health was called on a closed"):
            _ = env.health


@pytest.mark.parametrize("leak", [{"leak": -64 * KB}, {"step_leak": -16 * KB, "steps": 4}])
def test_a_worker_that_leaks_is_replaced(make, leak):
    pool = make(2, 1, way={"isolation": "process"}, leak_limit=4 * MB)
    steps, processes = leak.pop("steps", 0), set()
    for index in range(400):
        _, status = set_up(pool, k=1.0 + index % 2, **leak)  # other values: none is restored
        assert not status.any()
        for _ in range(steps):
            step(pool, 1.0)
        processes.update(pool.processes())
    health = pool.health()
    assert health["deaths"].tolist() == [0]
    assert health["recyclings"].tolist() == [len(processes) - 1]
    assert 2 <= len(processes) <= 20


def test_workers_may_grow_without_a_limit(make):
    pool = make(2, 1, way={"isolation": "process"}, leak_limit=None)
    for index in range(200):
        set_up(pool, k=1.0 + index % 2, leak=-64 * KB)
    assert pool.health()["recyclings"].tolist() == [0]
