"""How an environment opens its FMU and makes its pool."""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import takewhile
from pathlib import Path
from typing import Any

from fmugym.archive.fmu import FMU
from fmugym.checks import check_option, check_path
from fmugym.config import EnvConfig
from fmugym.errors import ConfigError
from fmugym.pool import Pool, PoolSpec
from fmugym.pool.spec import ISOLATIONS
from fmugym.task.episode import EpisodePlan
from fmugym.trial.opening import make_pool

__all__ = ["open_fmu", "open_pool", "request_pool"]

_request: ContextVar[tuple[int, dict[str, Any]]] = ContextVar("request", default=(1, {}))


@contextmanager
def request_pool(num_instances: int, **options: Any) -> Iterator[None]:
    """Give each environment made in this context a pool of this size.

    Args:
        num_instances: Number of FMU instances; the prototype of a vector environment has them all.
        options: Passed to ``fmugym.trial.opening.make_pool``.
    """
    token = _request.set((num_instances, options))
    try:
        yield
    finally:
        _request.reset(token)


def open_fmu(cls: type, path: str | os.PathLike[str], config: EnvConfig) -> FMU:
    """Open the FMU of an environment; relative paths start at the folder of its class's file.

    Raises:
        ConfigError: If an argument is invalid.
        FMULoadError: If the file is missing or not a valid FMU.
    """
    return FMU(
        _find_file(cls, check_path("fmu_path", path)),
        limits=config.archive_limits,
        preload=[_find_file(cls, Path(p)) if os.path.dirname(p) else p for p in config.preload],
        probe_timeout=config.probe_timeout,
    )


def open_pool(
    fmu: FMU,
    spec: PoolSpec,
    config: EnvConfig,
    plan: EpisodePlan,
    log: logging.Logger,
    backend: Any,
    isolation: str | None,
) -> Pool:
    """Make the pool that the config, the arguments and the context ask for.

    Raises:
        ConfigError: If an argument is invalid.
        FMULoadError: If the FMU cannot be used on this machine.
    """
    if isolation is not None:
        isolation = check_option("isolation", isolation, ISOLATIONS)
    num_instances, requested = _request.get()
    _check_max_instances(fmu, num_instances, config.max_instances)
    options: dict[str, Any] = {
        "isolation": isolation or config.isolation,
        "call_timeout": config.call_timeout,
        "reset_method": config.reset_method,
        "starts": plan.starts(),
        **requested,
    }
    if backend is not None:
        options["backend"] = backend
    return make_pool(fmu, spec, num_instances, log, **options)


def _check_max_instances(fmu: FMU, wanted: int, most: int | None) -> None:
    if most is not None and wanted > most:
        fmu.close()
        raise ConfigError(
            f"{fmu.path.name}: {wanted} environments need {wanted} instances, but config key "
            f"'max_instances' allows {most}"
        )


def _find_file(cls: type, path: Path) -> Path:
    """Find a relative path next to the file of the class or of one of its base classes.

    Classes from a notebook or the interactive interpreter have no file. For them, the path is
    relative to the working directory.
    """
    if path.is_absolute():
        return path
    own = takewhile(lambda c: c.__module__ != "fmugym.env", cls.__mro__)
    folders = [Path(inspect.getfile(c)).parent for c in own if _has_file(c)] or [Path.cwd()]
    candidates = [folder / path for folder in folders]
    return next((c for c in candidates if _exists(c)), candidates[0])


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # the path is not valid for any file
        return False


def _has_file(cls: type) -> bool:
    try:
        return Path(inspect.getfile(cls)).is_file()
    except (TypeError, OSError):
        return False
