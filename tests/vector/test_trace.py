"""Hooks that cannot be compiled for the native pool: the reason and the line are told."""

import numpy as np
import pytest
from vector_tools import Drawing

from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.trace import trace_hooks


def branch(self):
    return self.state[0] > 1.0 if self.state[0] > 0 else False


def remembered(self):
    self.worst = self.state[0]
    return self.worst > 1.0


def number(self):
    return self.state[0]


def array(self):
    return self.state[0] > np.array([1.0, 2.0])


@pytest.mark.parametrize(
    ("hook", "reason"),
    [
        (branch, "branches on a value"),
        (remembered, "changes self.worst"),
        (number, "a flag is no Boolean"),
        (array, "operands could not be broadcast|shape mismatch"),
    ],
)
def test_what_cannot_be_compiled_says_what_and_where(hook, reason):
    class Other(Drawing):
        _is_done = hook

    env = Other()
    line = hook.__code__.co_firstlineno
    with pytest.raises(UntraceableError, match=f"_is_done.*({reason})") as caught:
        trace_hooks(env)
    if "line" in str(caught.value):
        assert any(f"line {line + i}:" in str(caught.value) for i in range(1, 4))
    env.close()
