"""``check_hooks`` finds each kind of mistake in hooks on arrays, and lets sound hooks pass."""

import gymnasium as gym
import numpy as np
import pytest
from contract_cases import writing
from vector_tools import Drawing, Historic, Reaching, Remembering, Shifted

import fmugym
from fmugym import ConfigError, ContractError, Uniform
from fmugym.environment.env_checker import check_hooks
from fmugym.environment.hooks import ORDER


def wide(*shape):
    return gym.spaces.Box(-np.inf, np.inf, shape, np.float64)


class Branching(Drawing):
    def _is_done(self):
        if abs(self.state[0]) > 0.5:
            return True
        return self.state[1] > 1.0


class FarLimit(Drawing):
    """No episode reaches the limit."""

    def _is_done(self):
        return np.any(self.state[0] > 40.0)


class NormOfArray(Drawing):
    def _reward_policy(self):
        return -np.linalg.norm(self.state)


class Mean(Drawing):
    def _get_observation(self):
        return np.array(self.state, np.float32) - np.mean(self.state)


class Transposed(Drawing):
    """It fits if there are as many environments as elements."""

    def _get_observation(self):
        return np.array(self.state, np.float32).T


class RowOfWrongShape(Drawing):
    def _reward_policy(self):
        return np.asarray(self.state)


class InputsOfOthers(Drawing):
    def _get_inputs(self):
        return self.action[..., ::-1] if np.ndim(self.action) > 1 else self.action


class BranchingInputs(Drawing):
    def _get_inputs(self):
        return self.action if self.action[0] > 0 else -self.action


class Counting(Drawing):
    """Remembers in attributes."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _update(self):
        self.seen.append(self.state[0])


class Summing(Drawing):
    def __init__(self):
        super().__init__()
        self.total = 0.0

    def _update(self):
        self.total = self.total + self.state[0]


class OwnGenerator(Drawing):
    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng(3)

    def _reward_policy(self):
        return self.state[0] + self.rng.normal(size=np.shape(self.state[0]))


class BranchingUpdate(Drawing):
    def __init__(self):
        super().__init__(episode_variables={"count": 0.0})

    def _update(self):
        if self.state[0] > 0.3:
            self.variables["count"] = self.variables["count"] + 1.0


class Aliasing(Drawing):
    """Keeps what a sum was, which changes with the sum on arrays."""

    def __init__(self):
        super().__init__(episode_variables={"sum": 0.0, "step": 0.0})

    def _update(self):
        before = self.variables["sum"]
        self.variables["sum"] += self.state[0]
        self.variables["step"] = self.variables["sum"] - before


class Mixing(Drawing):
    """The variable of one environment comes from another."""

    def __init__(self):
        super().__init__(episode_variables={"last": 0.0})

    def _update(self):
        self.variables["last"] = np.roll(self.state[0], 1)


class WritingElsewhere(Drawing):
    def __init__(self):
        super().__init__(episode_variables={"count": 0.0})

    def _is_truncated(self):
        self.variables["count"] = self.variables["count"] + 1.0
        return False


class BranchingTruncation(Drawing):
    def _is_truncated(self):
        return bool(self.state[0] > 0.8)


class BranchingInfo(Drawing):
    def _get_info(self):
        return {"fast": "yes" if self.state[1] > 0.1 else "no"}


class InfoOfAll(Drawing):
    def _get_info(self):
        return {"nested": {"highest": np.max(self.state[0])}}


class InPlace(Drawing):
    """Changes numbers of its own, but arrays of everyone's."""

    def _reward_policy(self):
        q, q_dot = self.state
        q *= 2.0
        return q + q_dot


class ActionInPlace(Drawing):
    def _get_inputs(self):
        self.action[0] *= 0.5
        return self.action[0]


class AtStarts(Drawing):
    """The observation of an episode that begins is another one."""

    def _get_observation_space(self):
        return wide(2)

    def _get_observation(self):
        factor = 0.0 if np.all(self.step_count == 0) else 1.0
        return np.array(self.state) * factor


class Goals(Reaching):
    """The reward of one goal for all environments."""

    def _goal_reward(self, achieved_goal, desired_goal):
        return -float(np.abs(achieved_goal - desired_goal).max())


class SeldomRaising(Drawing):
    """Fails where one environment is far out, which is a branch in disguise."""

    def _is_done(self):
        return {False: False, True: True}[np.bool_(np.all(self.state[0] < 900.0)).item()]


MISTAKES = {
    Branching: "_is_done fails on the arrays of .*ValueError",
    FarLimit: "_is_done gives .* at a limit",
    NormOfArray: "_reward_policy gives ",
    Mean: "_get_observation gives ",
    Transposed: "_get_observation (gives|fails) .*shape",
    RowOfWrongShape: r"_reward_policy fails on the arrays of 23 .*shape \(2, 23\)",
    InputsOfOthers: "_get_inputs gives ",
    BranchingInputs: "_get_inputs fails on the arrays of ",
    Counting: "_update changes self.seen",
    Summing: "_update changes self.total",
    OwnGenerator: "_reward_policy gives ",
    BranchingUpdate: "_update fails on the arrays of ",
    Aliasing: "_update gives ",
    Mixing: "_update gives ",
    WritingElsewhere: "_is_truncated changes self.variables",
    BranchingTruncation: "_is_truncated fails on the arrays of ",
    BranchingInfo: "_get_info fails on the arrays of ",
    InfoOfAll: "_get_info gives ",
    InPlace: "_reward_policy changes the arrays in self.state and self.out in place",
    ActionInPlace: "_get_inputs changes the arrays in self.action in place",
    AtStarts: "_get_observation gives .*just begun",
    Goals: "_reward_policy (gives|fails) ",
    SeldomRaising: "_is_done gives ",
}


@pytest.mark.parametrize("cls", MISTAKES, ids=lambda cls: cls.__name__)
def test_a_mistake_is_found(cls):
    with pytest.raises(ContractError, match=f"^{cls.__name__}: {MISTAKES[cls]}"):
        check_hooks(cls)


class Squeezed(Drawing):
    """Of one environment it takes the axis of the environments away."""

    def _get_observation(self):
        return np.squeeze(np.array(self.state, np.float32))


class TransposedForTwo(Drawing):
    """Has been made to fit the two environments that its author tried."""

    def _get_observation(self):
        seen = np.array(self.state, np.float32)
        return seen.T if seen.shape == (2, 2) else seen


@pytest.mark.parametrize(("cls", "count"), [(Squeezed, "1 environment:"), (TransposedForTwo, "2 ")])
def test_some_mistakes_are_those_of_one_number_of_environments(cls, count):
    with pytest.raises(ContractError, match=f"_get_observation .*on the arrays of {count}"):
        check_hooks(cls)


class Tables(Drawing):
    """Hooks of many kinds, some of which fail far from episodes."""

    def __init__(self):
        variables = {"target": Uniform(-1.0, 1.0), "past": [0.0, 0.0], "count": 0}
        super().__init__(episode_variables=variables)
        self.comfort = np.array([0.0, 1.0, 0.0])

    def _update(self):
        self.variables["past"] = np.stack([self.state[0], self.variables["past"][0]])
        self.variables["count"] = self.variables["count"] + 1

    def _is_done(self):
        return (np.abs(self.state[0]) > 0.9) | (self.variables["count"] > 30)

    def _reward_policy(self):
        near = np.clip(np.round(self.state[0]), -1, 1).astype(np.int64)
        return np.take(self.comfort, near + 1) - self.variables["past"][1] * self.action[0]

    def _get_info(self):
        return {"far": self.comfort[np.asarray(self.state[0] * 1e-2).astype(np.int64) % 3]}


class Stopping(Drawing):
    """Its table ends beyond the limit."""

    def _reward_policy(self):
        return np.take(np.zeros(300), np.asarray(100.0 + 50.0 * self.state[0]).astype(np.int64))


class Divides(Drawing):
    """An episode that has just begun has no mean yet."""

    def _reward_policy(self):
        return self.state[0] / self.step_count


SOUND = (Drawing, Remembering, Historic, Reaching, Shifted, Tables, Stopping, Divides)


@pytest.mark.parametrize("cls", SOUND, ids=lambda cls: cls.__name__)
def test_sound_hooks_pass(cls):
    check_hooks(cls)


@pytest.mark.parametrize("env_id", [one for one in gym.registry if one.startswith("fmugym/")])
def test_bundled_environments_pass(env_id):
    if env_id != "fmugym/FMU-v0":
        check_hooks(lambda: gym.make(env_id))


def test_hooks_of_a_task_pass():
    task = {
        "fmu": {"bundled": "Pendulum"},
        "time_step": 0.05,
        "variables": {"tau": {"min": -2, "max": 2}},
        "agent": {"actions": "tau", "observations": ["theta", "theta_dot"]},
        "reward": "-theta**2",
    }

    class Sound(fmugym.TaskEnv):
        def _get_info(self):
            return {"energy": self.state[1] ** 2}

    class Wrong(fmugym.TaskEnv):
        def _get_info(self):
            return {"energy": float(self.state[1])}

    check_hooks(fmugym.TaskEnv, config=task)
    check_hooks(Sound, config=task)
    with pytest.raises(ContractError, match="_get_info fails"):
        check_hooks(Wrong, config=task)


class OwnStep(Drawing):
    def step(self, action):
        return super().step(action)


class Parts(Drawing):
    def _get_action_space(self):
        return gym.spaces.Dict(torque=gym.spaces.Box(-1.0, 1.0, (1,)))

    def _get_inputs(self):
        return self.action["torque"]


def test_what_no_arrays_are_for_is_told():
    with pytest.raises(ConfigError, match=r"overrides step.*SyncVectorEnv\(\[OwnStep\] \* N\)"):
        check_hooks(OwnStep)
    with pytest.raises(ContractError, match=r"Parts: actions of Dict.* do not make one array"):
        check_hooks(Parts)


def test_other_environments_are_refused():
    with pytest.raises(ConfigError, match="expected an environment of fmugym, got CartPoleEnv"):
        check_hooks(lambda: gym.make("CartPole-v1"))
    with pytest.raises(ConfigError, match="expected a class or a function"):
        check_hooks("CartPole")


def test_arguments_go_to_the_class():
    check_hooks(fmugym.envs.PendulumEnv, g=9.81)


@pytest.mark.parametrize("hook", [one for one in ORDER if one not in ("_get_inputs", "_update")])
def test_no_other_hook_than_update_may_write_variables(hook):
    with pytest.raises(ContractError, match=f"{hook} changes self.variables"):
        check_hooks(writing(hook))
