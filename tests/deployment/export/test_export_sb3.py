"""Exported agents of Stable-Baselines3 and PyTorch, beside the originals."""

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from export_tools import closed_loop, compiled, made
from fmpy.validation import validate_fmu
from test_export import FILTERED

import fmugym
from fmugym import ConfigError
from fmugym.deployment.export import Scaling, agent_of, network_of
from fmugym.deployment.export.decision import network_of_model

sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra 'sb3'")
torch = pytest.importorskip("torch", reason="needs PyTorch")

EXAMPLES = Path(__file__).parents[3] / "examples"
CONTINUOUS = ["PPO", "A2C", "SAC", "TD3", "DDPG", "TRPO", "TQC"]
DISCRETE = ["PPO", "DQN", "QRDQN"]
SMALL = {
    **{key: {"net_arch": [32, 32]} for key in ["SAC", "TD3", "DDPG", "TQC"]},
    **{key: {"net_arch": [32, 32]} for key in ["DQN", "QRDQN"]},
}
pytestmark = pytest.mark.filterwarnings("ignore")  # those of the libraries


def algorithm(name):
    if hasattr(sb3, name):
        return getattr(sb3, name)
    return getattr(pytest.importorskip("sb3_contrib", reason="needs sb3-contrib"), name)


def model_of(name, env, **more):
    keywords = {"policy_kwargs": dict(SMALL.get(name, {})), "device": "cpu", "seed": 0} | more
    return algorithm(name)("MlpPolicy", env, **keywords)


def filtered():
    return fmugym.load(FILTERED)


def predicting(model, normalization=None):
    """A model as an agent of an environment."""

    def act(observation):
        if normalization is not None:
            observation = normalization.normalize_obs(observation)
        return model.predict(observation, deterministic=True)[0]

    return act


class TestClosedLoop:
    """Whole episodes: the environment with its agent, and the plant with the agent in C."""

    @pytest.mark.parametrize(
        ("name", "are_scaled"),
        [*((name, False) for name in CONTINUOUS), ("PPO", True), ("SAC", True), ("TD3", True)],
    )
    def test_continuous_actions(self, name, are_scaled, tmp_path):
        """Gymnasium's wrapper brings those from -1 to 1 to the ranges of the task."""
        env = played = made("Pendulum")
        if are_scaled:
            played = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
        model = model_of(name, played)
        agent = agent_of(env, model)
        measured, written, steps = closed_loop(played, predicting(model), agent, tmp_path, 700)
        assert measured <= 1e-4
        assert written <= 1e-4
        assert steps == 700
        env.close()

    @pytest.mark.parametrize("name", DISCRETE)
    def test_discrete_actions(self, name, tmp_path):
        env = made("CartPole")
        model = model_of(name, env)
        agent = agent_of(env, model)
        measured, written, steps = closed_loop(env, predicting(model), agent, tmp_path)
        assert (measured, written) == (0.0, 0.0)
        assert steps >= 8
        env.close()

    def test_a_house_with_running_normalization(self, tmp_path):
        from stable_baselines3.common.vec_env import VecNormalize

        from fmugym.training.sb3 import make_sb3_env

        venv = VecNormalize(make_sb3_env("fmugym/House-v0", 4, seed=0))
        model = model_of("PPO", venv, n_steps=64, batch_size=64)
        model.learn(512)
        venv.training = False
        env = made("House")
        agent = agent_of(env, model, venv, all_inputs=True)
        predict = predicting(model, venv)
        measured, written, steps = closed_loop(env, predict, agent, tmp_path)
        assert measured <= 1e-3
        assert written <= 1e-4
        assert steps == 672
        env.close()
        venv.close()

    def test_several_actions(self, tmp_path):
        from stable_baselines3.common.vec_env import VecNormalize

        from fmugym.training.sb3 import make_sb3_env

        venv = VecNormalize(make_sb3_env(filtered, 2, seed=0))
        model = model_of("PPO", venv, n_steps=64, batch_size=64)
        model.learn(256)
        venv.training = False
        env = filtered()
        agent = agent_of(env, model, venv)
        played = closed_loop(env, predicting(model, venv), agent, tmp_path)
        assert played == (0.0, 0.0, 100)
        env.close()
        venv.close()

    @pytest.mark.parametrize("name", ["PPO", "SAC"])
    def test_noise_that_depends_on_states(self, name, tmp_path):
        env = made("Pendulum")
        model = model_of(name, env, use_sde=True)
        agent = agent_of(env, model)
        measured, written, _ = closed_loop(env, predicting(model), agent, tmp_path, 700)
        assert measured <= 1e-4
        assert written <= 1e-4
        env.close()


class TestPyTorch:
    def test_a_sequential(self, tmp_path):
        env = made("CartPole")
        layers = [torch.nn.Linear(4, 8), torch.nn.ReLU(), torch.nn.Linear(8, 2)]
        module = torch.nn.Sequential(torch.nn.Sequential(*layers[:2]), layers[2])
        controller = compiled(agent_of(env, network_of(module, env.action_space)), tmp_path)
        controller.begin()
        env.close()
        for seen in np.random.default_rng(0).normal(size=(100, 4)).astype(np.float32):
            best = int(module(torch.as_tensor(seen)).argmax())
            assert controller.step(seen.tolist()) == [[-10.0, 10.0][best]]

    def test_the_agent_of_the_example(self, tmp_path, monkeypatch):
        monkeypatch.syspath_prepend(str(EXAMPLES))
        import ppo

        options = {"env_id": "fmugym/Pendulum-v0", "num_envs": 8, "steps": 512, "normalize": True}
        settings = ppo.Settings(**options)
        example = ppo.train(settings, lambda steps, mean, agent: None)
        env = made("Pendulum")
        scale = Scaling(example.scale.mean, example.scale.spread, np.full(3, np.inf))
        modules = [example._body, example._actor, torch.nn.Hardtanh()]
        network = network_of(modules, env.action_space, scaling=scale, squashed=True)
        controller = compiled(agent_of(env, network), tmp_path)
        controller.begin()
        env.close()
        for theta, speed in np.random.default_rng(0).normal(size=(100, 2)):
            seen = np.array([[np.cos(theta), np.sin(theta), speed]], np.float32)
            torque = np.float32(3 * example.act(seen)[0, 0]) / 3
            assert controller.step([theta, speed]) == pytest.approx([torque], abs=1e-5)

    def test_other_modules_are_refused(self):
        module = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.LayerNorm(8))
        with pytest.raises(ConfigError, match="LayerNorm"):
            network_of(module, gymnasium.spaces.Discrete(8))


class TestRefused:
    def test_a_policy_with_images(self):
        space = gymnasium.spaces.Box(0, 255, (36, 36, 1), np.uint8)
        env = Pretend(space, gymnasium.spaces.Discrete(2))
        model = sb3.PPO("CnnPolicy", env, device="cpu")
        with pytest.raises(ConfigError, match="NatureCNN"):
            network_of_model(model)

    def test_a_policy_that_observes_a_dict(self):
        space = gymnasium.spaces.Dict({"angle": gymnasium.spaces.Box(-1, 1, (2,))})
        env = Pretend(space, gymnasium.spaces.Discrete(2))
        model = sb3.PPO("MultiInputPolicy", env, device="cpu")
        with pytest.raises(ConfigError, match=r"Dict.*a Box can be"):
            network_of_model(model)

    @pytest.mark.parametrize(
        ("name", "policy", "fact"),
        [("RecurrentPPO", "MlpLstmPolicy", "memory"), ("MaskablePPO", "MlpPolicy", "masks")],
    )
    def test_a_policy_that_needs_more_than_observations(self, name, policy, fact):
        env = made("CartPole")
        model = algorithm(name)(policy, env, device="cpu")
        with pytest.raises(ConfigError, match=f"{name}.*{fact}"):
            agent_of(env, model)
        env.close()

    def test_a_policy_that_does_more_than_its_layers(self):
        env = made("Pendulum")
        model = model_of("PPO", env)
        predict = model.policy._predict
        model.policy._predict = lambda *args, **more: predict(*args, **more) + 0.5
        with pytest.raises(ConfigError, match="more than its layers"):
            agent_of(env, model)
        env.close()


class Pretend(gymnasium.Env):
    """An environment of nothing but spaces."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


class TestCommand:
    """``fmugym export``."""

    def test_from_training_to_c(self, tmp_path, ran, refused):
        task, folder, output = EXAMPLES / "cart_pole.toml", tmp_path / "agent", tmp_path / "agent.c"
        options = "--steps", "256", "--envs", "2", "--episodes", "1", "n_steps=64"
        ran("train", task, "--output", folder, "--algorithm", "PPO", *options)
        command = "export", folder, "--task", task, "--output", output
        facts = json.loads(ran(*command, "--json"))
        assert facts["files"] == [str(tmp_path / "agent.h"), str(output)]
        assert [one["name"] for one in facts["measurements"]] == ["x", "x_dot", "phi", "phi_dot"]
        assert facts["actions"] == [{"name": "f", "unit": "N"}]
        assert facts["sample_time"] == 0.02
        assert "agent.c exists" in refused(*command)  # the files are there

    @pytest.fixture
    def export(self, tmp_path, cli):
        """Export an untrained model; it, the exit code, and what the command printed."""

        def command(env_id, output, *options, algorithm="PPO"):
            env = made(env_id)
            model = model_of(algorithm, env)
            model.save(tmp_path / "model.zip")
            env.close()
            arguments = "--task", f"fmugym/{env_id}-v0", "--output", tmp_path / output
            return model, *cli("export", tmp_path / "model.zip", *arguments, *options)

        return command

    def test_to_an_fmu(self, export, tmp_path, ran):
        _, code, out, _ = export("House", "heater.fmu", "--fmi", "3.0", "--json")
        assert code == 0
        assert [one["name"] for one in json.loads(out)["parameters"]] == ["clock"]
        assert validate_fmu(str(tmp_path / "heater.fmu")) == []
        assert "heater" in ran("info", tmp_path / "heater.fmu")

    def test_to_onnx(self, export, tmp_path):
        runtime = pytest.importorskip("onnxruntime", reason="needs ONNX Runtime")
        model, code, out, _ = export("CartPole", "agent.onnx")
        assert (code, "action f N" in out) == (0, True)
        session = runtime.InferenceSession(str(tmp_path / "agent.onnx"))
        seen = np.random.default_rng(0).normal(size=(100, 4))
        count = np.zeros(100, np.int64)
        (actions,) = session.run(["actions"], {"measurements": seen, "count": count})
        best, _ = model.predict(seen.astype(np.float32), deterministic=True)
        assert actions[:, 0].tolist() == np.where(best, 10.0, -10.0).tolist()

    def test_of_another_algorithm(self, export):
        _, code, out, _ = export("Pendulum", "swing.c", "--algorithm", "SAC", algorithm="SAC")
        assert (code, "action tau N.m" in out) == (0, True)

    @pytest.mark.parametrize(("output", "fact"), [("a-b.c", "'a-b'"), ("no/agent.c", "no folder")])
    def test_mistakes(self, output, fact, export):
        _, code, _, err = export("CartPole", output)
        assert (code, fact in err) == (1, True)
