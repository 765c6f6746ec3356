"""Finds the programs that stand for the hooks of an environment."""

from __future__ import annotations

import logging
from contextlib import suppress

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.signals import ordinary
from fmugym.vector.hooks.check import sample_states
from fmugym.vector.hooks.compare import require_same
from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.trace import TracedTask, trace_hooks

__all__ = ["find_programs"]

logger = logging.getLogger(__name__)

_WILD_SCALES = (-0.3, 10.0, 300.0, -1e5)
"""Magnitudes of other states that programs are compared with hooks on."""


def find_programs(env: FMUEnv, required: bool = False) -> TracedTask | None:
    """Compile the hooks of an environment, and compare the programs with the hooks on arrays.

    Args:
        env: A prototype whose hooks work on arrays.
        required: Whether hooks that cannot be compiled are an error.

    Returns:
        The programs, or None.

    Raises:
        ConfigError: If the programs are required, but the hooks cannot be compiled.
    """
    try:
        _require_playable(env)
        task = trace_hooks(env)
        require_same(env, sample_states(env, (1.0,)), task)
        with suppress(IndexError):  # hooks may look up what is not in their tables
            require_same(env, sample_states(env, _WILD_SCALES), task)
    except ordinary(Exception) as reason:  # hooks may raise anything
        text = f"the hooks of {type(env).__name__} cannot be compiled: {reason}"
        if required:
            raise ConfigError(text) from None
        logger.info("%s. They run on arrays, which is slower", text)
        return None
    for why in task.left.values():
        text = f"a hook of {type(env).__name__} cannot be compiled: {why}"
        if required:
            raise ConfigError(text)
        logger.info("%s. It runs on arrays, the others are compiled", text)
    return task


def _require_playable(env: FMUEnv) -> None:
    """Refuse environments that the native pool cannot play, whatever their hooks are."""
    if not env._open_pool("a vector environment").can_play:
        raise UntraceableError("the pool is not the native one")
