"""The table of quantities: expressions read the same of an episode as hooks do."""

import contextlib
import operator

import gymnasium
import numpy as np
import pytest
from ways import ALL_WAYS, in_python, in_way

import fmugym
from fmugym.expressions.quantities import QUANTITIES
from fmugym.fmi.bundled import bundled_fmu
from fmugym.fmi.status import Status

TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "variables": {"tau": {"min": -2, "max": 2}},
    "agent": {"actions": "tau", "observations": ["theta", "theta_dot"]},
    "parameters": {"theta_0": 1.0},
    "memory": {"sum": {"start": 0.5, "update": "sum + theta"}},
    "reward": {
        "outputs": "theta",
        "previous_outputs": "previous(theta)",
        "action": "tau",
        "previous_action": "previous(tau)",
        "parameters": "theta_0",
        "variables": "sum",
        "step_count": "step",
        "time": "time",
        "done": "1 if done else 0",
    },
    "terminated": "step > 18",
}
"""A term for each quantity but those of ``ELSEWHERE``."""

ELSEWHERE = {"inputs", "previous_inputs", "fmu_status", "after_end"}
"""Task files have the actions in the place of inputs, and no name of the status. Only classes go
on after an end."""

KEYS = {
    **dict.fromkeys(("outputs", "previous_outputs", "action", "previous_action"), 0),
    "parameters": "theta_0",
    "variables": "sum",
}


def test_each_has_a_term():
    assert {*TASK["reward"], *ELSEWHERE} == set(QUANTITIES)


@pytest.mark.parametrize("hooks", ["expressions", "Python"])
def test_of_one_environment(load, hooks):
    env = load(TASK, way=hooks)
    env.reset(seed=1)
    env.action_space.seed(1)
    angles, terminated = set(), False
    while not terminated:
        *_, terminated, _, info = env.step(env.action_space.sample())
        for name, term in info["reward_terms"].items():
            value = operator.attrgetter(QUANTITIES[name].path)(env)
            assert term == (value[KEYS[name]] if name in KEYS else value), name
        angles.add(info["reward_terms"]["previous_outputs"])
    assert len(angles) == 19


def test_of_many_environments(make_envs):
    envs = make_envs(in_way("expressions", lambda: fmugym.load(TASK)), 3)
    envs.reset(seed=1)
    envs.action_space.seed(1)
    for _ in range(15):
        *_, infos = envs.step(envs.action_space.sample())
        for name in TASK["reward"]:
            attribute = QUANTITIES[name].attribute
            rows = envs.get_attr("state" if attribute == "outputs" else attribute)
            expected = [row[KEYS[name]] if name in KEYS else row for row in rows]
            assert infos["reward_terms"][name].tolist() == expected, name


@pytest.mark.parametrize("hooks", ["expressions", "Python"])
def test_outputs_are_observed_in_any_order_and_twice(load, hooks):
    names = ["theta_dot", "theta", "theta_dot", "theta", "theta"]
    variables = TASK["variables"] | {f"own_{n}": {"name": name} for n, name in enumerate(names)}
    observed = {"actions": "tau", "observations": [f"own_{n}" for n in range(5)]}
    env = load(TASK | {"variables": variables, "agent": observed}, way=hooks)
    env.reset(seed=1)
    env.action_space.seed(1)
    for _ in range(10):
        observation, *_ = env.step(env.action_space.sample())
        assert observation.tolist() == np.float32([env.out[name] for name in names]).tolist()


class Pushed(fmugym.FMI2CSEnv):
    """The pendulum, driven by twice the action."""

    def __init__(self):
        told = {"now": "tau", "before": "previous(tau)"}
        config = {
            "model_input_names": "tau",
            "model_output_names": ["theta", "theta_dot"],
            "model_parameters": {"theta_0": fmugym.environment.distributions.Uniform(-3.0, 3.0)},
            "bounds": {"tau": (-2, 2)},
            "time_step": 0.05,
            "inputs": {"tau": "2 * action[0]"},
            "info": told,
            "terminated": "abs(theta) > 3",
            "max_episode_steps": 7,
        }
        super().__init__(bundled_fmu("Pendulum"), config)

    def _get_action_space(self):
        return gymnasium.spaces.Box(-1.0, 1.0, (1,))


@pytest.mark.parametrize("is_compiled", [True, False])
def test_inputs_of_the_step_before_in_one_environment(is_compiled):
    with contextlib.closing(Pushed() if is_compiled else in_python(Pushed())) as env:
        env.action_space.seed(1)
        for seed in range(3):
            env.reset(seed=seed)
            assert env.previous_inputs == (0.0,)
            before, ended = 0.0, False
            while not ended:
                *_, terminated, truncated, info = env.step(env.action_space.sample())
                ended = terminated or truncated
                assert info["before"] == before == env.previous_inputs[0]
                assert info["now"] == env.inputs[0] != before
                before = info["now"]
        assert env.is_compiled == is_compiled


@pytest.mark.parametrize("mode", gymnasium.vector.AutoresetMode)
@pytest.mark.parametrize("way", ALL_WAYS)
def test_inputs_of_the_step_before_in_many(way, mode, make_envs):
    """A snapshot of the middle goes on with the same ones."""
    envs = make_envs(in_way(way, Pushed), 3, autoreset_mode=mode)
    envs.reset(seed=1)
    envs.action_space.seed(1)
    before, ends = np.zeros(3), 0
    for step in range(40):
        fresh = envs.episodes.ended.copy()
        if mode is gymnasium.vector.AutoresetMode.DISABLED and fresh.any():
            envs.reset(options={"reset_mask": fresh})
            before[fresh], fresh[:] = 0.0, False
        _, _, terminated, truncated, infos = envs.step(envs.action_space.sample())
        ended = terminated | truncated
        ends += int(ended.sum())
        stepped = ~fresh
        told = infos
        if mode is gymnasium.vector.AutoresetMode.SAME_STEP and ended.any():
            told = {
                name: np.where(ended, infos["final_info"][name], infos[name])
                for name in infos
                if name in ("now", "before")
            }
        assert told["before"][stepped].tolist() == before[stepped].tolist(), step
        before = np.where(stepped, told["now"], 0.0)
        if mode is gymnasium.vector.AutoresetMode.SAME_STEP:
            before[ended] = 0.0
        if step == 20:
            snapshot = envs.save_state()
            envs.restore_state(snapshot)
    assert ends > 6


class Failing(fmugym.FMI2CSEnv):
    """The cart-pole, which discards steps of absurd forces."""

    def __init__(self):
        config = {
            "model_input_names": "f",
            "model_output_names": "x",
            "time_step": 0.02,
            "terminated": False,
        }
        super().__init__(bundled_fmu("CartPole"), config)

    def _get_action_space(self):
        return gymnasium.spaces.Box(-np.inf, np.inf, (1,))


@pytest.mark.parametrize("is_compiled", [True, False])
def test_status_of_one_fmu(is_compiled):
    with contextlib.closing(Failing() if is_compiled else in_python(Failing())) as env:
        for _ in range(2):
            env.reset(seed=0)
            told = [env.fmu_status]
            for force in (1.0, 1e30):
                env.step([force])
                told.append(env.fmu_status)
            assert told == [Status.OK, Status.OK, Status.DISCARD]


@pytest.mark.parametrize("way", ALL_WAYS)
def test_status_of_many_fmus(way, make_envs):
    envs = make_envs(in_way(way, Failing), 3)
    envs.reset(seed=0)
    for forces in ([1.0, 1.0, 1.0], [1.0, 1e30, 1.0], [1.0, 1.0, 1e30]):
        envs.step(np.array(forces)[:, None])
        wanted = [Status.DISCARD if force > 1 else Status.OK for force in forces]
        assert [*envs.get_attr("fmu_status")] == wanted
    (second,) = envs.save_state(2)
    envs.restore_state(second)
    assert [*envs.get_attr("fmu_status")] == [Status.DISCARD] * 3
