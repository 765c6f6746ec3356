"""Exported agents as ONNX, run by ONNX Runtime."""

import json

import numpy as np
import pytest
import test_export
import test_export_search
from combinations import in_turn
from export_tools import (
    ACTIVATIONS,
    Runner,
    acting,
    agent_named,
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
