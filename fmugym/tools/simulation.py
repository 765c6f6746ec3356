"""Episodes of a task, written as a table."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TextIO

import numpy as np

from fmugym.baselines import controller_of
from fmugym.checks import number_of
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, shown

__all__ = ["Policy", "Summary", "action_of", "policy_of", "simulate"]


def _begin() -> None:
    """A policy without a memory has nothing to forget."""


@dataclass(frozen=True)
class Policy:
    """Chooses actions.

    Attributes:
        act: Returns the action for an observation.
        begin: Is called before an episode begins.
    """

    act: Callable[[Any], Any]
    begin: Callable[[], None] = _begin


@dataclass(frozen=True)
class Summary:
    """An episode in numbers.

    Attributes:
        seed: The seed of the episode.
        steps: How many steps it had.
        seconds: The simulated time.
        total_reward, total_cost: Sums over the episode; no cost if the task has none.
        end: ``"terminated"``, ``"truncated"``, or ``"fault: ..."`` with its reason.
    """

    seed: int
    steps: int
    seconds: float
    total_reward: float
    total_cost: float | None
    end: str

    def as_dict(self) -> dict[str, Any]:
        """The numbers in types that JSON has."""
        return asdict(self)

    def as_text(self) -> str:
        """The numbers in a line."""
        cost = "" if self.total_cost is None else f", cost {self.total_cost:.6g}"
        return (
            f"seed {self.seed}: reward {self.total_reward:.6g}{cost} in {self.steps} steps "
            f"({self.seconds:g} s), {self.end}"
        )


def action_of(env: FMUEnv, text: str) -> Policy:
    """Make the policy that a text names.

    Args:
        env: The environment.
        text: ``"random"``, or the numbers of one action, which is repeated: ``"0.5,-1"``.

    Raises:
        ConfigError: If it names no action.
    """
    space = env.action_space
    if text == "random":
        return Policy(lambda observation: space.sample())
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
    """Make the policy of a controller of ``fmugym.baselines``.

    Args:
        env: The environment.
        text: See ``fmugym.baselines.controller_of``.

    Raises:
        ConfigError: If it names no controller, or the controller does not fit the environment.
    """
    controller = controller_of(text).bind(env)
    return Policy(controller.act, controller.reset)


def simulate(
    env: FMUEnv, policy: Policy, seed: int, most_steps: int, table: TextIO | None = None
) -> Summary:
    """Play one episode.

    Args:
        env: The environment.
        policy: Chooses the actions.
        seed: Of the episode, and of random actions.
        most_steps: The steps after which to stop.
        table: A text file that gets one line for each step as CSV, or None. Each line is written
            at once, so that it stays after an interruption.

    Returns:
        The numbers of the episode.
    """
    env.action_space.seed(seed)
    policy.begin()
    observation, info = env.reset(seed=seed)
    writer = None if table is None else _Writer(table, seed)
    if writer is not None:
        writer.add(env, info, None, "")
    total, cost, end, begin = 0.0, None, "stopped", env.time
    for _ in range(most_steps):
        observation, reward, terminated, truncated, info = env.step(policy.act(observation))
        total += reward
        cost = float(info["cost"]) + (cost or 0.0) if "cost" in info else cost
        end = _end(terminated, truncated, info) or end
        if writer is not None:
            writer.add(env, info, reward, _end(terminated, truncated, info))
        if terminated or truncated:
            break
    return Summary(seed, env.step_count, env.time - begin, total, cost, end)


def _end(terminated: bool, truncated: bool, info: Mapping[str, Any]) -> str:
    if "fault" in info:
        return f"fault: {info['fault']}"
    return "terminated" if terminated else "truncated" if truncated else ""


class _Writer:
    """Writes a table whose first line names the columns."""

    def __init__(self, file: TextIO, seed: int) -> None:
        self._file, self._writer, self._seed = file, csv.writer(file, lineterminator="\n"), seed
        self._has_header = file.tell() > 0

    def add(self, env: FMUEnv, info: Mapping[str, Any], reward: float | None, end: str) -> None:
        """Write the line of a step."""
        row = {"seed": self._seed, "time": env.time, **dict(_values(env, info))}
        row |= {"reward": "" if reward is None else reward, "end": end}
        if not self._has_header:
            self._writer.writerow(row)
            self._has_header = True
        self._writer.writerow(row.values())
        self._file.flush()


def _values(env: FMUEnv, info: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """The inputs, outputs, variables of the task, terms of the reward and costs by name."""
    yield from zip(env.config.model_input_names, env.inputs, strict=True)
    yield from env.out.items()
    for name, value in env.variables.items():
        if np.ndim(value) == 0 and name.isidentifier():  # others are the task's own bookkeeping
            yield name, value
    for group in ("reward_terms", "costs"):
        yield from ((f"{group}.{name}", value) for name, value in info.get(group, {}).items())
