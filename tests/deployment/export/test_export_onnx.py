"""Exported agents as ONNX, run by ONNX Runtime."""

import json

import numpy as np
import pytest
import test_export
import test_export_search
from combinations import in_turn
from export_tools import (
    ACTIVATIONS,
    FUNCTIONS,
    Runner,
    acting,
    agent_named,
    arguments_of,
    closed_loop,
    exported,
    made,
    network_for,
    network_with,
)
from test_export import heating
from test_export_search import HEAT, HEATERS, heater

from fmugym import ConfigError
from fmugym.deployment.export import agent_of, write_onnx
from fmugym.deployment.export.onnx_model import Nodes, Operations
from fmugym.expressions.graph import Graph
from fmugym.expressions.program import operation_of
from fmugym.training.search.policy import ResidualAgent

onnx = pytest.importorskip("onnx", reason="needs the extra 'onnx'")
runtime = pytest.importorskip("onnxruntime", reason="needs ONNX Runtime")


class TestEpisodes(test_export.Loops):
    languages = ("ONNX",)

    def test_of_data_that_are_given(self, tmp_path):
        env = made("House")
        network = network_for(env)
        agent = agent_of(env, network, external=["T_set"])
        runner = exported(agent, tmp_path, "ONNX")
        places = [i for i, one in enumerate(env.observation_names) if one.startswith("T_set")]
        observation, _ = env.reset(seed=2)
        runner.begin(clock=env.variables["clock"])
        for _ in range(50):
            actions = runner.step([env.out["T_op"], env.out["T_w"], *observation[places]])
            observation, *_ = env.step(network.action(observation))
            assert actions[0] == pytest.approx(env.inputs[0], abs=1e-5)
        env.close()


class TestSearch(test_export_search.Agents):
    language, tolerance = "ONNX", 1e-8

    def test_the_memory_is_json_without_nan(self, tmp_path):
        env = heater(HEATERS["a controller"][0])
        path = write_onnx(agent_of(env, ResidualAgent("by hand", HEAT)), tmp_path / "agent.onnx")
        facts = runtime.InferenceSession(str(path)).get_modelmeta().custom_metadata_map
        assert json.loads(facts["memory"])["agent_controller"] == [0.0, None]
        env.close()


class TestFunctions:
    @pytest.mark.parametrize("letter", "dfq")
    def test_of_numpy(self, letter):
        dtype = np.dtype(letter)
        for ufunc in FUNCTIONS:
            is_wider = ufunc is np.float_power and letter != "d"  # it computes with float64
            if is_wider or operation_of(ufunc, letter) is None:
                continue
            values = arguments_of(ufunc, dtype)
            if letter == "q" and ufunc in {np.remainder, np.floor_divide}:
                values[1][values[1] == 0] = 3
            with np.errstate(all="ignore"):
                wanted = ufunc(*values)

            def apply(graph, operands, ufunc=ufunc, dtype=wanted.dtype):
                return graph.compute("ufunc", ufunc, operands, dtype, ufunc)

            single = ufunc in {np.arcsin, np.arccos, np.arctan, np.arctan2}
            tolerance = 1e-12 if letter == "d" and not single else 3e-6
            np.testing.assert_allclose(
                written(apply, values), wanted, rtol=tolerance, atol=tolerance, err_msg=str(ufunc)
            )

    def test_others_are_refused(self):
        def cube_root(graph, operands):
            return graph.compute("ufunc", np.cbrt, operands, np.dtype(np.float64), np.cbrt)

        with pytest.raises(ConfigError, match=r"cbrt.*float64"):
            written(cube_root, [np.ones(3)])

    @pytest.mark.parametrize("count", [1, 2, 7])
    def test_tables(self, count):
        rng = np.random.default_rng(0)
        xs, ys = np.sort(rng.normal(size=count)), rng.normal(size=count)

        def look_up(graph, operands):
            graph.tables["table"] = np.concatenate([xs, ys, [-9.0, 9.0]])
            return graph.compute("interpolate", "table", operands, np.dtype(np.float64), None)

        seen = np.concatenate([xs, rng.normal(size=50) * 2])
        own = written(look_up, [seen])
        assert own == pytest.approx(np.interp(seen, xs, ys, -9.0, 9.0), abs=1e-12)


def written(operation, values):
    """What ONNX Runtime makes of an operation of a graph."""
    nodes, graph, dtype = Nodes(), Graph(), values[0].dtype
    operands = tuple(graph.load("row", name, dtype) for name in "xy"[: len(values)])
    node = operation(graph, operands)
    result = graph.nodes[node].dtype
    operations = Operations(nodes, graph, set(operands), "xy".__getitem__)
    (name,) = operations.written([node])
    made = onnx.helper.make_graph(
        nodes.nodes,
        "function",
        [value_info(name, dtype) for name in "xy"[: len(values)]],
        [value_info(name, result)],
        nodes.tensors,
    )
    return run_graph(made, dict(zip("xy", values, strict=False)), name)


def value_info(name, dtype):
    kind = onnx.helper.np_dtype_to_tensor_dtype(dtype)
    return onnx.helper.make_tensor_value_info(name, kind, [None])


def run_graph(graph, values, result):
    opset = onnx.helper.make_opsetid("", 18)
    model = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=9)
    return runtime.InferenceSession(model.SerializeToString()).run([result], values)[0]


class TestModel:
    def test_many_plants_at_once(self, tmp_path):
        env = heating("history")
        path = write_onnx(agent_of(env, network_for(env)), tmp_path / "agent.onnx")
        env.close()
        seen = 290 + 5 * np.random.default_rng(0).normal(size=(20, 7, 1))
        many, one = Runner(path, 7), Runner(path)
        together = np.array([many.steps(row) for row in seen])
        alone = np.array([one.steps(row[3:4]) for row in seen])
        assert together[:, 3:4] == pytest.approx(alone, abs=1e-6)
        assert np.ptp(together) > 0.01

    def test_says_what_it_is(self, tmp_path):
        env = made("House")
        path = write_onnx(agent_of(env, network_for(env)), tmp_path / "agent.onnx")
        env.close()
        facts = Runner(path).facts
        assert facts["measurements"][0] == {"name": "T_op", "unit": "K"}
        assert [one["name"] for one in facts["actions"]] == ["u"]
        assert facts["sample_time"] == 900.0
        assert facts["memory"].keys() == {"count", "clock"}
        onnx.checker.check_model(str(path), full_check=True)

    @in_turn({"activation": {one.name: one for one in ACTIVATIONS}, "squashed": [False, True]})
    def test_activations(self, activation, squashed, tmp_path):
        env = made("Pendulum")
        network = network_with(activation, env, squashed)
        agent = agent_of(env, network)
        _, written, _ = closed_loop(env, acting(network), agent, tmp_path, 50, language="ONNX")
        assert written <= 1e-5
        env.close()

    def test_nothing_is_overwritten(self, tmp_path):
        agent = agent_named()
        write_onnx(agent, tmp_path / "agent.onnx")
        with pytest.raises(FileExistsError, match=r"agent\.onnx"):
            write_onnx(agent, tmp_path / "agent.onnx")
        with pytest.raises(ConfigError, match="nowhere"):
            write_onnx(agent, tmp_path / "nowhere" / "agent.onnx")
