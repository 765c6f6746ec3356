"""Snapshots: episodes that go on from one are equal to the original, bit by bit."""

import copy
import hashlib
import pickle

import foreign_tank
import gymnasium
import numpy as np
import odd_values
import pytest
from combinations import in_turn
from demanding_tools import DemandingEnv, make_fmu
from fmu_tools import PlainEnv, grouped, probe_config
from ways import in_way
from zoo_tools import ZooEnv, parameters, zoo_fmu

import fmugym
from fmugym import ConfigError, SimulationError, Snapshot
from fmugym.envs import CartPoleEnv, PendulumEnv
from fmugym.pool.states import SaveMethod

POOLS = {
    "native": {},
    "process": {"isolation": "process"},
}
VERSIONS = ("1.0", "2.0", "3.0")
ACTIONS = np.random.default_rng(5).uniform(-1, 1, (60, 1)).astype(np.float32)


class Track(fmugym.FMI2CSEnv):
    """Follow a target that moves; an integral, a history, drawn values and short episodes."""

    def __init__(self, fmi_version="2.0", backend=None, isolation=None, **changes):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "monitor_names": "theta_ddot" if fmi_version != "1.0" else (),
            "model_parameters": {"m": fmugym.Uniform(0.05, 0.07), "q_0": fmugym.Normal(0, 0.3)},
            "episode_variables": {
                "target": fmugym.Uniform(-0.2, 0.2),
                "integral": 0.0,
                "history": np.zeros(3),
            },
            "bounds": {"tau": (-0.01, 0.01)},
            "time_step": 0.02,
            "max_episode_steps": 12,
        }
        fmu = fmugym.bundled_fmu("Pendulum", fmi_version)
        options = {"backend": backend, "isolation": isolation}
        super().__init__(fmu, grouped(config | changes), **options)

    fmi_version = None

    def _get_inputs(self):
        return 0.5 * (self.action + self.previous_action)

    def _update(self):
        q, _ = self.state
        self.variables["integral"] = self.variables["integral"] + (q - self.variables["target"])
        history = self.variables["history"]
        self.variables["history"] = np.stack([history[1], history[2], q])

    def _is_done(self):
        return abs(self.out["q"]) > 2.0

    def _reward_policy(self):
        _, before = self.previous_state
        return -abs(self.variables["integral"]) - 0.1 * before - self.variables["history"][0]


def play(env, actions=ACTIONS):
    """What a single environment does from now on, its resets included."""
    rows = []
    for action in actions:
        observation, reward, *ends, _ = env.step(action)
        rows.append((observation.tobytes(), reward, *ends))
        if any(ends):
            observation, info = env.reset()
            rows.append((observation.tobytes(), tuple(info["drawn"].values())))
    return rows


def play_vector(envs, index, actions=ACTIONS):
    """The same of one environment of many, with the mode Disabled."""
    rows = []
    for action in actions:
        observations, rewards, *ends, _ = envs.step(np.repeat(action[None], envs.num_envs, axis=0))
        rows.append((observations[index].tobytes(), rewards[index], *(e[index] for e in ends)))
        ended = ends[0] | ends[1]
        if ended.any():
            observations, infos = envs.reset(options={"reset_mask": ended})
            values = {n: v for n, v in infos["drawn"].items() if n[0] != "_"}.values()
            if ended[index]:
                rows.append((observations[index].tobytes(), tuple(v[index] for v in values)))
    return rows


@pytest.fixture
def halfway(opened):
    """Make an environment in the middle of its second episode."""

    def make(cls=Track, **changes):
        env = opened(cls(**changes))
        env.reset(seed=7)
        for action in ACTIONS[:3]:
            env.step(action)
        env.reset()
        for action in ACTIONS[3:8]:
            env.step(action)
        return env

    return make


class TestSingle:
    @in_turn({"version": VERSIONS, "pool": POOLS})
    def test_goes_on_as_the_original(self, halfway, pool, version):
        env = halfway(fmi_version=version, **pool)
        snapshot = env.save_state()
        assert snapshot.method == ("replay" if version == "1.0" else "state")
        assert snapshot.step_count.tolist() == [5]
        expected = play(env)
        observation = env.restore_state(snapshot)
        assert observation.tolist() == np.array(env.state, np.float32).tolist()
        assert env.save_state() == snapshot
        assert play(env) == expected

    @pytest.mark.parametrize("version", VERSIONS)
    def test_goes_on_in_another_environment_that_was_never_reset(self, halfway, version):
        env = halfway(fmi_version=version)
        copied = pickle.loads(pickle.dumps(env.save_state()))
        other = Track(fmi_version=version, isolation="process")
        other.restore_state(copied)
        assert other.time == env.time
        assert dict(other.parameters) == dict(env.parameters)
        assert play(other) == play(env)
        other.close()

    @pytest.mark.parametrize("version", VERSIONS)
    def test_deep_copies_are_in_the_same_episode(self, halfway, version):
        env = halfway(fmi_version=version)
        twin = copy.deepcopy(env)
        assert twin.save_state() == env.save_state()
        assert play(twin) == play(env)
        twin.close()

    def test_deep_copies_of_wrapped_environments_are_in_the_same_episode(self):
        env = gymnasium.make("fmugym/Pendulum-v0", max_episode_steps=9)
        env.reset(seed=0)
        for action in ACTIONS[:5]:
            env.step(action)
        twin = copy.deepcopy(env)
        for action in ACTIONS[5:9]:
            first, second = env.step(action), twin.step(action)
            assert first[0].tolist() == second[0].tolist()
            assert first[1:4] == second[1:4]
        assert second[3]
        env.close()
        twin.close()

    @pytest.mark.parametrize("way", ["arrays", "one by one"])
    def test_refuses_what_hooks_assign_to_attributes(self, way, vector_of):
        class Counting(CartPoleEnv):
            limit = 3.0

            def _update(self):
                self.pushes = [*getattr(self, "pushes", []), 1.0]

        message = "the attribute 'pushes' of Counting has changed .*'episode_variables'"
        with Counting() as env:
            env.reset(seed=0)
            env.save_state()
            env.step(1)
            for save in (env.save_state, lambda: copy.deepcopy(env)):
                with pytest.raises(ConfigError, match=message):
                    save()
        envs = vector_of(in_way(way, Counting), 2)
        envs.reset(seed=0)
        envs.set_attr("limit", [1.0, 2.0])
        snapshot = envs.save_state()
        envs.step(np.array([0, 1]))
        for save in (envs.save_state, lambda: envs.rollout(snapshot, np.zeros((2, 3), np.int64))):
            with pytest.raises(ConfigError, match=message):
                save()

    def test_after_a_fault_only_a_reset_can_follow(self, make_env):
        env = make_env(model_parameters={"fault": 3, "fault_step": 2})
        env.reset(seed=0)
        action = env.action_space.sample()
        while not any(env.step(action)[2:4]):
            pass
        snapshot = env.save_state()
        other = make_env(model_parameters={"fault": 3, "fault_step": 2})
        other.restore_state(snapshot)
        with pytest.raises(SimulationError, match="after the end"):
            other.step(action)
        other.reset()


class TestVector:
    @pytest.mark.parametrize("hooks", ["arrays", "one by one"])
    def test_parameters_from_options_are_restored(self, hooks, vector_of):
        envs = vector_of(in_way(hooks, Track), 2)
        envs.reset(seed=0, options={"model_parameters": {"b": 1e-3, "m": 0.2}})
        envs.step(np.ones((2, 1), np.float32))
        snapshot = envs.save_state()
        expected = play_vector(envs, 1)
        envs.reset(seed=1)
        envs.restore_state(snapshot)
        assert play_vector(envs, 1) == expected

    def test_deep_copies_are_in_the_same_episodes(self, vector_of):
        envs = vector_of(Track, 2)
        envs.reset(seed=0)
        envs.step(np.ones((2, 1), np.float32))
        twin = copy.deepcopy(envs)
        assert play_vector(twin, 1) == play_vector(envs, 1)
        twin.close()

    def test_an_instance_that_died_goes_on(self, probe, vector_of):
        """A snapshot from before a fatal error serves after it, also where states are replayed."""
        config = probe_config(model_parameters={"fault": 4, "fault_step": 3}, time_step=0.5)
        envs = vector_of(lambda: PlainEnv(probe(), config), 2)
        envs.reset(seed=0)
        actions = np.zeros(envs.action_space.shape, envs.action_space.dtype)
        first = envs.step(actions)
        snapshot = envs.save_state()
        while not envs.step(actions)[3].any():
            pass
        observations = envs.restore_state(snapshot)
        assert observations.tolist() == first[0].tolist()
        assert not envs.step(actions)[3].any()


class TestValues:
    def test_are_compared_by_content(self, halfway):
        env = halfway()
        first, second = env.save_state(), env.save_state()
        assert first == second
        assert hash(first) == hash(second)
        env.step(ACTIONS[0])
        assert first != env.save_state()
        assert first != "snapshot"
        assert copy.deepcopy(first) is first

    def test_of_several_are_taken_apart(self, vector_of):
        envs = vector_of(Track, 3)
        envs.reset(seed=0)
        snapshot = envs.save_state()
        assert len(snapshot) == len(list(snapshot)) == 3
        assert snapshot[1] == snapshot[np.array([False, True, False])] == snapshot[1:2]
        assert snapshot[0] != snapshot[1]
        assert repr(snapshot) == "Snapshot(3 environment(s), method='state')"
        with pytest.raises(ConfigError, match="no environments of a snapshot of 3"):
            snapshot[3]
        other = vector_of(Track, 3)
        other.restore_state(snapshot[[1, 1, 0]])
        assert other.save_state() == snapshot[[1, 1, 0]]

    def test_outlive_their_environment(self, halfway):
        env = halfway()
        snapshot, expected = env.save_state(), play(env)
        env.close()
        with Track() as other:
            other.restore_state(snapshot)
            assert play(other) == expected

    def test_of_another_version_are_refused(self, halfway):
        function, (_, *rest) = halfway().save_state().__reduce__()
        with pytest.raises(SimulationError, match="version 0"):
            function("0", *rest)


class TestRefusals:
    def test_before_the_first_reset(self, vector_of):
        with Track() as env, pytest.raises(SimulationError, match="before the first reset"):
            env.save_state()
        envs = vector_of(Track)
        with pytest.raises(SimulationError, match="before the first reset"):
            envs.save_state()

    def test_of_another_config(self, halfway):
        snapshot = halfway().save_state()
        with Track(time_step=0.01) as other, pytest.raises(ConfigError, match="time_step"):
            other.restore_state(snapshot)
        with Track(on_fault="raise", leak_limit=None) as other:  # no state depends on these
            other.restore_state(snapshot)

    def test_say_what_differs_and_no_more(self, halfway):
        env = halfway()
        snapshot = env.save_state()
        with Track(fmi_version="3.0") as other, pytest.raises(ConfigError) as refusal:
            other.restore_state(snapshot)
        said = str(refusal.value)
        assert "Pendulum of FMI 2.0" in said
        assert "Pendulum of FMI 3.0" in said
        for path in (env.fmu.path, fmugym.bundled_fmu("Pendulum", "3.0")):
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            assert content[:8] in said
            assert content[:12] not in said
        with Track(model_parameters={"m": 0.1, "q_0": fmugym.Normal(0, 0.3)}) as other:
            with pytest.raises(ConfigError, match=r"'m': 0\.1") as refusal:
                other.restore_state(snapshot)
            assert "q_0" not in str(refusal.value)
        with Track(model_parameters={"m": fmugym.Uniform(0.05, 0.07)}) as other:
            with pytest.raises(ConfigError, match="q_0") as refusal:
                other.restore_state(snapshot)
            assert "'m'" not in str(refusal.value)

    def test_of_what_is_no_snapshot_or_of_several(self, halfway, vector_of):
        env = halfway()
        envs = vector_of(Track)
        envs.reset(seed=0)
        with pytest.raises(ConfigError, match="expected a snapshot"):
            env.restore_state("here")
        with pytest.raises(ConfigError, match="of 3 environments, expected 1"):
            env.restore_state(envs.save_state())
        for where in ([0, 0], [5], [], "all", np.ones(2, bool), 1.5):
            with pytest.raises(ConfigError, match="mask"):
                envs.save_state(where)
        with pytest.raises(ConfigError, match="as many, or one"):
            envs.restore_state(envs.save_state([0, 1]))

    def test_after_close(self, halfway):
        env = halfway()
        snapshot = env.save_state()
        env.close()
        with pytest.raises(SimulationError, match="closed"):
            env.save_state()
        with pytest.raises(SimulationError, match="closed"):
            env.restore_state(snapshot)

    def test_of_real_systems(self):
        class Rig:
            def reset(self, values):
                return {"q": 0.0, "q_dot": 0.0, "theta_ddot": 0.0}

            def step(self, inputs):
                return {"q": 0.0, "q_dot": 0.0, "theta_ddot": 0.0}

            def stop(self):
                pass

        with Track(backend=Rig()) as env:
            env.reset(seed=0)
            with pytest.raises(SimulationError, match="no states that could be saved"):
                env.save_state()
            with Track() as model:
                model.reset(seed=0)
                with pytest.raises(SimulationError, match="no states that could be restored"):
                    env.restore_state(model.save_state())
            env.step(ACTIONS[0])  # the episode goes on

    def test_some_of_a_vector_that_was_never_reset(self, halfway, vector_of):
        envs = vector_of(Track)
        with pytest.raises(ConfigError, match="restored in all"):
            envs.restore_state(halfway().save_state(), [0])


@pytest.mark.usefixtures("own_trials")
class TestForeign:
    @pytest.mark.parametrize(
        ("token", "method"),
        [
            ("quick", SaveMethod.STATE),
            ("slow, crashes elsewhere", SaveMethod.COPY),
            ("slow, refuses elsewhere", SaveMethod.COPY),
            ("slow, differs elsewhere", SaveMethod.COPY),
        ],
    )
    def test_states_are_tried_in_a_second_process(self, tmp_path, token, method):
        path = make_fmu(tmp_path, token)
        for _ in range(2):  # the second time, the cache knows
            env = DemandingEnv(path)
            env.reset(seed=0)
            env.step(ACTIONS[0])
            snapshot = env.save_state()
            assert snapshot.method is method
            expected = [env.step(action)[0].tolist() for action in ACTIONS]
            env.restore_state(snapshot)
            assert [env.step(a)[0].tolist() for a in ACTIONS] == expected
            with DemandingEnv(path) as other:
                other.restore_state(snapshot)
                assert [other.step(a)[0].tolist() for a in ACTIONS] == expected
            env.close()

    def test_without_a_spare_instance_nothing_is_tried(self, tmp_path):
        path = make_fmu(tmp_path, "quick")
        with DemandingEnv(path, max_instances=1) as env:
            env.reset(seed=0)
            assert env.save_state().method is SaveMethod.REPLAY
        with DemandingEnv(path, max_instances=2) as env:
            env.reset(seed=0)
            assert env.save_state().method is SaveMethod.STATE

    def test_of_pythonfmu(self, tmp_path):
        builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu builds the FMU")
        path = builder.FmuBuilder.build_FMU(foreign_tank.__file__, dest=tmp_path)

        class Tank(fmugym.FMI2CSEnv):
            def __init__(self):
                config = {
                    "model_input_names": ["inflow", "valve_open"],
                    "model_output_names": ["level", "switches"],
                    "model_parameters": {"area": fmugym.Uniform(1.0, 3.0)},
                    "time_step": 0.5,
                    "bounds": {"inflow": (0.0, 0.5)},
                }
                super().__init__(path, config)

            def _is_done(self):
                return self.out["level"] < -1.0

        with Tank() as env, Tank() as other:
            env.reset(seed=0)
            actions = [env.action_space.sample() for _ in range(10)]
            for action in actions:
                env.step(action)
            other.restore_state(env.save_state())
            assert [other.step(a)[0].tolist() for a in actions] == [
                env.step(a)[0].tolist() for a in actions
            ]


class TestZoo:
    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_goes_on_after_the_death_of_its_process(self, tmp_path, version):
        values = parameters("segv", at=3)
        config = {"isolation": "process", "model_parameters": values}
        with ZooEnv(zoo_fmu(tmp_path, version), **config) as env:
            env.reset(seed=0)
            env.step(ACTIONS[0])
            snapshot = env.save_state()
            expected = env.step(ACTIONS[1])[:4]
            assert env.step(ACTIONS[2])[3]
            env.restore_state(snapshot)
            assert env.step(ACTIONS[1])[:4] == expected
            assert env.step(ACTIONS[2])[3]
            assert env.health["deaths"] == 2


def test_records_have_a_limit_and_say_so(halfway):
    """What is kept of an episode without saved states cannot be saved if it is not whole."""
    env = halfway(fmi_version="1.0")
    inputs = env.pool_spec.inputs
    env.pool.write(inputs, np.zeros((len(inputs), 1)))  # which no record has
    with pytest.raises(SimulationError, match="too long"):
        env.save_state()


def test_equal_episodes_have_equal_states(make_env, vector_of):
    """However often they are saved."""
    envs = vector_of(PendulumEnv, 8)
    envs.reset(seed=0)
    snapshots = [envs.save_state() for _ in range(1000)]
    assert len({snapshot.bundle.states for snapshot in snapshots}) == 1
    assert isinstance(snapshots[0], Snapshot)


class TestDamage:
    @pytest.mark.parametrize(
        "which",
        [None, True, [[0, 1]], np.zeros((2, 2), int), np.uint64(2**63), odd_values.Unspeakable()],
        ids=["None", "True", "nested", "matrix", "large", "object"],
    )
    def test_an_odd_index_is_refused(self, which):
        envs = fmugym.FMUVectorEnv(Track, 3)
        envs.reset(seed=0)
        snapshot = envs.save_state()
        envs.close()
        with pytest.raises(ConfigError, match="of a snapshot of 3"):
            snapshot[which]

    def test_a_changed_byte_is_found(self):
        with Track() as env:
            env.reset(seed=0)
            pickled = pickle.dumps(env.save_state())
        begin = pickled.index(b"fmugym.pool.states")
        for place in range(begin, begin + 300, 7):
            damaged = bytearray(pickled)
            damaged[place] ^= 1
            with pytest.raises(SimulationError, match="damaged"):
                pickle.loads(damaged)
