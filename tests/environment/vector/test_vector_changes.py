"""Hooks on arrays after a change: of options, parameters or attributes."""

import numpy as np
import pytest
from vector_tools import (
    CART_POLE,
    Drawing,
    fixture_outside,  # noqa: F401  # the fixture "outside"
    require_same_starts,
    results_of_both,
)
from ways import WAYS, in_way

from fmugym.environment.vector import FMUVectorEnv

CHANGES = {
    "options": lambda vector: vector.reset(
        options={
            "model_parameters": {"m_pole": 0.3},
            "reset_mask": np.array([True, False, False]),
        }
    ),
    "parameters": lambda vector: vector.set_attr("m_pole", [0.05, 0.2, 0.3]),
    "another parameter": lambda vector: vector.set_attr("theta_dot_0", [0.01, 0.02, 0.03]),
    "an attribute": lambda vector: vector.set_attr("x_threshold", 0.05),
}


@pytest.mark.parametrize("mode", ["next_step", "same_step"])
@pytest.mark.parametrize("change", CHANGES)
def test_hooks_after_a_change(change, mode, outside, make_envs):
    """Once the episodes from before have ended, the pool starts the next ones as before."""
    ours, theirs = (
        make_envs(in_way(hooks, CART_POLE), 3, max_episode_steps=12, autoreset_mode=mode)
        for hooks in ("arrays", "one by one")
    )
    for count, _ in enumerate(results_of_both(ours, theirs, 60)):
        if count == 6:
            assert not outside
            first, second = CHANGES[change](ours), CHANGES[change](theirs)
            if first is not None:
                require_same_starts(first, second)
        if count == 58:
            already = len(outside)
    assert len(outside) == already < 30


class Weighing(Drawing):
    """The reward is for a parameter that only some options give."""

    def _reward_policy(self):
        return self.parameters.get("b", -1.0) + 0.0 * self.state[0]


def test_hooks_read_parameters_that_options_add():
    ways = [FMUVectorEnv(in_way(way, Weighing), 3) for way in WAYS]
    for envs in ways:
        envs.reset(seed=1)
        assert envs.step(envs.action_space.sample())[1].tolist() == [-1.0] * 3
        envs.reset(options={"model_parameters": {"b": 0.25}})
        assert envs.step(envs.action_space.sample())[1].tolist() == [0.25] * 3
        envs.close()
