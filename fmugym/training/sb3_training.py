"""Training of agents with Stable-Baselines3, and the number of environments that it steps."""

from __future__ import annotations

import inspect
import json
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from time import monotonic, perf_counter
from typing import Any, Final

from gymnasium import spaces

from fmugym.environment.actions import can_be_scaled
from fmugym.environment.env import FMUEnv
from fmugym.environment.vector import FMUVectorEnv
from fmugym.errors import ConfigError, reason, shown, unknown_name
from fmugym.files import write_whole
from fmugym.pool.machine_limits import available_memory, available_processors, used_memory
from fmugym.records.evaluation import HELD_OUT_SEED, Score, Wrap, evaluate, warning_of_one_reward
from fmugym.records.players import Player, policy_of_controller
from fmugym.records.progress_bars import Advance, no_progress
from fmugym.task.likely_units import require_units
from fmugym.training.agents import (
    AGENT_FILE,
    agent_player,
    algorithm_of,
    imported_for_training,
    names_of,
    policy_with,
    read_facts,
    save,
)
from fmugym.training.checkpoints import (
    NOTHING_TO_RESUME,
    latest_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from fmugym.training.residual import begin_at_zero, residual_of
from fmugym.training.training_records import (
    EVALUATIONS,
    RECORDS,
    Tracker,
    TrainingRecords,
    append_row,
)

__all__ = [
    "TRAINING",
    "TRIALS",
    "VERY_SLOW",
    "TrainingSettings",
    "Watch",
    "algorithm_arguments",
    "facts_of",
    "fitting_envs",
    "require_new",
    "train",
]

VERY_SLOW: Final = 5e-3
"""If a step takes longer than this in seconds, more environments than processors are of no use.

Each of them may be a process."""

_USUAL: Final = 8
_TIMED: Final = 10
_SHARE: Final = 0.5
"""Of the memory that is free."""


def fitting_envs(make_env: Callable[[], FMUEnv]) -> int:
    """Number of environments that fit the processors and the memory.

    Args:
        make_env: A function that makes the environment. One takes some steps.
    """
    before, processors = used_memory(), available_processors()
    with closing(make_env()) as env:
        env.action_space.seed(0)
        env.reset(seed=0)
        memory = max(used_memory() - before, 1.0)
        seconds, is_over = [math.inf], False
        while len(seconds) <= _TIMED and not is_over:
            action, begin = env.action_space.sample(), perf_counter()
            _, _, terminated, truncated, _ = env.step(action)
            seconds.append(perf_counter() - begin)
            is_over = terminated or truncated
    wanted = processors if min(seconds) > VERY_SLOW else max(_USUAL, processors)
    return max(1, int(min(wanted, _SHARE * available_memory() / memory)))


TRAINING: Final = "training.json"
TRIALS: Final = "trials"
_EVALUATIONS: Final = 10
_SECONDS_BETWEEN_CHECKPOINTS: Final = 30.0


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training.

    Attributes:
        make_env: A function that makes the environment.
        held_out: By name, functions that make the environments of evaluations.
        folder: Folder of the new agent; it must not exist, unless a training is resumed.
        algorithm: The name of a class of Stable-Baselines3 or sb3-contrib.
        steps: Steps of all environments together, at most.
        num_envs: Environments that step together.
        seed: Seed of the environments and of the algorithm.
        episodes: Episodes of an evaluation in each environment of ``held_out``.
        most_steps: The steps after which an episode of an evaluation is stopped.
        normalize: Whether observations and rewards are normalized by running statistics. Actions
            with other ranges are scaled to -1 to 1 in any case.
        arguments: Arguments of the algorithm.
        residual: Which controller's action it adds to, see ``residual_facts``; None for none.
        records: Settings of recordings; None for none.
    """

    make_env: Callable[..., FMUEnv]
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
    residual: Mapping[str, Any] | None = None
    records: TrainingRecords | None = None

    def facts(self) -> dict[str, Any]:
        """Facts that a resumed training must share with its beginning."""
        return {
            "algorithm": self.algorithm,
            "envs": self.num_envs,
            "seed": self.seed,
            "episodes": self.episodes,
            "normalize": self.normalize,
            "arguments": dict(self.arguments or {}),
            "residual": self.residual,
        }

    @property
    def make_trained(self) -> Callable[[], FMUEnv]:
        """Makes the environment of the training; a controller needs its physical form."""
        return self.make_env if self.residual is None else partial(self.make_env, physical=True)


def algorithm_arguments(texts: Iterable[str]) -> dict[str, Any]:
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


@dataclass(frozen=True)
class Watch:
    """Listener of a training.

    Attributes:
        tell: Gets a line of text for each evaluation.
        advance: Is told of steps.
        evaluated: Gets the steps and the mean reward of each evaluation. An exception of it ends
            the training.
        begin_tracker: Makes what gets all numbers, when the folder is there; None for nobody.
    """

    tell: Callable[[str], None] = lambda line: None
    advance: Advance = no_progress
    evaluated: Callable[[int, float], None] = lambda steps, mean: None
    begin_tracker: Callable[[], Tracker] | None = None


def train(
    settings: TrainingSettings, *, resume: bool = False, watch: Watch = Watch()
) -> list[Score]:
    """Train an agent, and evaluate it on the way. The best one is kept.

    An interruption by Ctrl-C ends the training; the best agent until then is in the folder, and a
    checkpoint from which the training can be resumed.

    Args:
        settings: Settings of the training.
        resume: Whether to go on with the training in the folder. If the FMU's state can be saved or
            its steps repeated, all takes the same course as without the interruption, to the last
            bit.
        watch: Listener of the training.

    Returns:
        The scores of the agent that is kept.

    Raises:
        ConfigError: If Stable-Baselines3 is missing, an argument does not fit, the steps are too
            few to learn once, or there is no such training to resume.
        FileExistsError: If the folder exists, unless a training is resumed.
    """
    sb3 = imported_for_training("fmugym.training.sb3")
    if resume:
        _require_same(settings)
    else:
        require_new(settings.folder)
        _check_arguments(settings)
        with closing(settings.make_env()) as env:
            require_units(env.unwrapped)
    wrap = _recorder(settings, resume)
    venv = sb3.make_sb3_env(settings.make_trained, settings.num_envs, seed=settings.seed, wrap=wrap)
    try:
        if settings.residual is not None:
            venv = sb3.ResidualActions(venv, residual_of(settings.residual))
        elif can_be_scaled(venv.action_space):
            venv = sb3.ScaledActions(venv)
        if settings.normalize:
            venv = _normalized(venv)
        with closing(_Training(settings, venv, watch, resume)) as training:
            training.run()
            return training.scores_of_kept()
    finally:
        venv.close()


def _normalized(venv: Any) -> Any:
    """Normalize all numbers that are observed, and rewards."""
    space, names = venv.observation_space, None
    if isinstance(space, spaces.Dict):
        names = [name for name, part in space.spaces.items() if isinstance(part, spaces.Box)]
    if not names and not isinstance(space, spaces.Box):
        return venv
    make = import_module("stable_baselines3.common.vec_env").VecNormalize
    return make(venv, norm_obs_keys=names)


def _recorder(settings: TrainingSettings, resume: bool) -> Callable[[FMUVectorEnv], Any]:
    """Make the wrapper of a training's environments."""
    if settings.records is None:
        return lambda envs: envs
    begin = latest_checkpoint(settings.folder)[1] if resume else 0
    return settings.records.of_training(settings.folder, begin)


def _check_arguments(settings: TrainingSettings) -> None:
    """Refuse arguments that the algorithm does not have.

    Raises:
        ConfigError: With the nearest one.
    """
    known = inspect.signature(algorithm_of(settings.algorithm)).parameters
    takes_any = any(one.kind is one.VAR_KEYWORD for one in known.values())
    for name in () if takes_any else settings.arguments or ():
        if name not in known:
            raise unknown_name(f"argument of {settings.algorithm}", name, known)


def require_new(folder: Path) -> None:
    """Refuse a folder that has more in it than a search for arguments.

    Raises:
        FileExistsError: If it has.
    """
    if folder.exists() and not {path.name for path in folder.iterdir()} <= {
        TRIALS,
        f"{TRIALS}.csv",
    }:
        raise FileExistsError(f"{folder} exists; name a new folder")


def facts_of(folder: Path) -> dict[str, Any]:
    """Facts with which a training was begun.

    Raises:
        ConfigError: If there is none.
    """
    return read_facts(folder, TRAINING, NOTHING_TO_RESUME, "steps")


def _require_same(settings: TrainingSettings) -> None:
    before = facts_of(settings.folder)
    for name, value in settings.facts().items():
        if before.get(name) != value:
            raise ConfigError(
                f"the training in {shown(str(settings.folder))} has {name} = "
                f"{shown(before.get(name))}, which cannot change to {shown(value)}"
            )


def _new_model(settings: TrainingSettings, venv: Any) -> Any:
    own = _with_fitting_rollouts(settings)
    policy = own.pop("policy", None)
    if policy is None:
        is_dict = isinstance(venv.observation_space, spaces.Dict)
        recurrent = "Lstm" if settings.algorithm.startswith("Recurrent") else ""
        policy = f"{'MultiInput' if is_dict else 'Mlp'}{recurrent}Policy"
    try:
        algorithm = algorithm_of(settings.algorithm)
        return algorithm(policy, venv, **{"seed": settings.seed, "device": "cpu", **own})
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(f"{settings.algorithm} cannot be made: {reason(error)}") from error


def _with_fitting_rollouts(settings: TrainingSettings) -> dict[str, Any]:
    """Shorten rollouts for a training with fewer steps than a usual rollout."""
    own, most = dict(settings.arguments or {}), settings.steps // settings.num_envs
    default = inspect.signature(algorithm_of(settings.algorithm)).parameters.get("n_steps")
    if default is not None and 0 < most < default.default:
        own.setdefault("n_steps", 1 << (most.bit_length() - 1))  # so that batches divide rollouts
    return own


def _steps_between_updates(model: Any, num_envs: int) -> int:
    """The steps of all environments after which an algorithm learns; it cannot stop before."""
    if hasattr(model, "rollout_buffer"):
        return int(model.n_steps) * num_envs
    frequency: Any = getattr(model, "train_freq", None)
    steps = 1 if frequency is None or frequency.unit.value == "episode" else frequency.frequency
    return int(steps) * num_envs


class _Training:
    """A training: evaluates the agent now and then, keeps the best one, and can be resumed."""

    def __init__(self, settings: TrainingSettings, venv: Any, watch: Watch, resume: bool) -> None:
        self._settings, self._venv, self._watch = settings, venv, watch
        self._due = max(1, settings.steps // _EVALUATIONS)
        self._progress = {"best": -float("inf"), "next": self._due, "last": -1, "updates": -1}
        self._is_new = not resume
        if resume:
            self._load()
        else:
            self._model = _new_model(settings, venv)
            if settings.residual is not None:
                begin_at_zero(self._model)
            self._require_an_update()
            self._tell_of_the_plan()
            settings.folder.mkdir(parents=True, exist_ok=True)
        facts: dict[str, Any] = {"schema": 1, "steps": settings.steps, **settings.facts()}
        if settings.records is not None:
            (settings.folder / RECORDS).mkdir(exist_ok=True)
            facts["record"] = settings.records.facts()
        write_whole(settings.folder / TRAINING, json.dumps(facts).encode())
        self._tracker = None if watch.begin_tracker is None else watch.begin_tracker()
        self._begin = self._told = self._steps
        self._saved_at = monotonic()

    def _load(self) -> None:
        settings = self._settings
        self._model, more, is_exact = load_checkpoint(
            settings.folder, settings.algorithm, self._venv
        )
        self._due, self._progress = more["due"], more["progress"]
        _drop_rows(settings.folder / EVALUATIONS, self._steps)
        how = "" if is_exact else "; the FMUs cannot, so that their episodes begin anew"
        self._watch.tell(f"goes on after {self._steps} steps{how}")

    @property
    def _steps(self) -> int:
        return int(self._model.num_timesteps)

    def run(self) -> None:
        """Train until the end, and evaluate once more."""
        self._log_to()
        if self._is_new and self._settings.residual is not None:
            self.evaluate()  # the controller itself, which later agents have to beat
        remaining = self._settings.steps - self._steps
        remaining -= remaining % _steps_between_updates(self._model, self._settings.num_envs)
        try:
            if remaining > 0:
                self._model.learn(
                    remaining, callback=self._callback(), reset_num_timesteps=self._is_new
                )
                self.evaluate()
                self._save_checkpoint()
            else:
                self.evaluate()
        except KeyboardInterrupt:
            if not (
                self._settings.folder / AGENT_FILE
            ).exists():  # a second one may end the evaluation
                self._keep()
            self.evaluate()
            raise

    def _require_an_update(self) -> None:
        """Refuse a training that ends before it learns for the first time."""
        settings = self._settings
        between = _steps_between_updates(self._model, settings.num_envs)
        name = "n_steps" if hasattr(self._model, "rollout_buffer") else "train_freq"
        if between > settings.steps:
            count = settings.num_envs
            raise ConfigError(
                f"{settings.algorithm} learns after every {between} steps ({name}="
                f"{between // count} in {count} environments), more than the {settings.steps} of "
                f"the training: give a smaller {name}, or fewer environments"
            )

    def _tell_of_the_plan(self) -> None:
        settings = self._settings
        self._watch.tell(
            f"{settings.algorithm} learns for up to {settings.steps} steps of {settings.num_envs} "
            f"environments; {settings.episodes * len(settings.held_out)} episodes are played every "
            f"{self._due} steps, and the best agent is kept"
        )

    def close(self) -> None:
        """Close all logs."""
        if self._tracker is not None:
            self._tracker.close()
        if hasattr(self._model, "_logger"):
            self._model.logger.close()

    def _log_to(self) -> None:
        logger = import_module("stable_baselines3.common.logger")
        suffix = f"_from_{self._begin}" if self._begin else ""
        kinds = ["csv", *(["tensorboard"] if find_spec("tensorboard") else [])]
        folder = str(self._settings.folder)
        formats = [logger.make_output_format(kind, folder, suffix) for kind in kinds]
        if self._tracker is not None:
            formats.append(_writer_to(self._tracker, logger.KVWriter))
        self._model.set_logger(logger.Logger(folder=folder, output_formats=formats))

    def _callback(self) -> Any:
        base = import_module("stable_baselines3.common.callbacks").BaseCallback
        methods = {
            "_on_step": lambda callback: self._after_step(),
            "_on_rollout_start": lambda callback: self._between_updates(),
        }
        return type("Callback", (base,), methods)()

    def _after_step(self) -> bool:
        self._watch.advance(self._steps - self._told)
        self._told = self._steps
        if self._steps >= self._progress["next"] and self._has_learned:
            self._progress["next"] = self._steps + self._due - self._steps % self._due
            self.evaluate()
            self._saved_at = -float("inf")  # before the next update
        return True

    @property
    def _has_learned(self) -> bool:
        """Whether the agent has changed since the last evaluation, which would be the same."""
        return bool(self._model._n_updates != self._progress.get("updates"))

    def _between_updates(self) -> None:
        if monotonic() - self._saved_at > _SECONDS_BETWEEN_CHECKPOINTS:
            self._save_checkpoint()
            self._saved_at = monotonic()

    def _save_checkpoint(self) -> None:
        more = {"due": self._due, "progress": dict(self._progress)}
        save_checkpoint(self._settings.folder, self._model, self._venv, more)

    def evaluate(self) -> None:
        """Evaluate the agent, unless that was done at this step."""
        steps = self._steps
        if steps == self._progress["last"]:
            return
        is_first = self._progress["last"] < 0
        scores = self._scores(self._player(), self._wrap)
        mean = sum(score.mean for score in scores) / len(scores)
        self._progress |= {"last": steps, "updates": self._model._n_updates}
        self._watch.tell(f"{steps} steps: reward {mean:.6g} in evaluation")
        warning = warning_of_one_reward(scores) if is_first else None
        if warning is not None:
            self._watch.tell(f"warning: {warning}")
        self._note(steps, mean, scores)
        if mean > self._progress["best"]:
            self._progress["best"] = mean
            self._keep(reward=mean)
        self._watch.evaluated(steps, mean)

    def _player(self) -> Player:
        """Player of the agent as it is now."""
        if self._settings.residual is None:
            make_policy = partial(policy_with, self._model, self._normalization())
            return Player(make_policy, is_physical=False)
        residual = residual_of(self._settings.residual, self._model, self._normalization())
        return Player(partial(policy_of_controller, residual), is_physical=True)

    def scores_of_kept(self) -> list[Score]:
        """Let the agent in the folder play the episodes of the evaluations once more."""
        facts = json.loads((self._settings.folder / AGENT_FILE).read_text(encoding="utf-8"))
        self._watch.tell(f"the agent after {facts['steps']} steps was the best, and is kept")
        return self._scores(agent_player(self._settings.folder), lambda name: lambda env: env)

    def _scores(self, player: Player, wrap: Callable[[str], Wrap]) -> list[Score]:
        settings = self._settings
        seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + settings.episodes)
        return [
            score
            for name, make_env in settings.held_out.items()
            for score in evaluate(
                make_env, {name: player}, seeds, settings.most_steps, wrap=wrap(name)
            )
        ]

    def _wrap(self, name: str) -> Wrap:
        """Make the wrapper of an evaluation's environment."""
        settings = self._settings
        if settings.records is None:
            return lambda env: env
        return settings.records.of_evaluation(settings.folder, self._steps, name)

    def _normalization(self) -> Any:
        return self._venv if hasattr(self._venv, "normalize_obs") else None

    def _note(self, steps: int, mean: float, scores: list[Score]) -> None:
        names = ["steps", "reward", *(score.name for score in scores)]
        append_row(self._settings.folder, names, [steps, mean, *(score.mean for score in scores)])
        if self._tracker is not None:
            each = {f"evaluation/{score.name}": score.mean for score in scores}
            self._tracker.log({"evaluation/reward": mean, **each}, steps)

    def _keep(self, **more: float) -> None:
        (env,) = self._venv.get_attr("unwrapped", 0)
        residual = self._settings.residual
        own = {} if residual is None else {"residual": residual, "space": str(env.action_space)}
        about = {**names_of(env), **own, **more}
        facts = {"algorithm": self._settings.algorithm, "steps": self._steps, **about}
        save(self._settings.folder, self._model, self._normalization(), facts)


def _writer_to(tracker: Tracker, base: Any) -> Any:
    """Make a writer from the log of Stable-Baselines3 to a tracker, of the library's own class."""
    methods = {
        "write": lambda self, values, excluded, step=0: tracker.log(values, step),
        "close": lambda self: None,
    }
    return type("Writer", (base,), methods)()


def _drop_rows(path: Path, steps: int) -> None:
    """Drop the evaluations after a checkpoint: the training makes them again."""
    if path.exists():
        header, *rows = path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [row for row in rows if int(row.partition(",")[0]) <= steps]
        write_whole(path, "".join([header, *kept]).encode())
