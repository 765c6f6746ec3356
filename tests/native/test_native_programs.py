"""Programs in C load and store rows of any length, and those that are not sound are refused."""

import numpy as np
import pytest
from program_tools import code, constants

from fmugym.pool.pool_form import form_of_program

LENGTHS = (1, 15, 16, 17, 64, 127, 128, 129, 260)


def evaluate(lines, rows, kept=(), tables=(), count=None):
    """Run a program whose first registers hold constants."""
    from fmugym import _native

    form = form_of_program(code(*lines), constants(*kept), tables, 16)
    return _native.evaluate((form, tuple(rows)), count or len(rows[0]))


@pytest.mark.parametrize("n", LENGTHS)
def test_rows_that_a_program_both_reads_and_writes(n):
    rng = np.random.default_rng(n)
    first, second = rng.normal(size=(2, n))
    before = first.copy(), second.copy()
    lines = (
        ("load_row", 0, 0),
        ("load_row", 1, 1),
        ("store_row", 0, 0, 1),
        ("store_row", 1, 0, 0),
    )
    evaluate(lines, (first, second))
    np.testing.assert_array_equal(first, before[1])
    np.testing.assert_array_equal(second, before[0])


@pytest.mark.parametrize("n", LENGTHS)
def test_neighbouring_rows_become_neighbouring_elements(n):
    rows = np.random.default_rng(n).normal(size=(4, n)) * [[1.0], [1e30], [1e-50], [3.0]]
    seen = np.zeros((n, 5), np.float32)
    evaluate((("store_floats", 4, 0, 1, 3),), (*rows, *seen.T[1:4]))
    expected = np.zeros((n, 5), np.float32)
    expected[:, 1:4] = rows[1:].T
    np.testing.assert_array_equal(seen, expected)


@pytest.mark.parametrize(
    "line",
    [
        ("store_floats", 3, 0, 0, 0),  # none
        ("store_floats", 5, 0, 0, 2),  # beyond the last row
        ("store_floats", 3, 0, 1, 2),  # from a row of floats
        ("store_floats", 4, 0, 0, 2),  # to elements with one between them
        ("store_floats", 0, 0, 0, 1),  # to a row of doubles
        ("store_floats", 3, 0, 2, 1),
    ],
    ids=str,
)
def test_neighbours_that_do_not_exist(line):
    rows = np.zeros(3), np.zeros(3), np.zeros(3, np.float32)
    elements = np.zeros((3, 5), np.float32).T
    with pytest.raises(ValueError, match="the form of a program is damaged"):
        evaluate((line,), (*rows, *(elements[i] for i in (0, 1, 3))))


@pytest.mark.parametrize(
    "line", [("load_row", 0, 0), ("load_row", 0, 1, 60000), ("add d", 0, 0, 1, 1)], ids=str
)
def test_constants_stay_and_every_operand_exists(line):
    with pytest.raises(ValueError, match="the form of a program is damaged"):
        evaluate((line,), (np.zeros(3),), kept=(1.0,))


def test_a_row_that_is_not_aligned():
    row = np.zeros(25, np.uint8)[1:].view(np.float64)
    with pytest.raises(ValueError, match="aligned"):
        evaluate((("load_row", 0, 0),), (row, np.zeros(3)), count=3)
