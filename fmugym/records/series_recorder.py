"""Recorders: wrappers that write time series while an environment is used."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorWrapper

from fmugym.checks import check_count, check_path, number_of
from fmugym.environment.env import FMUEnv, inner_env
from fmugym.environment.vector import FMUVectorEnv
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.pool.pool import FloatArray, MaskArray, Pool
from fmugym.pool.pool_spec import whole_number_of_steps
from fmugym.records.recorded_quantities import (
    Infos,
    RecordedEnvs,
    RecordedStep,
    RowMaker,
    batched_info,
    choose,
)
from fmugym.records.time_series import MemoryStore, RowStore, TimeSeries, open_store

__all__ = ["RecordSeries", "RecordVectorSeries"]


class _Recorder:
    """Common part of the two recorders.

    Args:
        episodes: The environments.
        variables, environments, every, path, most_rows: See the wrappers.
    """

    def __init__(
        self,
        episodes: RecordedEnvs,
        variables: str | Iterable[str] | None,
        environments: Iterable[int] | None,
        every: float | None,
        path: str | os.PathLike[str] | None,
        most_rows: int,
    ) -> None:
        self.episodes = episodes
        patterns = [variables] if isinstance(variables, str) else variables
        self._choice = choose(episodes.prototype, patterns)
        self._indices = _chosen(environments, episodes.count)
        self._every = _steps_of(every, episodes.prototype.pool_spec.time_step)
        self._path = None if path is None else check_path("the path of a recording", path)
        self._most_rows = check_count("most_rows", most_rows)
        self._memory: MemoryStore | None = None
        self._stores: list[RowStore] = []
        self.has_begun = False

    def begin(self, mask: MaskArray, infos: Infos, observations: Any) -> None:
        """Write down that episodes have begun."""
        self._open(infos)
        self._add(self._rows.begin(mask, infos, observations))

    def _open(self, infos: Infos, steps: Any = None) -> None:
        """Find the columns; in the middle of episodes, these have had so many steps, shape (N,)."""
        if self.has_begun:
            return
        self.has_begun = True
        self._rows = RowMaker(self.episodes, self._choice, self._indices, self._every, infos)
        if steps is not None:
            self._rows.go_on(steps)
        if self._path is not None:
            self._stores.append(open_store(self._path, self._rows.none.columns))
            weakref.finalize(self, self._stores[0].close)
        self._memory = MemoryStore(self._rows.none, self._most_rows)
        self._stores.append(self._memory)

    def add(self, outcome: RecordedStep, idle: MaskArray, steps: Any) -> None:
        """Write down a step, before which episodes had so many steps, shape (N,)."""
        self._open(outcome.infos, steps)
        self._add(self._rows.add(outcome, idle))

    def present(self) -> FloatArray:
        """Present values of the environments; see ``RecordedQuantities.present``."""
        return self._choice.present(self.episodes, self._indices)

    def _add(self, rows: TimeSeries) -> None:
        for store in self._stores if len(rows) else ():
            store.add(rows)

    @property
    def series(self) -> TimeSeries:
        """Time series until now."""
        if self._memory is None:
            raise SimulationError("there is no recording before the first reset")
        rows: TimeSeries = self._memory.rows()
        return rows

    def close(self) -> None:
        """Complete the file; rows that follow are only in memory."""
        for store in self._stores:
            store.close()
        self._stores = self._stores[-1:]


def _chosen(environments: Iterable[int] | None, count: int) -> Any:
    if environments is None:
        return np.arange(count)
    numbers = sorted(set(environments))
    if not numbers or not set(numbers) <= set(range(count)):
        raise ConfigError(f"environments are numbers from 0 to {count - 1}, got {shown(numbers)}")
    return np.array(numbers, np.intp)


def _steps_of(every: float | None, time_step: float) -> int:
    if every is None:
        return 1
    steps = whole_number_of_steps(number_of("every", every), time_step)
    if steps is None or steps < 1:
        raise ConfigError(
            f"every must be a multiple of the time step of {time_step:g} s, got {every:g} s"
        )
    return steps


class _One:
    """A single environment, as ``RecordedEnvs``."""

    is_vector = False

    def __init__(self, env: FMUEnv) -> None:
        self.prototype, self.count = env, 1

    def evaluate(self, function: Callable[[Any], Sequence[Any]], indices: Any) -> FloatArray:
        return np.array(function(self.prototype), np.float64)[:, np.newaxis]

    @property
    def pool(self) -> Pool:
        return self.prototype.pool


class RecordSeries(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Recorder of an environment, which writes one row for each step.

    The first row of an episode is the moment after the reset. Rewards and costs in a row are those
    of the step that led to it.

    Args:
        env: An ``FMUEnv``, or wrappers around one.
        variables: Globs, which choose among the names of the task, all numbers of the FMU
            that the task has no name for, and ``observation.NAME``, what the agent sees of a
            name; ``*`` is any text, ``?`` one character. By default, all names of the task except
            parameters.
        every: The time from one row to the next in seconds, a multiple of the time step; by default
            one step. Rewards and costs in a row are then the sums since the row before. Episodes
            have a last row at their end.
        path: A new file that gets all rows, too: ``.csv``, in which each row is at once, or
            ``.parquet`` (extra ``parquet``), which ``close`` completes.
        most_rows: Rows to keep in memory, for ``series``; earlier ones are dropped.

    Raises:
        ConfigError: If an argument does not fit, there is no ``FMUEnv`` inside, or pyarrow is
            missing.
        FileExistsError: At the first reset, if the file exists.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        variables: str | Iterable[str] | None = None,
        *,
        every: float | None = None,
        path: str | os.PathLike[str] | None = None,
        most_rows: int = 1_000_000,
    ) -> None:
        inner = inner_env(env)
        super().__init__(env)
        self._recorder = _Recorder(_One(inner), variables, None, every, path, most_rows)

    @property
    def series(self) -> TimeSeries:
        """Time series until now.

        Raises:
            SimulationError: Before the first reset.
        """
        return self._recorder.series

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and write its first row; see ``FMUEnv.reset``."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._recorder.begin(np.array([True]), Infos(batched_info(info), 1), _batch(observation))
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Do a step, and write its row; see ``FMUEnv.step``."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        no = np.array([False])
        flags = np.array([terminated]), np.array([truncated])
        infos, seen = Infos(batched_info(info), 1), _batch(observation)
        outcome = RecordedStep(np.array([float(reward)]), *flags, infos, seen)
        self._recorder.add(outcome, no, self._recorder.episodes.prototype.step_count - 1)
        return observation, reward, terminated, truncated, info

    def complete(self) -> None:
        """Complete the file; rows that follow are only in memory."""
        self._recorder.close()

    def close(self) -> None:
        """Complete the file, and close the environment."""
        self.complete()
        super().close()


def _batch(observation: Any) -> Any:
    return observation[np.newaxis] if isinstance(observation, np.ndarray) else observation


class _Many:
    """The environments of a vector environment, as ``RecordedEnvs``."""

    is_vector = True

    def __init__(self, envs: FMUVectorEnv) -> None:
        self._envs, self.prototype, self.count = envs, envs.prototype, envs.num_envs
        self.actions: Any = np.zeros(envs.action_space.shape, envs.action_space.dtype)

    def evaluate(self, function: Callable[[Any], Sequence[Any]], indices: Any) -> FloatArray:
        return self._envs.episodes.evaluate(function, self.actions, indices)

    @property
    def pool(self) -> Pool:
        return self._envs.pool  # also within a step in the background


class RecordVectorSeries(VectorWrapper):
    """Recorder of a vector environment; see ``RecordSeries``.

    In the mode ``SAME_STEP``, an FMU is in its next episode when the step returns. The last row of
    an episode has the values at its end nevertheless: the recorder reads them within the step.

    Args:
        env: An ``FMUVectorEnv``.
        variables, every, path, most_rows: As for ``RecordSeries``.
        environments: The numbers of the environments to write down; by default all.

    Raises:
        ConfigError: As for ``RecordSeries``.
        FileExistsError: At the first reset, if the file exists.
    """

    def __init__(
        self,
        env: FMUVectorEnv,
        variables: str | Iterable[str] | None = None,
        *,
        environments: Iterable[int] | None = None,
        every: float | None = None,
        path: str | os.PathLike[str] | None = None,
        most_rows: int = 1_000_000,
    ) -> None:
        if not isinstance(env, FMUVectorEnv):
            raise ConfigError(f"expected a FMUVectorEnv, got {shown(env)}")
        super().__init__(env)
        self._mode, self._envs = env.autoreset_mode, _Many(env)
        self._ended = np.zeros(env.num_envs, np.bool_)
        self._recorder = _Recorder(self._envs, variables, environments, every, path, most_rows)
        self._at_end: FloatArray | None = None
        self._steps: Any = None
        if self._mode is AutoresetMode.SAME_STEP:
            env.look_at_ends(self._look)

    def _look(self, actions: Any) -> None:
        """Read the values of environments before the next episodes begin."""
        self._envs.actions = np.array(actions)
        self._at_end = self._recorder.present()

    @property
    def series(self) -> TimeSeries:
        """Time series until now.

        Raises:
            SimulationError: Before the first reset.
        """
        return self._recorder.series

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes, and write their first rows; see ``FMUVectorEnv.reset``."""
        observations, infos = self.env.reset(seed=seed, options=options)
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs)), np.bool_)
        self._begin(mask, infos, observations)
        return observations, infos

    def _begin(self, mask: MaskArray, infos: Any, observations: Any) -> None:
        self._envs.actions = self._envs.actions.copy()
        self._envs.actions[mask] = 0
        self._ended = self._ended & ~mask
        self._recorder.begin(mask, Infos(infos, self.num_envs), observations)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments, and write their rows; see ``FMUVectorEnv.step``."""
        self._go_on()
        return self._noted(actions, self.env.step(actions))

    def _go_on(self) -> None:
        """Count the steps of episodes in the middle of which the recording begins."""
        envs: Any = self.env
        if not self._recorder.has_begun and envs.episodes.started:
            everywhere = np.arange(self.num_envs)
            (self._steps,) = self._envs.evaluate(lambda env: (env.step_count,), everywhere)

    def step_async(self, actions: Any) -> None:
        """Begin a step; see ``FMUVectorEnv.step_async``."""
        self._go_on()
        self._pending = np.array(actions)
        self.env.step_async(actions)  # type: ignore[attr-defined]  # it is an FMUVectorEnv

    def step_wait(self, timeout: float | None = None) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Wait for a step, and write its rows; see ``FMUVectorEnv.step_wait``."""
        result = self.env.step_wait(timeout)  # type: ignore[attr-defined]  # as above
        return self._noted(self._pending, result)

    def _noted(self, actions: Any, result: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observations, rewards, terminated, truncated, infos = result
        self._envs.actions = np.array(actions)
        begun, ended, told = self._ended, terminated | truncated, Infos(infos, self.num_envs)
        outcome = RecordedStep(rewards, terminated, truncated, told, observations)
        if same_step := self._mode is AutoresetMode.SAME_STEP and ended.any():
            outcome = outcome._replace(**self._last(infos, observations, ended))
        self._recorder.add(outcome, begun, self._steps)
        begun, self._ended = ended if same_step else begun, ended
        if begun.any():
            self._begin(begun, infos, observations)
        return observations, rewards, terminated, truncated, infos

    def _last(self, infos: Any, observations: Any, ended: MaskArray) -> dict[str, Any]:
        """Last values of ended episodes in the mode SAME_STEP, as ``RecordedStep`` has them."""
        seen = observations
        if isinstance(observations, np.ndarray):
            seen = observations.copy()
            seen[ended] = infos["final_obs"][ended]
        last = Infos(infos, self.num_envs, infos["final_info"], ended)
        return {"infos": last, "observations": seen, "last": self._at_end}

    def close(self, **kwargs: Any) -> None:
        """Complete the file, and close the environments."""
        self._recorder.close()
        super().close(**kwargs)
