"""Compiled hooks of vector environments are those of numbers, or are not compiled."""

import numpy as np
import pytest
from vector_tools import (
    CART_POLE,
    Drawing,
    fixture_outside,  # noqa: F401  # the fixture "outside"
    require_pair_equal,
    require_same_starts,
    results_of_both,
    run_side_by_side,
)

from fmugym.vector import FMUVectorEnv
from fmugym.vector.hooks.symbols import Symbols

RARE = {
    "numpy.piecewise": lambda env: np.piecewise(env.state[0], [env.state[0] < 0], [-1.0, 1.0]),
    "float16": lambda env: np.asarray(env.state[0], np.float16),
    "uint64": lambda env: np.asarray(env.step_count).astype(np.uint64) % np.uint64(3),
    "where: use numpy.where": lambda env: np.divide(
        1.0, env.state[0], out=np.zeros_like(env.state[0]), where=env.state[0] != 0.0
    ),
    "a condition selects": lambda env: env.state[0] + np.sum(env.state[0][env.state[0] > 9]),
}


@pytest.mark.parametrize("reason", RARE)
def test_hooks_with_rare_functions_run_on_arrays_beside_compiled_ones(reason, caplog):
    class Other(Drawing):
        def _reward_policy(self):
            return RARE[reason](self)

    with caplog.at_level("INFO", "fmugym"):
        ours, theirs = (FMUVectorEnv(Other, 5, hooks=hooks) for hooks in ("auto", "array"))
    assert list(ours.inside.engine._task.left) == ["_reward_policy"]
    assert reason in caplog.text
    run_side_by_side(ours, theirs, 40)


class Differing(Drawing):
    """Its truncation is another one as a program, as if it hung on the last bit of a sine."""

    def _is_truncated(self):
        return super()._is_truncated() ^ isinstance(self.state, Symbols)


def test_a_program_that_differs_leaves_only_its_own_hook_to_arrays(caplog):
    with caplog.at_level("INFO", "fmugym"):
        require_pair_equal(Differing, steps=40, hooks="auto")
        envs = FMUVectorEnv(Differing, 3)
    assert "the program gives other values than _is_truncated. It runs on arrays" in caplog.text
    assert list(envs.inside.engine._task.left) == ["_is_truncated"]
    envs.close()


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
def test_compiled_hooks_after_a_change(change, mode, outside, make_envs):
    """Once the episodes from before have ended, the pool starts the next ones as before."""
    ours, theirs = (
        make_envs(CART_POLE, 3, hooks=hooks, max_episode_steps=12, autoreset_mode=mode)
        for hooks in ("compiled", "per_env")
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


def test_programs_know_parameters_that_options_add():
    """They were compiled when there was no such parameter."""
    ways = [FMUVectorEnv(Weighing, 3, hooks=hooks) for hooks in ("compiled", "array", "per_env")]
    for envs in ways:
        envs.reset(seed=1)
        assert envs.step(envs.action_space.sample()).rewards.tolist() == [-1.0] * 3
        envs.reset(options={"model_parameters": {"b": 0.25}})
        assert envs.step(envs.action_space.sample()).rewards.tolist() == [0.25] * 3
        envs.close()
