"""Players of episodes: agents, controllers and random actions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium
import numpy as np

from fmugym.checks import Spellings, number_of
from fmugym.control import controller_of
from fmugym.control.controller import require_physical
from fmugym.control.controller_table import resolved
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.records.progress_bars import Advance, no_progress
from fmugym.task import Task

__all__ = [
    "Player",
    "Policy",
    "Summary",
    "action_of",
    "given_controller",
    "policy_of",
    "policy_of_controller",
    "simulate",
]


@dataclass(frozen=True)
class Policy:
    """Chooses actions.

    Attributes:
        act: Returns the action for an observation.
        begin: Is called before an episode begins; without a memory there is nothing to forget.
    """

    act: Callable[[Any], Any]
    begin: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class Player:
    """Player of episodes: a policy, and the environment that it needs.

    Attributes:
        make_policy: Makes the policy for an environment.
        is_physical: Whether the environment must be in the physical form of its task, as for all
            who read and write values in units of the task; see ``Task.physical``.
    """

    make_policy: Callable[[FMUEnv], Policy]
    is_physical: bool

    def make_env(self, make_env: Callable[..., FMUEnv]) -> FMUEnv:
        """Make an environment in the form that the player needs.

        Args:
            make_env: As ``maker_of`` returns it. Only for a physical player it gets an argument.
        """
        return make_env(physical=True) if self.is_physical else make_env()


@dataclass(frozen=True)
class Summary:
    """An episode in numbers.

    Attributes:
        seed: The seed of the episode.
        steps: Number of its steps.
        seconds: The simulated time.
        total_reward, total_cost: Sums over the episode; no cost if the task has none.
        end: ``"terminated"``, ``"truncated"``, or ``"fault: ..."`` with its reason.
        kpis: The KPIs that the task has reported at the end, by name.
        only_reward: The reward of every step; None if it has changed.
    """

    seed: int
    steps: int
    seconds: float
    total_reward: float
    total_cost: float | None
    end: str
    kpis: Mapping[str, float] = field(default_factory=dict)
    only_reward: float | None = None

    @property
    def has_no_reward(self) -> bool:
        """Whether a step had a reward that is no finite number."""
        is_of_reward = any(word in self.end for word in ("the reward", "_reward_policy"))
        is_fault = self.end.startswith("fault: ") and is_of_reward
        return is_fault or not math.isfinite(self.total_reward)

    def as_dict(self) -> dict[str, Any]:
        """The numbers in types that JSON has."""
        return asdict(self)

    def as_text(self) -> str:
        """The numbers in a line."""
        cost = "" if self.total_cost is None else f", cost {self.total_cost:.6g}"
        kpis = "".join(f", {name} {value:.6g}" for name, value in self.kpis.items())
        return (
            f"seed {self.seed}: reward {self.total_reward:.6g}{cost} in {self.steps} steps "
            f"({self.seconds:.10g} s), {self.end}{kpis}"
        )


def action_of(env: FMUEnv, text: str) -> Policy:
    """Make the policy that a text names.

    Args:
        env: The environment.
        text: ``"random"``, or the numbers of one action, which is repeated: ``"0.5,-1"``.

    Raises:
        ConfigError: If it names no action, or numbers are for an environment that is not in its
            physical form.
    """
    space = env.action_space
    if text == "random":
        return Policy(lambda observation: space.sample())
    require_physical(env)
    try:
        numbers = [number_of("action", float(part)) for part in text.split(",")]
        array = np.array(numbers).reshape(space.shape or ())
    except ValueError:
        raise ConfigError(f"expected 'random' or an action of {space}, got {shown(text)}") from None
    action = array.astype(space.dtype)[()]
    if not space.contains(action) or not np.allclose(action, array):
        raise ConfigError(f"the action {shown(text)} is not in {space}")
    return Policy(lambda observation: action)


def policy_of(env: FMUEnv, text: str) -> Policy:
    """Make the policy of a controller of ``fmugym.control``.

    Args:
        env: The environment.
        text: The name of a controller of the task file, or as ``fmugym.control.controller_of``
            takes it.

    Raises:
        ConfigError: If it names no controller, or the controller does not fit the environment.
    """
    given = given_controller(env, text)
    if not isinstance(given, str):
        return action_of(env, str(given))
    return policy_of_controller(controller_of(given), env)


def given_controller(env: FMUEnv, text: str) -> Any:
    """The controller that a text gives without names: a text, or a number of the task file.

    Args:
        env: The environment.
        text: As for ``policy_of``.

    Raises:
        ConfigError: If it is a name that the task file does not have.
    """
    known = _named_controllers(env)
    own = Spellings("controller of the task", known).find(text)
    if own is None and known and text.isidentifier():
        raise unknown_name("controller of the task", text, known)
    return resolved(text if own is None else known[own], known)


def policy_of_controller(controller: Any, env: FMUEnv) -> Policy:
    """Bind a controller to an environment.

    Raises:
        ConfigError: If it does not fit.
    """
    controller.bind(env)
    return Policy(controller.act, controller.reset)


def _named_controllers(env: FMUEnv) -> Mapping[str, Any]:
    """The controllers that a task file declares, by name."""
    task = getattr(env, "task", None)
    return dict(task.document.get("controllers", {})) if isinstance(task, Task) else {}


def simulate(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    seed: int,
    most_steps: int,
    advance: Advance = no_progress,
    start: float | None = None,
) -> Summary:
    """Play one episode.

    Args:
        env: An ``FMUEnv``, or a wrapper around one.
        policy: Chooses the actions.
        seed: Seed of the episode, and of random actions.
        most_steps: The steps after which to stop. A registered id may have a lower limit, which
            truncates the episode.
        advance: Is told of each step.
        start: The start time, if the task draws one; None for one that is drawn.

    Returns:
        The numbers of the episode.
    """
    inner: Any = env.unwrapped
    env.action_space.seed(seed)
    policy.begin()
    options = None if start is None else {"model_parameters": {"start_time": start}}
    observation, info = env.reset(seed=seed, options=options)
    total, cost, end, begin = 0.0, None, "stopped", inner.time
    limit = inner.spec.max_episode_steps if inner.spec is not None else None
    values: set[float] = set()
    for step in range(1, most_steps + 1):
        observation, reward, terminated, truncated, info = env.step(policy.act(observation))
        truncated = truncated or step == limit
        total += float(reward)
        if len(values) < 2:
            values.add(float(reward))
        cost = float(info["cost"]) + (cost or 0.0) if "cost" in info else cost
        advance(1)
        if terminated or truncated:
            end = f"fault: {info['fault']}" if "fault" in info else ""
            end = end or ("terminated" if terminated else "truncated")
            break
    kpis = {name: float(value) for name, value in info.get("kpis", {}).items()}
    only = values.pop() if len(values) == 1 else None
    return Summary(seed, inner.step_count, inner.time - begin, total, cost, end, kpis, only)
