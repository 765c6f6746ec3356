"""The CloudPendulum environment with a client of the published methods, as real cells have one."""

import gc
import sys
import threading
import types
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest

from fmugym import ConfigError, SimulationError

ID = "fmugym/CloudPendulum-v0"


class Published:
    """A client with the published methods only, and an arm that does as it is told."""

    calls: ClassVar[list] = []
    answers: ClassVar[dict] = {}

    def __init__(self):
        """The real one takes no arguments."""

    def _call(self, name, *args):
        self.calls.append((name, *args))
        answer = self.answers.get(name)
        return answer() if answer is not None else None

    def start_experiment(self, user_token, experiment_type, experiment_time,
                         preparation_time=0.0, record=False, initial_state=None,
                         initial_position=None):  # fmt: skip
        self._call("start_experiment", user_token, experiment_type, initial_position)
        return "1234567890123456789", "https://example.org"

    def start_gym(self, user_token, gym_time, cell_types):
        self._call("start_gym", user_token, gym_time, cell_types)
        return "99"

    def start_episode(self, gym_token, experiment_type, time, preparation_time=0.0,
                      initial_position=None):  # fmt: skip
        self._call("start_episode", gym_token, experiment_type, initial_position)
        return "100", "https://example.org"

    def stop_experiment(self, session_token):
        self._call("stop_experiment", session_token)
        return ""

    def stop_episode(self, episode_token):
        self._call("stop_episode", episode_token)
        return ""

    def stop_gym(self, gym_token):
        self._call("stop_gym", gym_token)

    def get_position(self, token):
        value = self._call("get_position", token)
        return 0.1 if value is None else value

    def get_velocity(self, token):
        self._call("get_velocity", token)
        return 0.0

    def set_torque(self, torque, token):
        self._call("set_torque", torque, token)

    def set_impedance_controller_params(self, kp, kd, token):
        self._call("set_impedance_controller_params", kp, kd, token)


@pytest.fixture(name="published")
def fixture_published(monkeypatch):
    """A client of a package of the real one's form."""
    package = types.ModuleType("standin")
    data = types.ModuleType("standin.data")
    data.CellType = types.SimpleNamespace(SINGLE="single")
    monkeypatch.setitem(sys.modules, "standin", package)
    monkeypatch.setitem(sys.modules, "standin.data", data)
    return type(
        "Client", (Published,), {"calls": [], "answers": {}, "__module__": "standin.client"}
    )


def names(client):
    """The requests in their order, without what merely keeps the session alive."""
    return [name for name, *_ in client.calls]


class TestRealClient:
    def test_an_experiment_of_the_published_methods(self, published):
        env = gym.make(ID, backend=published(), user_token="ada", torque_limit=0.1)
        env.reset(options={"model_parameters": {"q_0": 0.02}})
        assert published.calls[:5] == [
            ("start_experiment", "ada", "SimplePendulum", [0.02]),
            ("set_impedance_controller_params", 0.0, 0.0, "1234567890123456789"),
            ("set_torque", 0.0, "1234567890123456789"),
            ("get_position", "1234567890123456789"),
            ("get_velocity", "1234567890123456789"),
        ]
        published.calls.clear()
        observation, *_ = env.step(np.array([0.5], np.float32))
        np.testing.assert_allclose(observation, [np.cos(0.1), np.sin(0.1), 0.0], atol=1e-7)
        env.close()
        steps = [call[:2] for call in published.calls if call[0] in ("set_torque", "get_position")]
        assert ("set_torque", 0.05) in steps
        assert names(published)[-2:] == ["set_torque", "stop_experiment"]

    def test_a_lease(self, published):
        env = gym.make_vec(ID, num_envs=2, backend=published(), user_token="ada", gym_time=60.0)
        env.reset()
        env.step(np.zeros((2, 1), np.float32))
        env.close()
        assert published.calls[0] == ("start_gym", "ada", 60.0, ["single"] * 2)
        assert names(published).count("start_episode") == 2
        assert names(published).count("stop_episode") == 2
        assert published.calls[-1] == ("stop_gym", "99")

    def test_it_wants_a_token(self, published):
        with pytest.raises(ConfigError, match="user_token= or gym_token="):
            gym.make(ID, backend=published())

    def test_a_package_without_cell_types(self):
        client = type("Client", (Published,), {"calls": [], "__module__": "nowhere.client"})
        env = gym.make(ID, backend=client(), user_token="ada", gym_time=60.0)
        with pytest.raises(SimulationError, match=r"nowhere has no data.CellType.*gym_token="):
            env.reset()
        env.close()

    @pytest.mark.parametrize(
        ("request_name", "answer", "text"),
        [
            ("get_position", lambda: float("nan"), "the outputs are not finite: q = nan"),
            ("get_position", lambda: [0.1, 0.2], "ValueError"),
            ("get_velocity", lambda: 1 / 0, "ZeroDivisionError"),
            ("set_torque", lambda: 1 / 0, "CellBackend.step: ZeroDivisionError"),
        ],
    )
    def test_nonsense_from_a_client(self, published, request_name, answer, text):
        env = gym.make(ID, backend=published(), user_token="ada")
        env.reset()
        published.calls.clear()
        published.answers[request_name] = answer
        observation, _, _, truncated, info = env.step(np.ones(1, np.float32))
        assert truncated
        assert text in info["fault"]
        assert np.isfinite(observation).all()
        assert published.calls[-1][:2] == ("set_torque", 0.0)
        env.close()
        assert names(published)[-1] == "stop_experiment"

    def test_an_interrupt_while_waiting_for_cells(self, published):
        def interrupt():
            raise KeyboardInterrupt

        published.answers["start_gym"] = interrupt
        env = gym.make(ID, backend=published(), user_token="ada", gym_time=60.0)
        with pytest.raises(KeyboardInterrupt):
            env.reset()
        env.close()
        assert names(published) == ["start_gym"]

    def test_an_interrupt_in_the_middle(self, published):
        def interrupt():
            raise KeyboardInterrupt

        env = gym.make(ID, backend=published(), user_token="ada")
        env.reset()
        published.answers["get_velocity"] = interrupt
        with pytest.raises(KeyboardInterrupt):
            env.step(np.ones(1, np.float32))
        assert names(published)[-2:] == ["set_torque", "stop_experiment"]
        env.close()
        assert names(published).count("stop_experiment") == 1

    def test_a_lost_session_is_stopped_without_complaint(self, published, caplog):
        def lose():
            raise RuntimeError("the session has ended")

        env = gym.make(ID, backend=published(), user_token="ada")
        env.reset()
        published.answers.update(set_torque=lose, stop_experiment=lose)
        env.close()
        assert caplog.text == ""

    def test_forgotten(self, published):
        before = set(threading.enumerate())
        env = gym.make(ID, backend=published(), user_token="ada")
        env.reset()
        (own,) = set(threading.enumerate()) - before
        del env
        gc.collect()
        assert names(published)[-1] == "stop_experiment"
        assert not own.is_alive()
