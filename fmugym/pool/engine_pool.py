"""Pools of the engine: their requests besides steps and resets, the same everywhere."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.errors import SimulationError, first_of
from fmugym.pool.base import FloatArray
from fmugym.pool.derivatives import Variables, differentiated
from fmugym.pool.form import Writer, table_of
from fmugym.pool.requests import (
    Reader,
    Request,
    read_values,
    request_listing,
    request_save,
)
from fmugym.pool.saving_pool import SavingPool

__all__ = ["EnginePool"]

R = TypeVar("R")


class EnginePool(SavingPool):
    """A pool whose instances are in blocks, here or in other processes, asked by forms."""

    @abstractmethod
    def _ask(
        self,
        doing: str,
        request: Request,
        content: Callable[[slice], bytes],
        read: Callable[[Reader, int], R],
    ) -> list[R]:
        """Ask all blocks of instances.

        Args:
            doing: What they do then.
            request: What they are asked for.
            content: Makes the content of the request for a block.
            read: Reads the answer of so many instances.

        Returns:
            What was read, in the order of the blocks.

        Raises:
            SimulationError: If an instance refuses.
        """

    def _ask_for_values(
        self, doing: str, request: Request, content: bytes, *shape: int
    ) -> FloatArray:
        """Ask for an array of a shape whose last axis, that of the instances, is left out."""
        parts = self._ask(
            doing,
            request,
            lambda _: content,
            lambda reader, count: read_values(reader, (*shape, count)),
        )
        return parts[0].copy() if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        doing, content = "reading variables", request_listing(variables, self._version)
        try:
            return self._ask_for_values(doing, Request.READ, content, len(variables))
        except SimulationError as error:
            names = first_of([variable.name for variable in variables])
            text = str(error).replace(doing, f"reading {names}", 1)
            raise SimulationError(text) from None

    def write(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        """See ``Pool.write``."""
        listing = request_listing(variables, self._version)
        self._ask(
            "setting parameters",
            Request.WRITE,
            lambda block: Writer().forms(listing).array(values[:, block], np.float64).form(),
            lambda reader, _: reader.end(),
        )

    def _save_snapshot(self, number: int, dropped: Sequence[int]) -> None:
        """See ``SavingPool._save_snapshot``."""

        def content(block: slice) -> bytes:
            indices = np.arange(block.stop - block.start)
            return request_save(indices, False, number, dropped)

        self._ask("saving a state", Request.SAVE, content, lambda reader, _: reader.end())

    def differentiate(self, unknowns: Variables, knowns: Variables) -> FloatArray:
        """See ``Pool.differentiate``."""
        description, spec = self._form
        about = description, spec, self.num_instances
        return differentiated(*about, self._differentiate, unknowns, knowns)

    def _differentiate(
        self, adjoint: bool, part: int, version: int, seeded: Variables, others: Variables
    ) -> FloatArray:
        lists = request_listing(seeded, version), request_listing(others, version)
        content = Writer().integers(adjoint, part).forms(*lists).form()
        shape = len(seeded), len(others)
        doing = "a directional derivative"
        return self._ask_for_values(doing, Request.DIFFERENTIATE, content, *shape)

    @property
    def _version(self) -> int:
        """See ``fmugym.pool.form.table_of``."""
        return table_of(self._form[0])
