"""What methods, attributes and snapshots tell of the last step, in every engine and mode.

No hook of these environments reads the actions or the state before a step. So compiled steps have
no use for them, but the caller may ask for them at any time. The reference are single environments
in Python.
"""

from functools import partial
from itertools import islice

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_tools import (
    CART_POLE,
    Drawing,
    each_way,
    in_each_mode,
    results_of_both,
    sampled_actions,
)

from fmugym.vector import FMUVectorEnv

COUNT, STEPS = 3, 6
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


def pair(hooks, mode=AutoresetMode.NEXT_STEP, cls=Told):
    """A vector environment, and single environments in Python."""
    ours = FMUVectorEnv(cls, COUNT, hooks=hooks, autoreset_mode=mode)
    return ours, SyncVectorEnv([partial(cls, "python")] * COUNT, autoreset_mode=mode)


def close(envs):
    for one in envs:
        one.close()


def plain(value):
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    return list(map(plain, value)) if isinstance(value, tuple) else np.asarray(value).tolist()


ASKED = {
    "call": lambda envs: envs.call("told"),
    "attributes": lambda envs: tuple(
        dict(zip(NAMES, values, strict=True))
        for values in zip(*(envs.get_attr(name) for name in NAMES), strict=True)
    ),
    "method_taken_before": lambda envs: tuple(told() for told in envs.get_attr("told")),
}


@in_each_mode({"way": list(ASKED), "first": [1, 3]})
def test_the_last_step_is_told_from_the_first_question_on(first, way, hooks, mode):
    envs = ours, theirs = pair(hooks, mode)
    for count, _ in enumerate(results_of_both(*envs, STEPS, seed=0), 1):
        if count >= first:
            assert plain(ASKED[way](ours)) == plain(theirs.call("told")), count
    close(envs)


@in_each_mode({"count": [1, 2, 3]})
def test_snapshots_hold_the_last_step(count, hooks, mode):
    envs = ours, theirs = pair(hooks, mode)
    list(islice(results_of_both(*envs, STEPS, seed=0), count))
    for index, told in enumerate(theirs.call("told")):
        with Told("python") as other:
            other.restore_state(ours.save_state(index))
            assert plain(other.told()) == plain(told)
    close(envs)


@each_way
def test_pictures_show_the_last_step(hooks):
    """The caption of this environment tells the action and the state before."""
    seen = []

    class Pictured(Told):
        metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (Gymnasium's own form)

        def __init__(self, hooks="auto"):
            super().__init__(hooks)
            self.render_mode = "rgb_array"

        def render(self):
            seen.append(self.told())

    envs = ours, theirs = pair(hooks, cls=Pictured)
    list(results_of_both(*envs, 1))
    ours.render()
    assert plain(tuple(seen)) == plain(theirs.call("told"))
    close(envs)


@each_way
def test_values_set_by_methods_of_the_last_step(hooks):
    """What a method assigns from the last step's values takes effect."""

    class Bounded(Told):
        bound = 10.0

        def learn(self):
            self.bound = abs(float(self.action[0])) + abs(self.previous_state[0])

        def _reward_policy(self):
            return self.bound * self.state[1]

    both = pair(hooks, cls=Bounded)
    for count, _ in enumerate(results_of_both(*both, 2)):
        for envs in both if count == 0 else ():
            envs.call("learn")
    close(both)


@each_way
def test_integers_of_a_registered_environment(hooks):
    ours = FMUVectorEnv(CART_POLE, 2, hooks=hooks)
    theirs = SyncVectorEnv([lambda: gym.make("fmugym/CartPole-v0", hooks="python")] * 2)
    list(results_of_both(ours, theirs, list(np.array([[0, 1], [1, 1], [1, 0]]))))
    for name in NAMES:
        assert plain(ours.get_attr(name)) == plain(theirs.get_attr(name)), name
    close((ours, theirs))


@each_way
def test_a_recorded_series_tells_the_state_before(hooks):
    envs = ours, theirs = pair(hooks)
    actions = sampled_actions(ours, 1)
    list(results_of_both(*envs, actions))
    told = ours.inside.engine.evaluate(
        lambda env: [env.previous_state[0], env.previous_action[0]], *actions, np.arange(COUNT)
    )
    for row, one in zip(told.T, theirs.call("told"), strict=True):
        assert row.tolist() == [one["previous_state"][0], one["previous_action"][0]]
    close(envs)


def test_before_the_first_reset(make_envs):
    """There is no last step: the values are those of a new environment."""
    envs = make_envs(Told, 2)
    assert plain(envs.get_attr("step_count")) == [0, 0]
    assert plain(envs.get_attr("previous_action")) == [[0.0], [0.0]]
