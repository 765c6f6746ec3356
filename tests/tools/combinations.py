"""Tests with several parameters: each value of each of them, instead of all combinations."""

from collections.abc import Mapping

import pytest


def in_turn(axes, indirect=False):
    """Parametrize a test with as many rows as the longest axis has values; others take turns.

    Pairs that count are an axis of their own: their names with a comma between them, and tuples.
    The values of shorter axes meet others in each round.

    Args:
        axes: By names as ``pytest.mark.parametrize`` has them: the values, or a dict of them by id.
        indirect: As ``pytest.mark.parametrize`` has it.
    """
    columns = [_cells(names, values) for names, values in axes.items()]
    rows = []
    for number in range(max(map(len, columns))):
        row = [
            cells[(number + place * (number // len(cells))) % len(cells)]
            for place, cells in enumerate(columns)
        ]
        values = [value for _, values in row for value in values]
        rows.append(pytest.param(*values, id="-".join(name for name, _ in row)))
    return pytest.mark.parametrize(",".join(axes), rows, indirect=indirect)


def _cells(names, values):
    """The id of each value, and a tuple for all names."""
    is_named, has_one = isinstance(values, Mapping), "," not in names
    items = values.items() if is_named else [(None, value) for value in values]
    cells = [(name, (value,) if has_one else tuple(value)) for name, value in items]
    return [(name or "-".join(map(_told, parts)), parts) for name, parts in cells]


def _told(value):
    return getattr(value, "__name__", None) or str(value)
