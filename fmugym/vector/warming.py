"""Warm-ups in the pool's pass: controllers, data and histories as programs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import Pool
from fmugym.pool.bundle import IndexArray
from fmugym.task.readings import Readings, reading
from fmugym.task.warm_up import WarmUp
from fmugym.vector.contents import borrowed
from fmugym.vector.hooks.lowering import Store, compile_graph
from fmugym.vector.hooks.patches import exclusive
from fmugym.vector.hooks.program import Program, UntraceableError
from fmugym.vector.hooks.symbols import LANES, Symbols, as_symbols, loaded, same_for_all
from fmugym.vector.hooks.tables import tables_in
from fmugym.vector.hooks.trace import Tracer
from fmugym.vector.streams import no_draws

__all__ = ["CompiledWarmUp", "compiled"]

_STEPS_AT_ONCE: Final = 64
"""The steps of one call, which bound the memory for its results."""


def compiled(env: FMUEnv, warm_up: WarmUp, pool: Any) -> CompiledWarmUp | None:
    """Compile a warm-up.

    Args:
        env: The environment, or the prototype of those of a vector environment.
        warm_up: What happens.
        pool: The pool of N instances.

    Returns:
        What does the warm-up; None if the pool cannot do whole steps, or the warm-up does what no
        program can do.
    """
    if not pool.plays_alone or not env._input_writer.all_real:
        return None
    try:
        return CompiledWarmUp(env, warm_up, pool)
    except UntraceableError as reason:
        env.logger.info("%s: warm-ups run in Python: %s", env.fmu.path.name, reason)
        return None


class _WarmUpTracer(Tracer):
    """Traces a warm-up instead of the hooks.

    Args:
        env: The prototype.
        warm_up: What happens.
    """

    _KINDS: Final = ("previous_action", "action")

    def __init__(self, env: FMUEnv, warm_up: WarmUp) -> None:
        super().__init__(env, {})
        self._warm_up = warm_up

    @property
    def variables(self) -> Mapping[str, np.dtype[Any]]:
        """The types of the episode variables by name."""
        return self._variables

    def programs(self) -> tuple[Program, Program]:
        """The programs before and after a step."""
        env: Any = self._env
        with (
            exclusive(),
            borrowed(env, outside=True),
            tables_in(env),
            reading(env, Readings.of(env)),
        ):
            env._own = replace(env._own, update=True)
            env._get_inputs = self._choose
            env._update = self._update
            programs: Any = self.task()
            first, second = programs
            return first, second

    def _traced(self) -> Any:
        inputs = self._trace_choice()
        self._begin(judging=True)
        env: Any = self._env
        env.action, env.previous_action = self._rows("action"), self._rows("previous_action")
        stores, _ = self._trace_update()
        constants = np.False_, np.False_, np.float64(0.0)
        results = [self._graph.constant(value, value.dtype).node for value in constants]
        return inputs, compile_graph(self._graph, stores, results, 0)

    def _rows(self, kind: str) -> Symbols:
        """Symbols for an action that is kept in rows of its own."""
        space: Any = self._env.action_space
        names = np.empty(space.shape or (), object)
        for index, place in enumerate(np.ndindex(names.shape)):
            names[place] = kind, index
        return loaded(self._graph, "row", names, space.dtype)

    def _trace_choice(self) -> Program:
        self._begin(judging=False)
        env: Any = self._env
        env.action, env.previous_action = self._rows("action"), self._rows("previous_action")
        kept = np.empty(len(env.out), object)
        kept[:] = [("kept", index) for index in range(len(kept))]
        env.previous_state = loaded(self._graph, "row", kept, np.float64)[: env._output_count]
        stores: list[Store] = self._call("_get_inputs", self._stores)
        return compile_graph(self._graph, stores, [], 0)

    def _choose(self) -> tuple[Any, Any]:
        env: Any = self._env
        names = np.empty(len(self._warm_up.starts), object)
        names[:] = [("state", index) for index in range(len(names))]
        state = loaded(self._graph, "row", names, np.float64)
        chosen, after = self._warm_up.decide(env, [state[i] for i in range(len(names))])
        env.previous_action, env.action = env.action, self._placed(env.action, chosen)
        return self._warm_up.inputs(env), after

    def _placed(self, action: Symbols, chosen: Mapping[int, Any]) -> Symbols:
        """The action with the elements that were chosen."""
        cells = action.cells.reshape(-1, LANES).copy()
        for place, value in chosen.items():
            node = int(self._nodes(value, (), action.dtype))
            cells[place] = self._whole(node, action.dtype).cells
        return Symbols(self._graph, cells.reshape(action.shape), action.dtype, writeable=False)

    def _stores(self, value: tuple[Any, Any]) -> list[Store]:
        inputs, after = value
        env: Any = self._env
        nodes = {
            kind: same_for_all(as_symbols(self._graph, getattr(env, kind))).reshape(-1).tolist()
            for kind in self._KINDS
        }
        nodes["state"] = [int(self._nodes(one, (), np.float64)) for one in after]
        nodes["input"] = self._input_nodes(inputs)
        return [Store(n, (kind, i)) for kind, row in nodes.items() for i, n in enumerate(row)]

    def _update(self) -> None:
        self._warm_up.update(self._env)


class CompiledWarmUp:
    """A warm-up as programs, with the arrays that these use in place.

    Args:
        env: The prototype.
        warm_up: What happens.
        pool: The pool of N instances.

    Raises:
        UntraceableError: If the warm-up does what no program can do.
    """

    def __init__(self, env: FMUEnv, warm_up: WarmUp, pool: Any) -> None:
        tracer = _WarmUpTracer(env, warm_up)
        programs = tracer.programs()
        self._env, self._warm_up, self._pool = env, warm_up, pool
        n: int = pool.num_instances
        starts, space = env.config.episode_variables, env.action_space
        self._shapes = {name: np.shape(starts[name]) for name in tracer.variables}
        self._now = {
            name: np.zeros((int(np.prod(self._shapes[name])), n), dtype)
            for name, dtype in tracer.variables.items()
        }
        self._before = {name: rows.copy() for name, rows in self._now.items()}
        numbers = env._interface.parameters.keys() - env.fmu.description.strings
        self._parameters = {name: np.zeros(n) for name in numbers}
        self._kept, self._state = np.zeros_like(pool.outputs), np.zeros((len(warm_up.starts), n))
        width = int(np.prod(space.shape or ()))
        self._actions = {
            kind: np.zeros((width, n), space.dtype) for kind in ("action", "previous_action")
        }
        self._counts, self._ended = np.zeros(n, np.int64), np.zeros(n, np.bool_)
        self._prepare(programs)

    def _prepare(self, programs: tuple[Program, Program]) -> None:
        """Let the pool take over the programs, beside those of the steps of episodes."""
        pool, n = self._pool, self._pool.num_instances
        pairs = [
            pair
            for name in self._now
            for pair in zip(self._now[name], self._before[name], strict=True)
        ]
        before = pool.exchange_play(None)
        try:
            pool.prepare_play(
                (),
                tuple(program.with_rows(self._find) for program in programs),
                _NO_ACTIONS,
                np.zeros((0, n)),
                (no_draws(), np.zeros((n, 6), np.uint64)),
                (self._counts, self._ended, sys.maxsize),
                {
                    "kept": self._kept,
                    "done": None,
                    "reads_kept": True,
                    "copies": tuple(pairs),
                    "input_starts": ((-1, 0.0),) * len(pool.inputs),
                    "drawn_variables": (),
                    "variable_starts": (),
                    "results": None,
                },
            )
        finally:
            self._play = pool.exchange_play(before)

    def _find(self, row: tuple[Any, ...]) -> Any:
        """The array of a row that a program loads or stores."""
        kind, *rest = row
        places: dict[str, Any] = {
            "output": self._pool.outputs,
            "input": self._pool.inputs,
            "kept": self._kept,
            "state": self._state,
            **self._actions,
        }
        if kind in places:
            return places[kind][rest[-1]]
        if kind == "step_count":
            return self._counts
        if kind == "parameter":
            return self._parameters[rest[0]]
        return (self._now if kind == "variable" else self._before)[rest[0]][rest[-1]]

    def run(
        self, pool: Pool, readings: Readings, indices: IndexArray, skip: npt.NDArray[np.bool_]
    ) -> dict[str, Any]:
        """Do the warm-up of episodes that have just begun; see ``WarmUps.run``.

        Args:
            pool: The pool that it was compiled for.
            readings: What hooks of these episodes read, environments on the last axis.
            indices: The environments, shape (M,).
            skip: The others, shape (N,).
        """
        self._fill(readings, indices)
        inputs = pool.inputs[:, skip]
        left, before = self._warm_up.steps, self._pool.exchange_play(self._play)
        try:
            while left and not np.any(pool.statuses[indices] > WARNING_CODE):
                steps = min(left, _STEPS_AT_ONCE)
                self._roll_out(steps, skip)
                left -= steps
        finally:
            self._pool.exchange_play(before)
            pool.inputs[:, skip] = inputs
        return {
            name: self._now[name][:, indices].reshape(*self._shapes[name], len(indices))
            for name in self._warm_up.writes
        }

    def _roll_out(self, steps: int, skip: npt.NDArray[np.bool_]) -> None:
        shape = steps, self._pool.num_instances
        flags = np.empty(shape, np.bool_), np.empty(shape, np.bool_)
        arrays = np.zeros(shape), (), np.empty(shape), *flags, np.zeros((0, shape[1]))
        self._pool.roll_out(*arrays, skip)

    def _fill(self, readings: Readings, indices: IndexArray) -> None:
        """Write down what the programs read at the beginning."""
        self._counts[indices] = -self._warm_up.steps
        self._pool.inputs[:, indices] = readings.inputs
        self._kept[: len(readings.previous_state), indices] = readings.previous_state
        for rows, start in zip(self._state, self._warm_up.starts, strict=True):
            rows[indices] = start
        for kind, rows in self._actions.items():
            rows[:, indices] = np.reshape(getattr(readings, kind), (len(rows), len(indices)))
        for name, row in self._parameters.items():
            row[indices] = readings.parameters[name]
        for name, rows in self._now.items():
            rows[:, indices] = np.reshape(readings.variables[name], (len(rows), len(indices)))


_NO_ACTIONS: Final[Mapping[str, Any]] = {
    "shape": (),
    "letter": "d",
    "size": 8,
    "check": 0,
    "lowest": 0,
    "highest": 0,
    "current": None,
    "previous": None,
    "none": np.zeros(1),
}
"""The programs keep the actions in rows of their own."""
