"""Expressions of exported agents, in C and in ONNX, have the values that programs compute."""

import ctypes

import numpy as np
import pytest
from export_tools import Runner, built, compiled, network_for
from expression_table import OPERATIONS, TEXTS, operands
from test_expressions import HEIGHTS, filled, program_of, require_bits, value_of

from fmugym import ConfigError
from fmugym.deployment.export import agent_of, write_onnx
from fmugym.deployment.export.c_source import C_TYPES, HELPERS, array, constant, expression
from fmugym.deployment.export.onnx_model import Nodes, Operations
from fmugym.expressions.graph import Graph, Value

MEASURED = {"a": "a", "b": "b", "c": "0.5 * b", "p": "a > 0", "q": "b > a"}
"""The names of the table in terms of two measurements."""

ROWS = {f"row_{place}": filled(text, MEASURED) for place, text in enumerate(TEXTS)}
TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": "50ms",
    "variables": {"a": {"name": "q"}, "b": {"name": "q_dot"}, "tau": {"min": -1, "max": 1}},
    "memory": {name: {"start": 0, "update": f"+({text})"} for name, text in ROWS.items()},
    "agent": {"actions": ["tau"], "observations": [*ROWS]},
    "reward": 0,
}
"""A task whose memory has the value of each row after a step."""


@pytest.fixture
def agent(load):
    """An agent that remembers all rows."""
    env = load(TASK)
    return agent_of(env, network_for(env, scaled=False))


def of_programs(a, b):
    """The value of each row in programs, as numbers."""
    columns = {"a": a, "b": b}
    values = {name: value_of(f"+({text})") for name, text in ROWS.items()}
    return {name: program_of(value)(columns)[0] for name, value in values.items()}


@pytest.mark.parametrize("language", ["C99", "C++"])
def test_an_agent_in_c_computes_what_programs_do(language, agent, tmp_path):
    """To the last bit, also with numbers that are very small or very great."""
    a, b = (one[:600] for one in operands("dd"))
    is_measured = np.isfinite(a) & np.isfinite(b)  # an agent takes no others
    a, b = a[is_measured], b[is_measured]
    controller, kept = compiled(agent, tmp_path, language), []
    controller.begin()
    controller.step([0.0, 0.0])
    for sample in zip(a.tolist(), b.tolist(), strict=True):
        assert controller.step(sample) is not None
        kept.append(np.frombuffer(controller.memory.raw, count=1 + len(ROWS))[1:])
    assert [one.name for one in agent.logic.kept] == [*ROWS]
    for (name, wanted), found in zip(of_programs(a, b).items(), np.transpose(kept), strict=True):
        require_bits(found, wanted, ROWS[name])


# The whole agent in ONNX


SINGLE = ("arcsin", "arccos", "arctan", "powf")
"""Functions that ONNX Runtime computes in single precision."""


def test_an_agent_in_onnx_computes_what_programs_do(agent, tmp_path):
    """Of usual numbers: functions that are made up of others are less exact elsewhere.

    Its zeros have no sign.
    """
    pytest.importorskip("onnx", reason="needs the extra 'onnx'")
    a, b = np.random.default_rng(0).uniform(-3.0, 3.0, (2, 400))
    a[:100], b[:100] = np.round(a[:100]) + 0.0, np.round(b[:100]) + 0.0
    a[100:200] /= 3.1
    runner = Runner(write_onnx(agent, tmp_path / "agent.onnx"), len(a))
    runner.steps(np.zeros((len(a), 2)))
    runner.steps(np.stack([a, b], axis=1))
    for name, wanted in of_programs(a, b).items():
        tolerance = 3e-6 if any(one in ROWS[name] for one in SINGLE) else 1e-12
        found = np.ravel(runner.memory[name])
        np.testing.assert_allclose(found, wanted, tolerance, tolerance, err_msg=ROWS[name])


# Operations with each type. Expressions of users have float64 only; the parts of tasks and agents
# have others.


KINDS = {"d": ctypes.c_double, "f": ctypes.c_float, "q": ctypes.c_int64, "?": ctypes.c_bool}

REFUSED_IN_C = {"remainder q", "floor_divide q"}
NOT_IN_AGENTS = {"minimum q", "maximum q"}
"""What C has, but a compiler warns of, as it compares a number with itself to find a NaN."""

REFUSED_IN_ONNX = {"cbrt d", "trunc d", "copysign d"}
REFUSED_IN_ONNX |= {"bitwise_and q", "bitwise_xor q", "right_shift q"}


def all_kinds(name):
    """Operands of an operation: zeros, infinities and no numbers among them."""
    ufunc, letter = OPERATIONS[name]
    columns = operands(2 * letter)[: ufunc.nin]
    if letter == "q":  # no overflow, which C leaves open
        columns = [one % 41 - 20 for one in columns]
        columns[-1] = np.abs(columns[-1]) + 1
    return columns


def usual(name):
    """Usual operands of an operation, with equal ones and zeros."""
    ufunc, letter = OPERATIONS[name]
    if letter not in "df":
        return all_kinds(name)
    columns = np.random.default_rng(0).uniform(-3.0, 3.0, (ufunc.nin, 300)).astype(letter)
    columns[:, :100] = np.round(columns[:, :100]) + 0
    if name == "floor_divide d":  # ONNX makes no infinities of zeros
        columns[1][columns[1] == 0] = 1.0
    return list(columns)


def of_program(name, columns):
    """What a program makes of the operands of an operation."""
    ufunc, letter = OPERATIONS[name]
    graph, names = Graph(), dict(zip("xy", columns, strict=False))
    value = ufunc(*(Value.read(graph, one, dtype=letter) for one in names))
    return program_of(value)(names)[0]


def test_c_has_each_operation(tmp_path):
    """To the last bit."""
    helpers, lines = {}, []
    known = [name for name in OPERATIONS if name not in REFUSED_IN_C | NOT_IN_AGENTS]

    def use(helper, letter):
        return helpers.setdefault((helper, letter), f"own_{helper}_{letter}")

    for name in known:
        ufunc, letter = OPERATIONS[name]
        result = C_TYPES[of_program(name, all_kinds(name)).dtype.char.replace("l", "q")]
        text = expression(ufunc, ["x", "y"][: ufunc.nin], np.dtype(letter), use)
        parameters = ", ".join(f"{C_TYPES[letter]} {one}" for one in "xy"[: ufunc.nin])
        function = in_library(name)
        lines.append(f"{result} {function}({parameters})")
        lines.append(f"{{\n    return {text};\n}}")
    own = [HELPERS[one].format(T=C_TYPES[kind], name=n) for (one, kind), n in helpers.items()]
    library = built("\n".join([INCLUDES, *own, *lines]), tmp_path)
    for name in known:
        letter, columns = OPERATIONS[name][1], all_kinds(name)
        wanted = of_program(name, columns)
        function = library[in_library(name)]
        function.argtypes = [KINDS[letter]] * len(columns)
        function.restype = KINDS[wanted.dtype.char.replace("l", "q")]
        rows = zip(*(column.tolist() for column in columns), strict=True)
        require_bits(np.array([function(*row) for row in rows], wanted.dtype), wanted, name)


INCLUDES = "#include <math.h>\n#include <stdbool.h>\n#include <stdint.h>"


def in_library(name):
    return f"of_{name}".replace(" ", "_").replace("?", "flags")


@pytest.mark.parametrize("name", sorted(REFUSED_IN_C))
def test_c_refuses_an_operation_that_it_lacks(name):
    ufunc, letter = OPERATIONS[name]
    with pytest.raises(ConfigError, match=f"{ufunc.__name__}.*{np.dtype(letter)}"):
        expression(ufunc, ["x", "y"], np.dtype(letter), None)


def places_on(xs):
    """Coordinates for which a curve is asked, but for one at which exports divide by zero."""
    x = np.concatenate([xs, np.random.default_rng(0).uniform(-4.0, 4.0, 300)])
    return x[x != -5e-324]


def test_curves_in_c_are_those_of_numpy(tmp_path):
    curves = {name: curve for name, curve in HEIGHTS.items() if np.isfinite(curve).all()}
    lines = [INCLUDES, HELPERS["interpolate"].format(T="double", name="own")]
    for place, (xs, ys) in enumerate(curves.values()):
        lines += [
            *array(f"x{place}", np.array(xs)),
            *array(f"y{place}", np.array([*ys, -7.0, 7.0])),
        ]
        call = f"own(x, x{place}, y{place}, {len(xs)})"
        lines.append(f"double curve_{place}(double x) {{\n    return {call};\n}}")
    library = built("\n".join(lines), tmp_path)
    for place, (name, (xs, ys)) in enumerate(curves.items()):
        x = places_on(xs)
        function = library[f"curve_{place}"]
        function.argtypes, function.restype = [ctypes.c_double], ctypes.c_double
        wanted = np.interp(x, xs, ys, left=-7.0, right=7.0)
        require_bits([function(one) for one in x.tolist()], wanted, name)


@pytest.mark.parametrize(
    ("value", "letter"),
    [
        *((0.1, "d"), (1e300, "d"), (-5e-324, "d"), (np.inf, "d"), (np.nan, "d"), (-0.0, "d")),
        *((np.float32(0.1), "f"), (np.float32(1e-45), "f"), (-np.inf, "f"), (True, "?")),
        *((-(2**63), "q"), (2**40, "q"), (-3, "q")),
    ],
)
def test_constants_in_c_keep_all_bits(value, letter, tmp_path):
    kind, text = C_TYPES[letter], constant(value, letter)
    library = built(f"{INCLUDES}\n{kind} value = {text};", tmp_path)
    dtype = np.dtype(letter)
    found = (ctypes.c_char * dtype.itemsize).in_dll(library, "value").raw
    assert found == np.array(value, dtype).tobytes()


@pytest.mark.parametrize("name", OPERATIONS)
def test_onnx_has_each_operation(name):
    """Or refuses it."""
    (ufunc, letter), columns = OPERATIONS[name], usual(name)
    wanted = of_program(name, columns)

    def apply(graph, nodes):
        return ufunc(*(Value(graph, node) for node in nodes)).node

    if name in REFUSED_IN_ONNX:
        with pytest.raises(ConfigError, match=f"{ufunc.__name__}.*{np.dtype(letter)}"):
            in_onnx(apply, columns)
        return
    tolerance = 1e-12 if letter == "d" and ufunc.__name__ not in (*SINGLE, "arctan2") else 3e-6
    found = in_onnx(apply, columns)
    assert found.dtype == wanted.dtype
    np.testing.assert_allclose(found, wanted, tolerance, tolerance)


@pytest.mark.parametrize("name", [name for name, one in HEIGHTS.items() if np.isfinite(one).all()])
def test_curves_in_onnx_are_those_of_numpy(name):
    xs, ys = map(np.asarray, HEIGHTS[name])

    def look_up(graph, nodes):
        graph.tables["table"] = np.concatenate([xs, ys, [-9.0, 9.0]])
        return Value(graph, *nodes).interpolated("table").node

    x = places_on(xs)
    wanted = np.interp(x, xs, ys, -9.0, 9.0)
    np.testing.assert_allclose(in_onnx(look_up, [x]), wanted, 1e-12, 1e-12)


def in_onnx(operation, columns):
    """What ONNX Runtime makes of an operation of a graph."""
    onnx = pytest.importorskip("onnx", reason="needs the extra 'onnx'")
    runtime = pytest.importorskip("onnxruntime", reason="needs ONNX Runtime")
    nodes, graph, names = Nodes(), Graph(), "xy"[: len(columns)]
    loads = [graph.load("row", name, columns[0].dtype) for name in names]
    node = operation(graph, loads)
    (result,) = Operations(nodes, graph, set(loads), "xy".__getitem__).written([node])

    def info(name, dtype):
        kind = onnx.helper.np_dtype_to_tensor_dtype(dtype)
        return onnx.helper.make_tensor_value_info(name, kind, [None])

    inputs = [info(name, columns[0].dtype) for name in names]
    outputs = [info(result, graph.nodes[node].dtype)]
    made = onnx.helper.make_graph(nodes.nodes, "function", inputs, outputs, nodes.tensors)
    opset = onnx.helper.make_opsetid("", 18)
    model = onnx.helper.make_model(made, opset_imports=[opset], ir_version=9)
    session = runtime.InferenceSession(model.SerializeToString())
    return session.run([result], dict(zip(names, columns, strict=True)))[0]
