"""Noise, quantization and delay of what agents observe in declared tasks."""

from functools import partial

import numpy as np
import pytest
from combinations import in_turn
from vector_tools import require_same_alone

import fmugym
from fmugym.errors import TaskError
from fmugym.expressions import functions

DT = 0.05
DRAWN = {"q_0": {"distribution": "uniform", "low": -1, "high": 1}}


def task(parameters=DRAWN, history=None, **sensor):
    agent = {"actions": ["tau"], "observations": ["angle", "q_dot"]}
    return {
        "fmu": {"bundled": "Pendulum"},
        "time_step": DT,
        "episode_length": "1s",
        "variables": {"angle": {"name": "q", "unit": "deg"} | sensor},
        "parameters": parameters,
        "agent": agent if history is None else agent | {"history": history},
        "reward": "angle",
    }


def episode(env, seed=None, steps=20):
    """The observed and the true angles in degrees."""
    seen, info = env.reset(seed=seed)
    observed, true = [seen[0]], [np.rad2deg(env.state[0])]
    for _ in range(steps):
        seen, reward, *_ = env.step([0.01])
        assert reward == pytest.approx(np.rad2deg(env.state[0]), rel=1e-12)
        observed.append(seen[0])
        true.append(reward)
    return np.array(observed, np.float64), np.array(true), info


def test_the_bits_of_noise_are_those_of_splitmix64():
    """The reference is Vigna's program of 2015 with the seed 1234567."""
    states = 1234567 + np.arange(1, 4) * np.int64(0x9E3779B97F4A7C15 - 2**64)
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert functions.splitmix64(states).view(np.uint64).tolist() == expected


def test_noise_is_normal_and_differs_in_steps_and_episodes(load):
    env = load(task(noise=3.0))
    differences = []
    for index in range(60):
        observed, true, _ = episode(env, seed=1 if index == 0 else None)
        differences.append(observed - true)
    noise = np.array(differences) / 3.0
    assert noise.shape == (60, 21)
    assert abs(noise.mean()) < 4 / np.sqrt(noise.size)
    assert noise.std() == pytest.approx(1.0, abs=0.08)
    assert np.mean(np.abs(noise) < 1) == pytest.approx(0.683, abs=0.05)
    for first, second in ((noise[:, 1:], noise[:, :-1]), (noise[1:], noise[:-1])):
        assert abs(np.mean(first * second)) < 0.12


def test_noise_without_other_draws_differs_from_episode_to_episode(load):
    env = load(task(parameters={}, noise=1.0))
    first, again, same = episode(env, 1)[0], episode(env)[0], episode(env, 1)[0]
    assert not np.any(first == again)
    np.testing.assert_array_equal(first, same)


def test_noise_differs_between_environments_of_a_vector(make_envs):
    envs = make_envs(partial(fmugym.load, task(parameters={}, noise=1.0)), 8)
    observed, info = envs.reset(seed=1)
    assert len(set(info["drawn"]["noise key"])) == 8
    for _ in range(3):
        assert len(set(observed[:, 0])) == 8
        observed, *_ = envs.step(np.full((8, 1), 0.01))


def test_values_come_late(load):
    env = load(task(delay="0.15s"))
    observed, true, _ = episode(env, 0)
    np.testing.assert_allclose(observed, [true[0]] * 3 + list(true[:-3]), rtol=1e-6)


@pytest.mark.parametrize(
    ("sensor", "measured"),
    [
        ({"quantum": 5.0}, lambda true: 5.0 * np.round(true / 5.0)),
        ({"saturation": [7, 12]}, lambda true: np.clip(true, 7, 12)),
        ({"bias": -7.5}, lambda true: true - 7.5),
    ],
)
def test_what_is_the_same_in_each_step(sensor, measured, load):
    env = load(task(**sensor))
    observed, true, _ = episode(env, 0)
    assert true.min() < 7
    assert true.max() > 12
    np.testing.assert_allclose(observed, measured(true), rtol=1e-5)


BIASES = {
    "uniform": ({"distribution": "uniform", "low": -4, "high": 8}, 2.0, 12 / np.sqrt(12)),
    "normal": ({"distribution": "normal", "mean": 1, "std": 3}, 1.0, 3.0),
}


@pytest.mark.parametrize("kind", BIASES)
def test_a_drawn_bias_is_one_number_in_each_episode(kind, load):
    bias, mean, std = BIASES[kind]
    env, biases = load(task(bias=bias)), []
    for index in range(150):
        observed, true, _ = episode(env, 1 if index == 0 else None, steps=3)
        assert np.ptp(observed - true) < 1e-4
        biases.append(observed[0] - true[0])
    assert np.mean(biases) == pytest.approx(mean, abs=4 * std / np.sqrt(150))
    assert np.std(biases) == pytest.approx(std, rel=0.2)


def test_a_drop_out_holds_the_last_value(load):
    env = load(task(drop_out=0.25))
    held = []
    for index in range(40):
        observed, true, _ = episode(env, 1 if index == 0 else None)
        assert observed[0] == np.float32(true[0])
        for step in range(1, 21):
            fresh = np.float32(true[step])
            held.append(observed[step] != fresh)
            assert observed[step] == (observed[step - 1] if held[-1] else fresh)
    assert np.mean(held) == pytest.approx(0.25, abs=0.06)


def test_a_drop_out_gives_what_the_task_says(load):
    env = load(task(drop_out={"probability": 0.5, "value": -99}, delay="0.1s"))
    observed, true, _ = episode(env, 3)
    late = np.float32([true[0], true[0], *true[:-2]])
    is_lost = observed == -99
    assert 4 < is_lost.sum() < 17
    np.testing.assert_array_equal(observed[~is_lost], late[~is_lost])


def test_a_sensor_may_follow_slowly(load):
    env = load(task(rate=40))
    observed, true, _ = episode(env, 0)
    expected = [true[0]]
    for value in true[1:]:
        expected.append(np.clip(value, expected[-1] - 2, expected[-1] + 2))
    np.testing.assert_allclose(observed, expected, rtol=1e-6)


ALL_RANDOM = {
    "noise": 1.0,
    "drop_out": 0.2,
    "bias": {"distribution": "uniform", "low": 0, "high": 1},
}


def test_nothing_random_in_devices_changes_a_draw(load):
    noisy_task = task(**ALL_RANDOM)
    noisy_task["variables"]["tau"] = {"noise": 0.001, "drop_out": 0.1}
    noisy, calm = load(noisy_task), load(task())
    for seed in (5, None, None):
        drawn = noisy.reset(seed=seed)[1]["drawn"]
        assert drawn.pop("noise key") >= 0
        assert drawn == calm.reset(seed=seed)[1]["drawn"]


def torques(steps=12, seed=1, agent=None, **actuator):
    """The actions that were chosen, and the torques that reached the FMU, in N.mm."""
    declared = task()
    unit = {"name": "tau", "unit": "N.mm", "min": -20, "max": 20}
    declared["variables"] |= {"torque": unit | actuator}
    declared["agent"] = declared["agent"] | {"actions": ["torque"]} | (agent or {})
    env = fmugym.load(declared | {"episode_length": "100s"})
    env.reset(seed=seed)
    chosen = np.random.default_rng(0).uniform(-20, 20, steps).astype(np.float32)
    reached = []
    for action in chosen:
        env.step([action])
        reached.append(env.inputs[0] * 1000)
    env.close()
    return chosen.astype(float), np.array(reached)


class TestActuators:
    def test_are_late(self):
        chosen, reached = torques(delay="0.15s")
        np.testing.assert_allclose(reached, [0, 0, 0, *chosen[:-3]])

    def test_have_a_bias_limits_and_steps(self):
        chosen, reached = torques(bias=3, saturation=[-8, 12], quantum=0.5)
        expected = 0.5 * np.round(np.clip(chosen + 3, -8, 12) / 0.5)
        np.testing.assert_allclose(reached, expected, atol=1e-9)

    def test_are_noisy(self):
        chosen, reached = torques(steps=400, noise=2.0)
        noise = reached - chosen
        assert noise.mean() == pytest.approx(0, abs=0.4)
        assert noise.std() == pytest.approx(2.0, rel=0.15)
        assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.2

    def test_drop_out(self):
        chosen, reached = torques(steps=200, drop_out=0.3)
        before = [0, *reached[:-1]]
        is_lost = np.abs(reached - chosen) > 1e-9
        assert is_lost.mean() == pytest.approx(0.3, abs=0.1)
        np.testing.assert_allclose(reached[is_lost], np.array(before)[is_lost], rtol=1e-9)

    def test_have_a_rate_after_all_else(self):
        chosen, reached = torques(rate=40, delay="0.05s")
        expected = [0.0]
        for value in [0.0, *chosen[:-1]]:
            expected.append(np.clip(value, expected[-1] - 2, expected[-1] + 2))
        np.testing.assert_allclose(reached, expected[1:], atol=1e-9)

    def test_changes_come_late(self):
        chosen, reached = torques(delta=5, delay="0.1s", steps=8)
        expected = [0.0, 0.0]
        for change in chosen[:-2]:
            expected.append(np.clip(expected[-1] + change, -20, 20))
        np.testing.assert_allclose(reached, expected, atol=1e-9)

    def test_are_for_inputs_of_actions(self):
        variables = {"tau": {"noise": 1}, "angle": {"name": "q"}, "gain": {"min": 0, "max": 1}}
        agent = {"actions": ["gain"], "observations": ["angle"]}
        wrong = task() | {"variables": variables, "agent": agent, "inputs": {"tau": "0 * gain"}}
        with pytest.raises(TaskError, match=r"^variables\.tau: .*'tau'"):
            fmugym.load(wrong)


ACTUATORS = {
    "": {},
    "late": {"delay": "0.15s", "bias": 0.001, "noise": 0.001},
    "lost": {"drop_out": 0.3, "quantum": 0.0005, "saturation": [-0.005, 0.005]},
    "slow": {"rate": 0.02, "bias": {"distribution": "uniform", "low": -1, "high": 1}},
    "changes": {"delta": 0.002, "delay": "0.1s"},
}


@pytest.mark.parametrize("more", [{"quantum": 0.5}, {"drop_out": 0.4}, {"rate": 30}])
def test_a_history_holds_what_was_measured(more, load):
    history = {"of": "angle", "length": "0.1s"}
    env = load(task(noise=2.0, delay="0.1s", history=history, **more))
    seen = [env.reset(seed=3)[0]]
    seen += [env.step([0.01])[0] for _ in range(10)]
    for now, before, earlier in zip(seen[2:], seen[1:], seen, strict=False):
        assert now[2:].tolist() == [before[0], earlier[0]]


SENSORS = {
    "noise": {"noise": 2.0},
    "all": {"noise": 2.0, "quantum": 0.1, "delay": "0.1s"},
    "drop-outs": {"drop_out": 0.4, "noise": 2.0, "delay": "0.1s"},
    "rate": {"rate": 40, "bias": {"distribution": "normal", "mean": 1, "std": 3}},
    "limits": {
        "saturation": [-30, 30],
        "drop_out": {"probability": 0.3, "value": -99},
        "bias": {"distribution": "uniform", "low": -5, "high": 5},
    },
}


COMBINATIONS = [(sensors, "") for sensors in SENSORS]
COMBINATIONS += [("noise", actuators) for actuators in ACTUATORS if actuators]
COMBINATIONS += [("drop-outs", "late"), ("rate", "lost")]


@in_turn(
    {
        "sensors,actuators": COMBINATIONS,
        "hooks": ["expressions", "arrays", "one by one"],
        "mode,parameters": {"drawn": ("next_step", DRAWN), "constant": ("same_step", {})},
    }
)
def test_many_environments_equal_single_ones(parameters, sensors, actuators, hooks, mode):
    history = {"of": ["angle", "tau"], "length": "0.1s"}
    declared = task(parameters, history, **SENSORS[sensors])
    declared["variables"]["tau"] = {"min": -0.01, "max": 0.01} | ACTUATORS[actuators]
    assert require_same_alone(partial(fmugym.load, declared), 50, mode, way=hooks)


@pytest.mark.parametrize(
    ("variables", "fact"),
    [
        ({"angle": {"name": "q", "noise": 0}}, "positive"),
        ({"angle": {"name": "q"}, "tau": {"sample": "mean"}}, "read from the FMU"),
        ({"angle": {"name": "q", "drop_out": {"probability": 0.1, "value": "nan"}}}, "nan"),
        ({"angle": {"name": "q", "saturation": 3}}, "list"),
        ({"angle": {"name": "q", "bias": {"distribution": "choice", "values": [1]}}}, "uniform"),
        ({"angle": {"name": "q"}, "tau": {"delay": "0.07s"}}, r"0\.05 s.*0\.07 s"),
        ({"angle": {"name": "q"}, "theta": {"noise": 1}}, "'theta' is not in its observations"),
    ],
)
def test_mistakes_are_placed(variables, fact):
    with pytest.raises(TaskError, match=rf"^variables\..*{fact}"):
        fmugym.load(task() | {"variables": variables})


RANDOM = task() | {
    "setpoints": {"goal": {"steps": {"low": -2, "high": 3, "every": "0.2s"}}},
    "data": {"load": {"values": [0, 10, 5], "step": "0.5s"}},
    "agent": {
        "actions": ["tau"],
        "observations": ["angle", "goal"],
        "forecast": [
            {"of": "load", "horizon": "0.4s", "step": "0.1s", "error": 2.0},
            {"of": "goal", "horizon": "0.2s", "step": "0.2s"},
        ],
    },
    "reward": "goal",
}


def test_random_steps_hold_and_are_foreseen(load):
    env = load(RANDOM)
    values, last_foreseen = [], None
    for seed in range(20):
        observation = env.reset(seed=seed)[0]
        for step in range(20):
            goal, foreseen = observation[1], observation[-1]
            observation, reward, *_ = env.step([0.0])
            assert np.float32(reward) == goal
            if step % 4 != 3:
                assert observation[1] == goal
            else:
                assert observation[1] == last_foreseen != goal
            if step % 4 == 0:
                last_foreseen = foreseen
                values.append(goal)
    assert -2 <= min(values) < -1.5
    assert 2.5 < max(values) < 3
    assert np.mean(values) == pytest.approx(0.5, abs=0.5)


def test_errors_of_forecasts_belong_to_times_and_fall():
    errors = forecast_errors(2.0)
    spread = np.std(errors, axis=(0, 1))
    np.testing.assert_allclose(spread, 2.0 * np.sqrt([0.25, 0.5, 0.75, 1.0]), rtol=0.15)
    later, sooner = errors[:, :-2, 1], errors[:, 2:, 0]  # of the same time
    np.testing.assert_allclose(later / np.sqrt(2), sooner, atol=1e-5)


def forecast_errors(error, episodes=60):
    """The errors of forecasts of ``load``, shape (episodes, steps, times ahead)."""
    forecast = {"of": "load", "horizon": "0.4s", "step": "0.1s", "error": error}
    agent = RANDOM["agent"] | {"forecast": forecast}
    env, errors = fmugym.load(RANDOM | {"agent": agent}), []
    for seed in range(episodes):
        rows = [env.reset(seed=seed)[0]]
        rows += [env.step([0.0])[0] for _ in range(8)]
        times = DT * np.arange(9)[:, None] + 0.1 * np.arange(1, 5)
        true = np.interp(times % 1.5, [0, 0.5, 1, 1.5], [0, 10, 5, 0])
        is_relative = isinstance(error, dict) and "relative" in error
        errors.append((np.array(rows)[:, 2:6] - true) / (true if is_relative else 1))
    env.close()
    return np.array(errors)


PARTS = np.array([0.25, 0.5, 0.75, 1.0])


@pytest.mark.parametrize(
    ("error", "sizes"),
    [
        ({"std": 2.0, "growth": "linear"}, 2 * PARTS),
        ({"std": 2.0, "growth": "none"}, [2, 2, 2, 2]),
        ({"std": 0.2, "relative": True}, 0.2 * np.sqrt(PARTS)),
        ({"bias": 3.0}, 3 * np.sqrt(PARTS)),
    ],
)
def test_sizes_of_errors_of_forecasts(error, sizes):
    errors = forecast_errors(error)
    np.testing.assert_allclose(np.std(errors, axis=(0, 1)), sizes, rtol=0.25)
    within = np.std(errors, axis=1).mean()
    assert (within < 1e-5) == ("bias" in error)


@pytest.mark.parametrize(
    ("error", "fact"),
    [
        ({"std": -1}, r"std: .*-1"),
        ({"growth": "cubic"}, "'cubic'"),
        ({"sdt": 1}, "'std'"),
        ("x", "'x'"),
    ],
)
def test_mistakes_in_errors_of_forecasts(error, fact):
    with pytest.raises(TaskError, match=rf"^agent\.forecast\.error.*{fact}"):
        forecast_errors(error, 1)


@pytest.mark.parametrize("hooks", ["expressions", "arrays", "one by one"])
def test_random_steps_of_many_environments(hooks):
    require_same_alone(partial(fmugym.load, RANDOM), 19, way=hooks)


def test_an_argument_that_does_not_exist():
    with pytest.raises(TypeError, match="'render_mode'"):
        fmugym.load(RANDOM, render_mod="human")


def test_steps_between_two_steps():
    setpoints = {"goal": {"steps": {"low": 0, "high": 1, "every": "0.07s"}}}
    with pytest.raises(TaskError, match=r"^setpoints\.goal: .*0\.07 s"):
        fmugym.load(RANDOM | {"setpoints": setpoints})
