"""What a vector environment asks of ``make_env``, and what constructors may do meanwhile."""

import threading

import numpy as np
import pytest
from combinations import in_turn
from vector_tools import Drawing, require_equal
from ways import in_way, make_vec

import fmugym
from fmugym import ConfigError, SimulationError
from fmugym.environment.vector import FMUVectorEnv

NOTHING = np.zeros((3, 1), np.float32)


@pytest.mark.parametrize("hooks", ["arrays", "one by one"])
def test_an_environment_that_was_there_before_is_refused_and_lives_on(hooks):
    env = Drawing()
    first = env.reset(seed=1)[0]
    with pytest.raises(ConfigError, match="make_env must make a new environment in each call"):
        FMUVectorEnv(in_way(hooks, lambda: env), 3)
    env.step(NOTHING[0])
    require_equal(env.reset(seed=1)[0], first)
    env.close()


def test_the_same_environment_twice_is_refused():
    made = []

    def make():
        made[:] = made or [Drawing()]
        return made[0]

    with pytest.raises(ConfigError, match="make_env must make a new environment in each call"):
        FMUVectorEnv(in_way("one by one", make), 3)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"time_step": 0.05}, "interface to the FMU"),
        ({"bounds": {"tau": (-1.0, 1.0)}}, "interface to the FMU"),
        ({"model_output_names": ["q"]}, "interface to the FMU"),
    ],
)
def test_environments_that_differ_in_more_than_values_are_refused(changes, what):
    given = iter([{}, {}, changes])
    with pytest.raises(ConfigError, match=f"environment 2 has another {what} than environment 0"):
        FMUVectorEnv(in_way("one by one", lambda: Drawing(**next(given))), 3)


def test_they_may_differ_in_values(make_envs):
    given = iter([0.1, 0.2, 0.3])
    vector = make_envs(
        in_way("one by one", lambda: Drawing(model_parameters={"q_0": next(given)})), 3
    )
    observations, _ = vector.reset(seed=1)
    np.testing.assert_allclose(observations[:, 0], [0.1, 0.2, 0.3], rtol=1e-6)


@pytest.mark.parametrize("hooks", ["arrays", "one by one"])
def test_make_env_may_use_another_thread(hooks, make_envs):
    def make():
        made = []
        thread = threading.Thread(target=lambda: made.append(Drawing()))
        thread.start()
        thread.join()
        return made[0]

    vector = make_envs(in_way(hooks, make), 3)
    assert vector.reset(seed=1)[0].shape == (3, 2)
    vector.step(NOTHING)


def test_all_are_closed(temp_root):
    closed = []

    class Closing(Drawing):
        def close(self):
            closed.append(self)
            super().close()

    vector = FMUVectorEnv(in_way("one by one", Closing), 3)
    vector.reset(seed=1)
    vector.close()
    assert len(set(map(id, closed))) == 3
    assert not list(temp_root.iterdir())


def test_what_was_made_is_closed_if_a_later_one_cannot_be_made(temp_root):
    made = []

    def make():
        if len(made) == 2:
            raise KeyError("no more")
        made.append(Drawing())
        return made[-1]

    with pytest.raises(KeyError, match="no more"):
        FMUVectorEnv(in_way("one by one", make), 3)
    for env in made:
        with pytest.raises(SimulationError, match="closed"):
            env.reset()
    assert not list(temp_root.iterdir())


class Failing(Drawing):
    """A hook fails in the second step."""

    def _reward_policy(self):
        if np.any(self.step_count == 2):
            raise ZeroDivisionError("in a hook")
        return 1.0


@in_turn({"mode": ["next_step", "same_step", "disabled"], "hooks": ["arrays", "one by one"]})
def test_an_exception_of_a_hook_after_the_step_ends_all_episodes(hooks, mode, make_envs):
    vector = make_envs(in_way(hooks, Failing), 3, autoreset_mode=mode)
    first = vector.reset(seed=1)[0]
    vector.step(NOTHING)
    with pytest.raises(ZeroDivisionError):
        vector.step(NOTHING)
    for _ in range(2):
        with pytest.raises(SimulationError, match="after an exception that has ended all"):
            vector.step(NOTHING)
    with pytest.raises(ConfigError, match="reset after an exception must be of all"):
        vector.reset(options={"reset_mask": np.array([True, False, True])})
    require_equal(vector.reset(seed=1)[0], first)
    vector.step(NOTHING)


class FailingEarly(Drawing):
    def _get_inputs(self):
        if np.any(np.asarray(self.action) > 0.005):
            raise ZeroDivisionError("in a hook")
        return self.action


@pytest.mark.parametrize("hooks", ["arrays", "one by one"])
def test_an_exception_before_the_step_leaves_the_episodes(hooks, make_envs):
    vector, twin = (make_envs(in_way(hooks, FailingEarly), 3) for _ in range(2))
    for envs in (vector, twin):
        envs.reset(seed=1)
        envs.step(NOTHING)
    with pytest.raises(ZeroDivisionError):
        vector.step(np.array([[0.0], [0.006], [0.0]], np.float32))
    require_equal(vector.step(NOTHING)[0], twin.step(NOTHING)[0])


def test_bundled_ids_take_any_number():
    """The environments of one vector environment share the FMU that they open."""
    envs = make_vec("one by one", "fmugym/Pendulum-v0", 20)
    assert len({id(fmu) for fmu in envs.get_attr("fmu")}) == 1
    envs.close()
    assert fmugym.bundled_fmu("Pendulum").exists()
