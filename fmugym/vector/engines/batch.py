"""N environments whose hooks run as programs in the pool's step."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from math import isfinite
from types import MappingProxyType, MethodType
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.texts import texts_at
from fmugym.archive.variable import checked_value
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.fmi.status import TERMINATED_CODE
from fmugym.pool.base import FloatArray, MaskArray, Played
from fmugym.pool.bundle import IndexArray
from fmugym.pool.extension import require_refusal
from fmugym.pool.health import fault_rates
from fmugym.pool.licences import require_started
from fmugym.task import judging
from fmugym.task import spaces as fmu_spaces
from fmugym.task.beginning import Beginning
from fmugym.task.construction import draws_of, draws_of_reset
from fmugym.task.episode import Episode, standing_in
from fmugym.task.episode_start import EpisodeStart, EpisodeValues
from fmugym.task.future import assumed, future_of
from fmugym.task.native_draws import no_draws
from fmugym.task.plain import put_back
from fmugym.task.saving import note_attributes
from fmugym.task.snapshot import Columns
from fmugym.task.values import ParameterValues, ShownParameters
from fmugym.vector.action_arrays import array_of, checked_actions
from fmugym.vector.attributes import require_settable
from fmugym.vector.codec import coded, with_masks
from fmugym.vector.column import PoolColumn
from fmugym.vector.engines.engine import Engine, StepResult, attribute, failed_in
from fmugym.vector.engines.layout import Layout
from fmugym.vector.hooks import hook_results
from fmugym.vector.hooks.memory import StepArrays
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.infos import copy_rows, drawn_info, late_info, observation_of, rows_not_finite
from fmugym.vector.streams import EpisodeStreams
from fmugym.vector.vector_saving import (
    batch_columns,
    place_batch,
    place_column,
    require_fit,
    which_of,
)
from fmugym.vector.views import EpisodeColumn, batched, keep_rows, some, start_numbers, take

__all__ = ["BatchEngine"]

_REFUSALS = (TypeError, ValueError, BufferError)
"""What the pool raises if it does not take the arguments of a step."""


class BatchEngine(Engine):
    """N environments of one prototype, whose hooks read arrays; here, these are programs.

    The pool does a step in one call, programs included. It also starts episodes by itself, unless
    there is something to do that only Python can: see ``_settle_starts``.

    Args:
        env: The prototype, made with a pool of N instances.
        num_envs: N.
        max_episode_steps: Truncates episodes, in addition to the config's own limit.
        task: Its programs.
    """

    way = "expressions"

    def __init__(
        self, env: FMUEnv, num_envs: int, max_episode_steps: int | None, task: TaskPrograms
    ) -> None:
        super().__init__(env._instance.pool)
        self.env = env
        self._n = num_envs
        self._streams = EpisodeStreams(num_envs)
        self._limit = min(env.step_limit, max_episode_steps or sys.maxsize)
        self._foreign, self._any_foreign = np.zeros(num_envs, np.bool_), False
        self._variable_starts: dict[str, FloatArray] = {}
        env._episode = batched(env, num_envs, self._pool)
        env._was_reset = True  # for the calls on single environments
        self._columns: dict[str, npt.NDArray[Any]] = {}
        self._given: dict[str, npt.NDArray[Any]] = {}
        self._strings = env.fmu.description.strings
        self._make_parameters(env.episode_start)
        self._memory = StepArrays(env, env._episode, self.ended)
        self._prepare(task)
        self._note_foreign(slice(None), False)

    def _make_parameters(self, draws: EpisodeStart) -> None:
        self._start_values = np.repeat(draws.constants[:, None], self._n, axis=1)
        self._parameters = ParameterValues(
            zip(draws.parameter_names, self._start_values, strict=True)
        )
        self._texts = {name: self._with_own(texts) for name, texts in draws.strings.items()}
        shown = ShownParameters(self._parameters, self._texts)
        self.env.parameters = MappingProxyType(shown if self._strings else self._parameters)

    def _with_own(self, texts: Sequence[str]) -> npt.NDArray[np.object_]:
        """The texts that a String draws from, and a place for an own one of each environment."""
        return np.array([*texts, *[None] * self._n], object)

    def _prepare(self, task: TaskPrograms) -> None:
        """Give the pool everything it needs for steps."""
        env, memory = self.env, self._memory
        draws, native = env.episode_start, env.episode_start.native
        drawn = () if native is None else draws.drawn
        self._task = task
        memory.parameters = self._parameters
        memory.hold(task)
        self._layout = layout = Layout(task, env, self._n)
        self._play = memory.prepare(
            self._pool,
            task,
            self._start_values,
            (no_draws() if native is None else native, drawn, self._streams.states),
            self._limit,
            (StepResult, *layout.form, layout.shapes, late_info(draws)),
        )
        starts, rows = env.config.episode_variables, memory.variables
        fit = all(np.shape(start) == rows[n].shape[:-1] for n, start in starts.items())
        has_all_starts = native is not None and fit
        is_free = env._warm_ups is None and not self._pool.retries_resets
        self._may_start = self._pool.plays_alone and has_all_starts and is_free
        self._settle_starts()

    def _settle_starts(self) -> None:
        """Decide whether the pool itself starts episodes, in its step or in a reset.

        Python does so where others step the FMUs, where it has to draw values or to set episode
        variables, where something goes with resets, and where constants are not the usual ones.
        """
        is_usual = not self._any_foreign and not self._variable_starts
        self._pool_starts = self._may_start and is_usual
        self._starts_at_ends = self._pool_starts

    def set_variable(self, name: str, values: FloatArray) -> None:
        """See ``Engine.set_variable``."""
        self._place({name: values}, slice(None))
        self._variable_starts[name] = values
        self._settle_starts()

    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """See ``Engine.set_parameter``."""
        env, before = self.env, self.env.parameters
        env.interface = env.interface.with_parameter(name, values, 0)
        variable = env.interface.parameter_variables[name]
        self._given[name] = np.array([checked_value(variable, one) for one in values.tolist()])
        env.episode_start = draws_of(env)
        self._make_parameters(env.episode_start)
        for known in before.keys() & self._parameters.keys():
            self._place_parameter(known, before[known], slice(None))
        self._prepare(self._task)
        self._note_foreign(slice(None), True)

    def seed_of(self, index: int) -> int | None:
        """See ``Engine.seed_of``."""
        return self._streams.seed_of(index)

    def close(self) -> None:
        """See ``Engine.close``."""
        self.env.close()

    @contextmanager
    def single(self, index: int) -> Iterator[FMUEnv]:
        """See ``Engine.single``; the prototype stands in for the environment."""
        env = self.env
        own = {name: take(row, index) for name, row in self._columns.items()}
        with standing_in(env, EpisodeColumn(env._episode, index)):
            try:
                _set_all(env, own)
                env._instance.pool = PoolColumn(self._pool, index)
                yield env
            finally:
                _set_all(env, self._columns)
                env._instance.pool = self._pool

    def read(self, name: str, index: int) -> Any:
        """See ``Engine.read``; a method that is called later reads the values of that moment."""
        value = super().read(name, index)
        if isinstance(value, MethodType) and value.__self__ is self.env:
            return partial(self._call_one, name, index)
        return value

    def _call_one(self, name: str, index: int, *arguments: Any, **keywords: Any) -> Any:
        return self.call(name, [index], arguments, keywords)[0]

    def set_attribute(self, name: str, values: Mapping[int, Any]) -> None:
        """See ``Engine.set_attribute``; values may only differ if they are numbers."""
        self._assign({name: self._of_all(name, values)})

    def _of_all(self, name: str, values: Mapping[int, Any]) -> tuple[Any, bool]:
        """The value for all environments, and whether it is an array with one for each."""
        if len(values) < self._n:
            present = {i: self.read(name, i) for i in range(self._n)}
            values = {**present, **values}
        each = [values[index] for index in range(self._n)]
        if all(value is each[0] for value in each):
            return each[0], False
        return _row_of(name, each), True

    def _assign(self, attributes: Mapping[str, tuple[Any, bool]]) -> None:
        for name, (value, is_row) in attributes.items():
            setattr(self.env, name, value)
            self._columns.pop(name, None)
            if is_row:
                self._columns[name] = value
        note_attributes(self.env)

    def call(
        self,
        name: str,
        indices: Sequence[int],
        arguments: Sequence[Any],
        keywords: Mapping[str, Any],
    ) -> list[Any]:
        """See ``Engine.call``."""
        before = {variable: row.copy() for variable, row in self._memory.variables.items()}
        returned, assigned = [], defaultdict[str, dict[int, Any]](dict)
        try:
            for index in indices:
                with self.single(index) as env:
                    result, attributes = _called(env, name, arguments, keywords)
                returned.append(result)
                for own, value in attributes.items():
                    assigned[own][index] = value
            self._assign({own: self._of_all(own, values) for own, values in assigned.items()})
        except BaseException:
            for variable, row in before.items():
                self._memory.variables[variable][...] = row
            raise
        return returned

    def evaluate(
        self, function: Callable[[Any], Sequence[Any]], actions: Any, indices: IndexArray
    ) -> FloatArray:
        """See ``Engine.evaluate``."""
        env = self.env
        latest = env._episode.replaced(action=np.moveaxis(np.asarray(actions), 0, -1))
        with standing_in(env, some(latest, indices)):
            rows = function(env)
        return np.array([np.broadcast_to(row, len(indices)) for row in rows], np.float64)

    def _note_foreign(self, indices: IndexArray | slice, foreign: bool) -> None:
        """Note which environments have other constants: from options, or from before."""
        self._foreign[indices] = foreign
        self._any_foreign = bool(self._foreign.any())
        self._settle_starts()

    # Episodes.

    def reset(
        self, mask: MaskArray, seeds: Sequence[int | None] | None, options: Mapping[str, Any]
    ) -> tuple[Any, dict[str, Any]]:
        """See ``Engine.reset``."""
        self.has_moved = False
        indices = np.flatnonzero(mask)
        self._streams.seed(seeds, indices)
        self._streams.require_seeds()
        started = None if options else self.reset_by({"reset_mask": mask})
        if started is not None:
            return started
        draws = draws_of_reset(self.env, options, "reset_mask")
        drawn = self._streams.draw(draws, indices)
        self._begin(indices, draws, drawn)
        try:
            observations, infos = self._seen_at_start(None, mask)
        finally:
            self.note_starts(mask)
        return observations, infos | drawn_info(draws, drawn, mask.copy())

    def reset_by(self, options: Any) -> tuple[Any, dict[str, Any]] | None:
        """See ``Engine.reset_by``."""
        if not self._pool_starts or self._play.reset is None:
            return None
        try:
            done = self._play.reset(options)
        except BaseException:
            self.has_moved = True
            raise
        if done is None:
            return None
        (observations, infos), troubled, self.any_ended = done
        if troubled:
            self.has_moved = True
            require_started(self._pool, np.flatnonzero(infos["_drawn"]))
        return self._begun(observations, infos, troubled)

    def _begun(
        self, observations: Any, infos: dict[str, Any], troubled: int
    ) -> tuple[Any, dict[str, Any]]:
        """The result of a reset by the pool; impossible first observations are refused."""
        if troubled:
            self._require_finite_start(observations, infos["_drawn"])
        return observations, infos

    def _seen_at_start(self, observations: Any, mask: MaskArray) -> tuple[Any, dict[str, Any]]:
        """The observations and infos where episodes have started; refuse impossible starts.

        Args:
            observations: Those that the pool has made; None for those of the hook.
            mask: Where episodes have started.
        """
        if observations is None:
            observations = self._observe()
        self._require_finite_start(observations, mask)
        return observations, self._infos(mask)

    def _require_finite_start(self, observations: Any, mask: MaskArray) -> None:
        wrong = rows_not_finite(observations)
        if wrong is not None and (wrong & mask).any():
            index = int(np.flatnonzero(wrong & mask)[0])
            first = shown(observation_of(observations, index))
            raise SimulationError(
                f"environment {index}: the first observation is not finite: {first}"
            )

    def _begin(self, indices: IndexArray, draws: EpisodeStart, drawn: FloatArray) -> None:
        """Start episodes with values that were drawn, shape (draws, M)."""
        self._place_episodes(indices, draws, drawn)
        self.has_moved = True
        rows = {name: self._parameters[name] for name in draws.parameter_names}
        for name, numbers in self._numbers_of_told_texts(draws, drawn).items():
            rows[name] = np.zeros(self._n)
            rows[name][indices] = numbers
        values = np.array([*rows.values()]).reshape(len(rows), self._n)
        _Beginning(self, draws, EpisodeValues(values, rows, {}, {}), indices).begin()

    def _place_episodes(self, indices: IndexArray, draws: EpisodeStart, drawn: FloatArray) -> None:
        """Write the values of episodes into the rows of the parameters and variables."""
        constants = draws.constant_parameters
        self._place(draws.variable_starts | constants | draws.named(drawn), indices)
        for name, values in self._variable_starts.items():
            self._place({name: values[..., indices]}, indices)
        own = constants.keys() - draws.told.keys()
        self._place({n: row[indices] for n, row in self._given.items() if n in own}, indices)
        for name, numbers in self._numbers_of_told_texts(draws, drawn).items():
            self._place_parameter(name, texts_at(draws.strings[name], numbers), indices)
        self._note_foreign(indices, draws is not self.env.episode_start)

    def _numbers_of_told_texts(self, draws: EpisodeStart, drawn: FloatArray) -> dict[str, Any]:
        """Strings from options: places among the texts that only these draws know."""
        told = draws.strings.keys() & draws.told.keys()
        numbers = draws.constant_parameters | draws.named(drawn) if told else {}
        return {name: numbers[name] for name in told}

    def _place_parameter(self, name: str, values: Any, indices: IndexArray | slice) -> None:
        """Write values of a parameter as hooks read them."""
        row = self._row(name)
        if name not in self._strings:
            row[indices] = values
            return
        texts, where = self._texts.setdefault(name, self._with_own(())), np.arange(self._n)[indices]
        count, each = len(texts) - self._n, np.broadcast_to(np.asarray(values, object), where.shape)
        known = {text: place for place, text in enumerate(texts[:count].tolist())}
        for index, text in zip(where.tolist(), each, strict=True):
            texts[count + index] = text
            row[index] = known.get(text, count + index)

    def _place(self, values: Mapping[str, Any], indices: IndexArray | slice) -> None:
        for name, value in values.items():
            self._row(name)[..., indices] = value

    def _row(self, name: str) -> FloatArray:
        """The values of a parameter or an episode variable, one for each environment."""
        variables = self.env.variables
        if name in variables:
            row: FloatArray = variables[name]
            if type(row) is not np.ndarray or row.shape[-1:] != (self._n,):
                row = variables[name] = hook_results.variable(name, row, self._n)
        else:
            known = self._parameters.get(name)
            row = np.full(self._n, np.nan) if known is None else known
            self._parameters[name] = row
        return row

    # Snapshots.

    def columns(self, indices: IndexArray) -> Columns:
        """See ``Engine.columns``."""
        which = which_of(indices, self._n)
        return batch_columns(self.env, which) | {
            "ended": np.array(self.ended[which]),
            **dict(zip(("streams", "seeds"), self._streams.taken(which), strict=True)),
        }

    def place(self, columns: Columns, sources: IndexArray, indices: IndexArray) -> None:
        """See ``Engine.place``."""
        whence = which_of(sources, len(columns["step_count"]))
        where = which_of(indices, self._n)
        place_batch(self.env, columns, whence, where)
        for name, values in (columns["parameters"] | columns["variables"]).items():
            if name in self._strings:
                self._place_parameter(name, np.array(values, object)[whence], where)
            else:
                place_column(self._row(name), values, whence, where)
        if isinstance(columns["streams"], np.ndarray):
            seeds = np.array(columns["seeds"], object)[whence]
            self._streams.put(where, columns["streams"][whence], seeds)
        self._streams.require_seeds()
        self.ended[where] = columns["ended"][whence]
        self.any_ended = bool(np.count_nonzero(self.ended))
        self._note_foreign(indices, self._has_other_constants(columns["parameters"]))

    def _has_other_constants(self, columns: Mapping[str, Any]) -> bool:
        """Whether parameters that are placed are not all the usual ones."""
        draws = self.env.episode_start
        own = all(
            (np.asarray(columns[name]) == value).all()
            for name, value in draws.constants_shown.items()
            if name in columns
        )
        return not own or not columns.keys() <= set(draws.parameter_names)

    @contextmanager
    def assuming(
        self, tables: Mapping[str, FloatArray], offsets: FloatArray | None
    ) -> Iterator[None]:
        """See ``Engine.assuming``."""
        own, self.offsets = self._task, offsets
        try:
            with assumed([future_of(self.env)], tables) as others:
                if others:
                    self._prepare(own.with_tables(others))
                yield
        finally:
            self.offsets = None
            if tables:
                self._prepare(own)

    def show(self, variables: Mapping[str, float], parameters: Mapping[str, FloatArray]) -> None:
        """See ``Engine.show``."""
        self._place({**variables, **parameters}, slice(None))
        if parameters:
            self._note_foreign(slice(None), True)

    def require_fit(self, columns: Columns) -> None:
        """See ``Engine.require_fit``."""
        require_fit(columns)

    def observe(self, indices: IndexArray) -> Any:
        """See ``Engine.observe``."""
        mask = np.zeros(self._n, np.bool_)
        mask[indices] = True
        return self._seen_at_start(None, mask)[0]

    # Steps.

    def step(
        self, actions: Any, resetting: MaskArray | None, resting: MaskArray | None = None
    ) -> StepResult:
        """See ``Engine.step``; a native pool does the same in one call where it can."""
        is_usual = resting is None and self.offsets is None
        can_start = resetting is None or self._pool_starts
        if self._play.step is None or not (is_usual and can_start):
            return super().step(actions, resetting, resting)
        return self._completed(self._play_step(actions, resetting), resetting)

    def _play_step(self, actions: Any, resetting: MaskArray | None) -> Played:
        """Let the pool do the whole step."""
        at_ends = self.starts_at_ends and self._starts_at_ends
        play: Any = self._play
        step = play.step if resetting is None and not at_ends else play.start_and_step
        self.has_moved = True  # unless the call refuses its arguments
        try:
            played: Played = step(actions, at_ends)
            return played
        except _REFUSALS as error:
            return self._play_step(self._converted(actions, error), resetting)

    def _take_actions(self, actions: Any, idle: MaskArray | None) -> npt.NDArray[Any]:
        """See ``Engine._take_actions``; what does not step counts as just started."""
        taken = self._checked(actions, idle)
        self.has_moved = True
        if idle is not None:
            self.ended[:] = idle
        self._play.before(taken)
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

    def _start(self, mask: MaskArray) -> dict[str, Any]:
        """See ``Engine._start``."""
        draws, indices = self.env.episode_start, np.flatnonzero(mask)
        drawn = self._streams.draw(draws, indices)
        self._begin(indices, draws, drawn)
        return drawn_info(draws, drawn, mask)

    def _conclude(self, taken: Any, idle: MaskArray | None, started: Any) -> StepResult:
        """See ``Engine._conclude``."""
        result, troubled, any_ended, _ = self._play.after(taken)
        result.infos.update(started or {})
        return self._completed((result, troubled, any_ended, idle), idle)

    def _converted(self, actions: Any, error: Exception) -> npt.NDArray[Any]:
        """The actions in the form that the pool takes, if it has refused another one."""
        require_refusal(error)
        self.has_moved = False
        converted = self._flat(actions)
        if converted is actions:
            raise error
        return converted

    def _completed(self, played: Played, idle: MaskArray | None) -> StepResult:
        """The result of a step of the pool, in which faults are settled."""
        result: StepResult
        result, troubled, self.any_ended, started = played
        if troubled:
            self._settle(result, troubled, idle if started is None else started)
        return result

    def _settle(self, result: StepResult, troubled: int, started: MaskArray | None) -> None:
        """Find numbers that are not finite, and handle them and failures."""
        rewards = rows_not_finite(result.rewards)
        is_told = self.env._conversions.pool_observes and not troubled
        observations = None if is_told else rows_not_finite(result.observations)
        if troubled or rewards is not None or observations is not None:
            self._mend(result, started, (rewards, observations))

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

    def _write_inputs(self, inputs: FloatArray, resetting: MaskArray | None) -> None:
        hook_results.write_inputs(self.env._get_inputs(), inputs)
        if not self.env._conversions.input_writer.all_real:
            for index in self._stepping(resetting):
                inputs[:, index] = fmu_spaces.to_input_types(
                    self.env.interface.inputs, inputs[:, index]
                )
        self._require_finite(inputs, resetting)

    def _stepping(self, resetting: MaskArray | None) -> list[int]:
        """The indices of the environments that do not start an episode in this step."""
        return [i for i in range(self._n) if resetting is None or not resetting[i]]

    def _require_finite(self, inputs: FloatArray, resetting: MaskArray | None) -> None:
        if isfinite(np.vdot(inputs, inputs)):  # half the time of what follows
            return
        finite = np.isfinite(inputs)
        for index in self._stepping(resetting):
            if not finite[:, index].all():
                raise ConfigError(
                    f"an input of environment {index} is not finite: {inputs[:, index]}"
                )

    def _restore_variables(self, mask: MaskArray) -> None:
        for name, values in self._memory.before.items():
            hook_results.restore_variable(name, self._row(name), mask, values)

    def _observe(self) -> Any:
        env = self.env
        return hook_results.observations(env._get_observation(), env.observation_space, self._n)

    def _infos(self, mask: MaskArray) -> dict[str, Any]:
        if not self.env._conversions.has_info:
            return {}
        infos = hook_results.info_arrays(self.env._get_info(), mask)
        if self.env._instance.tells:
            infos |= hook_results.info_arrays(self._pool.info(), mask)
        return infos

    def _mend(
        self,
        result: StepResult,
        started: MaskArray | None,
        wrong: tuple[MaskArray | None, MaskArray | None],
    ) -> None:
        """Handle failures and numbers that are not finite: rare, so numpy is fast enough.

        Args:
            result: Of the step; it is corrected.
            started: Which environments have started an episode in this step.
            wrong: Where rewards and observations are not finite.
        """
        if started is not None:
            require_started(self._pool, np.flatnonzero(started))
            self._require_finite_start(result.observations, started)
        self._require_possible_inputs(started)
        self._handle_faults(result, wrong)
        self.note_ends(result.terminated, result.truncated)
        if started is not None:
            self.note_starts(started)

    def _require_possible_inputs(self, resetting: MaskArray | None) -> None:
        """Refuse inputs that are not finite, which they also are outside of their type's range."""
        inputs = self._pool.inputs
        if not self.env._conversions.input_writer.all_real and not np.isfinite(inputs).all():
            self._write_inputs(np.array(inputs), resetting)
        self._require_finite(inputs, resetting)

    def _handle_faults(
        self,
        result: StepResult,
        wrong: tuple[MaskArray | None, MaskArray | None],
    ) -> None:
        """Handle FMUs that failed or asked to stop, and numbers that are not finite."""
        statuses = self._pool.statuses
        stopped, failed = statuses == TERMINATED_CODE, failed_in(statuses)
        if stopped.any():
            result.infos.update(with_masks({"fmu_terminated": stopped}, stopped))
        reasons = {index: self._pool.failure(index) for index in np.flatnonzero(failed).tolist()}
        for rows in wrong:
            for index in _indices(rows, ~failed):
                reasons[index] = self._not_finite(result, index)
        if reasons:
            self._end_with_faults(result, dict(sorted(reasons.items())), failed)

    def _not_finite(self, result: StepResult, index: int) -> str:
        observation = observation_of(result.observations, index)
        with self.single(index) as env:
            return judging.not_finite(env, result.rewards[index], observation)

    def _end_with_faults(
        self, result: StepResult, reasons: Mapping[int, str], failed: MaskArray
    ) -> None:
        """End the episodes of some environments, in the state before the step."""
        env, config = self.env, self.env.config
        faulty = np.zeros(self._n, np.bool_)
        faulty[list(reasons)] = True
        if config.on_fault == "raise":
            index, reason = next(iter(reasons.items()))
            raise SimulationError(f"environment {index}: {reason}")
        for index, reason in reasons.items():
            env.logger.warning("environment %d: %s", index, reason)
        env.done[faulty] = config.on_fault == "terminate"
        undone = faulty & ~failed
        if undone.any():
            self._undo(undone)
        if undone.any() or env._conversions.has_info or not env._conversions.pool_observes:
            self._see_again(result, faulty, reasons)
        texts = np.full(self._n, None, dtype=object)
        texts[faulty] = list(reasons.values())
        rates = fault_rates(self._pool.health())
        result.infos.update(coded({"fault": texts, "fault_rate": rates}, faulty))
        result.rewards[faulty] = hook_results.rewards(env._fault_reward(), self._n)[faulty]
        result.terminated[faulty] = config.on_fault == "terminate"
        result.truncated[faulty] = config.on_fault == "truncate"

    def _undo(self, mask: MaskArray) -> None:
        """Return environments to the state before a step whose numbers are not finite."""
        self._pool.outputs[:, mask] = self._memory.kept[:, mask]
        if self.env._own_hooks.update:
            self._restore_variables(mask)
        for index in np.flatnonzero(mask).tolist():
            self._pool.note_fault(index)
        self._pool.halt()

    def _see_again(self, result: StepResult, mask: MaskArray, reasons: Mapping[int, str]) -> None:
        """Observe environments in the state before a step, with ``done`` of their fault."""
        again = self._observe()
        for index in _indices(rows_not_finite(again), mask):
            before = shown(observation_of(again, index))
            raise SimulationError(
                f"environment {index}: {reasons[index]}; before it the observation is {before}"
            )
        copy_rows(again, result.observations, mask)
        if self.env._conversions.has_info:
            infos = self._infos(np.ones(self._n, np.bool_))
            copy_rows(infos, {name: result.infos[name] for name in infos}, mask)


class _Beginning(Beginning):
    """Episodes that begin in some environments of a batch.

    Args:
        engine: Has the rows.
        draws, episode, indices: See ``Beginning``.
    """

    def __init__(
        self, engine: BatchEngine, draws: EpisodeStart, episode: EpisodeValues, indices: IndexArray
    ) -> None:
        super().__init__(engine.env, draws, episode, indices)
        self._engine = engine

    def clear(self, inputs: list[Any], action: Any) -> None:
        """See ``Beginning.clear``."""
        read, own = self.env._episode, self.indices
        for row, value in zip(read.inputs, inputs, strict=True):
            row[own] = value[own] if isinstance(value, np.ndarray) else value
        read.action[..., own] = np.asarray(action)[..., np.newaxis]
        start_numbers(read, own)

    def look(self) -> None:
        """See ``Beginning.look``."""
        keep_rows(self.env._episode, self.indices)

    def episodes(self, indices: IndexArray) -> Episode:
        """See ``Beginning.episodes``."""
        return some(self.env._episode, indices)

    def row(self, name: str) -> FloatArray:
        """See ``Beginning.row``."""
        return self._engine._row(name)

    def place(self, values: Mapping[str, Any], indices: IndexArray) -> None:
        """See ``Beginning.place``."""
        self._engine._place(values, indices)


def _called(
    env: FMUEnv, name: str, arguments: Sequence[Any], keywords: Mapping[str, Any]
) -> tuple[Any, dict[str, Any]]:
    """Call a method of one environment, for which the prototype stands in.

    Returns:
        What it returns, or the attribute if it is no method; and the attributes that it has
        assigned, which the prototype does not keep.

    Raises:
        ConfigError: If it assigns what environments keep themselves.
    """
    before = dict(vars(env))
    try:
        value = attribute(env, name)
        result = value(*arguments, **keywords) if callable(value) else value
        own = {n: v for n, v in vars(env).items() if n not in before or v is not before[n]}
        for assigned in own:
            require_settable(assigned)
        return result, own
    finally:
        put_back(env, before)


def _indices(rows: MaskArray | None, mask: MaskArray) -> list[int]:
    """The indices of the environments in both masks; None stands for an empty mask."""
    return [] if rows is None else np.flatnonzero(rows & mask).tolist()


def _set_all(env: FMUEnv, attributes: Mapping[str, Any]) -> None:
    for name, value in attributes.items():
        setattr(env, name, value)


def _row_of(name: str, values: list[Any]) -> npt.NDArray[Any]:
    row = array_of(values)
    if row.ndim != 1 or row.dtype.kind not in "biuf":
        raise ConfigError(f"{name!r} can hold one number for each environment, got {shown(values)}")
    return row
