"""What users write in hooks, line by line: it is compiled, and gives what numpy gives on arrays."""

import contextlib
import math
import re
import textwrap
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from test_vector_program import Task, require_same
from vector_tools import Drawing, run_side_by_side

from fmugym.task.construction import prepare_hooks
from fmugym.vector import FMUVectorEnv
from fmugym.vector.hooks.check import find_difference, sample_states
from fmugym.vector.hooks.compare import require_same as require_same_programs
from fmugym.vector.hooks.tables import Table
from fmugym.vector.hooks.trace import trace_hooks

GAINS = np.array([1.5, -0.7])
MATRIX = np.array([[1.0, 2.0], [3.0, 4.0]])
LEVELS = np.array([1.0, 3.0, 7.0, -2.0])
COUNTS = np.array([[5, 6, 7], [8, 9, 10]])
PAIRS = np.arange(20).reshape(2, 10)[:, :8]
TIMES = np.linspace(0.0, 1.0, 5)
GOAL = [0.1, 0.2]
Q, W = "self.state[0]", "self.state[1]"

TABLES = (
    "LEVELS[self.step_count % 4]",
    "LEVELS[-1 - self.step_count % 4]",
    f"LEVELS[np.clip({Q}, 0, 3).astype(int)]",
    f"LEVELS[({Q} > 0).astype(np.intp)]",
    f"COUNTS[self.step_count % 2, ({Q} > 0).astype(int)]",
    "COUNTS[-1, self.step_count % 3]",
    "COUNTS[self.step_count % 2][..., 1]",
    "COUNTS[1][self.step_count % 3]",
    "np.asarray(GOAL)[self.step_count % 2]",
    "np.linspace(0, 1, 4)[self.step_count % 4]",
    "np.take(GOAL, self.step_count % 2)",
    "np.take(COUNTS, self.step_count % 2, axis=0)[..., 2]",
    "self.table[self.step_count % 3]",
    "float(self.table[1]) * self.state[0] + int(self.on_class[0])",
    f"np.interp({Q}, self.table - 2.0, self.table)",
    f"self.table[np.minimum(np.searchsorted(self.table, {Q}), 2)]",
    "self.on_class[self.step_count % 2]",
    "looked_up(self.step_count % 4)",
    "np.searchsorted([-0.5, 0.0, 0.5], self.state[0])",
    f"np.searchsorted(np.array([-0.5, 0.0, 0.0, 0.5]), np.round({Q}), side='right')",
    f"np.searchsorted([-1, 0, 0, 2], {Q}) + np.searchsorted([3], self.step_count)",
    f"LEVELS[np.minimum(np.searchsorted(TIMES, {Q}), 3)]",
    f"np.interp({Q}, [0.0, 1.0], [2.0, 5.0])",
    "np.interp(self.time, TIMES, TIMES**2)",
)

CHOICES = (
    f"np.where({Q} > 0.5, 1.0, np.where({Q} > 0, 2, 3))",
    f"np.select([{Q} > 0.5, {Q} > 0], [1.0, {W}], default=-1.0)",
    "np.argmax(self.state, axis=0)",
    "self.state.argmin(axis=0)",
    "np.argmax(np.sqrt(self.state), axis=0)",
    f"np.isclose({Q}, 0.0, atol=0.1)",
    "np.count_nonzero(self.state > 0, axis=0)",
    f"np.clip({Q}, -0.1, 0.1, out=np.zeros_like({Q}))",
)

FUNCTIONS = (
    f"divmod({Q}, 0.3)[0]",
    f"divmod({Q}, -0.3)[1]",
    "divmod(self.step_count, 3)[1]",
    f"np.mod({Q} + np.pi, 2 * np.pi) - np.pi",
    f"np.fmod({Q} + np.pi, 2 * np.pi)",
    f"np.hypot({Q}, {W})",
    f"np.deg2rad({Q}) + np.degrees({W})",
    f"np.sign({Q}) * np.copysign({W}, 0.5)",
    f"np.fix({Q}) + np.trunc({W})",
    f"np.floor(10 * {Q}).astype(np.int64) // 3",
    f"np.polyval([1.0, 2.0, 3.0], {Q})",
    f"math.sin(0.5) * {Q}",
)

ARRAYS = (
    "np.diff(self.state, axis=0)[0]",
    "np.roll(self.state, 1, axis=0)[0]",
    "np.concatenate([self.state, self.previous_state])[3]",
    "np.append(self.state, self.previous_state, axis=0)[2]",
    f"np.stack([{Q}, self.action[0]])[1]",
    f"np.array([{Q}, {W}], dtype=np.float32)[1]",
    f"np.linspace(0, 1, 5)[2] * {Q}",
    "np.sum(self.state[[1, 0]] ** 2, axis=0)",
    "self.state[np.array([1, 0])][0]",
    "np.sum(self.state[np.array([True, False])], axis=0)",
    "np.mean(self.state, axis=0) + np.std(self.state, axis=0)",
    "np.average(self.state, axis=0, weights=[0.3, 0.7])",
    "np.linalg.norm(self.state, axis=0)",
    "np.add.reduce(self.state)",
    "sum(w * x for w, x in zip(GOAL, self.state))",
    "sum((a - b) ** 2 for a, b in zip(self.state, GOAL))",
)

PRODUCTS = (
    f"self.table.dot(np.array([{Q}, {Q}, {W}]))",
    "-(GAINS @ self.state)",
    "(MATRIX @ self.state)[1]",
    "(self.state.T @ MATRIX).T[0]",
    "(MATRIX @ MATRIX @ self.state)[0]",
    "np.dot(GAINS, self.state)",
    "GAINS.dot(self.state)",
    "self.state.T.dot(GAINS)",
    "np.inner(GAINS, self.state.T)",
    "np.outer(GAINS, [1.0, 2.0])[0, 1] * self.state[0]",
    "np.sum(self.state * (MATRIX @ self.state), axis=0)",
    "np.cross([self.state[0], 0 * self.state[0], self.state[1]], [1.0, 2.0, 3.0], axis=0)[1]",
    "(COUNTS[:, :2] @ np.array([self.step_count, 2 * self.step_count]))[0]",
    "np.matmul(MATRIX.astype(np.float32), np.asarray(self.state, np.float32))[0]",
)

BLOCKS = (
    "out = np.zeros((2, *np.shape(self.state[0])))\nout[0] = self.state[0]\nreturn out[0] + out[1]",
    "out = np.empty((2, *np.shape(self.state[0])), np.float32)\n"
    "out[0], out[1] = self.state[0], 0.3\nreturn out[0] * out[1]",
    "out = np.zeros_like(self.state)\nout[0] = self.action[0]\nout[1] += 2\nreturn out[0] + out[1]",
    "out = np.zeros((3, *np.shape(self.state[0])))\nout[:2] = self.state\nreturn out.sum(axis=0)",
    "x = np.array(self.state[0])\nx[x > 0] = 0.5\nreturn x",
    "x = np.array(self.state, dtype=np.float64)\nx[x > 0.5] = 0.5\nreturn x[0] + x[1]",
    "x = np.array(self.state)\nx[:, self.state[0] > 0] = 0.0\nreturn x[0] + x[1]",
    "x = np.empty_like(self.state[0])\nx.fill(3)\nreturn x + self.state[0]",
    "h = np.roll(np.array([self.state[0], self.state[1]]), 1, axis=0)\nh[0] = 1.0\nreturn h[1]",
    "levels = np.array([1.0, 2.0, 3.0])\nreturn levels[self.step_count % 3]",
    "r = 0.0\nfor gain, x in zip(GAINS, self.state):\n    r += gain * x**2\nreturn r",
)


def looked_up(index):
    return LEVELS[index]


SHARED = SimpleNamespace(table=LEVELS)


def hook_of(body):
    names = {name: globals()[name] for name in globals() if name.isupper() or name == "looked_up"}
    names |= {"np": np, "math": math}
    text = body if "return" in body else f"return {body}"
    exec("def hook(self):\n" + textwrap.indent(text, "    "), names)
    return names["hook"]


class Snippet(Task):
    on_class = np.array([0.25, 0.5])

    def __init__(self, **changes):
        super().__init__(**changes)
        self.table = np.array([1.0, 2.0, 3.0])


@pytest.fixture(scope="module")
def prototype():
    env = Snippet()
    yield env, sample_states(env, (1.0, -0.3, 10.0)), sample_states(env, (-1e5,))
    env.close()


def compiled(prototype, body):
    """The programs of an environment with this reward, compared with the hook on arrays."""
    env, *batches = prototype
    env._reward_policy = hook_of(body).__get__(env)
    prepare_hooks(env)
    assert find_difference(env) is None
    task = trace_hooks(env)
    assert task.left == {}
    for batch in batches:
        with np.errstate(all="ignore"):
            require_same_programs(env, batch, task)
    return task


@pytest.mark.parametrize("body", [*TABLES, *CHOICES, *FUNCTIONS, *ARRAYS, *BLOCKS, *PRODUCTS])
def test_snippets_are_compiled(prototype, body):
    """These were refused, or nobody had tried."""
    uses_functions = re.search(r"hypot|math\.sin", body) or body in PRODUCTS
    assert bool(compiled(prototype, body).tolerance) <= bool(uses_functions)


def test_a_product_is_the_sum_in_the_order_of_its_terms():
    """So it gives the same on each machine, whatever linear algebra library numpy has."""

    class Product(Drawing):
        def _reward_policy(self):
            return GAINS @ self.state

    class Sum(Drawing):
        def _reward_policy(self):
            return GAINS[0] * self.state[0] + GAINS[1] * self.state[1]

    run_side_by_side(*(FMUVectorEnv(cls, 140, hooks="compiled") for cls in (Product, Sum)), 8)


NEAR = {
    "a function, nearly": (f"np.exp({Q})", f"np.exp({Q}) * (1 + 1e-13)", True),
    "another function": (f"np.exp({Q})", f"np.exp({Q}) * (1 + 1e-11)", False),
    "a function of float32": ("np.exp(self.action[0])", "np.exp(self.action[0]) * 1.000001", True),
    "another of float32": ("np.exp(self.action[0])", "np.exp(self.action[0]) * 1.0001", False),
    "a product, nearly": ("GAINS @ self.state", "GAINS @ self.state * (1 + 1e-13)", True),
    "another product": ("GAINS @ self.state", "GAINS @ self.state * (1 + 1e-10)", False),
    "arithmetic": (f"3.0 * {Q}", f"3.0 * {Q} * (1 + 2**-52)", False),
    "a count of a function": (f"np.sign(np.exp({Q}))", f"np.sign(np.exp({Q}) - 1.0)", False),
}


@pytest.mark.parametrize("name", NEAR)
def test_how_far_results_may_differ(prototype, name):
    """Relative to the largest; see docs/vector.md."""
    env, batch, _ = prototype
    body, other, is_same = NEAR[name]
    task = compiled(prototype, body)
    env._reward_policy = hook_of(other).__get__(env)
    found = contextlib.nullcontext() if is_same else pytest.raises(Exception, match="other values")
    with found:
        require_same_programs(env, batch, task)


def test_an_index_outside_of_its_table_is_an_error(make_envs):
    class Beyond(Drawing):
        def _get_info(self):
            return {"count": PAIRS[1, self.step_count]}

    envs = make_envs(lambda: Beyond(max_episode_steps=9), 3, hooks="compiled")
    envs.reset(seed=0)
    actions = np.zeros((3, 1), np.float32)
    for count in range(11, 18):
        assert envs.step(actions)[4]["count"].tolist() == [count] * 3
    with pytest.raises(IndexError):
        envs.step(actions)


def test_tables_are_arrays_again_after_tracing():
    """Constant arrays of a module stand in the hooks' own namespace while they are traced."""
    levels = np.array([2.0, 4.0])

    class Closing(Task):
        def _reward_policy(self):
            return levels[self.step_count % 2] + LEVELS[self.step_count % 4]

    before = LEVELS
    require_same(Closing, num_envs=3)
    assert LEVELS is before
    assert type(LEVELS) is type(levels) is np.ndarray
    assert Closing._reward_policy.__closure__[0].cell_contents is levels


def test_a_table_is_the_array_that_it_stands_for():
    """Another thread may find one while hooks are traced."""
    table = LEVELS.view(Table)
    found = []
    thread = threading.Thread(
        target=lambda: found.append((table + 1, table[1], table[:2], table @ table))
    )
    thread.start()
    thread.join()
    total, element, part, product = found[0]
    assert total.tolist() == (LEVELS + 1).tolist()
    assert (element, product) == (LEVELS[1], LEVELS @ LEVELS)
    assert part.tolist() == LEVELS[:2].tolist()
    part[0] = 5.0
    assert LEVELS[0] == 5.0
    part[0] = 1.0


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("np.sqrt(self.state[0], where=self.state[0] > 0)", "where: use numpy.where"),
        ("np.sum(self.state[0][self.state[0] > 0])", "use numpy.where"),
        ("np.interp(self.time, TIMES, TIMES**2, period=0.7)", "has a period"),
        ("SHARED.table[self.step_count % 4]", "needs numpy.take"),
        ("COUNTS[:, self.step_count % 3][1]", "cannot be followed"),
        ("self.state[self.step_count % 2]", "a table that is not constant"),
        ("np.maximum.reduce([self.state[0], self.state[1]])", "numpy.array around a list"),
        ("np.sum(np.ones((600, 2)) @ self.state, axis=0)", "it multiplies large matrices"),
        ("np.linalg.norm(self.state)", "it uses numpy.linalg.norm without one axis"),
        ("return 1.0 if self.state[0] > 0 else 0.0", "branches on a value"),
        ("self.worst = self.state[0]\nreturn self.worst", "changes self.worst"),
        ("self.state[0] > np.array([1.0, 2.0])", "operands could not be broadcast|shape mismatch"),
        (Q, "a flag is no Boolean"),
    ],
)
def test_what_is_refused_says_why(prototype, body, reason, monkeypatch):
    env, name = prototype[0], "_is_truncated" if "flag" in reason else "_reward_policy"
    monkeypatch.setattr(env, name, hook_of(body).__get__(env))
    prepare_hooks(env)
    (why,) = trace_hooks(env).left.values()
    assert re.search(reason, why), why
