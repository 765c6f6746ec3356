"""Episodes start within the native pool's pass, in every autoreset mode, as outside of it."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from vector_tools import (
    CART_POLE,
    Drawing,
    PushedCart,
    make_pair,
    require_equal,
    require_same_infos,
    run_side_by_side,
    sampled_actions,
)

from fmugym import SimulationError, Uniform
from fmugym.vector import FMUVectorEnv
from fmugym.vector.engines.batch import BatchEngine

SAME_STEP, DISABLED = AutoresetMode.SAME_STEP, AutoresetMode.DISABLED


@pytest.fixture
def outside(monkeypatch):
    """How many episodes Python has started, and not the pass."""
    calls = []
    begin = BatchEngine._begin

    def counted(self, *args):
        calls.append(args)
        return begin(self, *args)

    monkeypatch.setattr(BatchEngine, "_begin", counted)
    return calls


@pytest.mark.parametrize("mode", [SAME_STEP, DISABLED], ids=lambda mode: mode.name)
@pytest.mark.parametrize("num_envs", [1, 7, 140])
def test_no_reset_is_made_outside_of_the_pass(mode, num_envs, outside):
    ours, theirs = make_pair(CART_POLE, mode, num_envs, hooks="compiled")
    assert run_side_by_side(ours, theirs, mode, 60) >= 2 * num_envs
    assert not outside
    ours.close()
    theirs.close()


@pytest.mark.parametrize("mode", [SAME_STEP, DISABLED], ids=lambda mode: mode.name)
def test_threads_change_nothing(mode):
    results = []
    for threads in (1, 4):
        envs = gym.make_vec(
            "fmugym/CartPole-v0", num_envs=2000, autoreset_mode=mode, threads=threads
        )
        envs.reset(seed=3)
        for actions in sampled_actions(envs, 25):
            result = envs.step(actions)
            ended = result[2] | result[3]
            if mode is DISABLED and ended.any():
                first = envs.reset(options={"reset_mask": ended})[0]
        results.append(first if mode is DISABLED else result[0])
        envs.close()
    require_equal(*results)


class OwnUniform(Uniform):
    """A distribution of the user's, which only Python can draw."""

    def sample(self, rng):
        return float(rng.uniform(self.low, self.high)) ** 2


class Sorting(Drawing):
    """Hooks that are compiled; the draws are not."""

    def __init__(self):
        super().__init__(model_parameters={"q_0": OwnUniform(0.1, 0.9), "m": Uniform(0.05, 0.07)})

    def _get_action_space(self):
        return gym.spaces.Discrete(2)

    def _get_inputs(self):
        return (self.action - 0.5) * 0.01

    def _is_done(self):
        return abs(self.state[0]) > 0.7


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.name)
def test_draws_of_python_in_every_mode(mode):
    ours, theirs = make_pair(Sorting, mode, 5, hooks="compiled")
    assert run_side_by_side(ours, theirs, mode, 60) > 5
    ours.close()
    theirs.close()


class Limited(PushedCart):
    """Some environments fail in a step in which others end, or end as they fail."""

    def __init__(self):
        super().__init__(max_episode_steps=3, on_fault="truncate", fault_reward=-7.0)


def test_faults_beside_regular_ends():
    """An episode that ends by a fault keeps its last observation and its reason."""
    ours, theirs = (
        FMUVectorEnv(Limited, 6, autoreset_mode=SAME_STEP, hooks=hooks)
        for hooks in ("compiled", "per_env")
    )
    require_equal(ours.reset(seed=1)[0], theirs.reset(seed=1)[0])
    rng, both = np.random.default_rng(0), 0
    for _ in range(60):
        actions = (rng.random(6) < 0.1).astype(np.int64)
        first, second = ours.step(actions), theirs.step(actions)
        for mine, other in zip(first[:4], second[:4], strict=True):
            require_equal(mine, other)
        require_same_infos(first[4], second[4])
        ended, faulty = first[2] | first[3], first[1] == -7.0
        both += bool(faulty.any() and (ended & ~faulty).any())
    assert both > 2
    ours.close()
    theirs.close()


def test_options_and_parameters_between_steps(outside):
    ours, theirs = make_pair(CART_POLE, SAME_STEP, 4, hooks="compiled")
    run_side_by_side(ours, theirs, SAME_STEP, 30)
    options = {"model_parameters": {"x_0": 0.5}, "reset_mask": np.array([True, False, True, False])}
    first, second = ours.reset(options=options), theirs.reset(options=options)
    require_equal(first[0], second[0])
    require_same_infos(first[1], second[1])
    assert len(outside) == 1
    for actions in sampled_actions(ours, 120):
        first, second = ours.step(actions), theirs.step(actions)
        require_equal(first[0], second[0])
        require_same_infos(first[4], second[4])
    ours.close()
    theirs.close()


def test_the_infos_are_plain_when_copied():
    envs = gym.make_vec("fmugym/CartPole-v0", num_envs=8, autoreset_mode="same_step")
    envs.reset(seed=0)
    results = (envs.step(actions)[4] for actions in sampled_actions(envs, 60))
    infos = next(filter(None, results))
    for copied in (copy.deepcopy(infos), pickle.loads(pickle.dumps(infos))):
        assert type(copied) is dict
        assert copied.keys() == infos.keys()
    assert infos["final_obs"].dtype == object
    assert [row is not None for row in infos["final_obs"]] == infos["_final_obs"].tolist()
    assert infos["_final_obs"] is not infos["_final_info"]
    envs.close()


class Wide(Drawing):
    """An output that a float32 cannot hold at the start of two thirds of the episodes."""

    def __init__(self):
        super().__init__(
            model_parameters={"q_0": Uniform(-1e39, 1e39), "q_dot_0": 0.0}, max_episode_steps=2
        )

    def _get_action_space(self):
        return gym.spaces.Discrete(2)

    def _get_inputs(self):
        return self.action * 0.0

    def _is_done(self):
        return False & (self.state[0] > 0)


def too_wide(seed, episode):
    """Whether an episode begins with an angle that is infinite as a float32."""
    q_0 = np.random.default_rng(seed).uniform(-1e39, 1e39, episode + 1)[episode]
    return abs(q_0) > np.finfo(np.float32).max


@pytest.mark.parametrize("mode", [SAME_STEP, DISABLED], ids=lambda mode: mode.name)
def test_a_first_observation_that_is_not_finite(mode):
    envs = FMUVectorEnv(Wide, 1, hooks="compiled", autoreset_mode=mode)
    envs.reset(seed=next(s for s in range(99) if not too_wide(s, 0) and too_wide(s, 1)))
    envs.step(np.zeros(1, np.int64))
    with pytest.raises(SimulationError, match="first observation is not finite"):
        envs.reset() if mode is DISABLED else envs.step(np.zeros(1, np.int64))
    envs.close()


def test_masks_are_copied():
    envs = gym.make_vec("fmugym/CartPole-v0", num_envs=3, autoreset_mode="disabled")
    envs.reset(seed=0)
    mask = np.array([True, False, True])
    _, infos = envs.reset(options={"reset_mask": mask})
    mask[:] = False
    assert infos["_drawn"].tolist() == [True, False, True]
    assert infos["drawn"]["_x_0"].tolist() == [True, False, True]
    envs.close()


class TestGuards:
    """The methods of the extension refuse arrays that do not fit."""

    @pytest.fixture
    def pool(self):
        envs = FMUVectorEnv(CART_POLE, 4, hooks="compiled")
        envs.reset(seed=0)
        yield envs.inside.engine._pool._pool
        envs.close()

    def test_fitting_ones(self, pool):
        actions = np.zeros(4, np.int64)
        assert pool.play(actions, False)[1:] == (0, False, None)
        assert pool.play(actions, True)[1:] == (0, False, None)

    @pytest.mark.parametrize("actions", [np.zeros(3, np.int64), np.zeros(8, np.int64)[::2], 7])
    def test_others(self, pool, actions):
        for at_ends in (False, True):
            with pytest.raises((TypeError, ValueError, BufferError)):
                pool.play(actions, at_ends)
        with pytest.raises(TypeError, match="expected 2 arguments"):
            pool.play(np.zeros(4, np.int64))


class Tracking(Drawing):
    """Observations, infos and episode variables of its own."""

    def __init__(self):
        super().__init__(
            episode_variables={"target": Uniform(-1.0, 1.0), "integral": 0.0}, max_episode_steps=7
        )

    def _update(self):
        error = self.variables["target"] - self.state[0]
        self.variables["integral"] = self.variables["integral"] + 0.1 * error

    def _is_done(self):
        return abs(self.variables["integral"]) > 0.3

    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
        return gym.spaces.Dict({"plant": box, "steps": gym.spaces.Box(0, 99, (1,), np.int64)})

    def _get_observation(self):
        target, integral = self.variables["target"], self.variables["integral"]
        plant = np.array([np.sin(self.state[0]) - target, integral, self.previous_state[1]])
        return {"plant": plant, "steps": np.array([self.step_count])}

    def _get_info(self):
        return {"error": self.variables["target"] - self.state[0]}


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.name)
@pytest.mark.parametrize("num_envs", [3, 140])
def test_tasks_with_observations_of_their_own(mode, num_envs, outside):
    ours, theirs = make_pair(Tracking, mode, num_envs, hooks="compiled")
    assert run_side_by_side(ours, theirs, mode, 40) > 5 * num_envs
    assert not outside
    ours.close()
    theirs.close()


def played(envs, mode, steps):
    """The results of random steps, and of the resets that follow them."""
    envs.reset(seed=3)
    rng, results = np.random.default_rng(0), []
    for _ in range(steps):
        result = envs.step(rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32))
        results.append(result)
        ended = result[2] | result[3]
        if mode is DISABLED and ended.any():
            results.append(envs.reset(options={"reset_mask": ended}))
    envs.close()
    return results


@pytest.mark.parametrize("env_id", ["fmugym/Pendulum-v0", "fmugym/CloudPendulum-v0"])
@pytest.mark.parametrize("mode", [SAME_STEP, DISABLED], ids=lambda mode: mode.name)
def test_bundled_tasks_with_observations_of_their_own(env_id, mode, outside):
    ours, theirs = (
        gym.make_vec(env_id, num_envs=5, autoreset_mode=mode, hooks=hooks)
        for hooks in ("compiled", "array")
    )
    results = played(ours, mode, 420)
    assert not outside
    for first, second in zip(results, played(theirs, mode, 420), strict=True):
        for mine, other in zip(
            first[:-1], second[:-1], strict=True
        ):  # a square may differ in a bit
            np.testing.assert_allclose(mine, other, rtol=1e-9, atol=1e-9)
        require_same_infos(first[-1], second[-1])
