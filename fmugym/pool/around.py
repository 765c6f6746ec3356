"""Compiled hooks around the steps of pools that have no programs of their own.

The programs run in this process, on the arrays of such a pool, which may be memory that it shares
with others. A native pool runs them that has no FMU of its own.
"""

from __future__ import annotations

import logging
from typing import Any, cast

from fmugym import _native
from fmugym.archive.variable import Variable
from fmugym.pool.base import Play, Pool, PoolSpec, available_processors
from fmugym.pool.health import no_counts
from fmugym.pool.native import prepare
from fmugym.pool.settings import experiment_settings, listing, variable_settings

__all__ = ["PlayAround"]

_VERSION, _MANNER = 2, 0
"""Of functions that are never called."""

_NO_LIBRARY: _native.Library = {
    "version": _VERSION,
    "manner": _MANNER,
    "model": b"",
    "token": b"",
    "resources": b"",
    "paths": (),
    "private": False,
    "logging": False,
    "states": False,
    "categories": (),
    "solving": None,
    "system": None,
    "structural_references": b"",
    "structural_values": b"",
}


class PlayAround:
    """Runs programs before and after the steps of a pool.

    Args:
        pool: Its arrays are those that programs read and write.
        spec: What the pool does at each step.
    """

    def __init__(self, pool: Pool, spec: PoolSpec) -> None:
        accesses = {"inputs": _access(spec.inputs), "outputs": _access(spec.outputs)}
        self._pool = _native.Pool(
            library=_NO_LIBRARY,
            experiment=cast("_native.Experiment", experiment_settings(spec)),
            variables=cast("_native.Variables", variable_settings(spec) | accesses),
            arrays={
                "inputs": pool.inputs,
                "outputs": pool.outputs,
                "statuses": pool.statuses,
                "observations": pool.observations,
                "health": no_counts(pool.num_instances),
            },
            count=pool.num_instances,
            threads=available_processors(),
            callback=_ignore,
        )

    def prepare(self, variables: tuple[Variable, ...], *parts: Any) -> Play:
        """See ``Pool.prepare_play``."""
        prepare(self._pool, _access(variables), *parts)
        return Play(self._pool.play_before, self._pool.play_after)


def _access(variables: tuple[Variable, ...]) -> _native.Access:
    return _native.Access(_VERSION, *listing(variables, _VERSION), _MANNER)


def _ignore(index: int, status: int, category: str, message: str) -> None:
    """Receive the messages of FMUs, of which there are none."""
    logging.getLogger(__name__).debug("%d %d %s %s", index, status, category, message)
