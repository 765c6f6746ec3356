"""The formulas of a declared task become programs, without a function of Python in between."""

import numpy as np
import pytest
import test_declared

import fmugym
from fmugym.environment.vector.task_programs import formulas_of

SWING = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "parameters": {"theta_0": {"distribution": "uniform", "low": -3, "high": 3}},
    "variables": {"tau": {"min": -2, "max": 2}},
    "agent": {"actions": "tau", "observations": ["theta", "theta_dot"]},
    "reward": "-theta**2",
}


def test_the_time_begins_where_it_is_drawn(load):
    """With substeps, after a warm-up: the time is that of the FMU, in programs and in Python."""
    task = SWING | {
        "start_time": {"distribution": "uniform", "low": 10, "high": 1000},
        "substeps": 3,
        "warm_up": "0.5s",
        "reward": {"now": "time", "since": "elapsed", "steps": "step"},
    }
    told = []
    for hooks in ("expressions", "Python"):
        env = load(task, way=hooks)
        for seed in (3, None, 4):
            env.reset(seed=seed)
            for _ in range(5):
                *_, info = env.step(env.action_space.low)
                assert info["reward_terms"]["now"] == env.time
                told.append(info["reward_terms"])
    assert told[: len(told) // 2] == told[len(told) // 2 :]
    assert len({one["now"] for one in told}) == 15


class Own(fmugym.TaskEnv):
    """Has a reward of its own."""

    def _reward_policy(self):
        return np.cos(self.state[0])


def test_a_hook_of_a_class_takes_the_place_of_a_formula(opened, make_envs):
    env = opened(Own(SWING))
    assert formulas_of(env) is None
    env.reset(seed=1)
    observation, reward, *_ = env.step(env.action_space.low)
    assert reward == pytest.approx(np.cos(observation[0]), rel=1e-6)
    envs = make_envs(lambda: Own(SWING), 3)
    envs.reset(seed=1)
    _, rewards, *_ = envs.step(envs.action_space.sample())
    assert rewards == pytest.approx(np.cos([one[0] for one in envs.get_attr("state")]))


def test_a_task_that_is_too_long_for_a_program_runs_on_arrays(make_envs, caplog):
    rows = np.arange(7200.0).reshape(90, 80)
    terms = {f"r{row[0]:.0f}": ", ".join(f"sin(theta + {n})" for n in row) for row in rows}
    task = SWING | {"reward": {name: f"max({values})" for name, values in terms.items()}}
    with caplog.at_level("INFO", "fmugym"):
        envs = make_envs(lambda: fmugym.load(task), 2)
    assert "more than 20000 operations" in caplog.text
    envs.reset(seed=1)
    _, rewards, *_ = envs.step(envs.action_space.sample())
    expected = [np.sin(one[0] + rows).max(axis=1).sum() for one in envs.get_attr("state")]
    assert rewards == pytest.approx(expected)
    assert envs.task.way == "arrays"


@test_declared.each_file
def test_of_an_example(name, load):
    assert formulas_of(load(str(test_declared.EXAMPLES / f"{name}.toml"))) is not None
