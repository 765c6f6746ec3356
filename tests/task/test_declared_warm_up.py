"""Warm-ups of declared tasks: controllers and data before an episode, and states that are kept."""

from functools import partial
from itertools import product

import numpy as np
import pytest
from combinations import in_turn
from vector_tools import require_same_alone
from ways import in_way
from zoo_tools import parameters, zoo_fmu

import fmugym
from fmugym import FMUVectorEnv
from fmugym.control import controller_of
from fmugym.environment import reset as warm_ups
from fmugym.errors import SimulationError, TaskError

THERMOSTAT = "hysteresis of=T setpoint=T_set band=0.5"
PID = "pid of=T setpoint=T_set kp=0.3 ti=14400 td=60 offset=0.1"
STEPS = 48  # of half an hour: a day

HOUSE = {
    "fmu": {"bundled": "House"},
    "time_step": "30min",
    "substeps": 2,
    "episode_length": "3h",
    "clock": "01-15",
    "variables": {
        "T": {"name": "T_op", "unit": "degC", "min": 10, "max": 30},
        "P": {"name": "P", "unit": "kW", "sample": "mean", "max": 20},
    },
    "parameters": {"T_m_0": {"distribution": "uniform", "low": 290, "high": 296}},
    "data": {
        "T_out": {"values": [0, 5, -3, 8], "step": "5h", "unit": "degC", "input": "T_out"},
        "sun": {"values": [0, 0, 300, 90], "step": "6h", "input": "I_sol"},
    },
    "setpoints": {"T_set": {"schedule": {"06:00": 21, "22:00": 18}}},
    "agent": {"actions": ["u"], "observations": ["T", "T_set", "T_out", "P"]},
    "reward": "-abs(T - T_set) - P",
}


def house(controller=THERMOSTAT, agent=None, action=None, **keys):
    warm_up = {"period": "1d", "controller": controller}
    return (
        HOUSE
        | {"agent": HOUSE["agent"] | (agent or {})}
        | {"variables": HOUSE["variables"] | ({} if action is None else {"u": action})}
        | {"warm_up": warm_up}
        | keys
    )


def driven(task, controller, seed):
    """The outputs after a day in which a controller acts on the environment, as an agent does."""
    day_before = {"clock": "01-14", "episode_length": "100d"}
    env = fmugym.load({k: v for k, v in task.items() if k != "warm_up"} | day_before)
    bound = controller_of(controller).bind(env)
    observation, _ = env.reset(seed=seed)
    for _ in range(STEPS):
        observation, *_ = env.step(bound.act(observation))
    result = env.episode.outputs, env.inputs[0], observation[2]
    env.close()
    return result


@pytest.mark.parametrize("controller", [THERMOSTAT, PID, None])
def test_it_leads_where_the_controller_leads_as_an_agent(controller, load):
    """Without a controller, only data move."""
    env = load(house(controller) if controller else HOUSE | {"warm_up": "1d"})
    for seed in (3, 4):
        observation, _ = env.reset(seed=seed)
        expected = driven(HOUSE, controller or "schedule 00:00=0", seed)
        assert (env.episode.outputs, env.inputs[0], observation[2]) == expected
        assert env.time == 86400.0
        assert env.step_count == 0


CASCADE = {
    "u": "pid of=T setpoint=wish kp=0.4 ti=20000",
    "wish": {
        "controller": "pid of=P setpoint=T_set kp=0.2 ti=7200 offset=18",
        "min": 15,
        "max": 24,
    },
    "Q_int": "schedule 06:00=300 22:00=50",
}
BOTH = {"u": {"levels": [0, 0.5, 1]}, "Q_int": {"min": 0, "max": 400}}


@pytest.mark.parametrize("variables", [{"Q_int": BOTH["Q_int"]}, BOTH], ids=["numbers", "a switch"])
@pytest.mark.parametrize("rescale", [False, True])
def test_a_cascade_leads_where_it_leads_as_an_agent(variables, rescale, load):
    """By its name, with one of the actions that is a switch."""
    agent = HOUSE["agent"] | {"actions": ["u", "Q_int"]}
    task = HOUSE | {"agent": agent, "variables": HOUSE["variables"] | variables}
    table = {"controllers": {"cascade": CASCADE}}
    warm = {"warm_up": {"period": "1d", "controller": "cascade"}}
    env = load(task | table | warm | {"agent": agent | {"rescale": rescale}})
    day_before = {"clock": "01-14", "episode_length": "100d"}
    driven = load(task | day_before, physical=True)
    controller = controller_of(CASCADE)
    for seed in (3, 4):
        env.reset(seed=seed)
        controller.bind(driven)
        observation, _ = driven.reset(seed=seed)
        chosen = []
        for _ in range(STEPS):
            chosen.append(controller.act(observation))
            observation, *_ = driven.step(chosen[-1])
        wanted = [*driven.episode.outputs, *driven.inputs]
        found = [*env.episode.outputs, *env.inputs]
        assert found == (pytest.approx(wanted, rel=1e-5) if rescale else wanted)
        assert {one[1] for one in chosen} == {50.0, 300.0}
        assert len({one[0] for one in chosen}) > 5


def test_a_table_may_leave_out_actions(load):
    agent = HOUSE["agent"] | {"actions": ["u", "Q_int"]}
    variables = HOUSE["variables"] | {"Q_int": BOTH["Q_int"]}
    warm = {"period": "1d", "controller": {"Q_int": 120}}
    env = load(HOUSE | {"agent": agent, "variables": variables, "warm_up": warm})
    env.reset(seed=0)
    assert env.inputs[:2] == (0.0, 120.0)


def test_a_schedule_acts_by_the_clock(load):
    env = load(house("schedule 06:00=1 22:00=0.25", clock="01-15 05:30"))
    env.reset(seed=0)
    assert env.inputs[0] == 0.25
    later = load(house("schedule 06:00=1 22:00=0.25", clock="01-15 07:00"))
    later.reset(seed=0)
    assert later.inputs[0] == 1.0


@pytest.mark.parametrize("name", ["thermostat", "hysteresis"])
@pytest.mark.parametrize(
    "change",
    [
        {"agent": {"observations": ["T", "T_set", "T_out"]}},
        {"setpoints": {"T_set": {"schedule": {"06:00": 21, "22:00": 18}, "of": "T"}}},
    ],
)
def test_a_thermostat_whose_arguments_the_task_tells(name, change, load):
    full = "hysteresis of=T setpoint=T_set band=0 below=1 above=0"
    env, same = load(house(name, **change)), load(house(full, **change))
    assert env.reset(seed=0)[0].tolist() == same.reset(seed=0)[0].tolist()
    assert env.episode.outputs == same.episode.outputs


def test_named_controllers_and_constants():
    named = house("thermostat", controllers={"thermostat": THERMOSTAT, "half": 0.5})
    for task, controller in ((named, THERMOSTAT), (house(0.5), "schedule 00:00=0.5")):
        env, same = fmugym.load(task), fmugym.load(house(controller))
        np.testing.assert_array_equal(env.reset(seed=1)[0], same.reset(seed=1)[0])
        env.close()
        same.close()


ACTIONS = {
    "plain": ({}, None),
    "rescaled": ({"rescale": True, "normalize": False}, None),
    "levels": ({}, {"levels": [0, 0.5, 1]}),
    "changes": ({}, {"delta": 0.2}),
    "rate": ({}, {"rate": 1e-4}),
    "least times": ({}, {"levels": [0, 1], "min_on": "2h", "min_off": "2h"}),
    "histories": ({"history": {"of": ["T", "u", "T_out"], "length": "2h"}}, None),
}
CLOCKS = {"distribution": "choice", "values": [0, 864000.0]}


@in_turn(
    {
        "hooks,kind": list(product(["expressions", "arrays", "one by one"], ACTIONS)),
        "mode,caches": {"new": ("next_step", False), "cached": ("same_step", True)},
    }
)
def test_many_environments_equal_single_ones(caches, kind, hooks, mode):
    agent, action = ACTIONS[kind]
    task = house(PID, agent, action, clock=CLOCKS)
    if caches:
        task["warm_up"] = task["warm_up"] | {"cache": True}
        task["parameters"] = {"T_m_0": 291.0}
    assert require_same_alone(partial(fmugym.load, task), 16, mode, way=hooks)


@pytest.mark.parametrize("controller", [PID, THERMOSTAT, "schedule 05:00=0.7 21:00=0.3", 0.5])
def test_those_that_go_on_do_not_change(controller, make_envs):
    task = house(controller, clock=CLOCKS)
    envs = make_envs(partial(fmugym.load, task), 3, autoreset_mode="disabled")
    envs.reset(seed=2)
    envs.action_space.seed(1)
    envs.step(envs.action_space.sample())
    before, outputs = envs.call("inputs"), envs.pool.outputs.copy()
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    assert envs.call("inputs")[1] == before[1] != envs.call("inputs")[0]
    assert (envs.pool.outputs == outputs).all(axis=0).tolist() == [False, True, False]


def test_histories_hold_what_was_before_the_episode(load):
    agent = {"history": {"of": ["T", "u"], "length": "2h"}}
    task = house(0.75, agent)
    env = load(task)
    day_before = {k: v for k, v in task.items() if k != "warm_up"}
    plain = load(day_before | {"clock": "01-14", "episode_length": "100d"})
    observation, _ = env.reset(seed=5)
    plain.reset(seed=5)
    for _ in range(STEPS):
        expected = plain.step([0.75])[0]
    np.testing.assert_array_equal(observation, expected)
    for _ in range(3):
        np.testing.assert_array_equal(env.step([0.5])[0], plain.step([0.5])[0])


def test_after_one_that_fails_there_is_no_episode(tmp_path):
    task = {
        "fmu": str(zoo_fmu(tmp_path, 2)),
        "time_step": "500ms",
        "variables": {"u": {"min": -1, "max": 1}, "y": {"min": -9, "max": 9}},
        "parameters": parameters("status", "step", 2, status=3),
        "agent": {"actions": ["u"], "observations": ["y"]},
        "reward": "y",
        "warm_up": {"period": "2s", "controller": 0.5},
    }
    env, envs = fmugym.load(task), FMUVectorEnv(partial(fmugym.load, task), 2)
    for one, text in ((env, "the warm-up failed"), (envs, "environment 0: the warm-up failed")):
        with pytest.raises(SimulationError, match=text):
            one.reset(seed=0)
        with pytest.raises(SimulationError, match="before the first reset"):
            one.step(one.action_space.sample())
        one.close()


class TestCache:
    @pytest.fixture(autouse=True)
    def empty(self, monkeypatch, tmp_path):
        monkeypatch.setattr(warm_ups, "_memory", warm_ups._Memory())
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path))

    def task(self, **keys):
        task = house(**keys) | {"parameters": {"T_m_0": 291.0}}
        task["warm_up"] = task["warm_up"] | {"cache": True}
        return task

    def test_a_state_serves_later_episodes(self, load):
        env, plain = load(self.task()), load(house(parameters={"T_m_0": 291.0}))
        expected = plain.reset(seed=0)[0]
        for _ in range(3):
            np.testing.assert_array_equal(env.reset(seed=0)[0], expected)
        assert env.health["steps"] == 2 * STEPS  # substeps of one warm-up
        np.testing.assert_array_equal(env.step([0.3])[0], plain.step([0.3])[0])

    def test_each_beginning_has_its_own(self, load):
        env = load(self.task(clock=["01-15", "07-01 03:00"]))
        days = {}
        for seed in range(8):
            observation, info = env.reset(seed=seed)
            days.setdefault(info["drawn"]["clock"], []).append(observation.tolist())
        assert len(days) == 2
        for seen in days.values():
            assert seen == [seen[0]] * len(seen)
        assert env.health["steps"] == 2 * 2 * STEPS

    @pytest.mark.parametrize("hooks", ["expressions", "arrays"])
    def test_one_warm_up_serves_many_environments(self, hooks, load, make_envs):
        task = self.task(clock=["01-15", "07-01 03:00"])
        envs = make_envs(in_way(hooks, partial(fmugym.load, task)), 6)
        observations, infos = envs.reset(seed=0)
        assert len(set(infos["drawn"]["clock"])) == 2
        assert envs.health["steps"].sum() == 2 * 2 * STEPS
        single = load(task)
        for seed in range(6):
            np.testing.assert_array_equal(single.reset(seed=seed)[0], observations[seed])
        envs.reset(seed=6)
        assert envs.health["steps"].sum() == 2 * 2 * STEPS

    def test_it_survives_on_disk(self, monkeypatch, load):
        agent = {"history": {"of": ["T", "u"], "length": "2h"}}
        first = load(self.task(agent=agent))
        expected = first.reset(seed=0)[0]
        after = first.step([0.6])[0]
        monkeypatch.setattr(warm_ups, "_memory", warm_ups._Memory())  # another process
        second = load(self.task(agent=agent))
        np.testing.assert_array_equal(second.reset(seed=0)[0], expected)
        np.testing.assert_array_equal(second.step([0.6])[0], after)
        assert second.health["steps"] == 2

    def test_a_damaged_file_is_no_state(self, monkeypatch, tmp_path, load):
        env = load(self.task())
        expected = env.reset(seed=0)[0]
        (file,) = (tmp_path / "states").iterdir()
        content = bytearray(file.read_bytes())
        content[-1] ^= 1
        file.write_bytes(content)
        monkeypatch.setattr(warm_ups, "_memory", warm_ups._Memory())
        again = load(self.task())
        np.testing.assert_array_equal(again.reset(seed=0)[0], expected)
        assert again.health["steps"] == 2 * STEPS

    def test_without_states_every_episode_has_its_warm_up(self, caplog, load):
        task = {
            "fmu": {"bundled": "Pendulum", "fmi_version": "1.0"},
            "time_step": "50ms",
            "variables": {"tau": {"min": -1, "max": 1}},
            "agent": {"actions": ["tau"], "observations": ["q"]},
            "reward": "q",
            "warm_up": {"period": "1s", "controller": 0.01, "cache": True},
        }
        env = load(task)
        first, again = env.reset(seed=0)[0], env.reset(seed=0)[0]
        np.testing.assert_array_equal(first, again)
        assert env.health["steps"] == 40
        assert caplog.text.count("cannot be serialized") == 1

    def test_another_controller_is_another_state(self, load):
        task = self.task()
        cold = task | {"warm_up": task["warm_up"] | {"controller": 0}}
        one, other = load(task), load(cold)
        assert one.reset(seed=0)[0][0] > other.reset(seed=0)[0][0] + 1

    def test_what_is_drawn_from_a_continuum_is_refused(self):
        task = house()
        task["warm_up"] = task["warm_up"] | {"cache": True}
        with pytest.raises(TaskError, match=r"^warm_up\.cache: .*'T_m_0'"):
            fmugym.load(task)


LOOP = {"controller": "pid of=T setpoint=21 kp=1", "min": 0}
READS_W = "pid of=T setpoint=w kp=1"


@pytest.mark.parametrize(
    ("warm_up", "fact"),
    [
        ({"controller": 0}, "'period'"),
        ({"period": "40min", "controller": 0}, "2400 s"),
        ({"period": "1d", "controller": "thermostt"}, "thermostat"),
        ({"period": "1d", "controller": "pid of=T"}, "'setpoint'.*pid of=T setpoint=21 kp="),
        ({"period": "1d", "controller": "hysteresis"}, "'of'.*of=T setpoint=T_set band=.*below=1"),
        ({"period": "1d", "controller": "pid of=TT setpoint=1 kp=1"}, "'T'"),
        ({"period": "1d", "controller": "hysteresis of=T setpoint=T_sot band=1"}, "'T_set'"),
        ({"period": "1d", "controller": {"v": 0}}, "'u'"),
        ({"period": "1d", "controller": {"u": 0, "w": LOOP | {"max": 1}}}, "'w'"),
        ({"period": "1d", "controller": {"u": READS_W, "w": LOOP}}, "'max'"),
        ({"period": "1d", "controller": {"u": READS_W, "w": LOOP | {"max": -1}}}, "below"),
        ({"period": "1d", "controller": 3}, r"3\.0"),
        ({"period": "1d", "controller": 0, "cache": 1}, "cache"),
    ],
)
def test_mistakes_are_placed(warm_up, fact):
    task = HOUSE | {"warm_up": warm_up, "controllers": {"thermostat": THERMOSTAT}}
    with pytest.raises(TaskError, match=rf"^warm_up.*{fact}"):
        fmugym.load(task)


def test_a_fault_in_it_is_an_error(load):
    task = house(inputs={"Q_int": "exp(1000 * T_set)"})
    env = load(task)
    with pytest.raises(SimulationError, match="warm-up"):
        env.reset(seed=0)


def test_it_shares_no_time_with_an_excluded_scenario(load):
    task = house(
        clock={"from": "01-10", "to": "01-20", "exclude": "scenarios"},
        scenarios={"peak": {"start": "01-14", "length": "1d"}},
    )
    env = load(task)
    days = {round(env.reset(seed=s)[1]["drawn"]["clock"] / 86400) + 1 for s in range(60)}
    assert days == {10, 11, 12, 13, 16, 17, 18, 19, 20}
