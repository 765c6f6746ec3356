"""Multi-agent environment: PettingZoo's ``ParallelEnv`` over an environment of fmugym.

Needs the extra ``pettingzoo``. See ``docs/systems.md``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import Spellings, check_mapping, check_option, check_text
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.extras import lacking
from fmugym.fmi.systems.system_description import SystemDescription
from fmugym.task import TaskEnv

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError(
        lacking("fmugym.training.pettingzoo", "PettingZoo", "pettingzoo"), name=error.name
    ) from error

__all__ = ["Agent", "FMUParallelEnv"]

Dicts = tuple[
    dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
]
Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Agent:
    """Actions, observations and reward of one agent of a system.

    Attributes:
        actions: The names of the elements of the environment's action that it decides on. Together,
            the agents decide on all.
        observations: The names of the elements of the environment's observation that it sees, in
            this order. Agents may see the same.
        reward: The name of a reward of a task file that it gets; None for the environment's own
            reward, which all agents then share.
    """

    actions: Sequence[str]
    observations: Sequence[str]
    reward: str | None = None


@dataclass(frozen=True)
class _Part:
    """An agent with its places in the arrays of the environment."""

    actions: list[int]
    observations: list[int]
    reward: str | None
    action_space: spaces.Space[Any]
    observation_space: spaces.Box


class FMUParallelEnv(ParallelEnv[str, Array, Array]):
    """Several agents that act on one environment at the same time.

    An episode begins and ends for all agents together.

    Args:
        env: The environment. Its observation is a flat ``Box``, and its action a flat ``Box`` or a
            ``MultiDiscrete``.
        agents: The agents by name. By default, an environment of a system has an agent for each
            component with inputs among its actions, who sees what the environment observes of this
            component, and of the system itself.

    Attributes:
        env: As given.
        possible_agents: The names of the agents.
        agents: Agents that are acting: all of them in an episode, none after its end.

    Raises:
        ConfigError: If the spaces do not fit, a name is unknown, or an action belongs to no agent
            or to two.
    """

    metadata: dict[str, Any] = {"name": "fmugym", "render_modes": []}  # noqa: RUF012  # PettingZoo

    def __init__(self, env: FMUEnv, agents: Mapping[str, Agent] | None = None) -> None:
        self.env = env
        self.metadata = {**env.metadata, "name": type(env).__name__}
        self.render_mode = env.render_mode
        actions, observations = _action_names(env), _observation_names(env)
        given = _agents_of(env, actions, observations) if agents is None else agents
        given = check_mapping("agents", given)
        _require_one_each(given, actions)
        self._parts = {
            name: _part(env, name, agent, actions, observations) for name, agent in given.items()
        }
        self.possible_agents = list(self._parts)
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Box:
        """Observation space of an agent; the same object at each call."""
        return self._found(agent).observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Action space of an agent; the same object at each call."""
        return self._found(agent).action_space

    def _found(self, agent: str) -> _Part:
        return self._parts[check_option("agent", agent, self._parts)]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, dict[str, Any]]]:
        """Start a new episode for all agents.

        Args:
            seed: See ``FMUEnv.reset``.
            options: See ``FMUEnv.reset``; others are ignored, as PettingZoo asks.

        Returns:
            The first observations and the infos by agent.
        """
        known = {k: v for k, v in (options or {}).items() if k in self.env.reset_options}
        observation, info = self.env.reset(seed=seed, options=known)
        self.agents = list(self.possible_agents)
        return self._seen(observation), {name: dict(info) for name in self.agents}

    def step(self, actions: dict[str, Array]) -> Dicts:
        """Let all agents act.

        Args:
            actions: The action of each agent.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent.

        Raises:
            ConfigError: If an action is missing or does not fit.
            SimulationError: Before the first reset and after the end of an episode.
        """
        if not self.agents:
            raise SimulationError("step was called without agents; call reset first")
        action = self._joined(check_mapping("actions", actions))
        observation, reward, terminated, truncated, info = self.env.step(action)
        names = self.agents
        if terminated or truncated:
            self.agents = []
        rewards = {name: self._reward(self._parts[name], reward, info) for name in names}
        return (
            self._seen(observation),
            rewards,
            dict.fromkeys(names, terminated),
            dict.fromkeys(names, truncated),
            {name: dict(info) for name in names},
        )

    def _joined(self, actions: Mapping[str, Any]) -> Array:
        """The environment's action."""
        for name in actions:
            self._found(name)
        space = self.env.action_space
        joined = np.zeros(space.shape or (), space.dtype)
        for name, part in self._parts.items():
            if name not in actions:
                raise ConfigError(f"the action of the agent {name!r} is missing")
            try:
                joined[part.actions] = actions[name]
            except (TypeError, ValueError):
                raise ConfigError(
                    f"the action of the agent {name!r} must have the shape "
                    f"{part.action_space.shape}, got {shown(actions[name])}"
                ) from None
        return joined

    def _seen(self, observation: Array) -> dict[str, Array]:
        return {name: observation[part.observations] for name, part in self._parts.items()}

    @staticmethod
    def _reward(part: _Part, reward: float, info: Mapping[str, Any]) -> float:
        """An agent's own reward. After a fault there is only the environment's own."""
        if part.reward is None:
            return reward
        return float(info.get("reward_terms", {}).get(part.reward, reward))

    def render(self) -> Any:
        """Draw the environment; see ``FMUEnv.render``."""
        return self.env.render()

    def state(self) -> Array:
        """The last values of all outputs of the environment, shape (k,)."""
        return np.array(self.env.state)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def _action_names(env: FMUEnv) -> list[str]:
    """The names of the elements of the action, by the task file or the config."""
    space = env.action_space
    flat = isinstance(space, spaces.Box | spaces.MultiDiscrete) and len(space.shape or ()) == 1
    if not flat:
        raise ConfigError(f"the action space must be a flat Box or MultiDiscrete, got {space}")
    if isinstance(env, TaskEnv):
        given = env.task.root.child("agent").child("actions").value
        names = [given] if isinstance(given, str) else list(given)
    else:
        names = list(env.config.model_input_names)
    return _checked(names, "action", space)


def _observation_names(env: FMUEnv) -> list[str]:
    space = env.observation_space
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ConfigError(f"the observation space must be a flat Box, got {space}")
    return _checked(list(env.observation_names or ()), "observation", space)


def _checked(names: list[str], what: str, space: spaces.Space[Any]) -> list[str]:
    if space.shape != (len(names),):
        raise ConfigError(
            f"the {what} has the shape {space.shape}, but {len(names)} names; a hook of the class "
            "makes it"
        )
    return names


_ALL: Final = ""
"""Stands for the system itself among the owners of names."""


def _agents_of(
    env: FMUEnv, actions: Sequence[str], observations: Sequence[str]
) -> dict[str, Agent]:
    """An agent for each component that actions act on."""
    description = env.fmu.description
    if not isinstance(description, SystemDescription):
        raise ConfigError(f"{env.fmu.path.name} is no system; say which agents there are")
    owners = {name: _owner(env, description, name) for name in (*actions, *observations)}
    own = [name for name in actions if owners[name] == _ALL]
    if own:
        raise ConfigError(
            f"the action {own[0]!r} belongs to several components; say which agents there are"
        )
    return {
        component: Agent(
            [name for name in actions if owners[name] == component],
            [name for name in observations if owners[name] in {component, _ALL}],
        )
        for component in dict.fromkeys(owners[name] for name in actions)
    }


def _owner(env: FMUEnv, description: SystemDescription, name: str) -> str:
    """The component of a name, or ``_ALL``."""
    if isinstance(env, TaskEnv):
        name = env.task.root.child("variables").child(name).child("name").value or name
    variable, names = description.find(name), list(description.variables)
    if variable is None or variable.name not in names:
        return _ALL
    place = names.index(variable.name)
    parts = {end.part for end in description.ends[place]}
    return description.plan.components[parts.pop()].name if len(parts) == 1 else _ALL


def _require_one_each(agents: Mapping[str, Any], actions: Sequence[str]) -> None:
    """Each action must belong to one agent."""
    if not agents:
        raise ConfigError("there must be at least one agent")
    spellings, owners = Spellings("action", actions), dict[str, str]()
    for name, agent in agents.items():
        if not isinstance(agent, Agent):
            raise ConfigError(f"the agent {name!r} must be an Agent, got {shown(agent)}")
        for action in agent.actions:
            own = spellings.require(check_text("an action", action))
            other = owners.setdefault(own, name)
            if other != name:
                raise ConfigError(f"the action {action!r} belongs to two agents: {other}, {name}")
    for action in actions:
        if action not in owners:
            raise ConfigError(f"the action {action!r} belongs to no agent")


def _part(
    env: FMUEnv, name: str, agent: Agent, actions: Sequence[str], observations: Sequence[str]
) -> _Part:
    if not agent.actions or not agent.observations:
        raise ConfigError(f"the agent {name!r} must act on and observe something")
    places = _places("action", agent.actions, actions)
    seen = _places("observation", agent.observations, observations)
    return _Part(
        places,
        seen,
        None if agent.reward is None else _reward_of(env, agent.reward),
        _part_of(env.action_space, places),
        _part_of(env.observation_space, seen),
    )


def _places(what: str, names: Sequence[str], known: Sequence[str]) -> list[int]:
    spellings = Spellings(what, known)
    return [known.index(spellings.require(name)) for name in names]


def _reward_of(env: FMUEnv, name: str) -> str:
    """The name of a reward as the task has it."""
    rewards = env.task.root.child("reward").value if isinstance(env, TaskEnv) else None
    return Spellings("reward", rewards if isinstance(rewards, Mapping) else ()).require(name)


def _part_of(space: Any, places: list[int]) -> Any:
    if isinstance(space, spaces.Box):
        return spaces.Box(space.low[places], space.high[places], dtype=space.dtype.type)
    return spaces.MultiDiscrete(space.nvec[places], dtype=space.dtype.type)
