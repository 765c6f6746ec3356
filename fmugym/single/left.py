"""The hooks of a single environment that are not compiled: Python calls them in compiled steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from typing import Any, Final

from fmugym.env import FMUEnv
from fmugym.single.purity import names_of
from fmugym.task.results import as_flag, as_reward
from fmugym.vector.hooks.program import UntraceableError

__all__ = ["HooksLeft", "require_few"]

_NEEDED: Final = {"out": "_values", "time": "step_count"}
"""The readings that others are made of."""

_OF_ACTIONS: Final = {"action", "previous_action", "state", "previous_state"}
"""The readings that change before ``_get_inputs`` is called."""

_COSTS: Final = {"_get_inputs": 2}
"""What a hook costs that is not compiled; 1 for the others. It may read before the FMU steps."""

_MOST: Final = 2
"""With greater costs together, a step takes no less time than in Python."""

Readers = Mapping[str, Callable[[], Any]]


class HooksLeft:
    """Calls the hooks that are not compiled, in their order.

    The environment has what these hooks refer to as attributes while they run, because that takes
    less time than to make it when it is read.

    Args:
        env: The environment.
        hooks: The names of the hooks.
        late: The functions that make the readings which the pool keeps, by name.

    Raises:
        UntraceableError: If one of them assigns an attribute.
    """

    def __init__(self, env: FMUEnv, hooks: Iterable[str], late: Readers) -> None:
        after = [hook for hook in hooks if hook != "_get_inputs"]
        self.makes_inputs = "_get_inputs" in hooks
        self._truncates = "_is_truncated" in after
        self._observes = "_get_observation" in after
        self._rewards = "_reward_policy" in after
        is_default = self._rewards and not env._own.reward_policy
        called = ("_goal_reward", "_get_observation") if is_default else ()
        makers = ["_get_inputs"] if self.makes_inputs else []
        self._for_inputs = _late_ones(names_of(env, makers) | _OF_ACTIONS, late)
        self._for_others = _late_ones(names_of(env, [*after, *called]), late)

    def inputs(self, env: FMUEnv, action: Any) -> tuple[float, ...]:
        """Ask ``_get_inputs`` for the inputs of an action that was not taken yet.

        Raises:
            Exception: What the hook raises, or ``ConfigError`` if the inputs cannot be used.
        """
        attributes, names = vars(env), self._for_inputs
        before = {name: attributes[name] for name, _ in names if name in attributes}
        env._in_hooks = env._tells = True
        try:
            for name, read in names:
                if name not in before:
                    attributes[name] = read()
            env.previous_action, env.previous_state, env.action = env.action, env.state, action
            return env._input_writer.checked(env._get_inputs(), action)
        finally:
            env._in_hooks = env._tells = False
            for name, _ in names:
                attributes.pop(name, None)
            attributes.update(before)

    def complete(self, env: FMUEnv, result: tuple[Any, ...]) -> tuple[Any, ...] | bool:
        """Ask the other hooks for what is missing in the result of a step.

        Returns:
            The result; False if a number is not finite.

        Raises:
            Exception: What a hook raises, or ``ConfigError`` if what it returns cannot be used.
        """
        attributes, names = vars(env), self._for_others
        observation, reward, terminated, truncated, info = result
        env._in_hooks = env._tells = True
        try:
            for name, read in names:
                attributes[name] = read()
            if self._truncates:
                truncated = as_flag("_is_truncated", env._is_truncated()) | truncated
            if self._rewards and self._observes:
                reward, observation = env._reward_and_observation()
            elif self._rewards:
                reward = env._reward_policy()
            elif self._observes:
                observation = env._get_observation()
        finally:
            env._in_hooks = env._tells = False
            for name, _ in names:
                attributes.pop(name, None)
        if type(reward) is not float:
            reward = as_reward(reward)
        if not isfinite(reward) or (self._observes and not env._is_finite(observation)):
            return False
        return observation, reward, terminated, truncated, info


def require_few(left: Mapping[str, str]) -> None:
    """Refuse to compile the other hooks where that saves no time.

    Args:
        left: Why hooks cannot be compiled, by the name of the hook.

    Raises:
        UntraceableError: With all reasons.
    """
    if sum(_COSTS.get(name, 1) for name in left) > _MOST:
        raise UntraceableError("; ".join(left.values()))


def _late_ones(names: set[str], late: Readers) -> list[tuple[str, Callable[[], Any]]]:
    needed = {_NEEDED.get(name, name) for name in names}
    return [(name, read) for name, read in late.items() if name in needed]
