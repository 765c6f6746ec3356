"""Episodes start within the native pool's pass, in every autoreset mode, as outside of it."""

from itertools import product

import gymnasium as gym
import numpy as np
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

from fmugym import Uniform
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
