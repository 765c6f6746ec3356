"""Environments on which ``test_contract.py`` holds the laws: each with one thing that is special.

A case tells how its environment is made, and in which ways a vector environment can call its hooks.
"""

import functools
import os
import tempfile
from collections.abc import Callable
from typing import Any, NamedTuple

import building
import fmu_tools
import numpy as np
from example_tools import EXAMPLES
from gymnasium import spaces
from vector_tools import (
    ABSURD,
    CART_POLE,
    Cart,
    Drawing,
    Historic,
    Pushed,
    PushedCart,
    Reaching,
    Remembering,
    Shifted,
)
from ways import ALL_WAYS, ARRAYS, EACH, WAYS

import fmugym
from fmugym import Choice, Normal, Uniform
from fmugym.environment.hooks import ORDER

ROUNDED = 1e-6
"""Numbers of Python adapt to a float32, of which arrays do not."""


class Case(NamedTuple):
    """An environment with something special.

    Attributes:
        make: Makes it.
        ways: In which a vector environment can call its hooks.
        rtol: How far results may differ between a single environment and many.
        draws: Whether its episodes begin with drawn values.
        can_save: Whether episodes keep all in their variables, so that they can be saved.
        has_one_action: Whether an action is one array, as rollouts take them.
        has_faults: Whether episodes end by faults.
        usual: An action without a fault, where one of the actions leads to a fault.
        disturbing: That one.
    """

    make: Callable[[], fmugym.FMUEnv]
    ways: tuple[str, ...] = WAYS
    rtol: float = 0.0
    draws: bool = True
    can_save: bool = True
    has_one_action: bool = True
    has_faults: bool = False
    usual: Any = None
    disturbing: Any = None


def wide(*shape, dtype=np.float32):
    """A space of any numbers."""
    return spaces.Box(-np.inf, np.inf, shape, dtype)


@functools.cache
def probe(version=2):
    """The probe FMU of a version of FMI."""
    return fmu_tools.probe_fmu(tempfile.mkdtemp(dir=os.environ[building.FOLDER]), version)


# Observations


class Imprecise(Drawing):
    """Observes a float64 where the space has a float32."""

    def _get_observation(self):
        return np.array(self.state)


class Square(Drawing):
    """Observes an array with two axes."""

    def _is_done(self):
        return self.state[0] > 0.5

    def _get_observation_space(self):
        return wide(2, 2, dtype=np.float64)

    def _get_observation(self):
        return np.array([[self.state[0], self.state[1]], [self.previous_state[0], self.time]])


class Deep(Drawing):
    """Observes an array with eight axes."""

    def _get_observation_space(self):
        return wide(*(1,) * 7, 2)

    def _get_observation(self):
        return np.array([[[[[[[[self.state[0], self.state[1]]]]]]]]], np.float32)


class Pictured(Drawing):
    """Observes a small picture."""

    def _get_observation_space(self):
        return spaces.Box(0, 255, (2, 3), np.uint8)

    def _get_observation(self):
        angle = np.clip(self.state[0] * 100 + 100, 0, 255)
        steps, one = self.step_count, np.ones_like(angle)
        return np.array([[angle, one, one], [steps, one, angle / 2]]).astype(np.uint8)


class Nested(Drawing):
    """Observes dicts in a dict, of several types, and has nested infos."""

    def _is_done(self):
        return self.state[0] > 0.5

    def _get_observation_space(self):
        inner = spaces.Dict({"state": wide(2), "time": spaces.Box(0, 99, (1,))})
        return spaces.Dict({"plant": inner, "steps": spaces.Box(0, 99, (1,), np.int64)})

    def _get_observation(self):
        state = np.array([self.state[0], self.state[1]], np.float32)
        plant = {"state": state, "time": np.array([self.time], np.float32)}
        return {"plant": plant, "steps": np.array([self.step_count])}

    def _get_info(self):
        return {"angle": self.state[0], "nested": {"speed": self.state[1]}}


class Pair(Drawing):
    """Observes a tuple, which makes no array."""

    def _get_observation_space(self):
        return spaces.Tuple([wide(2), spaces.Discrete(2)])

    def _get_observation(self):
        return np.array(self.state, np.float32), np.int64(self.state[0] > 0.2)


class OfOtherTypes(Drawing):
    """Observes lists, a float64, and a number for a Discrete."""

    def _get_observation_space(self):
        box, pair = wide(2), spaces.Tuple([wide(2)])
        return spaces.Dict({"list": box, "wide": box, "sign": spaces.Discrete(2), "pair": pair})

    def _get_observation(self):
        precise, sign = np.array(self.state), int(self.state[0] > 0)
        pair = (precise.astype(np.float32),)
        return {"list": list(self.state), "wide": precise, "sign": sign, "pair": pair}


class Goal(Pushed):
    """A goal task with a float32 and a reward of a norm."""

    def __init__(self):
        super().__init__(episode_variables={"goal": Uniform(-0.5, 0.5)})

    def _get_observation_space(self):
        names = ("observation", "achieved_goal", "desired_goal")
        return spaces.Dict(dict.fromkeys(names, wide(1)) | {"observation": wide(2)})

    def _get_observation(self):
        return {
            "observation": np.asarray(self.state),
            "achieved_goal": np.stack([self.state[0]]),
            "desired_goal": np.stack([self.variables["goal"]]),
        }

    def _goal_reward(self, achieved_goal, desired_goal):
        distance = np.linalg.norm(achieved_goal - desired_goal, axis=-1)
        return -(distance > 0.1).astype(np.float32)


OBSERVATIONS = {
    "start values are drawn": Case(Drawing),
    "hooks read all that they may": Case(
        functools.partial(Remembering, substeps=2, warm_up=0.04),
    ),
    "observations are of a wider type": Case(Imprecise),
    "observations have two axes": Case(Square),
    "observations have eight axes": Case(Deep),
    "observations are pictures": Case(Pictured),
    "observations are dicts in a dict": Case(Nested),
    "observations are tuples": Case(Pair, (EACH,)),
    "observations are of types that do not fit": Case(OfOtherTypes, (EACH,)),
    "goals": Case(Reaching),
    "goals of a float32": Case(Goal, rtol=ROUNDED),
}


# Actions and inputs

ACTION_SPACES = {
    "float64": spaces.Box(-1.0, 1.0, (2, 3), np.float64),
    "float32": spaces.Box(-1.0, 1.0, (2,), np.float32),
    "int64": spaces.Box(-5, 5, (2,), np.int64),
    "discrete": spaces.Discrete(4, start=-1),
    "multi": spaces.MultiDiscrete([3, 5]),
    "binary": spaces.MultiBinary(3),
    "float16": spaces.Box(-1.0, 1.0, (2,), np.float16),
    "int32": spaces.Box(-5, 5, (2,), np.int32),
    "uint8": spaces.Box(0, 255, (2,), np.uint8),
    "int16": spaces.Box(-5, 5, (2,), np.int16),
}


class Acting(Drawing):
    """Acts on and observes actions of a space."""

    def __init__(self, space):
        self.space = space
        super().__init__()

    def _get_action_space(self):
        return self.space

    def _get_inputs(self):
        return [0.001 * np.sum(np.reshape(self.action, (-1, *np.shape(self.state[0]))), axis=0)]

    def _get_observation_space(self):
        return wide(3, dtype=np.float64)

    def _get_observation(self):
        flat = np.reshape(self.action, (-1, *np.shape(self.state[0])))
        before = np.reshape(self.previous_action, (-1, *np.shape(self.state[0])))
        return np.array([0.25 * flat[0], 0.5 * before[-1], self.inputs[0]])


class ActionsInParts(Drawing):
    """Has a dict of actions, and before the first one zeros."""

    def _get_action_space(self):
        torque = spaces.Box(-1.0, 1.0, (2,), np.float32)
        return spaces.Dict(torque=torque, gear=spaces.Tuple([spaces.Discrete(3)]))

    def _get_inputs(self):
        return 0.01 * self.action["torque"][0] * self.action["gear"][0]

    def _reward_policy(self):
        return self.previous_action["gear"][0] - self.previous_action["torque"][1]


class Typed(fmu_tools.PlainEnv):
    """Has inputs and outputs of some types."""

    def __init__(self, **config):
        defaults = {"max_episode_steps": 4, "episode_variables": {"x": Uniform(0, 1)}}
        super().__init__(probe(), fmu_tools.probe_config(**defaults | config))

    def _get_info(self):
        return {"inputs": np.array(self.inputs), "x": self.variables["x"]}


TYPES = {
    "reals": {"model_input_names": ["c", "a", "b"], "model_output_names": ["mix", "sum"]},
    "several types": {
        "model_input_names": ["a", "n", "on"],
        "model_output_names": ["n_out", "on_out", "sum"],
    },
    "integers": {"model_input_names": "n", "model_output_names": ["n_out", "steps"]},
    "an enumeration": {"model_input_names": "mode", "model_output_names": ["mode_out", "mix"]},
    "a Boolean": {"model_input_names": "on", "model_output_names": "on_out"},
    "a tunable": {"model_input_names": ["on", "trim"], "model_output_names": ["on_out", "mix"]},
    "one with a start value": {
        "model_parameters": {"a": 0.5, "trim": Uniform(0, 1)},
        "monitor_names": "steps",
    },
}


class TwoTorques(fmugym.FMUEnv):
    """Writes the inputs of all environments to one array, and returns what ``form`` makes of it."""

    array = np.zeros(2)

    def __init__(self, form=None):
        config = {
            "model_input_names": ["tau1", "tau2"],
            "model_output_names": ["q1", "q2"],
            "model_parameters": {"q1_0": Uniform(-1.0, 1.0)},
            "time_step": 0.02,
            "max_episode_steps": 7,
        }
        super().__init__(fmugym.bundled_fmu("DoublePendulum"), config)
        self.form = form

    def _get_action_space(self):
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _get_inputs(self):
        self.array[:] = self.action
        self.array *= 0.1
        return self.array if self.form is None else self.form(self.array)

    def _is_done(self):
        return False

    def _get_info(self):
        return {"first": self.inputs[0], "steps": self.step_count}


def as_column(values):
    """Inputs with an axis too many."""
    return values[:, None]


FORMS = {
    "one array": None,
    "arrays of a float32": np.float32,
    "lists": list,
    "tuples": tuple,
    "arrays of a long type": np.longdouble,
    "columns": as_column,
}


class Tables(Pushed):
    """Looks values up, and has infos."""

    space = spaces.MultiDiscrete([3, 4])
    angles, comfort = np.array([-0.5, 0.0, 0.5]), np.array([0.0, 1.0, 0.0])

    def __init__(self):
        super().__init__()
        self.levels = np.array([-0.5, 0.0, 0.25])

    def _get_inputs(self):
        level = self.levels[self.action[0]] + np.take([0.1, 0.2, 0.3, 0.4], self.action[1] - 4)
        return [0.01 * level]

    def _reward_policy(self):
        q, q_dot = self.state
        comfort = np.interp(q, self.angles, self.comfort, left=-1.0)
        band = np.select([q_dot > 0.3, q_dot < -0.3], [q_dot - 0.3, -0.3 - q_dot], 0.0)
        return comfort - np.clip(band, None, 1.0)

    def _get_info(self):
        return {"angle": self.state[0], "nested": {"level": self.action[0]}, "kind": 3}


ACTIONS = {
    **{
        f"actions are {name}": Case(functools.partial(Acting, space))
        for name, space in ACTION_SPACES.items()
    },
    "actions begin at -1": Case(Shifted),
    "actions are in parts": Case(ActionsInParts, (EACH,), has_one_action=False),
    "actions choose from tables": Case(Tables, rtol=ROUNDED),
    **{
        f"inputs are {name}": Case(
            functools.partial(Typed, **config), (EACH,) if name == "a Boolean" else (ARRAYS, EACH)
        )
        for name, config in TYPES.items()
    },
    **{
        f"inputs are {name} of all": Case(
            functools.partial(TwoTorques, form), (EACH,), can_save=False
        )
        for name, form in FORMS.items()
    },
}


# Variables of an episode


class Summing(Drawing):
    """Adds to variables in place, as one writes sums in Python."""

    def __init__(self, **changes):
        variables = {"sum": 0.0, "left": Uniform(0.0, 1.0), "count": 0}
        super().__init__(episode_variables=variables, monitor_names=["theta_ddot"], **changes)

    def _update(self):
        self.variables["sum"] += self.state[0]
        self.variables["left"] -= 0.1 * self.state[1]
        self.variables["count"] += 1

    def _reward_policy(self):
        return self.variables["sum"] + self.variables["left"] * self.variables["count"]

    def _get_observation_space(self):
        return wide(5, dtype=np.float64)

    def _get_observation(self):
        moved = self.state[0] - self.previous_state[0]
        own = self.variables["left"], self.variables["sum"], self.variables["count"]
        return np.array([*own, moved, self.action[0] - self.previous_action[0]])


class Swapping(Drawing):
    """Assigns arrays that the environment keeps itself, and parts of them."""

    def __init__(self):
        super().__init__(episode_variables={"one": 0.5, "other": 0.0, "pair": [1.0, 2.0]})

    def _update(self):
        one, other, pair = self.variables["one"], self.variables["other"], self.variables["pair"]
        self.variables["one"], self.variables["other"] = other, one
        self.variables["pair"] = np.stack([pair[1] + self.state[0], one + 0.0 * pair[0]])

    def _reward_policy(self):
        pair = self.variables["pair"]
        return self.variables["one"] + 10 * self.variables["other"] + 100 * pair[0] - pair[1]


class Changing(Drawing):
    """Assigns types that cannot hold all values that episodes start with."""

    def __init__(self):
        starts = {"level": 0.5, "drawn": Uniform(-1.0, 1.0), "last": 0.1, "past": [0.1, 2.0]}
        super().__init__(episode_variables=starts | {"on": 1.0, "mode": 3.0})

    def _update(self):
        high = self.state[0] > 0.0
        self.variables["level"] = np.where(high, 1, 2)
        self.variables["drawn"] = np.where(high, 1, 2)
        self.variables["last"] = np.float32(0.5) * self.action[0]
        self.variables["past"] = np.stack([self.action[0], self.action[0]])
        self.variables["on"] = high
        self.variables["mode"] = np.where(high, 4, 5)

    def _get_observation_space(self):
        return wide(7, dtype=np.float64)

    def _get_observation(self):
        level, drawn, last, past, on, mode = self.variables.values()
        parts = [level, drawn, last, past[0], past[1], on, mode]
        return np.stack([0.0 * self.state[0] + part for part in parts])


class Queueing(Drawing):
    """Delays discrete actions, and looks up pulses with what the delay holds."""

    pulses = np.array([[0, 0, 0, 1], [0, 0, 1, 1], [0, 1, 1, 1], [1, 1, 1, 1]])

    def __init__(self):
        super().__init__(episode_variables={"queue": [0, 0, 0], "bits": 0, "mode": 1.0})

    def _get_action_space(self):
        return spaces.MultiDiscrete([4, 2])

    def _get_inputs(self):
        level = self.pulses[self.variables["queue"][-1].astype(np.int64), self.step_count % 4]
        return 0.01 * level * (1 - 2 * self.action[1])

    def _update(self):
        newest = np.stack([self.action[0]])
        self.variables["queue"] = np.concatenate([newest, self.variables["queue"][:-1]])
        self.variables["bits"] = self.action[0] * (self.step_count % 3) + 2 * self.step_count
        self.variables["mode"] = np.where(self.state[0] > 0.0, 1.5, self.variables["mode"])

    def _reward_policy(self):
        whole, rest = divmod(self.step_count, 3)
        return np.sum(self.variables["queue"], axis=0) - self.variables["bits"] + whole / (1 + rest)


class Tracking(Pushed):
    """Follows a target that is drawn, and observes the integral of the error."""

    def __init__(self):
        super().__init__(episode_variables={"target": Uniform(-0.5, 0.5), "integral": 0.0})

    def _update(self):
        error = self.variables["target"] - self.state[0]
        self.variables["integral"] = 0.99 * self.variables["integral"] + 0.02 * error

    def _is_done(self):
        return np.abs(self.variables["integral"]) > 0.03

    def _reward_policy(self):
        error = self.variables["target"] - self.state[0]
        effort = np.sum(np.square(self.action), axis=0)
        change = np.linalg.norm(np.asarray(self.state) - np.asarray(self.previous_state), axis=0)
        return -(error**2) - 0.1 * effort - change

    def _get_observation_space(self):
        return wide(5)

    def _get_observation(self):
        q, q_dot = self.state
        names = self.variables["target"], self.variables["integral"]
        return np.array([np.sin(q), np.cos(q), q_dot, *names], np.float32)


class Delayed(Pushed):
    """Acts on a history of actions, observes one of angles, and counts."""

    def __init__(self):
        history = np.zeros((3, 2))
        super().__init__(
            episode_variables={"queue": [0.1, 0.2, 0.3], "seen": history, "count": 0, "near": 0}
        )

    def _get_inputs(self):
        return [0.01 * self.variables["queue"][0]]

    def _update(self):
        queue, seen = self.variables["queue"], self.variables["seen"]
        newest = np.stack([1.0 * self.action[0]])
        self.variables["queue"] = np.concatenate([queue[1:], newest])
        self.variables["seen"] = np.concatenate([seen[1:], np.asarray(self.state)[None]])
        self.variables["near"] = np.abs(self.state[0]) < 0.1
        self.variables["count"] = self.variables["count"] + self.variables["near"]

    def _is_truncated(self):
        return self.variables["count"] > 3

    def _get_observation_space(self):
        return spaces.Dict({"angles": wide(3, 2, dtype=np.float64), "queue": wide(3)})

    def _get_observation(self):
        return {"angles": self.variables["seen"], "queue": self.variables["queue"]}


class OwnUniform(Uniform):
    """Only Python can draw from it."""


ELEMENTS = {
    "target": [Uniform(-1, 1), Uniform(0, 2), 0.5],
    "gain": Uniform(3.0, 4.0),
    "offset": 1.5,
    "grid": [
        [1.0, Choice([1, 2, 3])],
        [Normal(0.0, 1.0), {"distribution": "uniform", "low": 0, "high": 1}],
    ],
    "old": [0.0, 0.0],
}


class Targets(Drawing):
    """Reads arrays of which some elements are drawn, and writes one of them."""

    def __init__(self, variables=ELEMENTS, **changes):
        super().__init__(episode_variables=variables, **changes)

    def _update(self):
        self.variables["grid"] = 0.5 * self.variables["grid"]
        self.variables["old"] = np.array([self.state[0], self.variables["old"][0]])

    def _reward_policy(self):
        target, grid = self.variables["target"], self.variables["grid"]
        return target[0] * self.state[0] + target[1] - grid[1, 0] + grid[0, 1] * target[2]

    def _get_info(self):
        return {"grid": self.variables["grid"], "gain": self.variables["gain"]}


def writing(hook):
    """A class whose hook writes a variable that the reward reads, which only ``_update`` may do."""

    class Writing(Drawing):
        def __init__(self):
            super().__init__(episode_variables={"n": 0.5})

        def _reward_policy(self):
            return 2.0 * self.variables["n"] - self.state[0]

    good = getattr(Writing, hook)

    def write(self):
        result = good(self)
        self.variables["n"] = 0.5 * self.variables["n"] + 1.0
        return result

    setattr(Writing, hook, write)
    return Writing


VARIABLES = {
    "sums are made in place": Case(Summing),
    "variables are swapped": Case(Swapping),
    "variables change their types": Case(Changing),
    "a variable is an index": Case(Queueing),
    "variables hold several numbers": Case(Historic),
    "a target is drawn": Case(Tracking, rtol=ROUNDED),
    "variables hold histories": Case(Delayed, rtol=ROUNDED),
    "elements are drawn": Case(Targets),
    "elements are drawn by Python alone": Case(
        functools.partial(Targets, {**ELEMENTS, "target": [OwnUniform(-1, 1), Uniform(0, 2), 0.5]}),
    ),
    **{
        f"{hook} writes a variable": Case(writing(hook), (EACH,), can_save=False)
        for hook in ORDER
        if hook != "_update"
    },
}


# Attributes and constructors


NARROW = {"x_threshold": 0.06}
"""A parameter with which episodes of the cart-pole are short."""


class Delegating(CART_POLE):
    """Keeps a bound method of its own in an attribute."""

    def __init__(self):
        super().__init__(model_parameters=NARROW)
        self.judge = self._lean

    def _lean(self):
        return 1.0 - abs(self.state[2])

    def _reward_policy(self):
        return self.judge()


class WithCost(Drawing):
    """Keeps a function in an attribute, made in the constructor."""

    def __init__(self):
        super().__init__()
        self.cost = lambda: self.state[0] * self.state[0]

    def _reward_policy(self):
        return -self.cost()


class Judge:
    """An object that refers to its environment."""

    def __init__(self, env):
        self.env = env

    def __call__(self):
        return -abs(self.env.state[0]) - abs(self.env.out["q_dot"])


class Judged(Drawing):
    """Keeps an object that refers to it in an attribute."""

    def __init__(self):
        super().__init__()
        self.judge = Judge(self)
        self.partial = functools.partial(abs, 1.0)

    def _reward_policy(self):
        return self.judge() + self.partial()


class LowPass:
    """A filter with a state."""

    __slots__ = ("value",)

    def __init__(self):
        self.value = 0.0

    def __call__(self, new):
        self.value += 0.1 * (new - self.value)
        return self.value


class Filtering(Drawing):
    """Keeps an object with a state in an attribute."""

    def __init__(self):
        super().__init__()
        self.low_pass = LowPass()

    def _reward_policy(self):
        return self.low_pass(self.state[0])


class WithHelper(Drawing):
    """Makes and uses other environments in the constructor, before and after its own."""

    def __init__(self):
        self.before = self.first_angle()
        super().__init__()
        self.helper = Drawing()
        self.after = self.first_angle()
        self.many = fmugym.FMUVectorEnv(Drawing, 2)
        self.several = self.many.reset(seed=5)[0][:, 0].tolist()

    def first_angle(self):
        """Play an episode of a helper."""
        with Drawing() as helper:
            helper.reset(seed=5)
            return helper.state[0]

    def _reward_policy(self):
        return self.state[0] + self.before - self.after + self.several[0]

    def close(self):
        super().close()
        if hasattr(self, "many"):
            self.helper.close()
            self.many.close()


class UsesItself(Drawing):
    """Begins an episode in the constructor."""

    def __init__(self):
        super().__init__()
        self.reset(seed=5)
        self.offset = self.state[0]

    def _reward_policy(self):
        return self.state[0] - self.offset


ATTRIBUTES = {
    "an attribute is a method": Case(Delegating),
    "an attribute is a function": Case(WithCost),
    "an attribute refers to its environment": Case(Judged),
    "an attribute has a state": Case(Filtering, (EACH,), can_save=False),
    "a constructor uses other environments": Case(WithHelper, can_save=False),
    "a constructor uses its environment": Case(UsesItself, can_save=False),
}


# Faults


class Faulty(PushedCart):
    """Ends by the task, by its length, and by faults of the FMU."""

    def __init__(self, on_fault="terminate"):
        super().__init__(max_episode_steps=6, on_fault=on_fault, fault_reward=-7.0)


class Broken(Faulty):
    """Observes and tells ``done``, also where the FMU fails."""

    def _is_done(self):
        return (self.step_count > 1) & (self.state[0] > 0.0)

    def _get_observation_space(self):
        return wide(2, dtype=np.float64)

    def _get_observation(self):
        return np.stack([self.state[0], 1.0 * self.done])

    def _get_info(self):
        return {"done": self.done}


class Doomed(Broken):
    """May end where it starts."""

    def _get_inputs(self):
        return self.action

    def _is_done(self):
        return self.state[0] > 0.2


class Unjudged(Faulty):
    """Has rewards that are no numbers at times, and tells ``done``."""

    def _get_inputs(self):
        return self.action

    def _reward_policy(self):
        return np.where(self.state[1] < -0.006, np.nan, 0.0)

    def _get_info(self):
        return {"done": self.done}


class FailingCart(fmugym.FMUEnv):
    """Has an FMU that fails where the push is absurd; hooks read what a fault takes back."""

    def __init__(self):
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot"],
            "model_parameters": {"x_0": Uniform(-0.5, 0.5)},
            "episode_variables": {"integral": 0.0},
            "time_step": 0.05,
            "max_episode_steps": 9,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), config)

    def _get_action_space(self):
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _get_inputs(self):
        return [np.where(self.action[0] > 0.8, ABSURD, np.float64(self.previous_action[1]))]

    def _update(self):
        self.variables["integral"] = self.variables["integral"] + self.state[0]

    def _is_done(self):
        return np.abs(self.state[0]) > 1.0

    def _get_observation_space(self):
        return wide(4)

    def _get_observation(self):
        before = self.previous_state[0], self.action[1]
        return np.array([self.state[0], self.variables["integral"], *before], np.float32)

    def _get_info(self):
        return {"integral": self.variables["integral"], "before": self.previous_state[0]}


class NotFinite(Drawing):
    """Has rewards and observations that are not finite in some steps."""

    def __init__(self, **changes):
        changes = {"fault_reward": -7.0, "episode_variables": {"sum": 0.0}} | changes
        super().__init__(max_episode_steps=12, **changes)

    def _update(self):
        self.variables["sum"] += self.state[0]

    def _reward_policy(self):
        q, q_dot = self.state
        wrong = np.where(self.step_count % 2 == 0, np.nan, -np.inf)
        return np.where(q_dot > 3.0, wrong, q)

    def _get_observation(self):
        q, q_dot = self.state
        return np.array([np.where(q_dot < -3.0, np.inf, q), q_dot], np.float32)

    def _get_info(self):
        return {"sum": self.variables["sum"], "count": self.step_count}


class Overflowing(Drawing):
    """Observes numbers that are too large for a float32 once the pendulum is fast."""

    def __init__(self):
        super().__init__(max_episode_steps=9)

    def _get_observation(self):
        q, q_dot = self.state
        return np.array([np.where(abs(q_dot) > 2.0, 1e300, q), q_dot])


class Large(fmu_tools.PlainEnv):
    """Has outputs that are too large for the default observation."""

    def __init__(self):
        config = {"model_input_names": "a", "model_output_names": "sum", "max_episode_steps": 5}
        super().__init__(probe(), fmu_tools.probe_config(**config, bounds={"a": (-1, 1)}))

    def _get_inputs(self):
        return np.float64(1e40) * self.action


class Breaking(Drawing):
    """Has an observation, in one of several forms, or a reward that breaks at an angle."""

    def __init__(self, form):
        self.form = form
        starts = {"q_0": Uniform(0.2, 1.0)}
        changes = {"episode_variables": {"sum": 0.0}, "max_episode_steps": 30}
        super().__init__(model_parameters=starts, **changes)

    def _get_observation_space(self):
        return spaces.Dict({"one": wide(2), "two": wide(2)}) if self.form == "dict" else wide(2)

    def _update(self):
        self.variables["sum"] += self.state[0]

    def _is_done(self):
        return self.state[0] < 0.1

    def _reward_policy(self):
        breaks = self.form == "reward" and self.state[0] < 0.1
        return np.float64(np.nan if breaks else self.variables["sum"])

    def _get_observation(self):
        q, q_dot = self.state
        seen = np.float32([q_dot, np.inf if q < 0.1 and self.form != "reward" else q])
        if self.form == "dict":
            return {"one": np.float32(self.state), "two": seen}
        return seen.tolist() if self.form == "list" else seen


class Stopping(fmu_tools.PlainEnv):
    """Has an FMU that fails, or asks for the end, in a step that is drawn."""

    def __init__(self, version, fault, **changes):
        starts = {"fault": fault, "fault_step": Choice([2, 3, 4, 6])}
        config = {"model_parameters": starts, "max_episode_steps": 5} | changes
        super().__init__(probe(version), fmu_tools.probe_config(**config))

    def _reward_policy(self):
        return np.where(self.done, -5.0, self.inputs[0])


ASKS_TO_STOP, FAILS = 6, 3
"""Values of the parameter ``fault`` of the probe."""

CUT_SHORT, ENDED = ({"on_fault": policy} for policy in ("truncate", "terminate"))
PUSHED = {"usual": np.array([0.5]), "disturbing": np.array([ABSURD])}
CHOSEN = {"usual": np.int64(0), "disturbing": np.int64(1)}
FAULTS = {
    "the FMU fails, and is cut short": Case(
        functools.partial(Cart, **CUT_SHORT), has_faults=True, **PUSHED
    ),
    "the FMU fails, which is an end": Case(
        functools.partial(Cart, **ENDED), has_faults=True, **PUSHED
    ),
    "the FMU fails at an action": Case(Faulty, has_faults=True, **CHOSEN),
    "the FMU fails at an action, and is cut short": Case(
        functools.partial(Faulty, "truncate"), has_faults=True, **CHOSEN
    ),
    "the FMU fails where done is observed": Case(Broken, has_faults=True, **CHOSEN),
    "the FMU fails where done is observed, and is cut short": Case(
        functools.partial(Broken, "truncate"), has_faults=True, **CHOSEN
    ),
    "the FMU fails where hooks look back": Case(
        FailingCart,
        has_faults=True,
        usual=np.float32([0.25, -0.5]),
        disturbing=np.float32([0.9, 0.5]),
    ),
    "the FMU fails in a drawn step": Case(functools.partial(Stopping, 2, FAILS), has_faults=True),
    "the FMU asks for the end": Case(functools.partial(Stopping, 2, ASKS_TO_STOP)),
    "the FMU of FMI 3.0 asks for the end": Case(functools.partial(Stopping, 3, ASKS_TO_STOP)),
    "episodes end where they start": Case(Doomed),
    "rewards are not finite": Case(Unjudged, has_faults=True),
    "rewards are not finite, and are cut short": Case(
        functools.partial(Unjudged, "truncate"), has_faults=True
    ),
    "numbers are not finite": Case(functools.partial(NotFinite, **CUT_SHORT), has_faults=True),
    "numbers are not finite, which is an end": Case(
        functools.partial(NotFinite, **ENDED), has_faults=True
    ),
    "observations overflow": Case(Overflowing, has_faults=True),
    "outputs overflow": Case(
        Large,
        has_faults=True,
        draws=False,
        usual=np.float32([1e-3]),
        disturbing=np.float32([1.0]),
    ),
    **{
        f"a number of {form} breaks": Case(
            functools.partial(Breaking, form), (EACH,), has_faults=True
        )
        for form in ("an array", "list", "dict", "reward")
    },
}


# Lengths, times and systems


class Sampled(fmugym.FMUEnv):
    """Has all that a config may ask of a step."""

    def __init__(self):
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "phi", "phi_dot"],
            "bounds": {"f": (-20, 20)},
            "time_step": 0.02,
            "substeps": 2,
            "warm_up": 0.1,
            "start_time": 3.0,
            "samplings": {"x": "mean"},
            "monitor_names": ["phi_ddot"],
            "max_episode_steps": 8,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), config)

    def _is_done(self):
        return np.abs(self.state[2]) > 0.2


class TwoPendulums(fmugym.FMUEnv):
    """Is a system."""

    def __init__(self):
        pendulum = fmugym.bundled_fmu("Pendulum")
        config = {
            "model_input_names": "a.tau",
            "model_output_names": ["a.theta", "b.theta"],
            "model_parameters": {"a.theta_0": Uniform(-0.1, 0.1), "b.theta_0": 0.3},
            "bounds": {"a.tau": (-0.1, 0.1)},
            "time_step": 0.02,
            "max_episode_steps": 9,
        }
        super().__init__(fmugym.FMUSystem({"a": pendulum, "b": pendulum}, []), config)

    def _is_done(self):
        return np.abs(self.state[0]) > 3.0


OTHERS = {
    "the cart-pole": Case(functools.partial(CART_POLE, model_parameters=NARROW), ALL_WAYS),
    "a step has substeps, means and a warm-up": Case(Sampled, draws=False),
    "the FMU is a system": Case(TwoPendulums),
}


# Expressions

UNIFORM = {"distribution": "uniform", "low": -1.0, "high": 1.0}
PENDULUM = {
    "fmu": str(fmugym.bundled_fmu("Pendulum")),
    "time_step": 0.02,
    "episode_length": 0.3,
    "variables": {"tau": {"min": -0.01, "max": 0.01}},
    "parameters": {"q_0": UNIFORM},
    "memory": {
        "target": {"start": UNIFORM},
        "count": {"start": 0, "update": "count + 1"},
        "total": {"start": 0.5, "update": "total / 2 + q"},
    },
    "terminated": "q > target and count > 5",
    "reward": "-abs(q - target) - 0.1 * total",
    "costs": {"effort": "abs(tau)"},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot", "total"]},
}
"""All that an expression may read and write."""

OUTPUTS = {"costs": {}, "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]}}
"""Changes by which the pool itself makes the observations."""

WITH_DONE = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "0.45s",
    "variables": {"angle": {"name": "q"}, "tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["angle", "q_dot"]},
    "parameters": {"q_0": UNIFORM},
    "reward": {"end": "10 * done", "near": "-abs(angle)"},
    "costs": {"last": "done"},
    "terminated": "abs(angle) > 0.9",
}
NOISY = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "0.45s",
    "start_time": {"distribution": "uniform", "low": 10, "high": 1000},
    "substeps": 3,
    "warm_up": "0.5s",
    "variables": {"tau": {"min": -0.1, "max": 0.1}, "q": {"noise": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
    "reward": {"now": "time", "since": "elapsed", "steps": "step"},
}
DRAWN_STARTS = {
    "model_input_names": "tau",
    "model_output_names": ["theta", "theta_dot"],
    "model_parameters": {"theta_0": Uniform(-3.0, 3.0)},
    "start_time": Uniform(0.0, 1.0),
    "stop_time": 2.0,
    "bounds": {"tau": (-2, 2)},
    "time_step": 0.1,
    "terminated": False,
    "reward": "time",
}


def task(of, **changes):
    """Make the environments of a task."""
    return functools.partial(fmugym.load, of | changes if isinstance(of, dict) else of)


EXPRESSED = {
    "the cart-pole of a file": Case(task(EXAMPLES / "cart_pole.toml"), ALL_WAYS),
    "the pendulum of a file": Case(
        task({"extends": str(EXAMPLES / "pendulum.toml"), "episode_length": "0.5s"}),
        ALL_WAYS,
        ROUNDED,
    ),
    "a task has memory": Case(task(PENDULUM), ALL_WAYS, ROUNDED),
    "a task observes outputs": Case(task(PENDULUM, **OUTPUTS), ALL_WAYS, ROUNDED),
    "a task pays for its end": Case(task(WITH_DONE), ALL_WAYS, ROUNDED),
    "a task has noise and begins at a drawn time": Case(task(NOISY), ALL_WAYS, ROUNDED),
    "a task has rewards that are not finite": Case(
        task(PENDULUM, reward="sqrt(0.3 - abs(q - 0.1))"), ALL_WAYS, ROUNDED, has_faults=True
    ),
    "a class has expressions and ends at a time": Case(
        functools.partial(fmugym.FMI2CSEnv, fmugym.bundled_fmu("Pendulum"), DRAWN_STARTS),
        ALL_WAYS,
        ROUNDED,
    ),
}

CASES = OBSERVATIONS | ACTIONS | VARIABLES | ATTRIBUTES | FAULTS | OTHERS | EXPRESSED
