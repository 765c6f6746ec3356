"""The search for the numbers of a controller, by many episodes at once."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.baselines.base import Controller, FloatArray
from fmugym.checks import check_count, check_mapping, check_number, check_seed
from fmugym.distributions import LogUniform, Uniform, as_distribution
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.lazy import scipy_module
from fmugym.vector import FMUVectorEnv

__all__ = ["Tuning", "tune"]

_LEAST_CANDIDATES: Final = 8


@dataclass(frozen=True)
class Tuning:
    """What a search has found.

    Attributes:
        controller: The best controller, to be bound.
        parameters: Its numbers by name.
        mean_return: The mean of the total rewards of its episodes.
        returns: The mean return of the best candidate of each round.
    """

    controller: Controller
    parameters: Mapping[str, float]
    mean_return: float
    returns: tuple[float, ...]


def tune(
    make_controller: Callable[..., Controller],
    make_env: Callable[[], Any],
    search: Mapping[str, Any],
    *,
    candidates: int = 32,
    episodes: int = 8,
    rounds: int = 20,
    most_steps: int = 10_000,
    seed: int = 0,
    watch: Callable[[Tuning], None] | None = None,
) -> Tuning:
    """Find the numbers with which a controller gets the largest rewards.

    In each round, all candidates play the same episodes side by side in one vector environment. The
    next candidates come from SciPy's differential evolution (R. Storn and K. Price, Journal of
    Global Optimization 11, 1997). The same arguments give the same result. Needs SciPy (the extra
    ``identification``).

    Args:
        make_controller: Makes a controller from the numbers by keyword, such as
            ``functools.partial(PID, "T", 21.0)``. It gets an array for each number, with one value
            for each environment, as ``PID`` and ``Hysteresis`` take it.
        make_env: A function that makes the environment, or its class.
        search: For each number a ``Uniform`` or a ``LogUniform`` over the values to be tried.
        candidates: The sets of numbers that are tried in each round, at least 8.
        episodes: How many episodes each of them plays. Those of all rounds are the same.
        rounds: The number of rounds.
        most_steps: Steps after which an episode is stopped.
        seed: Of the candidates and of the episodes.
        watch: Gets the best candidate until now after each round.

    Returns:
        The best of all candidates, and how the search went.

    Raises:
        ConfigError: If an argument does not fit.
    """
    for what, value in (("episodes", episodes), ("rounds", rounds), ("most_steps", most_steps)):
        check_count(what, value)
    check_number("candidates", check_count("candidates", candidates), _LEAST_CANDIDATES)
    axes = {name: _Axis(name, given) for name, given in check_mapping("search", search).items()}
    _check_names(make_controller, axes)
    seed = check_seed(seed) or 0
    with closing(FMUVectorEnv(make_env, candidates * episodes)) as envs:
        trials = _Trials(make_controller, envs, axes, episodes, most_steps, seed, watch)
        _search(trials, candidates, rounds, seed)
    return trials.result()


def _check_names(make_controller: Callable[..., Controller], names: Collection[str]) -> None:
    if not names:
        raise ConfigError("search needs the name of at least one number")
    parameters = inspect.signature(make_controller).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    for name in names:
        if name not in parameters:
            raise unknown_name("number in search", name, parameters)


def _search(trials: _Trials, candidates: int, rounds: int, seed: int) -> None:
    """Minimize over the unit cube; the first candidates lie in even layers along each axis."""
    rng = np.random.default_rng(seed)
    shape = candidates, len(trials.axes)
    layers = np.argsort(rng.random(shape), axis=0)
    try:
        scipy_module("optimize").differential_evolution(
            lambda places: -trials.score(places.T),
            bounds=[(0.0, 1.0)] * len(trials.axes),
            init=(layers + rng.random(shape)) / candidates,
            maxiter=rounds - 1,
            seed=seed,
            tol=0.0,
            polish=False,
            vectorized=True,
            updating="deferred",
        )
    except RuntimeError as error:  # SciPy's own, around a TypeError or a ValueError
        raise error.__cause__ or error from None


class _Axis:
    """One number, mapped to 0 to 1."""

    def __init__(self, name: str, given: Any) -> None:
        distribution = as_distribution(f"search[{name!r}]", given)
        if not isinstance(distribution, Uniform | LogUniform):
            raise ConfigError(f"search[{name!r}] must be Uniform or LogUniform, got {shown(given)}")
        self._is_log = isinstance(distribution, LogUniform)
        low, high = distribution.low, distribution.high
        self._low, self._high = (math.log(low), math.log(high)) if self._is_log else (low, high)
        self._limits = low, high

    def values(self, places: FloatArray) -> FloatArray:
        values = self._low + places * (self._high - self._low)
        values = np.exp(values) if self._is_log else values
        return np.clip(values, *self._limits)


class _Trials:
    """Lets candidates play, and remembers the best one."""

    def __init__(
        self,
        make_controller: Callable[..., Controller],
        envs: FMUVectorEnv,
        axes: Mapping[str, _Axis],
        episodes: int,
        most_steps: int,
        seed: int,
        watch: Callable[[Tuning], None] | None,
    ) -> None:
        self._watch = watch
        self._make_controller, self._envs, self.axes = make_controller, envs, axes
        self._episodes, self._most_steps = episodes, most_steps
        self._seeds = [*range(seed, seed + episodes)] * (envs.num_envs // episodes)
        self._best, self._most = np.empty(len(axes)), -math.inf
        self._returns: list[float] = []

    def result(self) -> Tuning:
        """The best candidate until now."""
        numbers = self._numbers(self._best[None])
        parameters = {name: float(values[0]) for name, values in numbers.items()}
        controller = self._make_controller(**parameters)
        return Tuning(controller, parameters, self._most, tuple(self._returns))

    def _numbers(self, places: FloatArray) -> dict[str, FloatArray]:
        """The numbers by name for places of shape (n, k), each of shape (n,)."""
        columns = zip(self.axes.items(), places.T, strict=True)
        return {name: axis.values(column) for (name, axis), column in columns}

    def score(self, places: FloatArray) -> FloatArray:
        """The mean returns of candidates, shape (n,)."""
        each = self._numbers(np.repeat(places, self._episodes, axis=0))
        controller = self._make_controller(**each).bind(self._envs)
        returns: FloatArray = self._play(controller).reshape(-1, self._episodes).mean(axis=1)
        leader = int(returns.argmax())
        self._returns.append(float(returns[leader]))
        if returns[leader] > self._most:
            self._best, self._most = places[leader].copy(), float(returns[leader])
        if self._watch is not None:
            self._watch(self.result())
        return returns

    def _play(self, controller: Controller) -> FloatArray:
        """The total rewards of one episode in each environment."""
        observations, infos = self._envs.reset(seed=self._seeds)
        returns = np.zeros(self._envs.num_envs)
        is_running = np.ones(self._envs.num_envs, dtype=bool)
        for _ in range(self._most_steps):
            actions = controller.act(observations, infos)
            observations, rewards, terminated, truncated, infos = self._envs.step(actions)
            returns += np.where(is_running, rewards, 0.0)
            is_running &= ~(terminated | truncated)
            if not is_running.any():
                break
        return returns
