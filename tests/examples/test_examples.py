"""The training example: its agents, its program, and the files that it writes."""

import itertools
import multiprocessing

import gymnasium as gym
import numpy as np
import pytest
from example_tools import EXAMPLES, run_example
from PIL import Image

METHODS = ["QLearning", "RandomSearch"]
MOST_LINES = {
    "own_fmu": 80,
    "ppo": 249,
    "mpc_pendulum": 149,
}


@pytest.mark.parametrize(("name", "lines"), MOST_LINES.items())
def test_some_are_short(name, lines):
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= lines


@pytest.fixture(name="agents")
def fixture_agents(example):
    return example("agents")


@pytest.fixture(name="training")
def fixture_training(example):
    return example("train_cart_pole")


@pytest.fixture(scope="module", name="quick")
def fixture_quick(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quick")
    return folder, run_training("--quick", folder=folder)


def run_training(*arguments, folder):
    return run_example("train_cart_pole.py", *arguments, folder=folder, warnings="default")


def learnt(agents, method, seed, episodes=40):
    """The first training episodes of a new agent, and its actions afterwards."""
    env = gym.make("fmugym/CartPole-v0")
    env.reset(seed=seed)
    agent = getattr(agents, method)(env.observation_space, seed)
    played = list(itertools.islice(agent.learn(env), episodes))
    observations = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 4)).astype(np.float32)
    return played, [agent.policy()(observation) for observation in observations]


def test_the_program_ends_well_and_writes_two_files_only(quick):
    folder, _ = quick
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
    assert files == ["results/learning_curves.png", "results/trained_agent.gif"]


def test_the_table_tells_of_both_methods_and_the_text_is_free_of_escapes(quick):
    text = quick[1]
    for row in ("Q-learning", "Random search"):
        line = next(line for line in text.splitlines() if f"│ {row}" in line)
        assert line.count("│") == 8
        assert "/2" in line
    assert "Mean length of 10 held-out episodes" in text
    assert "learning_curves.png" in text
    assert "trained_agent.gif" in text
    assert "\x1b" not in text
    assert "\r" not in text


def test_the_learning_curves_are_a_picture_with_both_colours(quick, training):
    with Image.open(quick[0] / "results/learning_curves.png") as picture:
        assert picture.format == "PNG"
        assert picture.width > 1000
        seen = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
    for colour in training.COLOURS.values():
        assert tuple(bytes.fromhex(colour[1:])) in seen


def test_the_animation_moves_for_as_long_as_the_episode_said(quick):
    steps = int(quick[1].rpartition(" steps)")[0].rpartition(" ")[2])
    with Image.open(quick[0] / "results/trained_agent.gif") as animation:
        frames = [animation.seek(i) or animation.convert("RGB").tobytes() for i in range(3)]
        assert (animation.format, animation.size) == ("GIF", (600, 400))
        assert animation.n_frames == pytest.approx(steps / 2, abs=1)
        assert animation.info["duration"] == 40
    assert len(set(frames)) == 3
    assert (quick[0] / "results/trained_agent.gif").stat().st_size < 1_500_000


def test_the_program_takes_the_environment_and_its_arguments(tmp_path):
    arguments = "--quick --method random-search --seeds 1 --workers 1 --output made/here"
    plant = "--env fmugym/ModelicaCartPole-v0 --set force=20 --set negative_reward=-50"
    printed = run_training(*arguments.split(), *plant.split(), folder=tmp_path)
    assert "Q-learning" not in printed
    assert len(list((tmp_path / "made/here").iterdir())) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "0"], "must be at least 1, is 0"),
        (["--set", "force"], "must be NAME=VALUE, is force"),
        (["--set", "no_such_argument=1"], "unexpected keyword argument 'no_such_argument'"),
        (["--env", "Pendulum-v1"], "expected 4 observations and 2 actions"),
        (["--env", "fmugym/NoSuchEnv-v0"], "NoSuchEnv"),
        (["--first-seed", "999999"], "kept for the evaluation"),
    ],
)
def test_a_mistake_on_the_command_line_is_named(training, capsys, arguments, message):
    with pytest.raises(SystemExit) as ended:
        training.main(arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_ctrl_c_ends_the_program_and_its_workers(training, monkeypatch, capsys, tmp_path):
    def press_ctrl_c(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "watch", press_ctrl_c)
    assert training.main(["--quick", "--output", str(tmp_path / "results")]) == 130
    assert capsys.readouterr() == ("Interrupted.\n", "")
    assert multiprocessing.active_children() == []
    assert list(tmp_path.iterdir()) == []


def test_the_learning_curve_is_the_mean_of_the_latest_episodes(training):
    task = training.Task("q-learning", 0, 1000, 1)
    run = training.Run(task, None, np.array([100, 200, 300, 400]), 0.0, 0.0, 0.0)
    curve = training.learning_curve(run, np.array([100, 599, 600, 1000]), window=500)
    assert curve.tolist() == [100, 150, 250, 350]


@pytest.mark.parametrize("method", METHODS)
def test_an_agent_learns_the_same_from_the_same_seed(agents, method):
    assert learnt(agents, method, seed=3) == learnt(agents, method, seed=3)
    assert learnt(agents, method, seed=3) != learnt(agents, method, seed=4)


def test_random_search_solves_the_task(agents):
    env = gym.make("fmugym/CartPole-v0")
    env.reset(seed=0)
    agent = agents.RandomSearch(env.observation_space, 0)
    steps = itertools.accumulate(episode.steps for episode in agent.learn(env))
    next(total for total in steps if total >= 40_000)
    held_out = [agents.play(env, agent.policy(), 1_000_000 + i).steps for i in range(100)]
    assert np.mean(held_out) >= 475


def test_q_learning_moves_a_value_by_the_temporal_difference(agents):
    agent = agents.QLearning(gym.make("fmugym/CartPole-v0").observation_space, 0)
    agent.values[7], agent.values[8] = [10.0, 20.0], [30.0, 5.0]
    agent.update(7, 1, reward=1.0, next_cell=8)
    assert agent.values[7] == pytest.approx([10.0, 22.14])  # 20 + 0.2 (1 + 0.99 * 30 - 20)
    agent.update(8, 0, reward=1.0, next_cell=None)
    assert agent.values[8] == pytest.approx([24.2, 5.0])  # 30 + 0.2 (1 - 30)
    assert (agent.best_action(7), agent.best_action(8)) == (1, 0)


def test_q_learning_starts_above_what_can_be_earned(agents):
    agent = agents.QLearning(gym.make("fmugym/CartPole-v0").observation_space, 0)
    assert np.shape(agent.values) == (324, 2)
    assert np.min(agent.values) >= 100


@pytest.mark.parametrize(
    ("observation", "cell"),
    [
        ([-5.0, -5.0, -5.0, -5.0], 0),
        ([5.0, 5.0, 5.0, 5.0], 323),
        ([0.0, 0.0, 0.01, -0.01], 1 * 108 + 1 * 36 + 3 * 6 + 2),
    ],
)
def test_q_learning_counts_the_cells_from_the_low_corner(agents, observation, cell):
    agent = agents.QLearning(gym.make("fmugym/CartPole-v0").observation_space, 0)
    assert agent.cell(np.array(observation, np.float32)) == cell


def test_random_search_moves_its_weights_towards_what_paid(agents):
    agent = agents.RandomSearch(gym.make("fmugym/CartPole-v0").observation_space, 0)
    returns = np.array([[30.0, 10.0], [10.0, 30.0]])
    agent.update(np.eye(4)[:2], returns)
    assert agent.weights == pytest.approx([0.1, -0.1, 0, 0])
    agent.update(np.eye(4)[:2], np.full((2, 2), 500.0))
    assert agent.weights == pytest.approx([0.1, -0.1, 0, 0])


def test_the_upright_pole_is_found_in_the_middle_of_the_observations(agents):
    upright = agents.middle(gym.make("fmugym/ModelicaCartPole-v0").observation_space)
    assert upright == pytest.approx([0, 0, np.pi / 2, 0])
    policy = agents.LinearPolicy(np.array([0.0, 0, 1, 0]), upright)
    assert policy(np.array([0, 0, np.pi / 2 + 0.01, 0], np.float32)) == 1
    assert policy(np.array([0, 0, np.pi / 2 - 0.01, 0], np.float32)) == 0
