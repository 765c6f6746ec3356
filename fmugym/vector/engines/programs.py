"""Finds the programs that stand for the hooks of an environment."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import Any, TypeVar, cast

import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.signals import ordinary
from fmugym.task.readings import Readings
from fmugym.vector.hooks.check import sample_states
from fmugym.vector.hooks.compare import require_same
from fmugym.vector.hooks.program import DifferenceError
from fmugym.vector.hooks.trace import TracedTask, trace_hooks

__all__ = ["attempt", "compile_hooks", "find_programs"]

logger = logging.getLogger(__name__)

_Made = TypeVar("_Made")

_WILD_SCALES = (-0.3, 10.0, 300.0, -1e5)
"""Magnitudes of other states that programs are compared with hooks on."""


def find_programs(env: FMUEnv, required: bool) -> TracedTask:
    """Compile the hooks of an environment, and compare the programs with the hooks on arrays.

    Args:
        env: A prototype whose hooks work on arrays.
        required: Whether hooks that cannot be compiled are an error.

    Raises:
        ConfigError: If the programs are required, but the hooks cannot be compiled.
    """

    def make() -> TracedTask:
        return compile_hooks(env, [sample_states(env, s) for s in ((1.0,), _WILD_SCALES)])

    return attempt(env, make, required, "on arrays") or TracedTask.without_programs(env)


def attempt(env: FMUEnv, make: Callable[[], _Made], required: bool, where: str) -> _Made | None:
    """Compile hooks; the log tells which ones cannot be compiled, and why.

    Args:
        env: The environment.
        make: Compiles its hooks; what it returns has in ``left`` those that cannot be compiled.
        required: Whether hooks that cannot be compiled are an error.
        where: How such hooks are called: ``"on arrays"``, for example.

    Returns:
        None if none can be compiled.

    Raises:
        ConfigError: If all are required, but one cannot be compiled.
    """
    name = type(env).__name__
    try:
        made: Any = make()
    except ordinary(Exception) as reason:  # hooks may raise anything
        text = f"the hooks of {name} cannot be compiled: {reason}"
        if required:
            raise ConfigError(text) from None
        logger.info("%s. They run %s, which is slower", text, where)
        return None
    for why in made.left.values():
        text = f"a hook of {name} cannot be compiled: {why}"
        if required:
            raise ConfigError(text)
        logger.info("%s. It runs %s, the others are compiled", text, where)
    return cast(_Made, made)


def compile_hooks(
    env: FMUEnv,
    batches: Sequence[Readings],
    attributes: Mapping[str, npt.NDArray[Any]] = MappingProxyType({}),
) -> TracedTask:
    """Trace hooks, and leave those to Python whose programs give other values than they.

    Args:
        env: A prototype whose hooks work on arrays.
        batches: What the hooks read where they are compared; only in the first one, they must find
            all that they look up in their tables.
        attributes: Those that have one number for each environment, by name.

    Raises:
        UntraceableError: As ``trace_hooks`` does.
    """
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
