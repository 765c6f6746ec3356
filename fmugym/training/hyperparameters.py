"""Tuning of hyperparameters of an algorithm, with Optuna."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

from fmugym.errors import ConfigError, FMUGymError
from fmugym.extras import imported
from fmugym.training.agents import algorithm_of
from fmugym.training.sb3_training import TRIALS, TrainingSettings, Watch, require_new, train
from fmugym.training.training_records import append_row

__all__ = ["tune_hyperparameters"]

_FACTORS: Final = (0.25, 0.5, 1, 2, 4)
_COUNTS: Final = ("n_steps", "batch_size", "n_epochs", "train_freq")
"""Arguments that are tried at multiples of their default."""

_CHOICES: Final[Mapping[str, tuple[float, ...]]] = {
    "gamma": (0.9, 0.95, 0.98, 0.99, 0.995, 0.999),
    "gae_lambda": (0.8, 0.9, 0.95, 0.98, 1.0),
    "clip_range": (0.1, 0.2, 0.3),
    "tau": (0.001, 0.005, 0.02, 0.05),
}
_WIDTHS: Final = (32, 64, 128, 256)
"""Widths of the two hidden layers."""

_SMALLEST_ENTROPY: Final = 1e-6
_LARGEST_ENTROPY: Final = 0.05
_PARTS: Final = 4
"""A trial has at least so many updates."""


def tune_hyperparameters(
    settings: TrainingSettings, trials: int, steps: int, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Try arguments of the algorithm in short trainings.

    The sampler is Optuna's tree-structured Parzen estimator, seeded as the settings say. A trial
    that is below the median of those before it is stopped early. Each trial is in a folder of its
    own, ``trials/000`` and so on, and in a line of ``trials.csv``.

    Args:
        settings: Settings of the training. Arguments that it has are not searched for.
        trials: How many to make.
        steps: The steps of a trial.
        tell: Gets a line of text for each trial.

    Returns:
        The arguments of the best trial, those of the settings included.

    Raises:
        ConfigError: If Optuna is missing, or no trial has come to its end.
        FileExistsError: If the folder of the settings exists.
    """
    optuna: Any = imported("optuna", "tune")
    require_new(settings.folder / TRIALS)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=settings.seed),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=3),
    )
    objective = partial(_best_reward, settings, steps, optuna.TrialPruned)

    def tell_of(_: Any, trial: Any) -> None:
        _note(settings, trial)
        reward = "" if trial.value is None else f", reward {trial.value:.6g}"
        tell(f"trial {trial.number}: {trial.state.name.lower()}{reward}")

    study.optimize(objective, n_trials=trials, callbacks=[tell_of], catch=(FMUGymError, ValueError))
    complete = [trial for trial in study.trials if trial.value is not None]
    if not complete:
        raise ConfigError(f"none of {trials} trials has come to its end; see trials.csv")
    best = max(complete, key=lambda trial: trial.value)
    return dict(best.user_attrs["arguments"])


def _best_reward(
    settings: TrainingSettings, steps: int, pruned: type[Exception], trial: Any
) -> float:
    """Make a trial; returns the mean reward of its best evaluation."""
    arguments = {**_suggested(trial, settings, steps), **(settings.arguments or {})}
    trial.set_user_attr("arguments", arguments)
    rewards: list[float] = []

    def evaluated(_: int, mean: float) -> None:
        rewards.append(mean)
        trial.report(mean, len(rewards))
        if trial.should_prune():
            raise pruned

    folder = settings.folder / TRIALS / f"{trial.number:03}"
    own = replace(settings, folder=folder, steps=steps, arguments=arguments, records=None)
    train(own, watch=Watch(evaluated=evaluated))
    return max(rewards)


def _suggested(trial: Any, settings: TrainingSettings, steps: int) -> dict[str, Any]:
    """Suggest arguments for a trial that the algorithm has and the settings do not give."""
    given = settings.arguments or {}
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(
            algorithm_of(settings.algorithm)
        ).parameters.items()
        if name not in given
    }
    found: dict[str, Any] = {}
    rate = defaults.get("learning_rate")
    if isinstance(rate, float):
        found["learning_rate"] = trial.suggest_float(
            "learning_rate", rate / 10, rate * 10, log=True
        )
    for name in _COUNTS:
        if type(defaults.get(name)) is int:
            most = _most(name, settings, steps)
            counts = {min(most, max(1, math.ceil(defaults[name] * f))) for f in _FACTORS}
            found[name] = trial.suggest_categorical(name, sorted(counts))
    for name, values in _CHOICES.items():
        if isinstance(defaults.get(name), float):
            found[name] = trial.suggest_categorical(name, values)
    if isinstance(defaults.get("ent_coef"), float):
        limits = _SMALLEST_ENTROPY, _LARGEST_ENTROPY
        found["ent_coef"] = trial.suggest_float("ent_coef", *limits, log=True)
    if "policy_kwargs" in defaults:
        width = trial.suggest_categorical("width", _WIDTHS)
        found["policy_kwargs"] = {"net_arch": [width, width]}
    return found


def _most(name: str, settings: TrainingSettings, steps: int) -> int:
    """The largest count with which a trial has some updates."""
    most = steps // _PARTS // (settings.num_envs if name == "n_steps" else 1)
    return 1 << max(3, most.bit_length() - 1)  # so that batches divide what was collected


def _note(settings: TrainingSettings, trial: Any) -> None:
    """Write a line about a trial."""
    arguments = json.dumps(trial.user_attrs.get("arguments", {}))
    row = [trial.number, trial.state.name.lower(), trial.value, arguments]
    settings.folder.mkdir(parents=True, exist_ok=True)
    append_row(settings.folder, ("trial", "state", "reward", "arguments"), row, f"{TRIALS}.csv")
