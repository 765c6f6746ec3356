"""The step of a single environment by programs of its expressions, as in a batch of one."""

from __future__ import annotations

import logging
from typing import Any, Final

import numpy as np

from fmugym.env import FMUEnv
from fmugym.expressions.program import UncompilableError
from fmugym.pool.extension import require_refusal
from fmugym.task.actions import as_element
from fmugym.task.conclusion import conclude
from fmugym.task.faults import Result
from fmugym.task.native_draws import no_draws
from fmugym.task.saving import READ
from fmugym.vector.episode_arrays import EpisodeArrays
from fmugym.vector.hooks.formula_programs import compile_formulas, formulas_of
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.layout import LayoutOfOne
from fmugym.vector.quantity_arrays import EpisodeColumn, batched
from fmugym.vector.step_form import prepare_step

__all__ = ["ExpressionStep", "expression_step_of"]

logger = logging.getLogger(__name__)

_REFUSALS: Final = (TypeError, ValueError, BufferError)
"""What the pool raises if it does not take an action."""


def expression_step_of(env: FMUEnv) -> ExpressionStep | None:
    """Compile the expressions of an environment, which then reads from arrays of one.

    Args:
        env: The environment, with a native pool of its own.

    Returns:
        None if they cannot be compiled, or if there is another hook.
    """
    formulas = formulas_of(env)
    if formulas is None:
        return None
    try:
        return ExpressionStep(env, compile_formulas(env, formulas, env.step_limit))
    except UncompilableError as reason:
        text = f"the expressions of {type(env).__name__} cannot be compiled: {reason}"
        logger.info("%s. They are evaluated in Python, which is slower", text)
        return None


class ExpressionStep:
    """The step of an environment whose hooks are expressions: a step of a pool of one.

    Args:
        env: The environment. It reads from the arrays of this step from now on.
        task: The programs of its expressions.
    """

    def __init__(self, env: FMUEnv, task: TaskPrograms) -> None:
        pool, draws = env._instance.pool, env.episode_start
        rows = batched(env, 1, pool)
        starts = draws.constants[:, None].copy()
        if task.inputs.loads("parameter") or task.conclusion.loads("parameter"):
            numbers = zip(draws.parameter_names, starts, strict=True)
            rows.parameters = {name: row for name, row in numbers if name not in draws.strings}
        self._arrays = arrays = EpisodeArrays(env, rows, np.zeros(1, np.bool_))
        arrays.hold(task.variables)
        self._layout = layout = LayoutOfOne(task, env)
        play = prepare_step(
            env,
            arrays,
            task,
            starts,
            (no_draws(), (), np.zeros((1, 6), np.uint64)),
            (True, layout.shapes),
        )
        self._play: Any = play.step
        self._updated = task.updated
        self._take_over(env, EpisodeColumn(rows, 0))

    def _take_over(self, env: FMUEnv, column: EpisodeColumn) -> None:
        """Let the environment read its quantities from the arrays."""
        own = env._episode
        for name in READ:
            setattr(column, name, getattr(own, name))
        column.parameters = own.parameters
        column.variables.update(own.variables)
        env._episode = column

    def step(self, env: FMUEnv, action: Any) -> Result:
        """Do a step.

        Raises:
            ConfigError: If the action does not fit, or the inputs that it makes are not finite.
            SimulationError: After a fault with ``on_fault="raise"``.
        """
        env._ended = True  # until the step is done: after an exception no episode goes on
        try:
            played = self._play(action, False)
        except _REFUSALS as error:
            require_refusal(error)
            played = self._play_element(env, action)
        troubled, ended, reward, terminated, truncated, seen, _ = played
        if troubled:
            return self._conclude_again(env)
        if ended:
            self._arrays.ended[0] = False  # a reset begins the next episode, not the pool
        else:
            env._ended = False
        if self._layout.is_plain:
            return seen[0], reward, terminated, truncated, {}
        observation, info = self._layout.of_one(seen)
        return observation, reward, terminated, truncated, info

    def _play_element(self, env: FMUEnv, action: Any) -> Any:
        """Do a step with an action that the pool has refused in its own type or shape."""
        env._ended = False
        element = as_element(env, action)
        env._ended = True
        return self._play(element if element.shape else element.item(), False)

    def _conclude_again(self, env: FMUEnv) -> Result:
        """Conclude a step in Python, whose status or a number is not good, from before it on."""
        arrays, read, conversions = self._arrays, env._episode, env._conversions
        values, read.outputs = read.outputs, arrays.kept[:, 0]
        for name in self._updated:
            arrays.variables[name][...] = arrays.before[name]
        read.done, arrays.ended[0] = False, False
        if not np.isfinite(env._instance.inputs).all():
            read.step_count -= 1
            conversions.input_writer.checked(
                env._get_inputs(), read.action
            )  # it says what is wrong
        if conversions.pool_observes:
            with np.errstate(over="ignore"):  # what is infinite then is a fault
                env._instance.observation[:] = values[: env.interface.output_count]
        result = conclude(env, env._instance.pool.statuses.item(0), values)
        env._ended = result[2] or result[3]
        return result
