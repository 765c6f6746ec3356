"""``vectorized``: what a class says of its hooks decides how a vector environment calls them."""

import gymnasium as gym
import numpy as np
import pytest
from vector_tools import Drawing, Reaching

import fmugym
from fmugym import ConfigError, FMUVectorEnv
from fmugym.cli.validation import validate

NOTHING = np.zeros((3, 1), np.float32)
SWING = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "variables": {"tau": {"min": -2, "max": 2}},
    "agent": {"actions": "tau", "observations": ["theta", "theta_dot"]},
    "reward": "-theta**2",
}


class Declared(Drawing):
    vectorized = True

    def _is_done(self):
        return self.state[0] > 0.8


class Inheriting(Declared):
    """Overrides no hook."""


class Overriding(Declared):
    def _reward_policy(self):
        return self.state[0]


class DefaultAgain(Overriding):
    """Takes the default back."""

    _reward_policy = fmugym.FMUEnv._reward_policy


class SayingItAgain(Declared):
    vectorized = True

    def _reward_policy(self):
        return self.state[0]


class Goals(Reaching):
    """One hook of its base class is not declared."""

    vectorized = True

    def _goal_reward(self, achieved_goal, desired_goal):
        return -1.0


class OwnTask(fmugym.TaskEnv):
    def _get_info(self):
        return {"energy": self.state[1] ** 2}


class DeclaredTask(OwnTask):
    vectorized = True

    def _get_info(self):
        return super()._get_info()


WAYS = [
    (Drawing, "one by one"),
    (Declared, "arrays"),
    (Inheriting, "arrays"),
    (Overriding, "one by one"),
    (DefaultAgain, "arrays"),
    (SayingItAgain, "arrays"),
    (Goals, "one by one"),
    (lambda: fmugym.load(SWING), "expressions"),
    (lambda: OwnTask(SWING), "one by one"),
    (lambda: DeclaredTask(SWING), "arrays"),
]


@pytest.mark.parametrize(("make", "way"), WAYS)
def test_it_holds_for_the_hooks_of_the_class_body_that_says_it(make, way, make_envs):
    envs = make_envs(make, 3)
    assert envs.task.way == way
    envs.reset(seed=1)
    envs.step(NOTHING)


@pytest.mark.parametrize(("make", "way"), [(Declared, "arrays"), (Overriding, "one by one")])
def test_nothing_is_called_at_construction(make, way, make_envs, monkeypatch):
    def refuse(self):
        raise AssertionError("a hook was called")

    monkeypatch.setattr(make, "_reward_policy", refuse, raising=False)
    assert make_envs(make, 3).task.way in (way, "one by one")


class Unsaid(Overriding):
    """Like its base class; no other test makes so many that the log tells of it."""


def test_from_16_environments_on_one_by_one_is_worth_a_warning(make_envs, caplog):
    make_envs(Unsaid, 15)
    make_envs(Declared, 16)
    assert caplog.text == ""
    for _ in range(2):
        make_envs(Unsaid, 16)
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    for word in ("Unsaid", "_reward_policy", "check_hooks", "vectorized = True", "'reward'"):
        assert word in record.getMessage()


class Parts(Declared):
    vectorized = True

    def _get_action_space(self):
        return gym.spaces.Tuple([gym.spaces.Discrete(2)])

    def _get_inputs(self):
        return 0.001 * self.action[0]


def test_spaces_that_make_no_arrays_are_called_one_by_one_with_a_reason(make_envs, caplog):
    envs = make_envs(Parts, 16)
    assert envs.task.way == "one by one"
    assert "actions of Tuple(Discrete(2)) do not make one array" in caplog.text


@pytest.mark.parametrize("method", ["step", "reset"])
def test_classes_with_a_step_or_reset_of_their_own_are_refused(method, temp_root):
    cls = type("Own", (Drawing,), {method: lambda self, *args, **options: None})
    with pytest.raises(ConfigError, match=rf"Own overrides {method}.*SyncVectorEnv\(\[Own\] \* N"):
        FMUVectorEnv(cls, 2)
    assert not list(temp_root.iterdir())


WRONG = {
    "_is_done": lambda self: bool(self.state[0] > 1.0),
    "_reward_policy": lambda self: np.array(self.state),
    "_get_observation": lambda self: np.array(self.state, np.float32).T,
    "_get_info": lambda self: {"rank": np.zeros(5)},
    "_get_inputs": lambda self: self.action if self.action[0] > 0 else -self.action,
}


@pytest.mark.parametrize("hook", WRONG)
def test_a_wrong_declaration_is_named_in_the_first_step(hook, make_envs):
    envs = make_envs(type("Wrong", (Declared,), {hook: WRONG[hook], "vectorized": True}), 3)

    def play():
        envs.reset(seed=1)
        envs.step(NOTHING)

    with pytest.raises(ConfigError, match=rf"{hook} .*vectorized.*check_hooks"):
        play()


def test_later_exceptions_are_the_users_own(make_envs):
    class Late(Declared):
        vectorized = True

        def _reward_policy(self):
            if np.any(self.step_count > 1):
                raise ZeroDivisionError("mine")
            return 0.0

    envs = make_envs(Late, 3)
    envs.reset(seed=1)
    envs.step(NOTHING)
    with pytest.raises(ZeroDivisionError, match="mine"):
        envs.step(NOTHING)


class Untrue(Declared):
    vectorized = True

    def _reward_policy(self):
        return -np.linalg.norm(self.state)


class Sound(Drawing):
    """Says nothing of its hooks."""


VERDICTS = [
    (Declared, "ok", "they give on arrays what they give one by one"),
    (Sound, "warning", "_is_done works on arrays, but its class does not say so"),
    (Untrue, "error", "_reward_policy gives"),
    (type("Quiet", (Untrue,), {"_is_done": Drawing._is_done}), "warning", "one by one: _reward"),
]


@pytest.mark.parametrize(("cls", "verdict", "text"), VERDICTS)
def test_validate_tells(cls, verdict, text):
    (found,) = [one for one in validate(cls).findings if one.check == "hooks"]
    assert found.verdict == verdict
    assert text in found.text


def test_validate_says_nothing_of_expressions():
    assert not [
        one for one in validate(lambda: fmugym.load(SWING)).findings if one.check == "hooks"
    ]
