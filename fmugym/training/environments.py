"""Number of environments that a training steps together."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from time import perf_counter
from typing import Final

from fmugym.env import FMUEnv
from fmugym.pool.processors import available_memory, available_processors, used_memory

__all__ = ["VERY_SLOW", "fitting_envs"]

VERY_SLOW: Final = 5e-3
"""If a step takes longer than this in seconds, more environments than processors are of no use.

Each of them may be a process."""

_USUAL: Final = 8
_TIMED: Final = 10
_SHARE: Final = 0.5
"""Of the memory that is free."""


def fitting_envs(make_env: Callable[[], FMUEnv]) -> int:
    """Number of environments that fit the processors and the memory.

    Args:
        make_env: A function that makes the environment. One takes some steps.
    """
    before, processors = used_memory(), available_processors()
    with closing(make_env()) as env:
        env.action_space.seed(0)
        env.reset(seed=0)
        memory = max(used_memory() - before, 1.0)
        seconds, is_over = [math.inf], False
        while len(seconds) <= _TIMED and not is_over:
            action, begin = env.action_space.sample(), perf_counter()
            _, _, terminated, truncated, _ = env.step(action)
            seconds.append(perf_counter() - begin)
            is_over = terminated or truncated
    wanted = processors if min(seconds) > VERY_SLOW else max(_USUAL, processors)
    return max(1, int(min(wanted, _SHARE * available_memory() / memory)))
