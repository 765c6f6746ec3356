"""N environments whose hooks run as programs in the native pool's own pass."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.values import LateDict
from fmugym.vector.batch import BatchEngine, StepResult
from fmugym.vector.probe import sample_states
from fmugym.vector.trace import Program, UntraceableError, evaluate, trace_hooks

__all__ = ["CompiledEngine", "find_programs"]

logger = logging.getLogger(__name__)

_FLOAT32, _BOOL = np.dtype(np.float32), np.dtype(np.bool_)
_make_tuple: Any = tuple.__new__  # a third of what a NamedTuple's own constructor takes


def find_programs(env: FMUEnv, required: bool = False) -> tuple[Program, Program] | None:
    """Compile the hooks of an environment and compare them with what they are on arrays.

    Args:
        env: A prototype whose hooks work on arrays.
        required: Whether it is an error if they cannot be compiled.

    Returns:
        The programs for the inputs and for the judgement, or None.

    Raises:
        ConfigError: If they are required and there are none.
    """
    try:
        if not hasattr(env._open_pool("a vector environment"), "prepare_play"):
            raise UntraceableError("the pool is not the native one")
        programs = trace_hooks(env)
        _require_same(env, programs)
    except Exception as reason:  # whatever numbers can do and symbols cannot
        text = f"the hooks of {type(env).__name__} cannot be compiled: {reason}"
        if required:
            raise ConfigError(text) from None
        logger.debug("%s", text)
        return None
    return programs


def _require_same(env: FMUEnv, programs: tuple[Program, Program]) -> None:
    batch = sample_states(env)
    with np.errstate(all="ignore"):
        inputs = np.array(evaluate(programs[0], batch))
        batch.inputs = inputs
        done, truncated, reward = evaluate(programs[1], batch)
        batch.done = done != 0.0
        hooks = (batch._is_done(), batch._is_truncated(), batch._reward_policy())
        expected_inputs = batch._get_inputs()
    for value, expected in zip((done, truncated, reward), hooks, strict=True):
        if not np.array_equal(value, np.broadcast_to(expected, value.shape)):
            raise UntraceableError("the program gives other values than the hooks")
    if not np.array_equal(inputs, np.broadcast_to(expected_inputs, inputs.shape)):
        raise UntraceableError("the program gives other inputs than the hook")


class CompiledEngine(BatchEngine):
    """A ``BatchEngine`` that leaves a step as a whole to the native pool.

    Resets, and steps after parameters were set for single environments or overridden, go the way
    of ``BatchEngine``, whose arrays are the same ones.

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
        plan, streams = env._plan, self._streams
        space: Any = env.action_space
        self._outdated = False
        self._shape = num_envs, env._output_count
        self._names = plan.drawn_names
        rows = [plan.parameter_names.index(name) for name in self._names]
        self._drawn_shape = len(rows), num_envs
        pool: Any = self._pool
        self._stream_version = -1
        self._play = pool.prepare_play(
            plan.model_variables,
            programs,
            (int(space.start), int(space.start + space.n - 1)),
            self._start_values,
            (streams.block, streams.used, *plan.limits, np.array(rows, np.int64)),
            (env.step_count, self.ended, self._limit),
        )
        self._play_with_resets = pool.watched(self._play)

    def reset(
        self, mask: MaskArray, seeds: Sequence[int | None], options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """See ``Engine.reset``."""
        result = super().reset(mask, seeds, options)
        if self._stream_version != self._streams.version:
            pool: Any = self._pool
            pool.set_streams(self._streams.bit_generators())
            self._stream_version = self._streams.version
        return result

    def step(self, actions: Any, resetting: MaskArray | None) -> StepResult:
        """See ``Engine.step``."""
        interpreted = self._outdated or self.given or self._overridden
        if interpreted or self._streams.num_draws is None:
            return super().step(actions, resetting)
        observations = np.empty(self._shape, _FLOAT32)
        rewards = np.empty(self._n)
        terminated, truncated = np.empty(self._n, _BOOL), np.empty(self._n, _BOOL)
        arrays = observations, rewards, terminated, truncated
        drawn = np.empty(self._drawn_shape)
        play = self._play if resetting is None else self._play_with_resets
        try:
            troubled, ended = play(actions, *arrays, drawn)
        except (TypeError, ValueError, BufferError):
            actions = np.ascontiguousarray(self._checked(actions), np.int64)
            troubled, ended = play(actions, *arrays, drawn)
        self.any_ended = ended > 0
        infos: dict[str, Any] = {}
        if resetting is not None:
            told = LateDict.of(self._named, drawn, resetting)  # few ever look at them
            infos = {"drawn": told, "_drawn": resetting}
        result: StepResult = _make_tuple(StepResult, (*arrays, infos))
        if troubled:
            self._mend(actions, result, resetting)
        return result

    def _named(self, drawn: FloatArray, mask: MaskArray) -> dict[str, Any]:
        named = dict(zip(self._names, np.where(mask, drawn, 0.0), strict=True))
        return named | {f"_{name}": mask.copy() for name in named}

    def note_attributes(self) -> None:
        """The programs have the former values in them."""
        self._outdated = True

    def _mend(self, actions: Any, result: StepResult, resetting: MaskArray | None) -> None:
        """Deal with FMUs that failed, or asked to stop: rare, and so left to numpy."""
        statuses = self._pool.statuses
        if resetting is not None:
            self._require_started(np.flatnonzero(resetting), statuses)
        self._require_finite_inputs(resetting)
        stopped = self._stopped(statuses)
        if stopped.any():
            result.terminated[stopped] = True
            self.env.action, self.env.done = self._checked(actions), result.terminated
            result.rewards[stopped] = self._rewards(self.env._reward_policy())[stopped]
        self._take_faults(result, statuses)
        self.note_ends(result.terminated, result.truncated)
