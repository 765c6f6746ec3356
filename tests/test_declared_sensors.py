"""Noise, quantization and delay of what agents observe in declared tasks."""

from functools import partial

import numpy as np
import pytest

import fmugym
from fmugym import FMUVectorEnv
from fmugym.errors import TaskError

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


def test_noise_is_normal_and_differs_in_steps_and_episodes():
    env = fmugym.load(task(noise=3.0))
    differences = []
    for index in range(60):
        observed, true, _ = episode(env, seed=1 if index == 0 else None)
        differences.append(observed - true)
    env.close()
    noise = np.array(differences) / 3.0
    assert noise.shape == (60, 21)
    assert abs(noise.mean()) < 4 / np.sqrt(noise.size)
    assert noise.std() == pytest.approx(1.0, abs=0.08)
    assert np.mean(np.abs(noise) < 1) == pytest.approx(0.683, abs=0.05)
    for first, second in ((noise[:, 1:], noise[:, :-1]), (noise[1:], noise[:-1])):
        assert abs(np.mean(first * second)) < 0.12


def test_noise_changes_no_draw():
    noisy, calm = fmugym.load(task(noise=3.0)), fmugym.load(task())
    for seed in (5, None, None):
        drawn = noisy.reset(seed=seed)[1]["drawn"]
        assert drawn.pop("noise key") >= 0
        assert drawn == calm.reset(seed=seed)[1]["drawn"]
    noisy.close()
    calm.close()


def test_noise_without_other_draws_differs_from_episode_to_episode():
    env = fmugym.load(task(parameters={}, noise=1.0))
    first, again, same = episode(env, 1)[0], episode(env)[0], episode(env, 1)[0]
    assert not np.any(first == again)
    np.testing.assert_array_equal(first, same)
    env.close()


def test_values_are_multiples_of_the_quantum():
    env = fmugym.load(task(quantum=5.0))
    observed, true, _ = episode(env, 0)
    np.testing.assert_allclose(observed, 5.0 * np.round(true / 5.0), rtol=1e-6)
    env.close()


def test_values_come_late():
    env = fmugym.load(task(delay="0.15s"))
    observed, true, _ = episode(env, 0)
    np.testing.assert_allclose(observed, [true[0]] * 3 + list(true[:-3]), rtol=1e-6)
    env.close()


def test_a_history_holds_what_was_measured():
    history = {"of": "angle", "length": "0.1s"}
    env = fmugym.load(task(noise=2.0, delay="0.1s", quantum=0.5, history=history))
    seen = [env.reset(seed=3)[0]]
    seen += [env.step([0.01])[0] for _ in range(10)]
    for now, before, earlier in zip(seen[2:], seen[1:], seen, strict=False):
        assert now[2:].tolist() == [before[0], earlier[0]]
    env.close()


SENSORS = {
    "noise": {"noise": 2.0},
    "all": {"noise": 2.0, "quantum": 0.1, "delay": "0.1s"},
}


@pytest.mark.parametrize("parameters", [DRAWN, {}], ids=["drawn", "constant"])
@pytest.mark.parametrize("sensors", SENSORS)
@pytest.mark.parametrize("hooks", ["compiled", "array", "per_env"])
@pytest.mark.parametrize("mode", ["next_step", "same_step"])
def test_many_environments_equal_single_ones(parameters, sensors, hooks, mode):
    history = {"of": ["angle", "tau"], "length": "0.1s"}
    make = partial(fmugym.load, task(parameters, history, **SENSORS[sensors]))
    envs, singles = FMUVectorEnv(make, 3, hooks=hooks, autoreset_mode=mode), []
    if hooks == "compiled":
        assert envs._engine._task.left == {}
    observations, infos = envs.reset(seed=2)
    for i in range(3):
        singles.append(make())
        seen, info = singles[i].reset(seed=2 + i)
        np.testing.assert_array_equal(seen, observations[i])
        assert info["drawn"]["noise key"] == infos["drawn"]["noise key"][i]
    assert len(set(infos["drawn"]["noise key"])) == 3
    envs.action_space.seed(1)
    ended = False
    for _ in range(50):
        actions = envs.action_space.sample()
        observations, *_ = envs.step(actions)
        results = []
        for i, env in enumerate(singles):
            if ended and mode == "next_step":
                results.append((env.reset()[0], False))
                continue
            seen, _, _, cut, _ = env.step(actions[i])
            results.append((env.reset()[0] if cut and mode == "same_step" else seen, cut))
        np.testing.assert_array_equal(observations, [seen for seen, _ in results])
        ended = results[0][1]
    for env in (envs, *singles):
        env.close()


@pytest.mark.parametrize(
    ("variables", "fact"),
    [
        ({"angle": {"name": "q", "delay": "0.07s"}}, r"0\.07 s.*0\.05"),
        ({"angle": {"name": "q", "noise": 0}}, "positive"),
        ({"angle": {"name": "q"}, "tau": {"noise": 1}}, "read from the FMU"),
        ({"angle": {"name": "q"}, "theta": {"noise": 1}}, "'theta' is not in its observations"),
    ],
)
def test_mistakes_are_placed(variables, fact):
    with pytest.raises(TaskError, match=rf"^variables\..*{fact}"):
        fmugym.load(task() | {"variables": variables})
