"""What the C extension calls for messages of FMUs.

It may not refer to the pool, or the pool would live for ever.
"""

from __future__ import annotations

import logging

from fmugym.archive.description import ModelDescription
from fmugym.pool.reports import as_record
from fmugym.systems.system_description import SystemDescription

__all__ = ["Receiver"]


class Receiver:
    """Passes on the FMU's messages.

    Args:
        log: Gets them.
        description: Of the FMU, or of a system, whose components are named.
        first: The number of the first instance.
    """

    def __init__(self, log: logging.Logger, description: ModelDescription, first: int = 0) -> None:
        self._log, self._model, self._first_index = log, description.model_identifier, first
        self._parts = [""]
        if isinstance(description, SystemDescription):
            self._parts = [f".{component.name}" for component in description.plan.components]

    def __call__(self, index: int, status: int, category: str, message: str) -> None:
        """Log a message of an instance, or of a component of one."""
        instance, part = divmod(index, len(self._parts))
        name = f"{self._model}_{self._first_index + instance}{self._parts[part]}"
        level, text = as_record(name, status, category, message)
        self._log.log(level, "%s", text)

    @property
    def sources(self) -> int:
        """How many sources of messages an instance has: its components, or itself."""
        return len(self._parts)
