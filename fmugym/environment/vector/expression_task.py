"""Task of expressions: their programs run in the pool's step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.environment.actions import checked_actions
from fmugym.environment.construction import draws_of_reset
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode_start import no_draws
from fmugym.environment.forecasts import assumed, future_of
from fmugym.environment.vector.array_episodes import ArrayEpisodes
from fmugym.environment.vector.array_faults import settle_faults
from fmugym.environment.vector.array_results import (
    infos_of_hooks,
    observations_of_hooks,
    require_finite_start,
)
from fmugym.environment.vector.compiled_step import Layout, prepare_step
from fmugym.environment.vector.infos import add_ends, add_starts
from fmugym.environment.vector.task_programs import TaskPrograms
from fmugym.environment.vector.tasks import StepResult, VectorTask
from fmugym.pool.c_extension import require_refusal
from fmugym.pool.licences import require_started
from fmugym.pool.pool import FloatArray, MaskArray, Played
from fmugym.pool.states import IndexArray

__all__ = ["Expressions"]

_REFUSALS = (TypeError, ValueError, BufferError)
"""What the pool raises if it does not take the arguments of a step."""


class Expressions(VectorTask):
    """Task of N environments whose hooks are expressions.

    The pool does a step in one call, programs included. It also starts episodes by itself, unless
    there is something to do that only Python can: see ``_pool_starts``.

    Args:
        env: The prototype, made with a pool of N instances.
        programs: Those of the expressions.
    """

    way = "expressions"
    episodes: ArrayEpisodes

    def __init__(self, env: FMUEnv, programs: TaskPrograms) -> None:
        super().__init__(ArrayEpisodes(env, env._instance.pool))
        self.env, self._n = env, self._pool.num_instances
        self._prepare(programs)

    def rebind(self) -> None:
        """See ``VectorTask.rebind``."""
        self._prepare(self._programs)

    def _prepare(self, programs: TaskPrograms) -> None:
        """Give the pool everything it needs for steps."""
        env, episodes = self.env, self.episodes
        draws, native = env.episode_start, env.episode_start.native
        self._programs = programs
        episodes.hold(programs.variables)
        self._layout = layout = Layout(programs, env, self._n)
        self._play = prepare_step(
            env,
            episodes.arrays,
            programs,
            episodes.start_values,
            (native or no_draws(), draws.drawn if native else (), episodes.streams.states),
            (False, layout.shapes),
        )
        starts, rows = env.config.episode_variables, episodes.arrays.variables
        fit = all(np.shape(start) == rows[n].shape[:-1] for n, start in starts.items())
        is_free = env._warm_ups is None and not self._pool.retries_resets
        self._may_start = self._pool.plays_alone and native is not None and fit and is_free

    @property
    def _pool_starts(self) -> bool:
        """Whether the pool itself starts episodes, in its step or in a reset.

        Python does so where others step the FMUs, where it has to draw values or to set episode
        variables, where something goes with resets, and where constants are not the usual ones.
        """
        return self._may_start and self.episodes.start_as_declared

    # Episodes

    def reset(
        self,
        mask: MaskArray,
        seeds: Sequence[int | None] | None = None,
        options: Mapping[str, Any] = {},
    ) -> tuple[Any, dict[str, Any]]:
        """See ``VectorTask.reset``."""
        self.has_moved = False
        indices, streams = np.flatnonzero(mask), self.episodes.streams
        streams.seed(seeds, indices)
        streams.require_seeds()
        done = None if options else self.start_at_once(mask)
        if done is not None:
            return done
        draws = draws_of_reset(self.env, options, "reset_mask")
        drawn = streams.draw(draws, indices)
        self.has_moved = True
        self.episodes.begin(indices, draws, drawn)
        try:
            observations, infos = self._first(None, mask)
        finally:
            self.episodes.note_starts(mask)
        add_starts(infos, draws, self._of_all(drawn, indices), mask.copy())
        return observations, infos

    def start_at_once(self, mask: Any) -> tuple[Any, dict[str, Any]] | None:
        """See ``VectorTask.start_at_once``."""
        if not self._pool_starts:
            return None
        play: Any = self._play
        self.has_moved = True
        done = play.start(mask)
        if done is None:
            self.has_moved = False
            return None
        troubled, self.episodes.any_ended, seen, mask, drawn = done
        if troubled:
            require_started(self._pool, np.flatnonzero(mask))
        observations, infos = self._first_by_pool(seen, mask, troubled)
        add_starts(infos, self.env.episode_start, drawn, mask)
        return observations, infos

    def _first_by_pool(
        self, seen: Sequence[Any], mask: MaskArray, troubled: int
    ) -> tuple[Any, dict[str, Any]]:
        """The result of a reset by the pool; impossible first observations are refused."""
        observations, infos = self._layout.parts(seen, mask)
        if troubled:
            require_finite_start(observations, mask)
        return observations, infos

    def _first(self, observations: Any, mask: MaskArray) -> tuple[Any, dict[str, Any]]:
        """The observations and infos where episodes have started; refuse impossible starts.

        Args:
            observations: Those that the pool has made; None for those of the hook.
            mask: Where episodes have started.
        """
        if observations is None:
            observations = observations_of_hooks(self.env)
        require_finite_start(observations, mask)
        return observations, infos_of_hooks(self.env, mask)

    @contextmanager
    def assuming(
        self, tables: Mapping[str, FloatArray], offsets: FloatArray | None
    ) -> Iterator[None]:
        """See ``VectorTask.assuming``."""
        own, self.offsets = self._programs, offsets
        try:
            with assumed([future_of(self.env)], tables) as others:
                if others:
                    self._prepare(own.with_tables(others))
                yield
        finally:
            self.offsets = None
            if tables:
                self._prepare(own)

    def observe(self, indices: IndexArray) -> Any:
        """See ``VectorTask.observe``."""
        mask = np.zeros(self._n, np.bool_)
        mask[indices] = True
        return self._first(None, mask)[0]

    # Steps

    def step(self, actions: Any, may_restart: bool = False) -> StepResult:
        """See ``VectorTask.step``; a pool that can does all of it in one call."""
        play: Any = self._play
        any_ended = self.episodes.any_ended
        starts = (any_ended or may_restart) and self._pool_starts
        if play.step is None or self.offsets is not None or (any_ended and not starts):
            return super().step(actions)
        step, at_ends = play.start_and_step if starts else play.step, may_restart and starts
        self.has_moved = True  # unless the call refuses its arguments
        try:
            played: Played = step(actions, at_ends)
        except _REFUSALS as error:
            return self.step(self._converted(actions, error), may_restart)
        return self._completed(played, None)

    def _take_actions(self, actions: Any, idle: MaskArray | None) -> npt.NDArray[Any]:
        """See ``VectorTask._take_actions``; what does not step counts as just started."""
        taken = self._checked(actions, idle)
        self.has_moved = True
        if idle is not None:
            self.episodes.ended[:] = idle
        self._play.before(taken)
        if idle is not None:
            self.episodes.arrays.quantities.step_count[idle] = 0
        return taken

    def _checked(self, actions: Any, idle: MaskArray | None) -> npt.NDArray[Any]:
        """The actions as the pool takes them, before anything is drawn or stepped."""
        self.has_moved = False
        try:
            self._play.check(actions)
        except _REFUSALS as error:
            actions = self._converted(actions, error)
            self._play.check(actions)
        taken: npt.NDArray[Any] = actions
        return taken

    def _converted(self, actions: Any, error: Exception) -> npt.NDArray[Any]:
        """The actions in the form that the pool takes, if it has refused another one."""
        require_refusal(error)
        self.has_moved = False
        converted = self._flat(actions)
        if converted is actions:
            raise error
        return converted

    def _flat(self, actions: Any) -> npt.NDArray[Any]:
        """The actions as the pool takes them, environments first.

        Raises:
            ConfigError: If they do not fit.
        """
        space: Any = self.env.action_space
        array = checked_actions(space, self._n, actions)
        if array.dtype != space.dtype:
            with np.errstate(over="ignore"):  # the action becomes infinite, and so does an input
                array = array.astype(space.dtype)
        return np.ascontiguousarray(array)

    def _start(self, mask: MaskArray) -> dict[str, Any]:
        """See ``VectorTask._start``."""
        draws, indices = self.env.episode_start, np.flatnonzero(mask)
        drawn = self.episodes.streams.draw(draws, indices)
        self.episodes.begin(indices, draws, drawn)
        infos: dict[str, Any] = {}
        add_starts(infos, draws, self._of_all(drawn, indices), mask)
        return infos

    def _of_all(self, drawn: FloatArray, indices: IndexArray) -> FloatArray:
        """Values that some have drawn, shape (draws, M), in an array for all, shape (draws, N)."""
        of_all = np.zeros((len(drawn), self._n))
        of_all[:, indices] = drawn
        return of_all

    def _conclude(self, taken: Any, idle: MaskArray | None, started: Any) -> StepResult:
        """See ``VectorTask._conclude``."""
        result = self._completed(self._play.after(), idle)
        result[-1].update(started or {})
        return result

    def _completed(self, played: Played, idle: MaskArray | None) -> StepResult:
        """The result of a step of the pool, in which faults are settled."""
        troubled, self.episodes.any_ended, rewards, terminated, truncated, seen, starts = played
        layout, started = self._layout, None
        observations, infos = (seen[0], {}) if layout.is_plain else layout.parts(seen)
        if starts is not None:
            started, drawn, last = starts
            self._tell_starts(infos, started, drawn, last)
        result = observations, rewards, terminated, truncated, infos
        if troubled:
            settle_faults(self.episodes, result, troubled, idle if started is None else started)
        return result

    def _tell_starts(
        self,
        infos: dict[str, Any],
        started: MaskArray,
        drawn: FloatArray,
        last: Sequence[Any] | None,
    ) -> None:
        """Add the infos of episodes that have started in a step of the pool; see ``Play.step``."""
        add_starts(infos, self.env.episode_start, drawn, started)
        if last is not None:
            observations, told = self._layout.parts(last, started)
            add_ends(infos, observations, told, started)
