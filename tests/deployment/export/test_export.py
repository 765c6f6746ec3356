"""Exported agents do what the originals do: in C, in a loop with the plant."""

from contextlib import closing

import gymnasium
import numpy as np
import pytest
from combinations import in_turn
from export_tools import (
    ACTIVATIONS,
    TIMED,
    TIMES,
    acting,
    agent_named,
    closed_loop,
    compiled,
    differences,
    drawn_in,
    exported,
    made,
    network_for,
    network_with,
)
from letters import wide

import fmugym
from fmugym import ConfigError
from fmugym.deployment.export import Layer, Network, agent_of, write_c

BALANCING = np.array([[0.0, 0.0, 0.0, 0.0], [0.1, 0.5, 10.0, 2.0]], np.float32)
"""The second action of a cart-pole is better than the first one where this feedback is positive."""

HEATING = {
    "fmu": {"bundled": "House"},
    "time_step": "15min",
    "episode_length": "2d",
    "parameters": {"T_m_0": {"distribution": "uniform", "low": 292, "high": 296}},
    "variables": {"T": {"name": "T_op", "unit": "degC", "min": 10, "max": 30}},
    "data": {"price": {"values": [1, 3, 2], "step": "1h"}},
    "reward": "-abs(T - 21)",
}
LATE = "sin(elapsed / 3600) % 0.3 + previous(T) / 50"
PRESENT = {"actions": ["u"], "observations": ["T", "price"], "normalize": True, "rescale": True}
SENSOR = {"delay": "30min", "noise": 0.2, "quantum": 0.5, "bias": 0.3}
TASKS = {
    "history": {
        "agent": PRESENT | {"history": {"of": ["T", "u"], "length": "1h"}, "observations": ["T"]}
    },
    "forecast": {"agent": PRESENT | {"forecast": {"of": "price", "horizon": "2h"}}},
    "change": {"variables": {"u": {"delta": 0.1}}, "agent": PRESENT},
    "rate": {"variables": {"u": {"rate": 0.0001, "quantum": 0.05}}, "agent": PRESENT},
    "levels": {
        "variables": {"u": {"levels": [0, 0.5, 1], "min_on": "1h", "min_off": "45min"}},
        "agent": {"actions": ["u"], "observations": ["T", "price"]},
    },
    "memory": {
        "memory": {"debt": {"start": 0.0, "update": "0.9 * debt + 21 - T", "min": -50, "max": 50}},
        "agent": PRESENT | {"observations": ["T", "debt"]},
    },
    "set point": {
        "setpoints": {"T_set": {"distribution": "uniform", "low": 19, "high": 22}},
        "agent": PRESENT | {"observations": ["T", "T_set"], "normalize": False},
    },
    "expression": {
        "expressions": {"late": {"expr": LATE, "min": 0, "max": 2}},
        "agent": PRESENT | {"observations": ["T", "late"]},
    },
}  # fmt: skip

FILTERED = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": "50ms",
    "episode_length": "5s",
    "parameters": {"theta_0": 0.5, "m": {"distribution": "uniform", "low": 0.9, "high": 1.1}},
    "variables": {"gain": {"levels": [0.5, 1, 2]}, "way": {"levels": [-1, 0, 1]}},
    "inputs": {"tau": "gain * way"},
    "memory": {
        "slow": {"start": 0, "update": "0.9 * slow + 0.1 * q_dot"},
        "goal": {"start": {"distribution": "uniform", "low": -1, "high": 1}},
    },
    "expressions": {"sine": "sin(q) - goal", "cosine": "cos(q)"},
    "agent": {"actions": ["gain", "way"], "observations": ["q_dot", "slow", "sine", "cosine"]},
    "reward": "-abs(q)",
}
"""A pendulum with a filter and two actions, one of which is a gain."""


class Shifted(fmugym.FMI2CSEnv):
    """The same as a class, whose choices do not begin with 0."""

    def __init__(self, **keys):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"theta_0": 0.5, "m": fmugym.Uniform(0.9, 1.1)},
            "time_step": 0.05,
            "max_episode_steps": 100,
            "inputs": {"tau": "(0.5 if action[0] == 2 else action[0] - 2) * action[1]"},
            "memory": {"slow": {"start": 0.0, "update": "0.9 * slow + 0.1 * q_dot"}},
            "episode_variables": {"goal": fmugym.Uniform(-1, 1)},
            "observations": ["q_dot", "slow", "sin(q) - goal", "cos(q)"],
            "terminated": False,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum", "2.0"), config | keys)

    def _get_action_space(self):
        return gymnasium.spaces.MultiDiscrete([3, 3], start=[2, -1])


def heating(name):
    own = TASKS[name]
    variables = HEATING["variables"] | own.get("variables", {})
    return fmugym.load(HEATING | own | {"variables": variables})


class Loops:
    """The environment with its agent, beside the plant in FMPy with the exported agent.

    Attributes:
        languages: Those of the agent; the last one for registered tasks, the first one for others.
    """

    @pytest.mark.parametrize("env_id", ["CartPole", "Pendulum", "House", "CloudPendulum"])
    def test_of_registered_tasks(self, env_id, tmp_path):
        env = made(env_id)
        network, language = network_for(env), self.languages[-1]
        agent = agent_of(env, network, all_inputs=True)
        measured, written, steps = closed_loop(
            env, acting(network), agent, tmp_path, 200, seed=3, language=language
        )
        assert steps > 5
        assert measured <= 1e-5
        assert written <= 1e-5
        env.close()

    @pytest.mark.parametrize("task", TASKS)
    def test_of_what_a_task_file_declares(self, task, tmp_path):
        env = heating(task)
        network = network_for(env, scaled=False)
        measured, written, steps = closed_loop(
            *(env, acting(network), agent_of(env, network), tmp_path),
            seed=1,
            language=self.languages[0],
        )
        assert steps == 192
        assert measured <= 1e-4
        assert written <= 1e-5
        env.close()

    @pytest.mark.parametrize("times", TIMES)
    def test_from_several_start_times(self, times, tmp_path, load):
        env = load(TIMED | TIMES[times])
        network = network_for(env, scaled=False)
        agent = agent_of(env, network)
        controller = exported(agent, tmp_path, self.languages[0])
        logic, began = agent.logic, set()
        for seed in range(6):
            env.reset(seed=seed)
            began.add(env.time + env.variables.get("clock", 0.0))
            controller.begin(**drawn_in(env, logic))
            _, worst, _ = differences(env, acting(network), logic, controller.step, 60)
            assert worst <= 1e-5
        assert (len(began) > 1) == (times != "constant")

    @pytest.mark.parametrize("make", [lambda: fmugym.load(FILTERED), Shifted])
    def test_of_several_choices(self, make, tmp_path):
        env = make()
        network = network_for(env)
        agent = agent_of(env, network)
        controller = exported(agent, tmp_path, self.languages[0])
        env.reset(seed=5)
        controller.begin(**drawn_in(env, agent.logic))
        chosen = []

        def act(observation):
            chosen.append(network.action(observation))
            return chosen[-1]

        assert differences(env, act, agent.logic, controller.step, 50) == (0.0, 0.0, 50)
        assert all(map(env.action_space.contains, chosen))
        assert len(np.unique(chosen, axis=0)) > 1
        env.close()


class TestClosedLoop(Loops):
    languages = "C99", "C++"

    def test_a_cart_pole_that_is_balanced_all_the_time(self, tmp_path):
        env = made("CartPole")
        network = Network((Layer(BALANCING, np.zeros(2, np.float32)),), env.action_space)
        played = closed_loop(env, acting(network), agent_of(env, network), tmp_path, 500)
        assert played == (0.0, 0.0, 500)
        env.close()


class TestMemory:
    """What an agent keeps from one sample to the next."""

    def test_kept_values_move_on_together(self, tmp_path, load):
        """The agent sees the angle three steps late."""
        env = load(
            {
                "fmu": {"bundled": "Pendulum"},
                "time_step": "50ms",
                "episode_length": "5s",
                "parameters": {"theta_0": 0.5},
                "memory": {
                    "first": {"start": 0, "update": "q"},
                    "second": {"start": 0, "update": "first"},
                    "third": {"start": 0, "update": "second"},
                    "count": {"start": 0, "update": "second - count"},
                },
                "expressions": {"torque": "previous(tau)"},
                "agent": {"actions": ["tau"], "observations": ["third", "count", "torque"]},
                "reward": 1,
            }
        )
        network = network_for(env)
        agent = agent_of(env, network)
        controller = compiled(agent, tmp_path)
        assert "count_[1]" in (tmp_path / "agent.h").read_text()
        observation, _ = env.reset(seed=0)
        controller.begin()
        for _ in range(50):
            actions = controller.step(env.state[:1])
            observation, *_ = env.step(network.action(observation))
            assert actions == pytest.approx(env.inputs, abs=1e-6)

    @pytest.mark.parametrize("env_id", ["CartPole", "House"])
    def test_an_environment_that_runs_compiled(self, env_id, tmp_path):
        env, other = made(env_id), made(env_id)
        network, texts, ran_compiled = network_for(env), [], False
        action = env.action_space.sample()
        for one in (env, other):
            one.reset(seed=0)
        for count in range(2000):
            results = [one.step(action) for one in (env, other)]
            assert results[0][1:4] == results[1][1:4]
            ran_compiled |= env.is_compiled
            if results[0][2] or results[0][3]:
                for one in (env, other):
                    one.reset()
            if count == 5 or (ran_compiled and len(texts) < 2):
                (tmp_path / str(count)).mkdir()
                files = write_c(agent_of(env, network), tmp_path / str(count))
                texts.append([file.read_text() for file in files])
        assert ran_compiled
        assert texts[0] == texts[1]
        env.close()
        other.close()

    def test_what_was_drawn_is_a_parameter(self, load):
        env = load(FILTERED)
        logic = agent_of(env, network_for(env)).logic
        assert [one.name for one in logic.parameters] == ["goal"]  # nothing reads the mass
        assert [kept.name for kept in logic.kept] == ["slow", "goal"]

    def test_a_hidden_state_is_refused(self, load):
        task = HEATING | {"agent": PRESENT | {"observations": ["rate"]}}
        variables = HEATING["variables"] | {"rate": {"name": "der_T_m", "min": -1, "max": 1}}
        env = load(task | {"variables": variables})
        with pytest.raises(ConfigError, match=r"'der_T_m'.*'local'"):
            agent_of(env, network_for(env))


class Plain(fmugym.FMI2CSEnv):
    """A pendulum whose only hooks are those that no controller needs."""

    def __init__(self):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "episode_variables": {"slow": 0.0},
            "time_step": 0.05,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum", "2.0"), config)

    def _is_done(self):
        return bool(abs(self.out["q"]) > 9)

    def _reward_policy(self):
        return -float(np.linalg.norm(self.state))


def observe(self):
    return self.state / 2


def update(self):
    self.variables["slow"] = 0.9 * self.variables["slow"]


class TestHooks:
    """Hooks are Python, which no controller runs."""

    def test_those_of_rewards_and_ends_are_not_needed(self, tmp_path):
        with closing(Plain()) as env:
            network = network_for(env)
            agent = agent_of(env, network)
            measured, written, steps = closed_loop(env, acting(network), agent, tmp_path, 50)
        assert measured <= 1e-3
        assert written <= 1e-3
        assert steps == 50

    @pytest.mark.parametrize(
        ("hooks", "fact"),
        [
            ({"step": lambda self, action: None}, "step is overridden"),
            ({"_get_inputs": lambda self: 2 * self.action}, "_get_inputs is .* 'inputs'"),
            ({"_update": update}, "_update is .* 'memory'"),
            ({"_get_observation": observe}, "_get_observation is .* 'observations'"),
        ],
    )
    def test_others_are_refused(self, hooks, fact):
        odd = type("Odd", (Plain,), hooks)
        with closing(odd()) as env, pytest.raises(ConfigError, match=f"Odd.*{fact}"):
            agent_of(env, network_for(env))

    def test_of_a_task_that_has_a_reward_in_python(self):
        class Rewarding(fmugym.TaskEnv):
            def _reward_policy(self):
                return -float(np.linalg.norm(self.state))

        with closing(Rewarding(HEATING | {"agent": PRESENT})) as env:
            assert [v.name for v in agent_of(env, network_for(env)).logic.measurements] == ["T_op"]

    def test_the_end_of_an_episode_is_not_known_to_a_controller(self):
        env = Shifted(observations=["1 if done else 0", "q"])
        with closing(env), pytest.raises(ConfigError, match="'done'"):
            agent_of(env, network_for(env))

    def test_one_that_is_assigned_is_refused(self, load):
        env = load(HEATING | {"agent": PRESENT})
        env._get_inputs = lambda: [1.0]
        with pytest.raises(ConfigError, match="_get_inputs is a function of Python"):
            agent_of(env, network_for(env))


class TestSensors:
    """What sensors and actuators do to values is part of the plant."""

    def test_are_left_out(self, tmp_path):
        ideal, real = heating("history"), HEATING["variables"]["T"] | SENSOR
        task = HEATING | TASKS["history"]
        noisy = fmugym.load(
            task | {"variables": {"T": real, "u": {"delay": "30min", "noise": 0.1}}}
        )
        texts = []
        for env, name in ((ideal, "one"), (noisy, "two")):
            (tmp_path / name).mkdir()
            files = write_c(agent_of(env, network_for(ideal)), tmp_path / name)
            texts.append([file.read_text() for file in files])
            env.close()
        assert texts[0] == texts[1]


class TestExternal:
    """Data that the agent is given instead of having them in tables."""

    def test_takes_the_place_of_tables(self, tmp_path):
        env, names = made("House"), ["T_out", "sun", "price"]
        network = network_for(env)
        agent = agent_of(env, network, external=[names[0], *map(wide, names[1:])])
        controller = compiled(agent, tmp_path)
        assert "house_table" not in (tmp_path / "agent.c").read_text()
        plain = [one.name for one in agent.logic.measurements]
        assert plain[:5] == ["T_op", "T_w", "T_out_given", "T_out_in_7200_s", "T_out_in_14400_s"]
        assert len(plain) == 2 + 3 * 7
        places = [
            i for i, one in enumerate(env.observation_names) if one.partition("[")[0] in names
        ]
        order = sorted(
            places, key=lambda i: names.index(env.observation_names[i].partition("[")[0])
        )
        observation, _ = env.reset(seed=2)
        controller.begin(clock=env.variables["clock"])
        for _ in range(100):
            given = [env.out["T_op"], env.out["T_w"], *observation[order]]
            actions = controller.step(given)
            observation, *_ = env.step(network.action(observation))
            assert actions == pytest.approx([env.inputs[0]], abs=1e-5)
        env.close()

    @pytest.mark.parametrize(
        ("name", "fact"), [("T_outt", "'T_out'"), ("people", "'people'"), ("hour", "'hour'")]
    )
    def test_mistakes(self, name, fact):
        env = made("House")
        with pytest.raises(ConfigError, match=fact):
            agent_of(env, network_for(env), external=[name])
        env.close()

    def test_classes_have_no_data(self):
        with closing(Plain()) as env, pytest.raises(ConfigError, match="task file"):
            agent_of(env, network_for(env), external=["price"])


class TestFiles:
    def test_measurements_and_actions_have_names_and_units(self, tmp_path):
        env = made("House")
        header, source = write_c(agent_of(env, network_for(env), name="heat"), tmp_path)
        env.close()
        text = header.read_text()
        assert "heat_step(heat_state *state, const double *measurements, double *actions)" in text
        assert "HEAT_MEASUREMENT_T_op, /* K, Operative temperature inside */" in text
        assert "HEAT_ACTION_u" in text
        assert "HEAT_SAMPLE_TIME 900.0" in text
        assert "malloc" not in source.read_text()

    def test_two_agents_live_in_one_program(self, tmp_path):
        agents = [
            compiled(agent_named(name, seed), tmp_path)
            for seed, name in enumerate(["left", "right"])
        ]
        for agent in agents:
            agent.begin()
        seen = np.random.default_rng(0).normal(size=(50, 4)).tolist()
        chosen = [[agent.step(one) for one in seen] for agent in agents]
        assert chosen[0] != chosen[1]

    def test_nothing_is_overwritten(self, tmp_path):
        agent = agent_named()
        write_c(agent, tmp_path)
        with pytest.raises(FileExistsError, match=r"agent\.h"):
            write_c(agent, tmp_path)
        with pytest.raises(ConfigError, match="nowhere"):
            write_c(agent, tmp_path / "nowhere")

    @pytest.mark.parametrize("name", ["math", "agent_fmi2", "a-b", "ä", "2a", ""])
    def test_names_that_are_none(self, name):
        with pytest.raises(ConfigError, match="name"):
            agent_named(name)

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_a_measurement_that_is_not_finite_changes_nothing(self, bad, tmp_path):
        env = heating("history")
        controller = compiled(agent_of(env, network_for(env)), tmp_path)
        env.close()
        controller.begin()
        controller.step([293.0])
        before = controller.memory.raw
        assert controller.step([bad]) is None
        assert controller.memory.raw == before


class TestNetworks:
    @in_turn({"activation": {one.name: one for one in ACTIVATIONS}, "squashed": [False, True]})
    def test_activations(self, activation, squashed, tmp_path):
        env = made("Pendulum")
        self._compare(env, network_with(activation, env, squashed), tmp_path)

    def test_double_precision(self, tmp_path):
        env = made("Pendulum")
        layers = network_for(env).layers
        wide = [
            Layer(one.weights.astype(float), one.bias.astype(float), one.activations)
            for one in layers
        ]
        self._compare(
            env, Network(tuple(wide), env.action_space, dtype=np.dtype(np.float64)), tmp_path
        )

    def _compare(self, env, network, tmp_path):
        controller = compiled(agent_of(env, network), tmp_path)
        controller.begin()
        env.reset(seed=0)
        for theta, speed in np.random.default_rng(0).normal(size=(100, 2)) * [1, 3]:
            seen = np.array([np.cos(theta), np.sin(theta), speed], np.float32)
            torque = np.float32(3 * np.clip(network.action(seen), -2, 2)[0]) / 3
            assert controller.step([theta, speed]) == pytest.approx([torque], abs=2e-6)
        env.close()

    def test_of_another_task_is_refused(self):
        env, other = made("Pendulum"), made("CartPole")
        with pytest.raises(ConfigError, match="4 values, the task gives 3"):
            agent_of(env, network_for(other))
        env.close()
        other.close()

    def test_layers_that_do_not_fit_are_refused(self):
        space = gymnasium.spaces.Discrete(2)
        layers = [
            Layer(np.zeros((b, a), np.float32), np.zeros(b, np.float32))
            for a, b in [(4, 8), (9, 2)]
        ]
        with pytest.raises(ConfigError, match=r"8 values.*9"):
            Network(tuple(layers), space)
        with pytest.raises(ConfigError, match=r"8 values, expected 2"):
            Network((layers[0],), space)
