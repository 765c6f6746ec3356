"""Training of agents with Stable-Baselines3, and the agents that come of it."""

from __future__ import annotations

import csv
import json
import pickle
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from gymnasium import spaces

from fmugym.checks import check_option
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, reason, shown
from fmugym.tools.evaluation import Score, evaluate
from fmugym.tools.simulation import Policy

__all__ = ["Plan", "agent_policy", "arguments_of", "train"]

_LIBRARIES: Final = ("stable_baselines3", "sb3_contrib")
_MODEL, _NORMALIZATION, _FACTS = "model.zip", "normalization.pkl", "agent.json"
_EVALUATIONS: Final = 10
_HELD_OUT_SEED: Final = 1_000_000
"""Episodes of evaluations have seeds from here on, which no training uses."""


@dataclass(frozen=True)
class Plan:
    """What to train, and how.

    Attributes:
        make_env: A function that makes the environment.
        held_out: By name, functions that make the environments of evaluations.
        folder: Where the agent is written; it must not exist.
        algorithm: The name of a class of Stable-Baselines3 or sb3-contrib.
        steps: Steps of all environments together.
        num_envs: Environments that step together.
        seed: Of the environments and of the algorithm.
        episodes: Episodes of an evaluation in each environment of ``held_out``.
        most_steps: The steps after which an episode of an evaluation is stopped.
        normalize: Whether observations and rewards are normalized by running statistics.
        arguments: Arguments of the algorithm.
    """

    make_env: Callable[[], FMUEnv]
    held_out: Mapping[str, Callable[[], FMUEnv]]
    folder: Path
    algorithm: str = "PPO"
    steps: int = 100_000
    num_envs: int = 8
    seed: int = 0
    episodes: int = 5
    most_steps: int = 10_000
    normalize: bool = True
    arguments: Mapping[str, Any] | None = None


def arguments_of(texts: Iterable[str]) -> dict[str, Any]:
    """Read arguments of an algorithm, ``key=value`` with values as in TOML.

    A value that is none of TOML is taken as text: ``policy=MlpPolicy``.

    Raises:
        ConfigError: If a text has no key.
    """
    arguments: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.isidentifier():
            raise ConfigError(f"expected an argument such as learning_rate=1e-3, got {shown(text)}")
        try:
            arguments[key] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            arguments[key] = value
    return arguments


def train(plan: Plan, tell: Callable[[str], None] = lambda line: None) -> list[Score]:
    """Train an agent, and evaluate it on the way. The best one is kept.

    An interruption by Ctrl-C ends the training; the best agent until then is in the folder.

    Args:
        plan: What to train.
        tell: Gets a line of text for each evaluation.

    Returns:
        The scores of the last evaluation.

    Raises:
        ConfigError: If Stable-Baselines3 is missing, or an argument does not fit.
        FileExistsError: If the folder exists.
    """
    make_sb3_env = _import("fmugym.sb3").make_sb3_env
    algorithm = _algorithm(plan.algorithm)
    if plan.folder.exists():
        raise FileExistsError(f"{plan.folder} exists; name a new folder")
    venv = make_sb3_env(plan.make_env, plan.num_envs, seed=plan.seed)
    try:
        is_box = isinstance(venv.observation_space, spaces.Box)
        if plan.normalize and is_box:
            wrappers = import_module("stable_baselines3.common.vec_env")
            venv = wrappers.VecNormalize(venv)
        model = _model(plan, algorithm, venv)
        _log_to(plan.folder, model)
        keeper = _Keeper(plan, model, venv, tell)
        try:
            model.learn(plan.steps, callback=keeper.callback())
        finally:
            model.logger.close()
            keeper.evaluate()
        return keeper.scores
    finally:
        venv.close()


def _model(plan: Plan, algorithm: Any, venv: Any) -> Any:
    own = dict(plan.arguments or {})
    policy = own.pop("policy", None)
    if policy is None:
        is_dict = isinstance(venv.observation_space, spaces.Dict)
        policy = "MultiInputPolicy" if is_dict else "MlpPolicy"
    try:
        return algorithm(policy, venv, **{"seed": plan.seed, "device": "cpu", **own})
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(f"{plan.algorithm} cannot be made: {reason(error)}") from error


def _log_to(folder: Path, model: Any) -> None:
    folder.mkdir(parents=True)
    logger = import_module("stable_baselines3.common.logger")
    formats = ["csv", *(["tensorboard"] if find_spec("tensorboard") else [])]
    model.set_logger(logger.configure(str(folder), formats))


def _algorithm(name: str) -> Any:
    """Find the class of an algorithm by its name."""
    base: Any = _import("stable_baselines3.common.base_class").BaseAlgorithm
    known = {
        key: value
        for library in filter(find_spec, _LIBRARIES)
        for key, value in vars(import_module(library)).items()
        if isinstance(value, type) and issubclass(value, base)
    }
    return known[check_option("algorithm", name, known)]


def _import(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"training needs Stable-Baselines3, but {name} cannot be imported; install the extra: "
            "pip install 'fmugym-toolbox[sb3]'"
        ) from error


class _Keeper:
    """Evaluates the agent now and then, and keeps the best one.

    Attributes:
        scores: The scores of the last evaluation.
    """

    def __init__(self, plan: Plan, model: Any, venv: Any, tell: Callable[[str], None]) -> None:
        self._plan, self._model, self._venv, self._tell = plan, model, venv, tell
        self._best = -float("inf")
        self._due = max(1, plan.steps // _EVALUATIONS)
        self._next, self._last = self._due, -1
        self.scores: list[Score] = []

    def callback(self) -> Any:
        """The callback of Stable-Baselines3, which it calls in each step."""

        def after_step(local_names: Any, global_names: Any) -> bool:
            if self._model.num_timesteps >= self._next:
                self._next += self._due
                self.evaluate()
            return True

        return after_step

    def evaluate(self) -> None:
        """Evaluate the agent, unless that was done at this step."""
        steps = int(self._model.num_timesteps)
        if steps == self._last:
            return
        self._last = steps
        policy = _policy(self._model, self._normalization())
        seeds = range(_HELD_OUT_SEED, _HELD_OUT_SEED + self._plan.episodes)
        self.scores = []
        for name, make_env in self._plan.held_out.items():
            one = {name: lambda env: policy}
            self.scores += evaluate(make_env, one, seeds, self._plan.most_steps)
        mean = sum(score.mean for score in self.scores) / len(self.scores)
        self._tell(f"{steps} steps: reward {mean:.6g} in evaluation")
        self._note(steps, mean)
        if mean > self._best:
            self._best = mean
            self._save(steps)

    def _normalization(self) -> Any:
        return self._venv if hasattr(self._venv, "normalize_obs") else None

    def _note(self, steps: int, mean: float) -> None:
        path = self._plan.folder / "evaluations.csv"
        is_new = not path.exists()
        with path.open("a", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            if is_new:
                writer.writerow(["steps", "reward", *(score.name for score in self.scores)])
            writer.writerow([steps, mean, *(score.mean for score in self.scores)])

    def _save(self, steps: int) -> None:
        folder, normalization = self._plan.folder, self._normalization()
        self._model.save(folder / _MODEL)
        if normalization is not None:
            normalization.save(str(folder / _NORMALIZATION))
        facts = {"algorithm": self._plan.algorithm, "steps": steps, "reward": self._best}
        (folder / _FACTS).write_text(json.dumps(facts), encoding="utf-8")


def _policy(model: Any, normalization: Any) -> Policy:
    def choose(observation: Any) -> Any:
        if normalization is not None:
            observation = normalization.normalize_obs(observation)
        action, _ = model.predict(observation, deterministic=True)
        return action if action.ndim else int(action)

    return Policy(choose)


def agent_policy(folder: Path) -> Callable[[FMUEnv], Policy]:
    """Load the agent that ``train`` has written to a folder.

    Only load agents from sources that you trust: the files hold pickles, which can run code.

    Raises:
        ConfigError: If there is no agent, or Stable-Baselines3 is missing.
    """
    try:
        facts = json.loads((folder / _FACTS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise ConfigError(f"{shown(str(folder))} is no folder of 'fmugym train'") from None
    model = _algorithm(facts["algorithm"]).load(folder / _MODEL, device="cpu")
    normalization = None
    if (folder / _NORMALIZATION).exists():
        wrappers = import_module("stable_baselines3.common.vec_env")
        with (folder / _NORMALIZATION).open("rb") as file:
            normalization = pickle.load(file)
        if not isinstance(normalization, wrappers.VecNormalize):
            raise ConfigError(f"{_NORMALIZATION} in {shown(str(folder))} is of something else")
        normalization.training = False
    return lambda env: _policy(model, normalization)
