"""Finds the programs that stand for the hooks of an environment."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import Any, TypeVar

import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.expressions.program import DifferenceError, UntraceableError
from fmugym.task.readings import Readings
from fmugym.vector.hooks.check import sample_states
from fmugym.vector.hooks.compare import require_same
from fmugym.vector.hooks.formula_programs import compile_formulas, formulas_of
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.hooks.trace import trace_hooks

__all__ = ["attempt", "compile_hooks", "find_programs"]

logger = logging.getLogger(__name__)

_Made = TypeVar("_Made")

_WILD_SCALES = (-0.3, 10.0, 300.0, -1e5)
"""Magnitudes of other states that programs are compared with hooks on."""


def find_programs(env: FMUEnv, required: bool) -> TaskPrograms:
    """Compile the hooks of an environment, and compare the programs with the hooks on arrays.

    Args:
        env: A prototype whose hooks work on arrays.
        required: Whether hooks that cannot be compiled are an error.

    Raises:
        ConfigError: If the programs are required, but the hooks cannot be compiled.
    """

    def make() -> TaskPrograms:
        kinds = () if formulas_of(env) else ((1.0,), _WILD_SCALES)
        task = compile_hooks(env, [sample_states(env, scales) for scales in kinds])
        if required and task.left:
            raise UntraceableError("; ".join(task.left.values()))
        return task

    task = attempt(env, make, required, "on arrays")
    if task is None:
        return TaskPrograms.without_programs(env)
    for why in task.left.values():
        text = f"a hook of {type(env).__name__} cannot be compiled: {why}"
        logger.info("%s. It runs on arrays, the others are compiled", text)
    return task


def attempt(env: FMUEnv, make: Callable[[], _Made], required: bool, where: str) -> _Made | None:
    """Compile hooks; if they cannot be compiled, the log tells why.

    Args:
        env: The environment.
        make: Compiles its hooks.
        required: Whether hooks that cannot be compiled are an error.
        where: How such hooks are called: ``"on arrays"``, for example.

    Returns:
        None if they cannot be compiled.

    Raises:
        ConfigError: If they cannot be compiled, but must.
    """
    try:
        return make()
    except Exception as reason:  # hooks may raise anything
        text = f"the hooks of {type(env).__name__} cannot be compiled: {reason}"
        if required:
            raise ConfigError(text) from None
        logger.info("%s. They run %s, which is slower", text, where)
        return None


def compile_hooks(
    env: FMUEnv,
    batches: Sequence[Readings],
    attributes: Mapping[str, npt.NDArray[Any]] = MappingProxyType({}),
) -> TaskPrograms:
    """Compile hooks: the formulas that they are, or what they do with symbols.

    Those whose programs give other values than they are left to Python.

    Args:
        env: A prototype whose hooks work on arrays.
        batches: What the hooks read where they are compared; only in the first one, they must find
            all that they look up in their tables. Formulas are not compared, and need none.
        attributes: Those that have one number for each environment, by name.

    Raises:
        UntraceableError: As ``trace_hooks`` does.
    """
    formulas = formulas_of(env)
    if formulas is not None:
        return compile_formulas(env, formulas)
    refused: dict[str, str] = {}
    while True:
        task = trace_hooks(env, attributes, refused)
        try:
            require_same(env, batches[0], task)
            for batch in batches[1:]:
                with suppress(IndexError):
                    require_same(env, batch, task)
            return task
        except DifferenceError as difference:
            refused[difference.hook] = str(difference)
