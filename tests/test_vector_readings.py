"""What methods, attributes and snapshots tell of the last step, in every engine and mode.

No hook of these environments reads the actions or the state before a step. So compiled steps have
no use for them, but the caller may ask for them at any time. The reference are single environments
in Python.
"""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from vector_tools import CART_POLE, Drawing, each_mode, each_way

from fmugym.vector import FMUVectorEnv

COUNT, STEPS = 3, 5
NAMES = (
    *("action", "previous_action", "state", "previous_state"),
    *("inputs", "step_count", "done", "time"),
)


class Told(Drawing):
    """Methods that read what no hook reads. Episodes end after some steps, one by its hook."""

    def __init__(self, hooks="auto"):
        super().__init__()
        self._way = hooks

    def _is_done(self):
        return abs(self.state[0]) > 0.55

    def told(self):
        return {name: getattr(self, name) for name in NAMES}


def singles():
    envs = [Told("python") for _ in range(COUNT)]
    for index, env in enumerate(envs):
        env.reset(seed=index)
    return envs


def advance(envs, ended, actions, mode):
    """A step of single environments as vector environments do it; returns which have ended."""
    for index, env in enumerate(envs):
        if ended[index]:
            env.reset()
            ended[index] = False
            if mode is AutoresetMode.NEXT_STEP:
                continue
        *_, terminated, truncated, _ = env.step(actions[index])
        ended[index] = terminated or truncated
        if ended[index] and mode is AutoresetMode.SAME_STEP:
            env.reset()
            ended[index] = False


def plain(value):
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    return np.asarray(value).tolist()


ASKED = {
    "call": lambda envs: envs.call("told"),
    "attributes": lambda envs: [
        dict(zip(NAMES, values, strict=True))
        for values in zip(*(envs.get_attr(name) for name in NAMES), strict=True)
    ],
    "method_taken_before": lambda envs: [told() for told in envs.get_attr("told")],
}


@each_mode
@each_way
@pytest.mark.parametrize("way", ASKED)
@pytest.mark.parametrize("first", [1, 3])
def test_the_last_step_is_told_from_the_first_question_on(first, way, hooks, mode):
    envs = FMUVectorEnv(Told, COUNT, hooks=hooks, autoreset_mode=mode)
    alone, ended = singles(), [False] * COUNT
    envs.reset(seed=0)
    rng = np.random.default_rng(7)
    for count in range(STEPS + 1):
        if count >= first:
            expected = [plain(env.told()) for env in alone]
            assert [plain(told) for told in ASKED[way](envs)] == expected, count
        actions = rng.uniform(-0.01, 0.01, (COUNT, 1)).astype(np.float32)
        if mode is AutoresetMode.DISABLED and any(ended):
            envs.reset(options={"reset_mask": np.array(ended)})
        advance(alone, ended, actions, mode)
        envs.step(actions)
    for env in (envs, *alone):
        env.close()


@each_mode
@pytest.mark.parametrize("hooks", ["array", "per_env", "auto"])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_snapshots_hold_the_last_step(count, hooks, mode):
    envs = FMUVectorEnv(Told, COUNT, hooks=hooks, autoreset_mode=mode)
    alone, ended = singles(), [False] * COUNT
    envs.reset(seed=0)
    rng = np.random.default_rng(7)
    for _ in range(count):
        actions = rng.uniform(-0.01, 0.01, (COUNT, 1)).astype(np.float32)
        advance(alone, ended, actions, mode)
        envs.step(actions)
    for index, env in enumerate(alone):
        other = Told("python")
        other.restore_state(envs.save_state(index))
        assert plain(other.told()) == plain(env.told())
        other.close()
    for env in (envs, *alone):
        env.close()


@each_way
def test_pictures_show_the_last_step(hooks):
    """The caption of this environment tells the action and the state before."""
    seen = []

    class Pictured(Told):
        metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (Gymnasium's own form)

        def __init__(self):
            super().__init__()
            self.render_mode = "rgb_array"

        def render(self):
            seen.append(self.told())

    envs = FMUVectorEnv(Pictured, COUNT, hooks=hooks)
    alone, ended = singles(), [False] * COUNT
    envs.reset(seed=0)
    actions = np.full((COUNT, 1), 0.003, np.float32)
    advance(alone, ended, actions, AutoresetMode.NEXT_STEP)
    envs.step(actions)
    envs.render()
    assert [plain(told) for told in seen] == [plain(env.told()) for env in alone]
    for env in (envs, *alone):
        env.close()


@each_way
def test_values_set_by_methods_of_the_last_step(hooks):
    """What a method assigns from the last step's values takes effect."""

    class Bounded(Told):
        bound = 10.0

        def learn(self):
            self.bound = abs(float(self.action[0])) + abs(self.previous_state[0])

        def _reward_policy(self):
            return self.bound * self.state[1]

    envs = FMUVectorEnv(Bounded, COUNT, hooks=hooks)
    alone = [Bounded("python") for _ in range(COUNT)]
    envs.reset(seed=0)
    actions = np.full((COUNT, 1), 0.003, np.float32)
    rewards = []
    for index, env in enumerate(alone):
        env.reset(seed=index)
        env.step(actions[index])
        env.learn()
        rewards.append(env.step(actions[index])[1])
        env.close()
    envs.step(actions)
    envs.call("learn")
    np.testing.assert_array_equal(envs.step(actions)[1], rewards)
    envs.close()


@each_way
def test_integers_of_a_registered_environment(hooks):
    envs = FMUVectorEnv(CART_POLE, 2, hooks=hooks)
    alone = [gym.make("fmugym/CartPole-v0", hooks="python").unwrapped for _ in range(2)]
    envs.reset(seed=0)
    for index, env in enumerate(alone):
        env.reset(seed=index)
    for actions in np.array([[0, 1], [1, 1], [1, 0]]):
        envs.step(actions)
        for env, action in zip(alone, actions, strict=True):
            env.step(action)
    for name in NAMES:
        assert plain(envs.get_attr(name)) == [plain(getattr(env, name)) for env in alone], name
    for env in (envs, *alone):
        env.close()


@each_way
def test_a_recorded_series_tells_the_state_before(hooks):
    envs = FMUVectorEnv(Told, COUNT, hooks=hooks)
    envs.reset(seed=0)
    actions = np.full((COUNT, 1), 0.003, np.float32)
    envs.step(actions)

    def function(env):
        return [env.previous_state[0], env.previous_action[0]]

    told = envs.inside.engine.evaluate(function, actions, np.arange(COUNT))
    alone, ended = singles(), [False] * COUNT
    advance(alone, ended, actions, AutoresetMode.NEXT_STEP)
    expected = [[env.previous_state[0], env.previous_action[0]] for env in alone]
    np.testing.assert_array_equal(told.T, np.array(expected, np.float64))
    for env in (envs, *alone):
        env.close()


def test_before_the_first_reset():
    """There is no last step: the values are those of a new environment."""
    envs = FMUVectorEnv(Told, 2)
    assert plain(envs.get_attr("step_count")) == [0, 0]
    assert plain(envs.get_attr("previous_action")) == [[0.0], [0.0]]
    envs.close()
