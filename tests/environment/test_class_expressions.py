"""Expressions in the config of a class: the same task as hooks, and as a task file."""

import functools

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import fmugym
from fmugym import ConfigError, FMI2CSEnv
from fmugym.environment.distributions import Uniform
from fmugym.environment.vector.task_programs import formulas_of
from fmugym.fmi.bundled import bundled_fmu

START = {name: Uniform(-0.05, 0.05) for name in ("x_0", "x_dot_0", "phi_0", "phi_dot_0")}
CART_POLE = {
    "model_input_names": "f",
    "model_output_names": ["x", "x_dot", "phi", "phi_dot"],
    "model_parameters": START,
    "time_step": 0.02,
    "max_episode_steps": 40,
}
EXPRESSIONS = {
    "inputs": {"f": "10 * (2 * action - 1)"},
    "terminated": "abs(x) > 2.4 or abs(phi) > 0.05",
}
PENDULUM = {
    "model_input_names": "tau",
    "model_output_names": ["theta", "theta_dot"],
    "model_parameters": {"theta_0": Uniform(-3.0, 3.0)},
    "bounds": {"tau": (-2, 2)},
    "time_step": 0.05,
    "max_episode_steps": 25,
}


class Expressed(FMI2CSEnv):
    """The cart-pole without a hook of a step."""

    def __init__(self, **keys):
        super().__init__(bundled_fmu("CartPole"), CART_POLE | EXPRESSIONS | keys)

    def _get_action_space(self):
        return spaces.Discrete(2)


class Hooked(FMI2CSEnv):
    """The same in Python."""

    def __init__(self):
        super().__init__(bundled_fmu("CartPole"), CART_POLE)

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return 10.0 * (2.0 * self.action - 1.0)

    def _is_done(self):
        x, _, phi, _ = self.state
        return (abs(x) > 2.4) | (abs(phi) > 0.05)


class Pendulum(FMI2CSEnv):
    """The pendulum, with what the config says."""

    def __init__(self, **keys):
        super().__init__(bundled_fmu("Pendulum"), PENDULUM | {"terminated": False} | keys)


def played(env, steps=150, seed=3):
    """All that an environment tells, one or many."""
    rng, told = np.random.default_rng(seed), [env.reset(seed=seed)]
    is_vector = isinstance(env, gymnasium.vector.VectorEnv)
    space = env.single_action_space if is_vector else env.action_space
    for _ in range(steps):
        shape = (env.num_envs,) if is_vector else ()
        if isinstance(space, spaces.Discrete):
            action = rng.integers(space.n, size=shape)
        else:
            action = rng.uniform(-2, 2, (*shape, *space.shape)).astype(np.float32)
        told.append(env.step(action if shape or action.shape else int(action)))
        if not is_vector and (told[-1][2] or told[-1][3]):
            told.append(env.reset())
    env.close()
    assert len(told) > steps
    return told


def is_same(one, other):
    """Whether what two environments tell is equal to the last bit."""
    assert len(one) == len(other)
    for own, theirs in zip(one, other, strict=True):
        assert len(own) == len(theirs)
        for part, their_part in zip(own, theirs, strict=True):
            if isinstance(part, dict) and "final_obs" in part:
                assert_rows_equal(part.pop("final_obs"), their_part.pop("final_obs"))
            np.testing.assert_equal(part, their_part)
    return True


def assert_rows_equal(rows, others):
    assert len(rows) == len(others)
    for row, other in zip(rows, others, strict=True):
        np.testing.assert_array_equal(row, other)


def test_two_expressions_are_a_whole_environment():
    assert is_same(played(Expressed()), played(Hooked()))


def test_a_base_class_alone_will_do():
    config = PENDULUM | {"terminated": "abs(theta_dot) > 3", "reward": "-theta**2"}
    env = FMI2CSEnv(bundled_fmu("Pendulum"), config)
    told = played(env)
    steps = [one for one in told if len(one) == 5]
    for observation, reward, terminated, *_ in steps:
        assert reward == pytest.approx(-(float(observation[0]) ** 2), rel=1e-6)
        assert terminated == (abs(observation[1]) > 3)
    assert any(terminated for _, _, terminated, *_ in steps)


TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "1.25s",
    "variables": {"tau": {"min": -2, "max": 2}},
    "parameters": {"theta_0": {"distribution": "uniform", "low": -3, "high": 3}},
    "memory": {
        "effort": {"start": 0, "update": "effort + abs(tau) * dt"},
        "goal": {"start": {"distribution": "uniform", "low": -1, "high": 1}, "update": "goal"},
    },
    "agent": {"actions": "tau", "observations": ["theta", "theta_dot", "effort", "goal"]},
    "reward": {
        "near": "-abs(theta - goal)",
        "calm": {"expr": "-(theta_dot - previous(theta_dot))**2", "weight": 0.1},
        "end": "-done",
    },
    "costs": {"effort": "max(effort - 1, 0)", "late": "elapsed > 1"},
    "terminated": "abs(theta - goal) < 0.2",
    "truncated": "effort > 0.8",
}
AS_A_CLASS = {
    "memory": {
        "effort": {"start": 0, "update": "effort + abs(tau) * dt"},
        "goal": {"start": Uniform(-1, 1), "update": "goal"},
    },
    "observations": ["theta", "theta_dot", "effort", "goal"],
    **{key: TASK[key] for key in ("reward", "costs", "terminated", "truncated")},
}


def test_each_key_means_what_it_means_in_a_task_file():
    one, other = played(fmugym.load(TASK)), played(Pendulum(**AS_A_CLASS))
    assert is_same(one, other)
    ends = [step for step in one if len(step) == 5]
    assert any(np.any(step[2]) for step in ends)
    assert any(np.any(step[3]) for step in ends)


def test_the_costs_and_terms_of_a_step_are_told():
    env = Pendulum(**AS_A_CLASS, info={"height": "cos(theta)", "is_late": "elapsed > 0.1"})
    _, info = env.reset(seed=1)
    assert info["cost"] == 0.0
    assert info["reward_terms"] == {"near": 0.0, "calm": 0.0, "end": 0.0}
    for step in range(1, 4):
        _, reward, *_, info = env.step(np.float32([1.0]))
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert info["height"] == np.cos(env.state[0])
        assert info["is_late"] == (step > 2)
        assert env.variables["effort"] == pytest.approx(0.05 * step)


def test_what_only_expressions_name_is_read_from_the_fmu(make_envs):
    names = {"model_output_names": ["phi"]}
    keys = {"reward": "x + m_cart + 0 * theta_dot", **names}
    env = Expressed(**keys)
    assert set(env.config.monitor_names) == {"m_cart", "theta_dot", "x"}
    env.reset(seed=1)
    _, reward, *_ = env.step(1)
    assert reward == env.out["x"] + 10.0
    envs = make_envs(functools.partial(Expressed, **keys), 3)
    envs.reset(seed=1)
    assert envs.step(np.ones(3, int))[1][0] == reward


def test_inputs_that_no_expression_writes_come_from_the_action():
    system = fmugym.FMUSystem({"a": bundled_fmu("Pendulum"), "b": bundled_fmu("Pendulum")})
    config = {
        "model_input_names": ["a.tau", "b.tau"],
        "model_output_names": ["a.theta", "b.theta"],
        "bounds": {"a.tau": (-1, 1)},
        "inputs": {"b.tau": "2 * a.tau"},
        "terminated": "abs(a.theta - b.theta) > 1",
        "reward": "-previous(a.theta)",
        "time_step": 0.05,
    }
    env = FMI2CSEnv(system, config)
    assert env.action_space == spaces.Box(-1, 1, (1,), np.float32)
    env.reset()
    for value in (0.5, -0.25):
        before = env.state
        _, reward, terminated, *_ = env.step(np.float32([value]))
        assert env.inputs == (value, 2 * value)
        assert reward == -before[0]
        assert terminated == (abs(env.state[0] - env.state[1]) > 1)


def test_names_of_the_fmu_need_no_alias_in_task_files():
    task = {
        "system": {"components": {"a": {"bundled": "Pendulum"}, "b": {"bundled": "Pendulum"}}},
        "time_step": 0.05,
        "variables": {"u": {"name": "a.tau", "min": -1, "max": 1}},
        "agent": {"actions": "u", "observations": ["a.theta"]},
        "reward": "b.theta - previous(a.theta)",
    }
    env = fmugym.load(task)
    env.reset(seed=1)
    before = env.out["a.theta"]
    _, reward, *_ = env.step(np.float32([0.5]))
    assert reward == env.out["b.theta"] - before


class TestOverridden:
    """A hook of a class takes the place of the expression, and can call it."""

    class Shaped(Expressed):
        def _reward_policy(self):
            return super()._reward_policy() - abs(self.state[0])

    def test_the_others_stay_expressions(self, make_envs):
        assert formulas_of(self.Shaped()) is None
        one, other = played(self.Shaped()), played(Expressed())
        for own, theirs in zip(one, other, strict=True):
            np.testing.assert_equal(own[0], theirs[0])
            if len(own) == 5:
                assert own[1] == theirs[1] - abs(float(own[0][0])) or own[1] < theirs[1]
                assert own[2:4] == theirs[2:4]
        assert played(make_envs(self.Shaped, 4))[0][0].shape == (4, 4)

    def test_memory_and_observations_on_arrays(self, make_envs):
        class Same(Pendulum):
            def _update(self):
                super()._update()

        keys = AS_A_CLASS
        one = played(make_envs(functools.partial(Pendulum, **keys), 3))
        assert is_same(one, played(make_envs(functools.partial(Same, **keys), 3)))


def test_a_class_must_say_when_it_ends():
    with pytest.raises(ConfigError, match=r"'terminated', such as .* or override _is_done"):
        FMI2CSEnv(bundled_fmu("Pendulum"), PENDULUM)


def test_an_action_space_needs_an_input_without_an_expression():
    config = PENDULUM | {"terminated": False, "inputs": {"tau": "1"}}
    with pytest.raises(ConfigError, match="expressions write all inputs"):
        FMI2CSEnv(bundled_fmu("Pendulum"), config)


def test_a_reward_that_is_not_finite_is_told_with_its_text():
    env = Pendulum(reward="log(theta - 10)")
    env.reset(seed=1)
    *_, info = env.step(np.float32([0.0]))
    assert "the reward 'log(theta - 10)' is nan" in info["fault"]


def test_arrays_of_episode_variables_have_elements():
    env = Pendulum(reward="goals[1] - goals[0]", episode_variables={"goals": [1.0, 4.0, 9.0]})
    env.reset()
    assert env.step(np.float32([0.0]))[1] == 3.0


def test_start_times_that_are_drawn_end_at_the_stop_time(make_envs):
    keys = {"start_time": Uniform(0.0, 1.0), "stop_time": 2.0, "reward": "time"}
    keys["max_episode_steps"] = None
    env = Pendulum(**keys)
    assert formulas_of(env) is not None
    for seed in range(5):
        env.reset(seed=seed)
        truncated = False
        while not truncated:
            _, reward, _, truncated, _ = env.step(np.float32([0.0]))
            assert reward == env.time
        assert env.time + 0.05 > 2.0
    envs = make_envs(functools.partial(Pendulum, **keys), 3)
    envs.reset(seed=0)
    lengths = np.zeros(3)
    for _ in range(45):
        lengths += ~envs.step(np.zeros((3, 1), np.float32))[3]
    assert len(set(lengths)) > 1


class TestNumbersOfBundledTasks:
    def test_are_given_to_the_constructor(self):
        env = gymnasium.make("fmugym/CartPole-v0", model_parameters={"force_mag": Uniform(5, 20)})
        forces = set()
        for seed in range(3):
            _, info = env.reset(seed=seed)
            env.step(1)
            assert env.unwrapped.force_mag == env.unwrapped.inputs[0] == info["drawn"]["force_mag"]
            forces.add(env.unwrapped.force_mag)
        assert len(forces) == 3

    @pytest.mark.parametrize("id_", ["fmugym/CartPole-v0", "fmugym/Pendulum-v0"])
    def test_are_not_assigned(self, id_):
        env = gymnasium.make(id_).unwrapped
        name = "force_mag" if "Cart" in id_ else "max_torque"
        with pytest.raises(ConfigError, match=f"env.variables\\['{name}'\\]"):
            setattr(env, name, 1.0)


@pytest.mark.parametrize(
    "cls", [Pendulum, type("InPython", (Pendulum,), {"_is_done": lambda _: False})]
)
def test_memory_may_be_set_for_each_environment(make_envs, cls):
    keys = {"memory": {"sum": {"start": 1, "update": "sum + 1"}}, "reward": "sum"}
    envs = make_envs(functools.partial(cls, **keys), 3)
    envs.set_attr("sum", [10.0, 20.0, 30.0])
    envs.reset(seed=0)
    for step in range(1, 4):
        assert envs.step(np.zeros((3, 1), np.float32))[1].tolist() == [
            start + step for start in (10.0, 20.0, 30.0)
        ]
    assert envs.get_attr("sum") == (13.0, 23.0, 33.0)
    envs.set_attr("sum", 5.0)
    assert envs.step(np.zeros((3, 1), np.float32))[1].tolist() == [6.0] * 3
