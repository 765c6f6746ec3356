"""The physical form of a task: controllers read and write values in its units."""

import json
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from combinations import in_turn
from ways import in_way

import fmugym
from fmugym import FMUVectorEnv, Task, TaskEnv
from fmugym.control import PID, Constant, Hysteresis, Random, Schedule
from fmugym.envs.house import HOUSE_TASK
from fmugym.errors import ConfigError

STEPS = 48

HOUSE = {"extends": str(HOUSE_TASK)}
TASKS = {
    "house": HOUSE,
    "levels": HOUSE | {"variables": {"u": {"levels": [1, 0, 0.5]}}},
    "delta": HOUSE | {"variables": {"u": {"min": 0, "max": 1, "delta": 0.15}}},
    "rate": HOUSE | {"variables": {"u": {"rate": 1e-4, "delay": "15min"}}},
    "late change": HOUSE | {"variables": {"u": {"delta": 0.15, "delay": "30min"}}},
    "least times": HOUSE
    | {"variables": {"u": {"levels": [0, 1], "min_on": "1h", "min_off": "2h"}}},
}
FORMS = {
    "normalize": {"normalize": True},
    "nominal": {"normalize": "nominal"},
    "rescale": {"rescale": True},
    "both": {"normalize": True, "rescale": True},
}
CONTROLLERS = {
    "pid": lambda: PID("T", "T_set", kp=0.3, ti=14400.0, td=60.0, offset=0.1),
    "hysteresis": lambda: Hysteresis("T", 21.0, band=0.3),
    "schedule": lambda: Schedule({"06:00": 0.8, "22:00": 0.3}),
    "constant": lambda: Constant([0.4]),
}


def formed(task, **agent):
    """The task with more keys of the agent; of its observations, those that have limits."""
    own = {"observations": ["T", "T_floor", "T_set", "T_out", "price"]}
    return task | {"agent": {**own, **agent}}


def played(env, controller, steps=STEPS):
    """The inputs and the rewards of an episode."""
    controller.bind(env)
    observation, info = env.reset(seed=3)
    rows = []
    for _ in range(steps):
        observation, reward, *_, info = env.step(controller.act(observation, info))
        rows.append((*env.inputs, reward))
    env.close()
    return np.array(rows)


@in_turn({"controller": list(CONTROLLERS), "kind": list(TASKS)})
def test_the_form_for_agents_leaves_controllers_as_they_are(kind, controller):
    make = CONTROLLERS[controller]
    plain = played(fmugym.load(formed(TASKS[kind]), physical=True), make())
    assert len(np.unique(plain[:, -1])) > 10
    for agent in FORMS.values():
        env = fmugym.load(formed(TASKS[kind], **agent), physical=True)
        np.testing.assert_array_equal(played(env, make()), plain)


@pytest.mark.parametrize("kind", ["house", "rate"])
def test_a_task_without_a_form_for_agents_is_physical(kind):
    task = formed(TASKS[kind])
    declared, physical = fmugym.load(task), fmugym.load(Task.from_dict(task).physical())
    assert declared.unphysical_keys == physical.unphysical_keys == ()
    controller = CONTROLLERS["pid"]
    np.testing.assert_array_equal(played(declared, controller()), played(physical, controller()))


class TestLimits:
    def inputs(self, kind, controller, form="both"):
        env = fmugym.load(formed(TASKS[kind], **FORMS[form]), physical=True)
        return played(env, controller)[:, 0]

    @pytest.mark.parametrize("kind", ["delta", "late change"])
    def test_a_change_is_limited(self, kind):
        inputs = self.inputs(kind, PID("T", "T_set", kp=5.0, td=3600.0))
        changes = np.abs(np.diff(inputs, prepend=0.0))
        assert changes.max() == pytest.approx(0.15)
        assert 0 <= inputs.min() < inputs.max() <= 1

    def test_a_late_change_follows_the_value_of_two_steps_ago(self):
        inputs = self.inputs("late change", Constant([0.4]))
        assert inputs[:6] == pytest.approx([0, 0, 0.15, 0.3, 0.4, 0.4])

    def test_a_rate_and_least_times_bind(self):
        inputs = self.inputs("rate", Constant([0.4]))
        assert inputs[:7] == pytest.approx([0, 0.09, 0.18, 0.27, 0.36, 0.4, 0.4])
        switched = self.inputs("least times", Hysteresis("T", 21.0, band=0.0))
        places = [i for i, (old, new) in enumerate(pairwise(switched)) if old != new]
        assert min(np.diff(places)) >= 4
        assert set(switched) == {0.0, 1.0}

    @pytest.mark.parametrize(
        ("value", "level"), [(0.2, 0.0), (0.25, 0.0), (0.26, 0.5), (0.75, 0.5), (0.76, 1.0)]
    )
    def test_the_nearest_level_is_written_or_the_lower_one_of_two(self, value, level):
        assert set(self.inputs("levels", Constant([value]))) == {level}

    def test_spaces(self, load):
        env = load(formed(TASKS["levels"]), physical=True)
        assert env.action_space == fmugym.load(formed(HOUSE), physical=True).action_space


@pytest.mark.parametrize("kind", ["levels", "late change", "least times"])
def test_many_environments_are_compiled_and_equal_single_ones(kind):
    make = partial(fmugym.load, formed(TASKS[kind], **FORMS["both"]), physical=True)
    envs = FMUVectorEnv(in_way("expressions", make), 2)
    assert envs.task.way == "expressions"
    controller = CONTROLLERS["pid"]().bind(envs)
    observations, _ = envs.reset(seed=[3, 4])
    rewards = []
    for _ in range(STEPS):
        observations, reward, *_ = envs.step(controller.act(observations))
        rewards.append(reward[0])
    envs.close()
    np.testing.assert_array_equal(rewards, played(make(), CONTROLLERS["pid"]())[:, -1])


class TestRefusals:
    @pytest.mark.parametrize(
        ("kind", "form", "keys"),
        [
            ("house", "normalize", ["normalize"]),
            ("house", "both", ["normalize", "rescale"]),
            ("levels", None, ["levels"]),
            ("delta", "rescale", ["delta", "rescale"]),
        ],
    )
    @pytest.mark.parametrize("is_vector", [False, True])
    def test_controllers_refuse_the_form_for_agents(self, kind, form, keys, is_vector, tmp_path):
        Task.of(formed(TASKS[kind], **FORMS.get(form, {}))).write(tmp_path / "own.toml")
        make = partial(fmugym.load, tmp_path / "own.toml")
        env = FMUVectorEnv(make, 2) if is_vector else make()
        with pytest.raises(ConfigError) as caught:
            CONTROLLERS["pid"]().bind(env)
        for fact in (*map(repr, keys), "fmugym.load('own.toml', physical=True)"):
            assert fact in str(caught.value)
        Random(0).bind(env)
        env.close()

    def test_physical_is_true_or_false(self):
        with pytest.raises(ConfigError, match=r"physical.*'yes'"):
            fmugym.load(HOUSE, physical="yes")


def test_the_form_of_a_task():
    task = Task.from_dict(HOUSE).physical()
    assert task.in_scenario("frost").is_physical
    assert task.physical() == task != Task.from_dict(HOUSE)
    assert "physical" not in str(task.document)


@pytest.mark.parametrize("physical", [False, True])
class TestWarmUps:
    def input_after(self, period, controller, physical, **u):
        task = HOUSE | {
            "variables": {"u": u},
            "warm_up": {"period": period, "controller": controller},
            "clock": "01-15 12:00",
        }
        env = fmugym.load(
            formed(task, normalize=True, rescale="levels" not in u), physical=physical
        )
        env.reset(seed=0)
        env.close()
        return env.inputs[0]

    def test_changes_and_rates_are_limited(self, physical):
        for limit in ({"delta": 0.09}, {"rate": 1e-4}):
            found = [self.input_after(f"{15 * n}min", 0.4, physical, **limit) for n in (1, 2, 3, 9)]
            assert found == pytest.approx([0.09, 0.18, 0.27, 0.4])

    def test_least_times_bind(self, physical):
        switch = {"levels": [0, 1], "min_on": "2h"}
        schedule = "schedule 00:00=0 11:00=1 11:15=0"
        assert self.input_after("3h", schedule, physical, **switch) == 1.0
        assert self.input_after("3h", schedule, physical, levels=[0, 1]) == 0.0

    def test_the_lower_one_of_two_levels(self, physical):
        assert self.input_after("15min", 0.25, physical, levels=[1, 0.5, 0]) == 0.0


OWN = {"half": 0.5, "own": "pid of=T setpoint=21 kp=1"}


class TestCommandLine:
    def found(self, ran, *arguments):
        return json.loads(ran(*arguments, "--steps", "48", "--json"))

    def files(self, kind, tmp_path):
        """The task, and the same with a form for agents."""
        for name, form in (("plain", {}), ("formed", FORMS["both"])):
            path = tmp_path / f"{name}.toml"
            Task.of(formed(TASKS[kind], **form) | {"controllers": OWN}).write(path)
            yield path

    @pytest.mark.parametrize("kind", ["levels", "delta"])
    def test_all_who_are_no_agents_play_as_without_its_form(self, kind, tmp_path, ran):
        pid = "--controller", "own"
        players = *pid, "--controller", "half", "--action", "0.4", "--episodes", "1"
        search = "pid of=T setpoint=20..22 kp=1", "--rounds", "1", "--candidates", "8"
        results = []
        for path in self.files(kind, tmp_path):
            table = tmp_path / f"{path.stem}.csv"
            one = self.found(ran, "simulate", path, *pid)["episodes"]
            two = self.found(ran, "simulate", path, *pid, "--output", table, "--variables", "u")
            three = self.found(ran, "tune", path, *search, "--episodes", "1")
            _, *scores = self.found(ran, "evaluate", path, *players)["scores"]
            four = [(score["name"], score["rewards"]) for score in scores]
            results.append((one, two["runs"], three["rewards_of_rounds"], table.read_text(), four))
        assert results[0] == results[1]

    def test_a_class_whose_task_stays_as_it_is_tells_the_cure(self, refused, ran):
        for player in (("--controller", "pid of=T setpoint=21 kp=1"), ("--action", "0.5")):
            told = refused("simulate", "test_declared_physical:Rescaled", *player)
            assert "'rescale'" in told
            assert "Task.physical()" in told
        ran("simulate", "test_declared_physical:Rescaled", "--steps", "3")


class Rescaled(TaskEnv):
    """A class that takes no task."""

    def __init__(self, task):
        super().__init__(formed(HOUSE, rescale=True))
