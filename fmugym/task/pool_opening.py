"""Opening of an environment's FMU and of its pool."""

from __future__ import annotations

import inspect
import logging
import os
from abc import ABCMeta
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from itertools import count, takewhile
from math import floor, isfinite
from pathlib import Path
from typing import Any, Final

from fmugym.archive.fmu import FMU
from fmugym.checks import check_option, check_path
from fmugym.config import EnvConfig
from fmugym.errors import ConfigError
from fmugym.pool import Pool, PoolSpec
from fmugym.pool.spec import ISOLATIONS
from fmugym.systems import FMUSystem
from fmugym.task.episode_start import EpisodeStart
from fmugym.task.starting import structural_values
from fmugym.trial.opening import make_pool

__all__ = ["PoolOpening", "deferred_pools", "env_numbers", "open_fmu", "pools_are_deferred"]

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


@dataclass(frozen=True)
class PoolOpening:
    """What it takes to open the pool of an environment.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        config: The environment's config.
        draws: The draws of its episodes, for the trial of resets.
        log: The logger that gets the FMU's messages.
        backend: See ``FMUEnv``.
        isolation: See ``FMUEnv``.

    Raises:
        ConfigError: If there is no isolation of this name.
    """

    fmu: FMU
    spec: PoolSpec
    config: EnvConfig
    draws: EpisodeStart
    log: logging.Logger
    backend: Any
    isolation: str | None

    def __post_init__(self) -> None:
        if self.isolation is not None:
            check_option("isolation", self.isolation, ISOLATIONS)

    def open(
        self, num_instances: int = 1, *, max_episode_steps: int | None = None, **options: Any
    ) -> Pool:
        """Open a pool.

        Args:
            num_instances: N.
            max_episode_steps: The most steps of an episode, if the config does not limit it more.
            options: Wishes of ``fmugym.pool.wishes.Wishes``, before the config's own.

        Raises:
            ConfigError: If an argument is invalid.
            FMULoadError: If the FMU cannot be used on this machine.
        """
        most = self.config.foreign.max_instances
        if most is not None and num_instances > most:
            raise ConfigError(
                f"{self.fmu.path.name}: {num_instances} environments need {num_instances} "
                f"instances, but 'max_instances' of 'foreign' allows {most}"
            )
        own: dict[str, Any] = {
            "isolation": self.isolation or self.config.isolation,
            "call_timeout": self.config.foreign.call_timeout,
            "reset_method": self.config.foreign.reset_method,
            "starts": self.draws.starts(),
            "length": self._length(max_episode_steps),
            "spare": most is None or num_instances < most,
        }
        options = own | options
        if self.backend is not None:
            options["backend"] = self.backend
        return make_pool(self.fmu, self.spec, num_instances, self.log, **options)

    def _length(self, max_episode_steps: int | None) -> int | None:
        """The most steps of an episode; None if nothing limits them."""
        limits = [max_episode_steps, self.config.max_episode_steps]
        if self.spec.stop_time is not None:
            span = self.spec.stop_time - self.spec.start_time
            steps = span / self.spec.time_step
            limits.append(max(1, floor(steps + 1e-9)) if isfinite(steps) else None)
        return min((limit for limit in limits if limit is not None), default=None)

    def apart(self) -> PoolOpening:
        """Return the same with an FMU that is not shared."""
        return replace(self, fmu=FMU.of(self.fmu))


def _find_file(cls: type, path: Path) -> Path:
    """Find a relative path next to the file of the class or of one of its base classes.

    Classes from a notebook or the interactive interpreter have no file. For them, the path is
    relative to the working directory.
    """
    if path.is_absolute():
        return path
    own = takewhile(lambda c: c.__module__ != "fmugym.env", cls.__mro__)
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
