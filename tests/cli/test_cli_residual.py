"""Residual policies: networks that add to the action of a controller."""

import json
from contextlib import closing

import numpy as np
import pytest
from export_tools import closed_loop
from test_residual import HIGH, TASK, TEXT, physical

import fmugym
from fmugym.control import controller_of
from fmugym.deployment.export import agent_of
from fmugym.training.agents import load_agent

sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra 'sb3'")
import torch  # noqa: E402  (comes with it)

from fmugym.training.residual import Residual  # noqa: E402
from fmugym.training.sb3 import ResidualActions, make_sb3_env  # noqa: E402

SAC = "--algorithm", "SAC", "learning_starts=10", "batch_size=16", "buffer_size=1000"
pytestmark = pytest.mark.filterwarnings("ignore")  # those of the libraries


@pytest.fixture
def task(tmp_path):
    fmugym.Task.from_dict(TASK).write(tmp_path / "task.toml")
    return tmp_path / "task.toml"


@pytest.fixture
def trained(task, tmp_path, ran):
    """Trains an agent, with more options."""

    def train(*options):
        folder = tmp_path / "agent"
        common = "--output", folder, "--envs", "2", "--episodes", "2", "--residual", "pi"
        ran("train", task, *common, *options)
        return folder

    return train


def actions_of(controller, seed=0):
    """The actions of an episode, as an environment gets them."""
    with closing(physical()) as env:
        controller.bind(env)
        observation, _ = env.reset(seed=seed)
        found, ends = [], False
        while not ends:
            found.append(np.array(controller.act(observation)))
            observation, _, terminated, truncated, _ = env.step(found[-1])
            ends = terminated or truncated
    return np.array(found)


def disturbed(residual):
    """Let the last layer of a model give something."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in residual.model.policy.actor.mu.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return residual


def test_environments_of_an_algorithm_equal_single_ones():
    """Over the ends of episodes, whose last observations have the controller's actions, too."""
    rng = np.random.default_rng(1)
    parts = rng.uniform(-1, 1, (90, 3, 1)).astype(np.float32)
    venv = make_sb3_env(physical, 3, seed=5, monitor=False)
    found, rewards = [], []
    with closing(ResidualActions(venv, Residual(controller_of(TEXT), 0.3))) as venv:
        found.append(venv.reset())
        lasts = []
        for part in parts:
            observations, reward, dones, infos = venv.step(part)
            found.append(observations)
            rewards.append(reward)
            lasts += [infos[i]["terminal_observation"] for i in np.flatnonzero(dones)]
    assert len(lasts) == 6
    for index in range(3):
        with closing(physical()) as env:
            residual = Residual(controller_of(TEXT), 0.3).bind(env)
            observation, _ = env.reset(seed=5 + index)
            own_lasts = []
            for step in range(90):
                seen = residual.seen(observation)
                np.testing.assert_array_equal(seen[0], found[step][index])
                action = residual.actions(parts[step, index])[0]
                observation, reward, terminated, truncated, _ = env.step(action)
                assert np.float32(reward) == rewards[step][index]
                if terminated or truncated:
                    own_lasts.append(residual.seen(observation)[0])
                    observation, _ = env.reset()
                    residual.reset()
            np.testing.assert_array_equal(own_lasts, lasts[index::3])


class TestTraining:
    @pytest.mark.parametrize("algorithm", ["SAC", "PPO", "TD3"])
    def test_untrained_it_is_the_controller_to_the_last_bit(self, algorithm, trained, tmp_path):
        options = ["n_steps=8"] if algorithm == "PPO" else ["learning_starts=1000"]
        folder = trained("--algorithm", algorithm, "--steps", "16", *options)
        residual = load_agent(folder)
        if algorithm == "PPO":  # it has learned
            torch.nn.init.zeros_(residual.model.policy.action_net.weight)
            torch.nn.init.zeros_(residual.model.policy.action_net.bias)
        for seed in range(5):
            own = actions_of(controller_of(TEXT), seed)
            np.testing.assert_array_equal(actions_of(residual, seed), own)

    def test_the_first_agent_is_the_controller(self, trained, task, ran):
        folder = trained(*SAC, "--steps", "16", "learning_starts=1000")
        first = (folder / "evaluations.csv").read_text().splitlines()[1]
        options = "--seed", "1000000", "--episodes", "2", "--json"
        text = ran("evaluate", task, "--controller", "pi", *options)
        (mean,) = (one["mean_reward"] for one in json.loads(text)["scores"] if one["name"] == "pi")
        assert first.startswith("0,")
        assert float(first.split(",")[1]) == pytest.approx(mean, rel=1e-12)

    def test_the_folder_plays_and_evaluates(self, trained, task, ran):
        folder = trained(*SAC, "--steps", "16", "--residual-scale", "0.1")
        facts = json.loads((folder / "agent.json").read_text())
        assert facts["residual"] == {"controller": TEXT, "scale": 0.1}
        ran("evaluate", task, "--agent", folder, "--episodes", "1")
        residual = disturbed(load_agent(folder))
        difference = np.abs(actions_of(residual)[0] - actions_of(controller_of(TEXT))[0])
        assert 0 < difference <= 0.1 * 2 * HIGH * (1 + 1e-6)

    def test_ranges_are_tuned(self, task, tmp_path, ran):
        folder = tmp_path / "agent"
        options = "--residual", "wide", "--steps", "16", "--episodes", "1", *SAC
        ran("train", task, "--output", folder, *options)
        text = json.loads((folder / "agent.json").read_text())["residual"]["controller"]
        assert 0.1 <= controller_of(text).ti <= 1

    def test_it_goes_on_to_the_last_bit(self, trained, task, tmp_path, ran):
        from test_cli_resume import interrupted, parameters

        whole, parts = tmp_path / "agent", tmp_path / "parts"
        trained(*SAC, "--steps", "320")
        common = "--envs", "2", "--episodes", "2", "--residual", "pi", "--steps", "320", *SAC
        with interrupted("SAC", 100), pytest.raises(AssertionError):
            ran("train", task, "--output", parts, *common)
        ran("train", task, "--output", parts, "--resume")
        assert parameters(parts) == parameters(whole)


class TestExport:
    @pytest.mark.parametrize("is_trained", [False, True])
    def test_in_c(self, is_trained, trained, tmp_path):
        residual = load_agent(trained(*SAC, "--steps", "16", "learning_starts=1000"))
        if is_trained:
            disturbed(residual)
        with closing(physical()) as env:
            agent = agent_of(env, residual)
            residual.bind(env)
            measured, written, steps = closed_loop(env, residual.act, agent, tmp_path, 40)
        assert measured <= 1e-5
        assert written <= (1e-6 if is_trained else 1e-12)
        assert steps == 40

    def test_by_the_command(self, trained, task, tmp_path, ran):
        folder = trained(*SAC, "--steps", "16")
        ran("export", folder, "--task", task, "--output", tmp_path / "residual.fmu")
        assert (tmp_path / "residual.fmu").exists()
