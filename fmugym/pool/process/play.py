"""Compiled hooks around the steps of worker processes.

The programs run in this process, on the memory that the workers share with it. A native pool runs
them that has no FMU of its own.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from fmugym import _native
from fmugym.archive.variable import Variable
from fmugym.pool.base import FloatArray, MaskArray, Played, available_processors
from fmugym.pool.extension import passes_refusals
from fmugym.pool.native import prepare
from fmugym.pool.process.shared_memory import Arrays
from fmugym.pool.process.worker import Setup
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

Advance = Callable[[tuple[Variable, ...], FloatArray, MaskArray], None]
"""Resets the instances in a mask with values of variables, and steps the others."""


class PlayAround:
    """Runs programs before and after the steps of other processes.

    Args:
        setup: What the workers know; all of them together.
        arrays: Those of all instances, in the shared memory.
        advance: Lets the workers do their part of a step.
    """

    def __init__(self, setup: Setup, arrays: Arrays, advance: Advance) -> None:
        self._advance = advance
        self._pool = self._open(setup, arrays)

    def _open(self, setup: Setup, arrays: Arrays) -> _native.Pool:
        spec = setup.spec
        accesses = {"inputs": self._access(spec.inputs), "outputs": self._access(spec.outputs)}
        return _native.Pool(
            library=_NO_LIBRARY,
            experiment=cast("_native.Experiment", experiment_settings(spec)),
            variables=cast("_native.Variables", variable_settings(spec) | accesses),
            arrays={
                "inputs": arrays.inputs,
                "outputs": arrays.outputs,
                "statuses": arrays.statuses,
                "observations": arrays.observations,
                "health": arrays.counts,
            },
            count=setup.num_instances,
            threads=available_processors(),
            callback=_ignore,
        )

    @staticmethod
    def _access(variables: tuple[Variable, ...]) -> _native.Access:
        return _native.Access(_VERSION, *listing(variables, _VERSION), _MANNER)

    def prepare(
        self,
        variables: tuple[Variable, ...],
        programs: Any,
        actions: Any,
        start_values: FloatArray,
        draws: Any,
        episodes: tuple[npt.NDArray[np.int64], MaskArray, int],
        surroundings: Mapping[str, Any],
    ) -> Callable[..., Played]:
        """See ``NativePool.prepare_play``; episodes start in the step after the end of others."""
        start, ended = self._access(variables), episodes[1]
        kept = {**surroundings, "reads_kept": True}  # the workers overwrite the outputs
        prepare(self._pool, start, programs, actions, start_values, draws, episodes, kept)
        before, after, advance = self._pool.play_before, self._pool.play_after, self._advance

        @passes_refusals
        def play(*arrays: Any) -> Played:
            before(*arrays)
            advance(variables, start_values, ended)
            return after(*arrays)

        return play


def _ignore(index: int, status: int, category: str, message: str) -> None:
    """Receive the messages of FMUs, of which there are none."""
    logging.getLogger(__name__).debug("%d %d %s %s", index, status, category, message)
