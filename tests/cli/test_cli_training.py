"""Training and evaluation from the command line."""

import csv
import errno
import json
import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import fmugym
from fmugym import ConfigError
from fmugym.records.evaluation import HELD_OUT_SEED, evaluate, warning_of_one_reward
from fmugym.records.players import Player, action_of
from fmugym.training.sb3_training import TrainingSettings, algorithm_arguments, train

CART_POLE = str(Path(__file__).parents[2] / "examples" / "cart_pole.toml")
SCENARIOS = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "1s",
    "variables": {"tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot", "goal"]},
    "data": {"goal": {"values": [0, 1, 2], "step": "1d"}},
    "reward": "-abs(q - goal)",
    "costs": {"effort": "abs(tau)"},
    "clock": {"from": "01-01", "to": "01-03", "step": "1h", "exclude": "scenarios"},
    "scenarios": {
        "early": {"start": "01-01 12:00", "length": "0.5s"},
        "late": {"start": "01-02 12:00", "length": "0.5s"},
    },
}


class Parts(fmugym.FMI2CSEnv):
    """A pendulum with a number and a choice as observations."""

    def __init__(self):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "time_step": 0.05,
            "max_episode_steps": 20,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum", "2.0"), config)

    def _get_action_space(self):
        return spaces.Box(-2, 2, (1,), np.float32)

    def _get_observation_space(self):
        angle = spaces.Box(-np.inf, np.inf, (1,), np.float32)
        return spaces.Dict({"angle": angle, "side": spaces.Discrete(2)})

    def _get_observation(self):
        angle = np.array(self.state[:1], np.float32)
        return {"angle": angle + np.float32(1000), "side": np.int64(angle[0] > 0)}

    def _is_done(self):
        return False


@pytest.fixture
def trained(cli):
    """By PPO, if the arguments name no other algorithm."""
    return lambda task, *arguments: cli("train", task, "--algorithm", "PPO", *arguments)


@pytest.mark.parametrize(
    ("function", "options"), [("train", ["--algorithm", "PPO"]), ("Searching.run", [])]
)
def test_a_full_disk_is_told_with_the_folder(function, options, tmp_path, cli, monkeypatch):
    def fill(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"fmugym.cli.training_commands.{function}", fill)
    options = "--output", tmp_path / "agent", *options
    code, out, err = cli("train", CART_POLE, *options)
    assert (code, out) == (1, "")
    assert err == f"fmugym: error: {tmp_path / 'agent'}: No space left on device\n"


class TestEvaluate:
    def test_controllers_play_the_same_episodes(self, cli):
        arguments = "--action", "-10", "--action", "10", "--episodes", "4", "--json"
        code, out, _ = cli("evaluate", CART_POLE, *arguments)
        scores = json.loads(out)["scores"]
        assert code == 0
        assert [score["name"] for score in scores] == ["random", "action -10", "action 10"]
        env = fmugym.load(CART_POLE)
        lengths = []
        for seed in range(1_000_000, 1_000_004):
            env.reset(seed=seed)
            steps = 1
            while not env.step(1)[2]:
                steps += 1
            lengths.append(steps)
        env.close()
        assert scores[2]["rewards"] == scores[2]["steps"] == lengths
        assert scores[2]["mean_reward"] == np.mean(lengths)
        low, high = scores[2]["interval_95"]
        assert low < np.mean(lengths) < high
        assert scores[2]["ends"] == {"terminated": 4}

    def test_a_table_with_costs_and_a_scenario(self, tmp_path, ran):
        fmugym.Task.from_dict(SCENARIOS).write(tmp_path / "a.toml")
        arguments = "--scenario", "late", "--action", "0.1", "--episodes", "2"
        out = ran("evaluate", tmp_path / "a.toml", *arguments)
        header, random, constant = (line.split() for line in out.splitlines())
        assert header[:4] == ["reward", "+-", "cost", "steps"]
        assert random[0] == "random"
        assert constant[:2] == ["action", "0.1"]
        assert float(constant[4]) == pytest.approx(1.0)
        assert constant[5:8] == ["10", "2", "truncated"]


def test_arguments_of_an_algorithm():
    texts = ["gamma=0.9", "n_steps=64", "policy=MlpPolicy", "policy_kwargs={net_arch=[8]}", "a=b=c"]
    assert algorithm_arguments(texts) == {
        "gamma": 0.9,
        "n_steps": 64,
        "policy": "MlpPolicy",
        "policy_kwargs": {"net_arch": [8]},
        "a": "b=c",
    }
    with pytest.raises(ConfigError, match="'gamma'"):
        algorithm_arguments(["gamma"])


@pytest.mark.parametrize(
    ("reward", "terminated", "told"),
    [
        ("0", "q_dot > 0.3", "0 in every step"),
        ("-1", "false", "-1 in every step"),
        ("-1", "q_dot > 0.3", None),
        ("-abs(q)", "false", None),
    ],
)
def test_a_reward_that_never_changes_is_warned_of(reward, terminated, told):
    task = {k: v for k, v in SCENARIOS.items() if k != "costs"}
    task |= {"reward": reward, "terminated": terminated}
    make_env, player = partial(fmugym.load, task), Player(partial(action_of, text="random"), False)
    scores = list(evaluate(make_env, {"a": player, "b": player}, range(4), 100))
    warning = warning_of_one_reward(scores)
    assert (told is None) == (warning is None)
    assert told is None or told in warning


class TestTrain:
    @pytest.fixture(autouse=True)
    def sb3(self):
        pytest.importorskip("stable_baselines3", reason="needs the extra test-sb3")

    def test_an_agent_learns_is_kept_and_evaluated(self, tmp_path, cli, trained):
        folder = tmp_path / "agent"
        options = "--steps", "6000", "--episodes", "3", "--output", folder
        arguments = "n_steps=128", "batch_size=256"
        code, out, err = trained(CART_POLE, *arguments, *options)
        assert code == 0
        plan = "PPO learns for up to 6000 steps of 8 environments; 3 episodes are played every 600"
        assert err.startswith(plan)
        assert "5120 steps: reward" in err  # five rollouts of 128 steps in 8 environments
        assert "held-out seeds" in out
        rows = list(csv.DictReader((folder / "evaluations.csv").read_text().splitlines()))
        assert len(rows) > 5
        best = max(float(row["reward"]) for row in rows)
        assert json.loads((folder / "agent.json").read_text())["reward"] == best > 100
        names = "--agent", folder, "--episodes", "3", "--json"
        code, out, _ = cli("evaluate", CART_POLE, *names)
        random, agent = json.loads(out)["scores"]
        assert code == 0
        assert agent["mean_reward"] == best > 2 * random["mean_reward"]
        code, _, err = trained(CART_POLE, *options)
        assert code == 1
        assert "exists" in err

    def test_no_agent_is_evaluated_twice(self, tmp_path, trained):
        """PPO learns after every 128 steps here, and an evaluation is due after every 27."""
        folder = tmp_path / "agent"
        options = "--steps", "270", "--envs", "4", "--episodes", "1", "--output", folder
        code, _, err = trained(CART_POLE, "n_steps=32", *options)
        assert code == 0
        assert "n_steps" not in err
        rows = list(csv.DictReader((folder / "evaluations.csv").read_text().splitlines()))
        assert [int(row["steps"]) for row in rows] == [28, 132, 256]

    @pytest.mark.parametrize(
        ("arguments", "steps", "done"),
        [
            (["n_steps=16", "batch_size=32"], 100, 96),
            ([], 300, 256),  # shorter rollouts than the 2048 steps of PPO's own
            (["--algorithm", "SAC", "learning_starts=10", "train_freq=10"], 99, 80),
            (["--algorithm", "SAC", "learning_starts=10"], 33, 32),
        ],
    )
    def test_steps_are_a_ceiling(self, tmp_path, trained, arguments, steps, done):
        fmugym.Task.from_dict(SCENARIOS).write(tmp_path / "a.toml")
        options = "--steps", steps, "--envs", "2", "--episodes", "1", "--output", tmp_path / "a"
        code, *_ = trained(tmp_path / "a.toml", *arguments, *options)
        assert code == 0
        last = (tmp_path / "a" / "evaluations.csv").read_text().splitlines()[-1]
        assert int(last.partition(",")[0]) == done

    def test_the_scores_are_those_of_the_agent_that_is_kept(self, tmp_path, trained, monkeypatch):
        """A training whose agent gets worse: it pushes, where none should."""
        pushes = iter([0.0, 5.0, 5.0])

        def train(self):
            self._n_updates += 1
            for parameter in self.policy.parameters():
                parameter.data.zero_()
            self.policy.action_net.bias.data.fill_(next(pushes))

        monkeypatch.setattr("stable_baselines3.PPO.train", train)
        fmugym.Task.from_dict(SCENARIOS).write(tmp_path / "a.toml")
        options = "--steps", "192", "--envs", "2", "--output", tmp_path / "agent", "n_steps=32"
        code, out, err = trained(tmp_path / "a.toml", *options, "--json")
        told = json.loads(out)
        text = (tmp_path / "agent" / "evaluations.csv").read_text()
        rows = list(csv.DictReader(text.splitlines()))
        best = max(rows, key=lambda row: float(row["reward"]))
        assert code == 0
        assert best != rows[-1]
        for score in told["scores"]:
            assert score["mean_reward"] == float(best[score["name"]])
        assert f"the agent after {best['steps']} steps" in err

    def test_scenarios_are_the_evaluation(self, tmp_path, trained):
        fmugym.Task.from_dict(SCENARIOS).write(tmp_path / "a.toml")
        arguments = "learning_starts=10", "train_freq=20"
        options = "--steps", "100", "--envs", "2", "--episodes", "1", "--algorithm", "SAC"
        output = "--output", tmp_path / "agent"
        code, out, _ = trained(tmp_path / "a.toml", *arguments, *options, *output)
        assert code == 0
        assert [line.split()[0] for line in out.splitlines()[1:]] == ["early", "late"]
        text = (tmp_path / "agent" / "evaluations.csv").read_text()
        rows = list(csv.DictReader(text.splitlines()))
        assert {"early", "late"} < rows[0].keys()

    def test_a_reward_that_never_changes_is_told_once(self, tmp_path, trained):
        fmugym.Task.from_dict(SCENARIOS | {"reward": "0"}).write(tmp_path / "a.toml")
        options = "--steps", "64", "--envs", "2", "--episodes", "1", "--output", tmp_path / "agent"
        own = "n_steps=8", "batch_size=16"
        code, _, err = trained(tmp_path / "a.toml", *own, *options)
        assert code == 0
        assert err.count("the reward was 0") == 1
        assert err.count("in evaluation") > 2

    @pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
    def test_actions_are_scaled_and_observations_normalized(self, algorithm, tmp_path, trained):
        """Gymnasium's wrapper of the same model gives the rewards that are told."""
        from stable_baselines3 import PPO, SAC

        task = SCENARIOS | {"variables": {"tau": {"min": -50, "max": 150}}}
        del task["scenarios"], task["clock"], task["data"]
        task |= {"agent": {"actions": ["tau"], "observations": ["q", "q_dot"]}, "reward": "-abs(q)"}
        fmugym.Task.from_dict(task).write(tmp_path / "a.toml")
        own = ["n_steps=16", "batch_size=32"] if algorithm == "PPO" else ["learning_starts=10"]
        options = "--steps", "64", "--envs", "2", "--episodes", "1", "--json"
        folder = tmp_path / "agent"
        chosen = "--algorithm", algorithm, "--output", folder
        code, out, _ = trained(tmp_path / "a.toml", *own, *options, *chosen)
        assert code == 0
        model = {"PPO": PPO, "SAC": SAC}[algorithm].load(folder / "model.zip")
        normalization = pickle.loads((folder / "normalization.pkl").read_bytes())
        normalization.training = False
        env = fmugym.load(tmp_path / "a.toml")
        outer = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
        assert model.action_space == outer.action_space
        seen, _ = outer.reset(seed=HELD_OUT_SEED)
        total, is_over = 0.0, False
        while not is_over:
            action, _ = model.predict(normalization.normalize_obs(seen), deterministic=True)
            seen, reward, *ends, _ = outer.step(action)
            total, is_over = total + reward, any(ends[:2])
        env.close()
        assert json.loads(out)["scores"][0]["mean_reward"] == pytest.approx(total, rel=1e-4)

    def test_parts_of_observations_are_normalized(self, tmp_path):
        """Numbers are, and choices are not."""
        from stable_baselines3 import PPO

        settings = TrainingSettings(Parts, {"held out": Parts}, tmp_path / "agent", steps=64)
        train(
            replace(settings, num_envs=2, arguments={"n_steps": 16, "batch_size": 32}, episodes=1)
        )
        normalization = pickle.loads((tmp_path / "agent" / "normalization.pkl").read_bytes())
        assert normalization.norm_obs_keys == ["angle"]
        assert normalization.obs_rms["angle"].mean == pytest.approx(1000.0, rel=0.01)
        assert PPO.load(tmp_path / "agent" / "model.zip").action_space.high == [1.0]

    @pytest.mark.parametrize("evaluations", [1, 0])
    def test_an_interruption_in_an_evaluation(
        self, tmp_path, cli, trained, monkeypatch, evaluations
    ):
        """The agent is kept, although it was never evaluated if there is a second Ctrl-C."""
        from fmugym.training import sb3_training

        original, calls = (
            sb3_training.evaluate,
            iter([False] * 1 + [True] + [False] * 9 * evaluations),
        )

        def evaluate(*args, **kwargs):  # the second scenario of the first evaluation
            if next(calls, True):
                raise KeyboardInterrupt
            return original(*args, **kwargs)

        monkeypatch.setattr(sb3_training, "evaluate", evaluate)
        fmugym.Task.from_dict(SCENARIOS).write(tmp_path / "a.toml")
        folder = tmp_path / "agent"
        options = "--output", folder, "--episodes", "1", "--envs", "2", "--steps", "400"
        arguments = "n_steps=32", "batch_size=32"
        code, _, err = trained(tmp_path / "a.toml", *arguments, *options)
        assert code == 130
        assert "nothing was trained" not in err
        assert str(folder) in err
        code, *_ = cli("evaluate", tmp_path / "a.toml", "--agent", folder, "--episodes", "1")
        assert code == 0
        assert ("reward" in json.loads((folder / "agent.json").read_text())) == bool(evaluations)
