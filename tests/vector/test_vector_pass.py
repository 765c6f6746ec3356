"""Episodes start within the native pool's pass, in every autoreset mode, as outside of it."""

from itertools import product

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.vector import AutoresetMode
from vector_tools import (
    CART_POLE,
    Drawing,
    PushedCart,
    each_mode,
    fixture_outside,  # noqa: F401  # the fixture "outside"
    require_pair_equal,
    results_of_both,
    run_side_by_side,
)

from fmugym import SimulationError, Uniform
from fmugym.vector import FMUVectorEnv

SAME_STEP, DISABLED = AutoresetMode.SAME_STEP, AutoresetMode.DISABLED


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


@in_turn({"task,mode": list(product([CART_POLE, Tracking], AutoresetMode)), "num_envs": [140, 1]})
def test_no_reset_is_made_outside_of_the_pass(mode, task, num_envs, outside):
    assert require_pair_equal(task, 60, mode, num_envs=num_envs, hooks="compiled") >= 2 * num_envs
    assert not outside


@each_mode
def test_threads_change_nothing(mode):
    ours, theirs = (
        FMUVectorEnv(Tracking, 2000, autoreset_mode=mode, threads=threads) for threads in (1, 4)
    )
    assert run_side_by_side(ours, theirs, 25) > 2000


class Limited(PushedCart):
    """Some environments fail in a step in which others end, or end as they fail."""

    def __init__(self):
        super().__init__(max_episode_steps=3, on_fault="truncate", fault_reward=-7.0)


def test_faults_beside_regular_ends(make_envs):
    """An episode that ends by a fault keeps its last observation and its reason."""
    ours, theirs = (
        make_envs(Limited, 6, autoreset_mode=SAME_STEP, hooks=hooks)
        for hooks in ("compiled", "per_env")
    )
    rng, both = np.random.default_rng(0), 0
    actions = [(rng.random(6) < 0.1).astype(np.int64) for _ in range(60)]
    for result in results_of_both(ours, theirs, actions):
        ended, faulty = result[2] | result[3], result[1] == -7.0
        both += bool(faulty.any() and (ended & ~faulty).any())
    assert both > 2


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
def test_a_first_observation_that_is_not_finite(mode, make_envs):
    envs = make_envs(Wide, 1, hooks="compiled", autoreset_mode=mode)
    envs.reset(seed=next(s for s in range(99) if not too_wide(s, 0) and too_wide(s, 1)))
    envs.step(np.zeros(1, np.int64))
    with pytest.raises(SimulationError, match="first observation is not finite"):
        envs.reset() if mode is DISABLED else envs.step(np.zeros(1, np.int64))


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
