"""Opening of an environment's FMU and of its pool, and its instance in this pool or in one of N."""

from __future__ import annotations

import inspect
import os
from abc import ABCMeta
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import count, takewhile
from pathlib import Path
from typing import Any, Final

from fmugym.checks import check_path
from fmugym.environment.config import EnvConfig
from fmugym.environment.fmu_variables import structural_values
from fmugym.errors import ConfigError
from fmugym.fmi.fmu import FMU
from fmugym.fmi.systems import FMUSystem
from fmugym.pool import Pool
from fmugym.pool.opening import PoolOptions, open_pool

__all__ = [
    "Instance",
    "deferred_pools",
    "env_numbers",
    "open_env_pool",
    "open_fmu",
    "pool_options",
    "pools_are_deferred",
]


class Instance:
    """FMU instance of an environment: its rows and calls in a pool.

    Args:
        pool: A pool of one; or one of N, whose vector environment then steps it.

    Attributes:
        pool: As given.
        step: Steps it; returns whether it failed.
        halt: Lets a plant that stands in for the FMU stop.
        inputs, outputs: The rows that the pool reads and writes, shapes (m,) and (k,).
        observation: The outputs in float32, which the pool writes in the same pass.
        tells: Whether the pool adds to the info of a step.
    """

    __slots__ = ("halt", "inputs", "observation", "outputs", "pool", "step", "tells")

    def __init__(self, pool: Pool) -> None:
        self.pool, self.step, self.halt = pool, pool.step_own, pool.halt
        self.inputs, self.outputs = pool.inputs[:, 0], pool.outputs[:, 0]
        self.observation, self.tells = pool.observations[0], bool(pool.info())


env_numbers: Final = count()
"""Numbers of environments in the order in which they are made."""

_fmus: ContextVar[dict[Any, FMU] | None] = ContextVar("fmus", default=None)


@contextmanager
def deferred_pools(fmus: dict[Any, FMU]) -> Iterator[None]:
    """Let environments that are made in this context open no pool before they need one.

    A vector environment gives columns of its own pool to the environments that it makes here.
    Others, such as one that a constructor makes for itself, open a pool when they are first used.

    Args:
        fmus: The FMUs that these environments share; new ones are added.
    """
    token = _fmus.set(fmus)
    try:
        yield
    finally:
        _fmus.reset(token)


def pools_are_deferred() -> bool:
    """Whether this is the context of ``deferred_pools``."""
    return _fmus.get() is not None


def open_fmu(
    cls: type,
    path: str | os.PathLike[str] | FMUSystem,
    config: EnvConfig,
    interface: str | None = None,
) -> FMU:
    """Open the FMU of an environment; relative paths start at the folder of its class's file.

    Args:
        cls: The class of the environment.
        path: The ``.fmu`` file, the ``.ssp`` file of a system, or a system.
        config: The environment's config.
        interface: The only interface that the class can use; None for any.

    Raises:
        ConfigError: If an argument is invalid.
        FMULoadError: If the file is missing or not a valid FMU.
    """
    fmu = _opened(cls, path, config, interface)
    return fmu.with_units(config.units) if config.units else fmu


def _opened(
    cls: type,
    path: str | os.PathLike[str] | FMUSystem,
    config: EnvConfig,
    interface: str | None,
) -> FMU:
    limits, timeout = config.foreign.archive_limits, config.foreign.probe_timeout
    if isinstance(path, FMUSystem):
        return _shared((path, timeout), lambda: _open_system(path, config))
    file = _find_file(cls, check_path("fmu_path", path))
    if file.suffix.lower() == ".ssp":
        key = file, repr(limits), timeout
        return _shared(key, lambda: _open_system(FMUSystem.read(file, limits), config))
    preload = [
        _find_file(cls, Path(p)) if os.path.dirname(p) else p for p in config.foreign.preload
    ]
    arguments: dict[str, Any] = {
        "limits": limits,
        "preload": preload,
        "probe_timeout": timeout,
        "interface": _interface_of(cls, config.interface, interface),
    }
    fmu = _shared((file, repr(arguments)), lambda: FMU(file, **arguments))
    sizes = structural_values(fmu.description, config.model_parameters)
    if not sizes:
        return fmu
    arguments |= {"sizes": sizes}
    return _shared((file, repr(arguments)), lambda: FMU(file, **arguments))


def _shared(key: Any, open_it: Callable[[], FMU]) -> FMU:
    """Open an FMU, unless an environment that is made in the same context has done so."""
    known = _fmus.get()
    if known is None:
        return open_it()
    if key not in known:
        known[key] = open_it()
    return known[key]


def _open_system(system: FMUSystem, config: EnvConfig) -> FMU:
    given = {
        "preload": (config.foreign.preload, "the FMU of a component"),
        "interface": (config.interface, "a component"),
    }
    for key, (value, owner) in given.items():
        if value:
            raise ConfigError(
                f"config key {key!r} is for a single FMU; give it to {owner} of {system.name!r}"
            )
    fmu = system.as_fmu(config.foreign.probe_timeout)
    fmu.description.resized(structural_values(fmu.description, config.model_parameters))
    return fmu


def _interface_of(cls: type, wanted: str | None, own: str | None) -> str | None:
    if wanted is not None and own is not None and wanted != own:
        raise ConfigError(
            f"config key 'interface' is {wanted!r}, but {cls.__name__} is made for {own!r}"
        )
    return wanted or own


def open_env_pool(env: Any, num_instances: int = 1, **given: Any) -> Pool:
    """Open a pool for an environment, or for N of its kind.

    Args:
        env: The environment; its FMU is closed with the pool.
        num_instances: N.
        given: As for ``pool_options``.

    Raises:
        ConfigError: If an argument is invalid.
        FMULoadError: If the FMU cannot be used on this machine.
    """
    options = pool_options(env, **given)
    return open_pool(env.fmu, env.pool_spec, num_instances, env.logger, options)


def pool_options(env: Any, *, max_episode_steps: int | None = None, **given: Any) -> PoolOptions:
    """The options of an environment's pool.

    Args:
        env: The environment.
        max_episode_steps: The most steps of an episode, if the config does not limit it more.
        given: Options before those of the config; the environment's own backend is before both.

    Raises:
        ConfigError: If an option is invalid.
    """
    config = env.config
    limits = (max_episode_steps, config.max_episode_steps)
    own: dict[str, Any] = {
        "isolation": env.given_isolation or config.isolation,
        "call_timeout": config.foreign.call_timeout,
        "reset_method": config.foreign.reset_method,
        "starts": env.episode_start.starts(),
        "max_episode_steps": min((one for one in limits if one is not None), default=None),
    }
    backend = {} if env.given_backend is None else {"backend": env.given_backend}
    return PoolOptions(**(own | given | backend))


def _find_file(cls: type, path: Path) -> Path:
    """Find a relative path next to the file of the class or of one of its base classes.

    Classes from a notebook or the interactive interpreter have no file. For them, the path is
    relative to the working directory.
    """
    if path.is_absolute():
        return path
    own = takewhile(lambda c: c.__module__ != "fmugym.environment.env", cls.__mro__)
    folders = [Path(inspect.getfile(c)).parent if _has_file(c) else Path.cwd() for c in own]
    candidates = [folder / path for folder in folders or [Path.cwd()]]
    return next((c for c in candidates if _exists(c)), candidates[0])


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # the path is not valid for any file
        return False


def _has_file(cls: type) -> bool:
    if cls.__module__ == ABCMeta.__module__:  # it was made by a call of type()
        return False
    try:
        return Path(inspect.getfile(cls)).is_file()
    except (TypeError, OSError):
        return False
