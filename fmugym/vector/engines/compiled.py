"""N environments whose hooks run as programs inside the native pool's step."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.extension import require_refusal
from fmugym.task.readings import Readings, reading
from fmugym.task.values import LateDict
from fmugym.vector.contents import borrowed
from fmugym.vector.engines.base import StepResult
from fmugym.vector.engines.batch import BatchEngine
from fmugym.vector.hooks import results
from fmugym.vector.hooks.check import sample_states
from fmugym.vector.hooks.program import Program, UntraceableError, evaluate, is_always_finite
from fmugym.vector.hooks.trace import trace_hooks
from fmugym.vector.infos import not_finite
from fmugym.vector.streams import given_draws
from fmugym.vector.views import copied

__all__ = ["CompiledEngine", "find_programs"]

logger = logging.getLogger(__name__)

_FLOAT32, _BOOL = np.dtype(np.float32), np.dtype(np.bool_)
_REWARD = 2
"""The index of the reward among the results of the second program."""

_make_tuple: Any = tuple.__new__  # takes a third of the time of a NamedTuple's constructor


def find_programs(env: FMUEnv, required: bool = False) -> tuple[Program, Program] | None:
    """Compile the hooks of an environment, and compare the programs with the hooks on arrays.

    Args:
        env: A prototype whose hooks work on arrays.
        required: Whether hooks that cannot be compiled are an error.

    Returns:
        The program for the inputs and the program for done, truncated and reward; or None.

    Raises:
        ConfigError: If the programs are required, but the hooks cannot be compiled.
    """
    try:
        _require_playable(env)
        programs = trace_hooks(env)
        _require_same(env, sample_states(env), programs)
    except Exception as reason:  # hooks may raise anything
        text = f"the hooks of {type(env).__name__} cannot be compiled: {reason}"
        if required:
            raise ConfigError(text) from None
        logger.debug("%s", text)
        return None
    return programs


def _require_playable(env: FMUEnv) -> None:
    """Refuse environments that the native pool cannot play, whatever their hooks are."""
    if not env._open_pool("a vector environment").can_play:
        raise UntraceableError("the pool is not the native one")


def _require_same(env: FMUEnv, batch: Readings, programs: tuple[Program, Program]) -> None:
    with np.errstate(all="ignore"), borrowed(env):
        batch.inputs = inputs = np.array(evaluate(programs[0], batch))
        done, truncated, reward = evaluate(programs[1], batch)
        batch.done = done != 0.0
        with reading(env, batch):
            hooks = (env._is_done(), env._is_truncated(), env._reward_policy())
            expected_inputs = env._get_inputs()
    for value, expected in zip((done, truncated, reward), hooks, strict=True):
        if not _equal(value, expected):
            raise UntraceableError("the program gives other values than the hooks")
    if not _equal(inputs, expected_inputs):
        raise UntraceableError("the program gives other inputs than the hook")


def _equal(value: FloatArray, expected: Any) -> bool:
    """Whether values are the same to the last bit, NaN included."""
    floats = np.asarray(expected, np.float64)
    return np.array_equal(value, np.broadcast_to(floats, value.shape), equal_nan=True)


class CompiledEngine(BatchEngine):
    """A ``BatchEngine`` in which the native pool does whole steps, hooks included.

    ``BatchEngine`` does the resets, on the same arrays. It also does the steps in two cases:
    while parameters of a running episode are overridden or were set since it began, and if the
    hooks can no longer be compiled after an attribute was set.

    Args:
        env: The prototype, made with a native pool of N instances.
        num_envs: N.
        max_episode_steps: Truncates episodes, in addition to the config's own limit.
        programs: From ``find_programs``.
    """

    def __init__(
        self,
        env: FMUEnv,
        num_envs: int,
        max_episode_steps: int | None,
        programs: tuple[Program, Program],
    ) -> None:
        super().__init__(env, num_envs, max_episode_steps)
        self._shape = num_envs, env._output_count
        self._prepare(programs)

    def _prepare(self, programs: tuple[Program, Program] | None) -> None:
        """Give the pool everything it needs for a step, if it can draw the episodes."""
        plan, streams = self.env._plan, self._streams
        self._programs = programs
        self._prepared = False
        if programs is None:
            return
        space: Any = self.env.action_space
        self._may_overflow = not is_always_finite(programs[1], _REWARD)
        self._names = plan.drawn_names
        self._drawn_shape = len(self._names), self._n
        draws = streams.native_draws(plan)
        self._draws_ahead = draws is None
        self._play = self._pool.prepare_play(
            plan.model_variables,
            programs,
            (int(space.start), int(space.start + space.n - 1)),
            self._start_values,
            (given_draws(plan) if draws is None else draws, streams.states),
            (self.env.step_count, self.ended, self._limit),
        )
        self._play_with_resets = self._pool.watched(self._play)
        self._prepared = True

    def set_parameter(self, name: str, values: FloatArray) -> None:
        """See ``Engine.set_parameter``."""
        super().set_parameter(name, values)
        self._prepare(self._programs)

    def _assign(self, attributes: Mapping[str, tuple[Any, bool]]) -> None:
        """Compile the hooks anew, because the programs contain the old values of the attributes."""
        super()._assign(attributes)
        try:
            if self._columns:
                raise UntraceableError("environments have attributes of their own")
            programs = trace_hooks(self.env)
            _require_same(self.env, copied(Readings.of(self.env)), programs)
        except Exception as reason:  # as in find_programs
            logger.debug("the hooks cannot be compiled any more: %s", reason)
            programs = None
        self._prepare(programs)

    def step(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        """See ``Engine.step``."""
        if self._any_foreign or not self._prepared:
            return super().step(actions, resetting)
        self._longest = self._limit  # this path does not count steps
        if self._may_overflow:
            self._outputs_before = self._pool.outputs.copy()
        observations = np.empty(self._shape, _FLOAT32)
        rewards = np.empty(self._n)
        terminated, truncated = np.empty(self._n, _BOOL), np.empty(self._n, _BOOL)
        arrays = observations, rewards, terminated, truncated
        drawn = np.empty(self._drawn_shape)
        self.has_moved = False
        if resetting is not None and self._draws_ahead:
            actions = self._checked(actions)  # a refused step draws nothing
            drawn[:, resetting] = self._streams.draw(self.env._plan, np.flatnonzero(resetting))
        play = self._play if resetting is None else self._play_with_resets
        try:
            troubled, ended = play(actions, *arrays, drawn)
        except (TypeError, ValueError, BufferError) as error:
            require_refusal(error)
            actions = np.require(self._checked(actions), np.int64, ["C", "A"])
            troubled, ended = play(actions, *arrays, drawn)
        self.has_moved = True
        self.any_ended = ended > 0
        infos: dict[str, Any] = {}
        if resetting is not None:
            told = LateDict.of(_told, self._names, drawn, resetting)  # rarely read
            infos = {"drawn": told, "_drawn": resetting}
        result: StepResult = _make_tuple(StepResult, (*arrays, infos))
        if troubled or (self._may_overflow and not_finite(rewards) is not None):
            self._mend(actions, result, resetting)
        return result

    def _mend(self, actions: Any, result: StepResult, resetting: MaskArray | None) -> None:
        """Handle FMUs that failed or asked to stop: they are rare, so numpy is fast enough."""
        statuses = self._pool.statuses
        if resetting is not None:
            self._require_started(np.flatnonzero(resetting), statuses)
        self._require_finite_inputs(resetting)
        stopped = self._stopped(statuses)
        if stopped.any():
            result.terminated[stopped] = True
            self.env.action, self.env.done = self._checked(actions), result.terminated
            rewards = results.rewards(self.env._reward_policy(), self._n)
            result.rewards[stopped] = rewards[stopped]
        self._handle_faults(result, statuses, True)
        self.note_ends(result.terminated, result.truncated)


def _told(names: list[str], drawn: FloatArray, mask: MaskArray) -> dict[str, Any]:
    named = dict(zip(names, np.where(mask, drawn, 0.0), strict=True))
    return named | {f"_{name}": mask.copy() for name in named}
