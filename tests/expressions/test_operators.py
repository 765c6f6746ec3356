"""Operators of values, beside those of numpy's numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from fmugym.expressions.graph import Graph, Value
from fmugym.expressions.numpy_evaluation import function_of

FORMULAS = {
    "negative": lambda x: -x,
    "subtracted": lambda x: x - np.float64(1.1),
    "subtracted from": lambda x: np.float64(1.1) - x,
    "times float32": lambda x: np.float32(0.1) * x + np.float32(0.7),
    "compared": lambda x: x > np.float32(0.3),
}


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_equal_those_of_numbers(name, dtype):
    graph, number = Graph(), dtype(0.3)
    value = Value.read(graph, "x", dtype=dtype)
    found = value.beside(FORMULAS[name](value))
    wanted = FORMULAS[name](number)
    evaluated = function_of(found)(SimpleNamespace(x=number))
    assert (found.dtype, evaluated) == (wanted.dtype, wanted)
