"""Agents of Stable-Baselines3 in folders: saved by a training, loaded to act."""

from __future__ import annotations

import inspect
import json
import os
import pickle
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from fmugym.checks import check_option, check_path, require_regular
from fmugym.control import Controller
from fmugym.environment.actions import are_scaled, unscaled
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, reading_file, shown
from fmugym.extras import imported
from fmugym.files import replaced_together
from fmugym.records.players import Player, Policy, policy_of_controller
from fmugym.training.residual import Residual, residual_of
from fmugym.training.search.policy import POLICY_FILE, ResidualAgent, require_task

__all__ = [
    "AGENT_FILE",
    "agent_player",
    "algorithm_of",
    "imported_for_training",
    "load_agent",
    "names_of",
    "policy_with",
    "read_agent",
    "read_facts",
    "save",
]

_LIBRARIES: Final = ("stable_baselines3", "sb3_contrib")
_MODEL, _NORMALIZATION = "model.zip", "normalization.pkl"
AGENT_FILE: Final = "agent.json"


def imported_for_training(name: str) -> Any:
    """Import a module of Stable-Baselines3, or one that needs it.

    Raises:
        ConfigError: If it is missing.
    """
    return imported(name, "sb3")


def algorithm_of(name: str) -> Any:
    """Find the class of an algorithm by its name.

    Raises:
        ConfigError: If there is none, or Stable-Baselines3 is missing.
    """
    base: Any = imported_for_training("stable_baselines3.common.base_class").BaseAlgorithm
    known = {
        key: value
        for library in filter(find_spec, _LIBRARIES)
        for key, value in vars(import_module(library)).items()
        if isinstance(value, type) and issubclass(value, base)
    }
    return known[check_option("algorithm", name, known)]


def save(folder: Path, model: Any, normalization: Any, facts: Mapping[str, Any]) -> None:
    """Write an agent to a folder.

    Args:
        folder: The folder; an agent that is there is replaced once this one is complete.
        model: The model of Stable-Baselines3.
        normalization: A ``VecNormalize``, or None.
        facts: What to tell about the agent, ``algorithm`` at least, and for ``bind`` the names of
            its ``observations`` and ``actions``.
    """
    with replaced_together() as beside:
        model.save(beside(folder / _MODEL))
        if normalization is not None:
            normalization.save(str(beside(folder / _NORMALIZATION)))
        beside(folder / AGENT_FILE).write_text(json.dumps(dict(facts)), encoding="utf-8")


def load_agent(folder: str | os.PathLike[str]) -> Controller | TrainedModel:
    """Load the agent that ``fmugym train`` has written to a folder, to act as controllers do.

    Only load agents of Stable-Baselines3 from sources that you trust: their files hold pickles,
    which can run code. Those of a search hold numbers only.

    Returns:
        The agent, which ``bind`` prepares for an environment: that of a search and a residual
        policy for one or many environments in the physical form of the task, any other one of
        Stable-Baselines3 for a single one.
        It refuses other observations or actions than it was trained for.

    Raises:
        ConfigError: If there is no agent, its files are damaged, or Stable-Baselines3 is missing.
    """
    path = check_path("folder", folder)
    model, normalization = read_agent(path)
    if isinstance(model, ResidualAgent):
        return model.policy()
    if isinstance(model, Residual):
        return model
    return TrainedModel(path, model, normalization, {} if path.is_file() else _facts_in(path))


def agent_player(folder: Path) -> Player:
    """Make the player of the agent in a folder; raises as ``load_agent``."""
    agent = load_agent(folder)
    return Player(partial(policy_of_controller, agent), agent.is_physical)


class TrainedModel:
    """An agent of Stable-Baselines3, with the methods of a ``fmugym.control.Controller``.

    Args:
        folder: Folder of the agent, for errors.
        model: The model.
        normalization: Its ``VecNormalize``, or None.
        facts: Facts that ``save`` was given.
    """

    is_physical: Final = False

    def __init__(
        self, folder: Path, model: Any, normalization: Any, facts: Mapping[str, Any]
    ) -> None:
        self._folder, self._model, self._normalization = folder, model, normalization
        self._facts = facts

    def bind(self, env: Any) -> Self:
        """Prepare for an environment.

        Raises:
            ConfigError: If the agent was trained for other observations or actions.
        """
        self._require_names(env.unwrapped)
        for what in ("observation", "action"):
            own, other = getattr(self._model, f"{what}_space"), getattr(env, f"{what}_space")
            if type(own) is not type(other) or own.shape != other.shape:
                raise ConfigError(
                    f"the agent in {shown(str(self._folder))} is for another task: its {what}s are "
                    f"{_kind(own)}, those of the task are {_kind(other)} "
                    f"({', '.join(names_of(env.unwrapped)[what + 's'])})"
                )
        self._policy = policy_with(self._model, self._normalization, env.unwrapped)
        return self

    def _require_names(self, env: FMUEnv) -> None:
        """Refuse names other than those of the training, if these are known."""
        here = names_of(env)
        own = {what: self._facts.get(what, names) for what, names in here.items()}
        tasks = ((one["observations"], ", ".join(one["actions"])) for one in (own, here))
        require_task(f"the agent in {shown(str(self._folder))}", *tasks)

    def act(self, observation: Any, info: Any = None) -> Any:
        """Choose the best action."""
        return self._policy.act(observation)

    def reset(self) -> None:
        """Begin a new episode."""
        self._policy.begin()


def read_agent(path: Path, algorithm: str = "PPO") -> tuple[Any, Any]:
    """Load an agent of a search, a residual policy, or a model of Stable-Baselines3.

    Only load the latter from sources that you trust: their files hold pickles, which can run code.

    Args:
        path: The folder of a training, or the file of a model.
        algorithm: The name of the algorithm of a file; a folder knows its own.

    Returns:
        The agent or model, and its ``VecNormalize``, or None; a residual policy has its own. That
        of a file is ``normalization.pkl`` beside it, if there is one.

    Raises:
        ConfigError: If there is no agent, its files are damaged, or Stable-Baselines3 is missing.
    """
    if (path / POLICY_FILE).exists():
        return ResidualAgent.load(path), None
    file = path if path.is_file() else path / _MODEL
    facts: dict[str, Any] = {"algorithm": algorithm} if path.is_file() else _facts_in(path)
    kind = algorithm_of(facts["algorithm"])
    with reading_file(f"the agent in {shown(str(path))} cannot be read"):
        require_regular(file)
        model, normalization = kind.load(file, device="cpu"), _normalization_in(file.parent)
        if facts.get("residual") is None:
            return model, normalization
        task = facts["observations"], facts["space"]
        return residual_of(facts["residual"], model, normalization, task), None


def _facts_in(folder: Path) -> dict[str, Any]:
    return read_facts(folder, AGENT_FILE, "is no folder of 'fmugym train'", "algorithm")


def read_facts(folder: Path, name: str, what_is_wrong: str, *needed: str) -> dict[str, Any]:
    """Read a file of facts.

    Args:
        folder: Folder of the agent.
        name: Its name.
        what_is_wrong: What the error says of the folder.
        needed: The facts that must be there.

    Raises:
        ConfigError: If there is no such file, or it lacks one of them.
    """
    try:
        require_regular(folder / name)
        facts = json.loads((folder / name).read_text(encoding="utf-8"))
        return {**{one: facts[one] for one in needed}, **facts}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise ConfigError(f"{shown(str(folder))} {what_is_wrong}") from None


def _normalization_in(folder: Path) -> Any:
    path = folder / _NORMALIZATION
    if not path.exists():
        return None
    require_regular(path)
    with path.open("rb") as file:
        normalization = pickle.load(file)
    wrappers = import_module("stable_baselines3.common.vec_env")
    if not isinstance(normalization, wrappers.VecNormalize):
        raise ConfigError(f"{_NORMALIZATION} in {shown(str(folder))} is of something else")
    normalization.training = False
    return normalization


def _kind(space: Any) -> str:
    """A space without its limits, which may be long arrays."""
    return f"{type(space).__name__} of shape {space.shape}"


def names_of(env: FMUEnv) -> dict[str, list[str]]:
    """Names of an agent's observations, and of the inputs that it writes."""
    seen = env.observation_names or env.config.model_output_names
    return {"observations": list(seen), "actions": list(env.config.model_input_names)}


def policy_with(model: Any, normalization: Any, env: FMUEnv) -> Policy:
    """Make the policy of a model: its best action, masked only if it knows masks.

    Actions from -1 to 1 stand for the ranges of the environment's.

    Args:
        model: The model.
        normalization: A ``VecNormalize`` that does not learn now, or None.
        env: The environment to act in.
    """
    masks = "action_masks" in inspect.signature(model.predict).parameters
    space, memory = env.action_space, dict[str, Any]()
    scaled = space if are_scaled(model.action_space, space) else None

    def begin() -> None:
        memory.clear()

    def choose(observation: Any) -> Any:
        if normalization is not None:
            observation = normalization.normalize_obs(observation)
        more: Any = {"action_masks": env.action_masks()} if masks else {}  # type: ignore[attr-defined]  # a TaskEnv
        action, memory["state"] = model.predict(
            observation,
            state=memory.get("state"),
            episode_start=np.array(["state" not in memory]),
            deterministic=True,
            **more,
        )
        if scaled is not None:
            return unscaled(action, scaled)
        return action if action.ndim else int(action)

    return Policy(choose, begin)
