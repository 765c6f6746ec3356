"""Programs and draws as the C extension gets them, written by hand."""

import numpy as np

from fmugym import _native
from fmugym.expressions.program import CONSTANT, OPERATIONS, TYPES
from fmugym.pool.play_form import ArrayElement
from fmugym.pool.pool_form import form_of_draws, form_of_program

DISCRETE = {
    "size": 8,
    "check": 1,
    "lowest": 0,
    "highest": 1,
    "none": np.zeros(1, np.int64),
}
"""Actions that are 0 or 1."""


def kept_actions(count):
    """Memory for the actions of a step, and of the one before."""
    return {"current": np.zeros(count, np.int64), "previous": np.zeros(count, np.int64)}


def code(*rows):
    """Instructions: operation, extra, the register to write, operands."""
    numbered = [[OPERATIONS.index(name), *rest, *[0] * (5 - len(rest))] for name, *rest in rows]
    return np.array(numbered, np.uint16).tobytes()


def constants(*values):
    """The first registers keep these values."""
    rows = [(np.float64(value).view("u8"), register, 8, 0) for register, value in enumerate(values)]
    return np.array(rows, CONSTANT).tobytes()


def uniform_draws(*rows):
    """Uniform numbers from [0, 1), one for each row of the start values."""
    kind = _native.DISTRIBUTIONS.index("uniform")
    table = np.array([[kind, row, 0, 2] for row in rows], np.int64).reshape(-1, 4)
    return form_of_draws(table, [0.0, 1.0]), 0, 0


def results_of(count, observed, draws):
    """What a step returns: a tuple, with so many outputs that the pool observes, and draws."""
    flags, seen = np.empty(count, bool), np.empty((count, observed), np.float32)
    arrays = seen, np.empty(count), flags, flags, flags, np.empty((draws, count))
    zero = np.float64(0.0).tobytes()
    unstepped = tuple((row, zero) for row in RESULT_ROWS)
    return {"seen": 1, "results": (False, arrays), "unstepped": unstepped}


RESULT_ROWS = tuple(ArrayElement(place, 0, 1, TYPES.index(t)) for place, t in enumerate("d??", 1))
"""The rows of rewards, terminated and truncated, after the observations."""


def stored_results(first, reward, terminated, truncated):
    """Instructions that store registers in ``RESULT_ROWS``, the first of which has this number."""
    registers = enumerate((reward, terminated, truncated), first)
    return [("store_row", row, 0, register) for row, register in registers]


def no_observation():
    """A program that stores nothing, as the pool makes the observations."""
    return form_of_program(b"", b"", (), 0), ()
