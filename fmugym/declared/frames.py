"""Data of a task in a dict: columns of pandas and arrays of numpy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fmugym.checks import integer_of
from fmugym.errors import ConfigError, unknown_name

__all__ = ["is_column", "with_tables"]


def is_column(value: Any) -> bool:
    """Whether a value is a column or an index of pandas."""
    return getattr(value, "ndim", None) == 1 and hasattr(type(value), "isna")


def with_tables(data: Any) -> Any:
    """The table ``data`` of a task, in which each entry is a table.

    A column or an array stands for ``values``. A frame of pandas has the column that ``column``
    names, or else the one with the name of the entry, or its only one. An index of pandas gives the
    ``times``, unless there are others or a ``step``, or it only counts the rows.

    Raises:
        ConfigError: If it is not clear which column of a frame is meant.
    """
    if not isinstance(data, Mapping):
        return data
    return {name: _table(name, one) for name, one in data.items()}


def _table(name: Any, given: Any) -> Any:
    if _is_frame(given) or is_column(given) or (isinstance(given, np.ndarray) and given.ndim == 1):
        given = {"values": given}
    if not isinstance(given, Mapping):
        return given
    table = dict(given)
    if _is_frame(table.get("values")):
        table["values"] = _chosen(name, table["values"], table.pop("column", None))
    index = getattr(table.get("values"), "index", None)
    is_count = getattr(index, "start", None) == 0 and getattr(index, "step", None) == 1
    if is_column(index) and not is_count and not table.keys() & {"times", "step"}:
        table["times"] = index
    return table


def _is_frame(value: Any) -> bool:
    return getattr(value, "ndim", None) == 2 and hasattr(type(value), "isna")


def _chosen(name: Any, frame: Any, column: Any) -> Any:
    """The column of a frame that is meant."""
    columns = [*frame.columns]
    if column is None and len(columns) > 1 and name not in columns:
        raise ConfigError(
            f"data.{name}: the frame has the columns {', '.join(map(repr, columns))}; "
            "name one by 'column'"
        )
    place = integer_of(column)
    if column is None:
        place = 1 + (columns.index(name) if name in columns else 0)
    elif place is None:
        if column not in columns:
            raise ConfigError(f"data.{name}: {unknown_name('column', column, columns)}")
        place = 1 + columns.index(column)
    if not 1 <= place <= len(columns):
        raise ConfigError(
            f"data.{name}: column = {place}, but the frame has {len(columns)}, from 1 on"
        )
    return frame.iloc[:, place - 1]
