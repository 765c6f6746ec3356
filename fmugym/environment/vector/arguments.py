"""Checks of arguments of a vector environment: its size, its pool, seeds, masks, options."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from gymnasium.vector import AutoresetMode

from fmugym.checks import (
    check_count,
    check_mapping,
    check_number,
    check_seed,
    integer_of,
)
from fmugym.environment.actions import array_of
from fmugym.errors import ConfigError, shown, unknown_argument, unknown_name
from fmugym.pool.pool import MaskArray

__all__ = [
    "ARGUMENTS",
    "POOL_OPTIONS",
    "UnknownAttributeError",
    "autoreset_mode_of",
    "checked_num_envs",
    "checked_pool_options",
    "checked_seeds",
    "split_options",
]

POOL_OPTIONS: Final = ("threads", "private_libraries", "isolation", "workers", "call_timeout")
"""The arguments that are meant for the pool."""

ARGUMENTS: Final = ("make_env", "num_envs", "max_episode_steps", "autoreset_mode")
"""The arguments that are not."""

_LEAST_BYTES_PER_ENV: Final = 1024
"""An FMU instance and its columns of the arrays take more than this."""


class UnknownAttributeError(ConfigError, AttributeError):
    """An attribute that does not exist: ``hasattr`` and its like expect an ``AttributeError``."""


def checked_num_envs(value: Any) -> int:
    """Check the number of environments.

    Raises:
        ConfigError: If it is no positive integer, or no memory can hold so many environments.
    """
    count = integer_of(value)
    if count is None or count < 1:
        raise ConfigError(f"num_envs must be a positive integer, got {shown(value)}")
    memory = _bytes_of_memory()
    if count * _LEAST_BYTES_PER_ENV > memory:
        raise ConfigError(
            f"num_envs = {shown(value)} is too large: this machine has {memory / 1e9:.0f} GB of "
            f"memory, and an environment takes at least {_LEAST_BYTES_PER_ENV} bytes"
        )
    return count


def _bytes_of_memory() -> int:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows
        return 2**40


def autoreset_mode_of(mode: Any) -> AutoresetMode:
    """Turn ``"next_step"``, ``"NextStep"`` and the like into the mode.

    Raises:
        ConfigError: If there is none of this name.
    """
    if isinstance(mode, AutoresetMode):
        return mode
    by_name = {m.name.lower(): m for m in AutoresetMode}
    by_value = {m.value: m for m in AutoresetMode}
    if isinstance(mode, str):
        mode = str.__str__(mode)  # a subclass may have odd methods
        known = by_value.get(mode) or by_name.get(mode.lower().replace("-", "_"))
        if known is not None:
            return known
    raise unknown_name("autoreset mode", mode, by_name)


def checked_pool_options(options: Mapping[str, Any], num_envs: int) -> dict[str, Any]:
    """Check the arguments for the pool.

    Args:
        options: The arguments by name.
        num_envs: N; more threads or workers than environments are of no use.

    Returns:
        The arguments; those that are None are left out.

    Raises:
        ConfigError: If one is unknown or does not fit.
    """
    for name in options:
        if name not in (*POOL_OPTIONS, "backend"):
            raise unknown_argument("FMUVectorEnv", name, (*ARGUMENTS, *POOL_OPTIONS, "backend"))
    checked = {name: value for name, value in options.items() if value is not None}
    for name in checked.keys() & {"threads", "workers"}:
        checked[name] = min(check_count(name, checked[name]), num_envs)
    if "call_timeout" in checked:
        what = "call_timeout, in seconds or None,"
        checked["call_timeout"] = check_number(what, checked["call_timeout"], positive=True)
    elif "call_timeout" in options:
        checked["call_timeout"] = None  # no limit
    apart = checked.get("private_libraries", False)
    if not isinstance(apart, bool | np.bool_):
        raise ConfigError(f"private_libraries must be True, False or None, got {shown(apart)}")
    where = checked.get("isolation", "none")
    if not isinstance(where, str):
        raise ConfigError(f"isolation must be 'none', 'process' or None, got {shown(where)}")
    return checked


def checked_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """Turn the argument ``seed`` of ``reset`` into one seed or None for each environment.

    Raises:
        ConfigError: If it is neither an integer that is not negative, nor a sequence of N of them,
            some of which may be None.
    """
    first = integer_of(seed)
    if first is not None:
        check_seed(first)
        return list(range(first, first + num_envs))
    given = _elements(seed)
    if given is None:
        raise ConfigError(f"seed must be an integer or a list of them, got {shown(seed)}")
    if len(given) != num_envs:
        raise ConfigError(f"there are {len(given)} seeds, expected {num_envs}")
    return list(map(check_seed, given))


def _elements(values: Any) -> list[Any] | None:
    """Elements of a sequence; None for a value without elements or order, and for text."""
    if isinstance(values, str | bytes | bytearray | Mapping | set | frozenset):
        return None
    if not isinstance(values, Iterable) or not hasattr(values, "__len__"):
        return None
    try:
        return list(values)
    except Exception:  # an array without a dimension, or the user's own __iter__
        return None


def split_options(options: Any, num_envs: int) -> tuple[dict[str, Any], MaskArray]:
    """Take ``"reset_mask"`` out of the argument ``options`` of ``reset``.

    Returns:
        The other options, and a copy of the mask.

    Raises:
        ConfigError: If the options are neither None nor a dict, or the mask does not fit.
    """
    remaining = {} if options is None else check_mapping("the options of reset", options)
    return remaining, _checked_mask(remaining.pop("reset_mask", None), num_envs)


def _checked_mask(mask: Any, num_envs: int) -> MaskArray:
    """Copy ``options["reset_mask"]``; None stands for all environments.

    Raises:
        ConfigError: If it is no Boolean array of shape (N,), or has no True.
    """
    if mask is None:
        return np.ones(num_envs, np.bool_)
    array = array_of(mask)
    if array.shape != (num_envs,) or array.dtype != np.bool_ or not array.any():
        raise ConfigError(
            f"options['reset_mask'] must be a Boolean array of shape ({num_envs},) with at least "
            f"one True, got {shown(mask)}"
        )
    return array
