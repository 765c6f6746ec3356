"""The CloudPendulum environment: on the FMU, on simulated cells, on whatever else is a client."""

import contextlib
import queue
import signal
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lab_tools import ideal_lab
from process_tools import INTERRUPTIBLE
from scipy.integrate import solve_ivp

from fmugym import ConfigError, SimulationError, Uniform
from fmugym.envs import CloudPendulumEnv
from fmugym.lab import CellType, Client, Lab, ManualClock

ID = "fmugym/CloudPendulum-v0"
M, L, B, G = 0.06, 0.1, 4e-4, 9.81  # kg, m, N m s/rad, m/s^2: the published nominal values


@pytest.fixture(name="make_lab")
def fixture_make_lab(opened):
    """Make labs on a clock that stands still; in the end, nothing runs on them."""
    labs = []

    def make(make_lab=ideal_lab, **options):
        labs.append(opened(make_lab(clock=ManualClock(), seed=0, **options)))
        return labs[-1]

    yield make
    assert not any(lab.running for lab in labs)


@pytest.fixture
def on_lab(make_lab):
    """Make environments on a lab, or on a client, that are closed after the test."""
    with contextlib.ExitStack() as stack:

        def make(backend, **options):
            made = gym.make_vec if "num_envs" in options else gym.make
            return stack.enter_context(contextlib.closing(made(ID, backend=backend, **options)))

        yield make


def swings(count, amplitude=0.1, seed=0):
    """Random actions, each kept for a fifth of a second, that pass no limit of the platform."""
    values = np.random.default_rng(seed).uniform(-amplitude, amplitude, -(-count // 10))
    return np.repeat(values, 10)[:count, None].astype(np.float32)


def run(env, actions, seed=0, **options):
    """The states and rewards of an episode, from the reset on."""
    env.reset(seed=seed, **options)
    states, rewards = [env.unwrapped.state], []
    for action in actions:
        _, reward, *ends, info = env.step(action)
        assert not ends[0], info
        states.append(env.unwrapped.state)
        rewards.append(reward)
    return np.array(states), np.array(rewards)


def last(env, actions):
    """The info of the step that ends the episode."""
    for action in actions:
        *_, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return info
    raise AssertionError("the episode did not end")


class TestTask:
    def test_spaces(self):
        env = gym.make(ID)
        assert env.action_space == gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        high = np.array([1.0, 1.0, 50.0], np.float32)
        assert env.observation_space == gym.spaces.Box(-high, high, dtype=np.float32)
        assert env.spec.max_episode_steps == 500
        assert env.metadata["render_fps"] == 50
        env.close()

    def test_keeps_the_contract_of_gymnasium(self):
        env = CloudPendulumEnv(model_parameters={"c": Uniform(0, 3e-3)})
        check_env(env, skip_render_check=True)
        env.close()

    def test_against_an_integration_by_scipy(self):
        """The equation of the plant, with each action from the tick after its own."""
        env = CloudPendulumEnv(torque_limit=0.1, model_parameters={"q_0": 0.4, "c": 2e-3})
        actions = swings(100)
        states, _ = run(env, actions)
        state, applied = np.array([0.4, 0.0]), [0.0, *(0.1 * actions[:-1, 0].astype(float))]
        for k, torque in enumerate(applied):

            def derivative(_, x, torque=torque):
                friction = B * x[1] + 2e-3 * np.tanh(x[1] / 0.05)
                return x[1], (torque - friction) / (M * L**2) - G / L * np.sin(x[0])

            solution = solve_ivp(derivative, (0, 0.02), state, rtol=1e-9, atol=1e-10)
            state = solution.y[:, -1]
            np.testing.assert_allclose(states[k + 1], state, atol=2e-3)
        env.close()

    def test_the_start(self):
        env = gym.make_vec(ID, num_envs=500)
        observations, infos = env.reset(seed=0)
        q = infos["drawn"]["q_0"]
        assert -0.05 <= q.min() < -0.045 < 0.045 < q.max() < 0.05
        np.testing.assert_allclose(observations, np.c_[np.cos(q), np.sin(q), 0 * q], atol=1e-7)
        env.close()

    def test_rewards_by_hand(self):
        """Hanging costs pi^2, half the torque 0.004 / 4, 10 rad/s 0.1 * 15 / 98.1 * 100."""
        env = CloudPendulumEnv(model_parameters={"q_0": 0.0, "q_dot_0": 10.0})
        env.reset()
        reward = env.step(np.array([0.5], np.float32))[1]
        assert reward == pytest.approx(-(np.pi**2 + 1.52905199 + 0.001), abs=1e-6)
        env.reset(options={"model_parameters": {"q_0": np.pi + 0.3, "q_dot_0": 0.0}})
        assert env.step(np.array([0.0], np.float32))[1] == pytest.approx(-(0.3**2))
        env.reset(options={"model_parameters": {"q_0": -np.pi - 0.2, "q_dot_0": 0.0}})
        assert env.step(np.array([-3.0], np.float32))[1] == pytest.approx(-(0.2**2) - 0.004)
        env.close()

    @pytest.mark.parametrize("start", [{"q_0": 6.2, "q_dot_0": 9.0}, {"q_0": 0.0, "q_dot_0": -52}])
    def test_beyond_the_limits_of_the_platform_it_ends(self, start):
        env = CloudPendulumEnv(model_parameters={**start, "b": 0.0})
        env.reset()
        observation, reward, terminated, truncated, _ = env.step(np.array([0.0], np.float32))
        assert (terminated, truncated) == (True, False)
        assert reward < -1000.0
        assert env.observation_space.contains(observation)
        env.close()

    @pytest.mark.parametrize("limit", [0.0, -0.1, 0.2, float("nan")])
    def test_a_torque_limit_beyond_the_platform(self, limit):
        with pytest.raises(ConfigError, match="torque_limit must be more than 0 and at most"):
            CloudPendulumEnv(torque_limit=limit)

    def test_the_picture_shows_the_torque_that_acts(self):
        env = CloudPendulumEnv("rgb_array", model_parameters={"q_0": 0.0})
        pictures = []
        for first in (0.0, 1.0):
            env.reset()
            for action in (first, 0.0):
                env.step(np.array([action], np.float32))
            pictures.append(env.render())
        assert pictures[0].shape == (500, 500, 3)
        assert not np.array_equal(*pictures)
        env.close()

    def test_no_time_passes_between_sample_and_step_on_the_fmu(self):
        env = gym.make(ID)
        assert env.reset(seed=0)[1]["sample_age"] == 0.0
        assert env.step(env.action_space.sample())[4]["sample_age"] == 0.0
        envs = gym.make_vec(ID, num_envs=3)
        envs.reset(seed=0)
        assert envs.step(envs.action_space.sample())[4]["sample_age"].tolist() == [0.0] * 3
        envs.close()
        env.close()


class TestOnTheLab:
    def test_the_same_as_on_the_fmu(self, make_lab):
        """Solver steps of 2 ms there and 0.5 ms here: 1e-6 of 10 s of swings that are not small."""
        actions = swings(500)
        on_fmu, on_lab = gym.make(ID), gym.make(ID, backend=Client(make_lab()))
        states, rewards = run(on_fmu, actions, seed=3)
        lab_states, lab_rewards = run(on_lab, actions, seed=3)
        assert np.ptp(states[:, 0]) > 1.0
        np.testing.assert_allclose(lab_states, states, atol=1e-5)
        np.testing.assert_allclose(lab_rewards, rewards, atol=1e-4)
        assert on_lab.observation_space == on_fmu.observation_space
        assert on_lab.action_space == on_fmu.action_space
        on_lab.close()
        on_fmu.close()

    def test_a_client_will_do_and_needs_no_token(self, make_lab, on_lab):
        lab = make_lab()
        env = on_lab(Client(lab))
        _, info = env.reset(seed=1)
        assert lab.running == ["experiment"]
        assert (info["sample_age"], info["deadline_misses"]) == (0.0, 0)

    def test_a_lease_of_ones_own_serves_all_episodes(self, make_lab, on_lab):
        lab = make_lab()
        env = on_lab(Client(lab), user_token="ada", gym_time=100.0)
        for _ in range(3):
            env.reset()
            env.step(np.zeros(1, np.float32))
            assert lab.running == ["episode", "gym"]

    def test_a_lease_that_is_there_is_used_and_left(self, make_lab):
        lab = make_lab()
        token = Client(lab).start_gym("ada", 100.0, [CellType.SINGLE])
        env = gym.make(ID, backend=Client(lab), gym_token=token)
        env.reset()
        assert lab.running == ["episode", "gym"]
        env.close()
        assert lab.running == ["gym"]
        Client(lab).stop_gym(token)

    @pytest.mark.parametrize("names", [{"q_dot_0": 1.0}, {"l": 0.12}, {"q_0": 0.1, "c": 0.0}])
    def test_what_the_lab_cannot_set_is_refused(self, make_lab, names):
        lab = make_lab()
        with pytest.raises(ConfigError, match="cannot be set in the lab"):
            CloudPendulumEnv(backend=Client(lab), model_parameters=names)
        env = CloudPendulumEnv(backend=Client(lab), model_parameters={"q_0": 0.2})
        assert env.reset()[1]["drawn"] == {}
        assert env.state == pytest.approx((0.2, 0.0))
        with pytest.raises(ConfigError, match="cannot be set in the lab"):
            env.reset(options={"model_parameters": names})
        env.close()

    @pytest.mark.parametrize(
        ("arguments", "text"),
        [
            ({"backend": object()}, "must be 'fmu', or a client of the lab"),
            ({"backend": "lab"}, r"such as fmugym\.lab\.Client\(\), not 'lab'"),
            ({"backend": "fmuu"}, "unknown backend 'fmuu'; did you mean 'fmu'"),
            ({"user_token": "a", "gym_token": "b"}, "give no user_token"),
            ({"gym_token": "b", "gym_time": 5.0}, "and no gym_time"),
        ],
    )
    def test_arguments_that_do_not_fit(self, make_lab, arguments, text):
        with pytest.raises(ConfigError, match=text):
            CloudPendulumEnv(**{"backend": Client(make_lab()), **arguments})

    def test_a_limit_ends_it_as_on_the_fmu(self, make_lab):
        ends = []
        for backend in ("fmu", Client(make_lab())):
            env = CloudPendulumEnv(backend=backend)
            env.reset(seed=0)
            terminated = False
            while not terminated:
                _, reward, terminated, truncated, info = env.step(np.ones(1, np.float32))
                assert not truncated, info
            assert reward < -1000.0
            ends.append(env.step_count)
            env.close()
        assert abs(ends[0] - ends[1]) <= 1

    def test_a_lab_as_it_is(self, make_lab, on_lab):
        lab = make_lab(Lab)
        env = on_lab(Client(lab))
        env.reset(seed=0)
        ages = []
        for action in swings(200):
            *_, truncated, info = env.step(action)
            assert not truncated
            ages.append(info["sample_age"])
        # Two readings and a setter, from the first reading on: 0.79 ms in the median.
        assert 0.5e-3 < np.median(ages) < 1.2e-3
        assert lab.clock.time() == pytest.approx(1.0 + 4.0, abs=0.2)

    def test_a_pause_keeps_the_session_and_shifts_the_schedule(self, make_lab, monkeypatch):
        """A policy update of 5 s, in steps of time that the lab's heartbeat would survive."""
        lab, torques = make_lab(), queue.Queue()
        env = CloudPendulumEnv(backend=Client(lab))
        env.reset()
        tell = lab.tell

        def told(token, command, quantity, value):
            tell(token, command, quantity, value)
            torques.put(value)

        monkeypatch.setattr(lab, "tell", told)
        env.step(np.full(1, 0.2, np.float32))
        for expected in (0.03, 0.0, 0.0, 0.0, 0.0, 0.0):
            assert torques.get(timeout=10) == pytest.approx(expected)
            lab.clock.advance(1.0)
        torques.get(timeout=10)
        *_, truncated, info = env.step(np.zeros(1, np.float32))
        assert not truncated, info
        assert info["deadline_misses"] == 1
        assert info["worst_lateness"] == pytest.approx(5.98)
        env.close()
        assert lab.running == []

    def test_without_a_keeper_the_session_is_lost(self, make_lab, on_lab):
        lab = make_lab()
        env = on_lab(Client(lab))
        env.reset()
        lab.clock.advance(2.5)
        assert lab.running == []
        observation, _, terminated, truncated, info = env.step(np.zeros(1, np.float32))
        assert (terminated, truncated) == (False, True)
        assert "no request for 2 s" in info["fault"]
        assert np.isfinite(observation).all()
        env.reset()
        assert "fault" not in env.step(np.zeros(1, np.float32))[4]

    def test_an_expired_lease(self, make_lab, on_lab):
        lab = make_lab()
        env = on_lab(Client(lab), gym_time=3.0)
        env.reset()
        assert "the lease of its gym is over" in last(env, swings(160))["fault"]
        with pytest.raises(SimulationError, match="the gym has ended"):
            env.reset()
        assert lab.running == []
        env.reset()  # takes a new lease

    def test_the_session_time(self, make_lab, on_lab):
        lab = make_lab()
        env = on_lab(Client(lab), session_time=1.0)
        env.reset()
        assert "its time of 1 s is over" in last(env, swings(56))["fault"]


class TestCells:
    @pytest.mark.parametrize("mode", ["next_step", "same_step"])
    def test_one_lease_for_all_and_new_episodes(self, make_lab, mode, on_lab):
        lab = make_lab()
        env = on_lab(Client(lab), num_envs=4, autoreset_mode=mode, max_episode_steps=20)
        alone = gym.make_vec(ID, num_envs=4, autoreset_mode=mode, max_episode_steps=20)
        for each in (env, alone):
            each.reset(seed=5)
        assert lab.running == ["episode"] * 4 + ["gym"]
        for action in swings(50):
            actions = np.tile(action, (4, 1))
            got, expected = env.step(actions), alone.step(actions)
            for left, right in zip(got[:4], expected[:4], strict=True):
                np.testing.assert_allclose(left, right, atol=1e-5)
        assert got[4]["_sample_age"].all()
        alone.close()

    def test_cells_start_together(self, make_lab, on_lab):
        """Homing takes a second: for all of them at once, also where a clock is moved by hand."""
        lab = make_lab(Lab, stall_share=0.0)
        env = on_lab(Client(lab), num_envs=4)
        env.reset(seed=0)
        assert lab.clock.time() == pytest.approx(1.0, abs=0.05)
        for _ in range(50):
            *_, infos = env.step(np.zeros((4, 1), np.float32))
        assert lab.clock.time() == pytest.approx(2.0, abs=0.05)
        assert infos["deadline_misses"].tolist() == [0] * 4

    def test_programs_of_several_threads(self, make_lab):
        """Two programs, each with a lease of its own; time waits for both."""
        lab, ends = make_lab(Lab, stall_share=0.0), []

        def program():
            env, begin = gym.make(ID, backend=Client(lab), gym_time=60.0), lab.clock.time()
            env.reset(seed=0)
            for _ in range(50):
                *_, info = env.step(np.zeros(1, np.float32))
            ends.append((lab.clock.time() - begin, info["deadline_misses"]))
            env.close()

        threads = [lab.clock.thread(program) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
        for duration, misses in ends:
            assert duration == pytest.approx(2.0, abs=0.05)
            assert misses == 0
        assert len(ends) == 2
        assert lab.running == []

    def test_more_cells_than_there_are(self, make_lab, on_lab):
        env = on_lab(Client(make_lab()), num_envs=5)
        with pytest.raises(SimulationError, match="the lab has 4 cells of type SINGLE, not 5"):
            env.reset()

    def test_a_fault_of_one_cell(self, make_lab, monkeypatch, on_lab):
        lab, tokens = make_lab(), []
        start_episode = lab.start_episode

        def started(*args):
            token, address = start_episode(*args)
            tokens.append(token)
            return token, address

        monkeypatch.setattr(lab, "start_episode", started)
        env = on_lab(Client(lab), num_envs=3, autoreset_mode="same_step")
        env.reset()
        zeros = np.zeros((3, 1), np.float32)
        Client(lab).stop_episode(tokens[1])
        *_, truncated, infos = env.step(zeros)
        (index,) = np.flatnonzero(truncated)  # the cells start at the same time, in any order
        assert "was stopped" in infos["final_info"]["fault"][index]
        assert not env.step(zeros)[3].any()

    def test_in_gymnasiums_own_vector_environment(self, make_lab, on_lab):
        env = on_lab(Client(make_lab()), num_envs=2, vectorization_mode="sync")
        env.reset(seed=0)
        assert env.step(np.zeros((2, 1), np.float32))[0].shape == (2, 3)


PROGRAM = """
import sys
import gymnasium as gym, numpy as np
import fmugym
from fmugym.lab import Client, Lab

stop_session = Lab.stop_session
def told(self, *args):
    result = stop_session(self, *args)
    print("stopped", flush=True)
    return result
Lab.stop_session = told

env = gym.make("fmugym/CloudPendulum-v0", backend=Client(Lab(homing_time=0.0)))
env.reset()
print("running", flush=True)
for _ in range(int(sys.argv[1])):
    env.step(np.zeros(1, np.float32))
"""


class TestExits:
    def start(self, steps):
        command = [sys.executable, "-W", "error", "-c", INTERRUPTIBLE + PROGRAM, str(steps)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen(command, **pipes)

    def test_a_program_that_forgets_to_close(self):
        process = self.start(2)
        out, error = process.communicate(timeout=60)
        assert (process.returncode, out, error) == (0, "running\nstopped\n", "")

    @pytest.mark.skipif(sys.platform == "win32", reason="there is no such signal")
    def test_control_c(self):
        process = self.start(1000)
        assert process.stdout.readline() == "running\n"
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=60)
        assert out == "stopped\n"
        assert error.strip().endswith("KeyboardInterrupt")
