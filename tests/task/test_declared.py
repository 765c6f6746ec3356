"""Tasks that are declared in files: equal to classes, compiled, and refused with good errors."""

import pickle
import re
import textwrap
import tomllib
from functools import partial
from pathlib import Path

import gymnasium
import model_tools
import numpy as np
import pytest
import zoo_tools
from gymnasium.envs.registration import EnvSpec
from vector_tools import require_same_alone

import fmugym
from fmugym import ConfigError, Task, TaskEnv, Uniform
from fmugym.errors import TaskError
from fmugym.expressions.functions import FUNCTIONS
from fmugym.expressions.language import CONSTANTS
from fmugym.task.declarations import BUILT_IN

EXAMPLES = Path(__file__).parents[2] / "examples"
DOCS = Path(__file__).parents[2] / "docs"

TWINS = {
    "cart_pole": ("fmugym/CartPole-v0", 0.0),
    "pendulum": ("fmugym/Pendulum-v0", 1e-9),
}
"""By file: the id of the equal class, and a bound of the difference of rewards.

The class rounds as Gymnasium does, by the C library's ``powf``, when it steps alone. A declared
task gives one environment the rewards of many, which round correctly.
"""

each_file = pytest.mark.parametrize("name", TWINS)


def same(first, second):
    """Compare two results of reset or step; infos may be dicts, with arrays of arrays."""
    np.testing.assert_equal(plain(first), plain(second))


def plain(value):
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, tuple):
        return tuple(map(plain, value))
    return list(value) if isinstance(value, np.ndarray) and value.dtype == object else value


class TestExamples:
    @each_file
    def test_one_environment_equals_the_class(self, name):
        twin_id, tolerance = TWINS[name]
        env = gymnasium.make("fmugym/FMU-v0", config=str(EXAMPLES / f"{name}.toml"))
        twin = gymnasium.make(twin_id)
        assert env.action_space == twin.action_space
        assert env.observation_space == twin.observation_space
        env.action_space.seed(0)
        for seed in range(4):
            same(env.reset(seed=seed), twin.reset(seed=seed))
            ended = False
            while not ended:
                action = env.action_space.sample()
                (seen, reward, *ends), (expected, other, *others) = (
                    env.step(action),
                    twin.step(action),
                )
                same(seen, expected)
                assert ends[:2] == others[:2]
                assert abs(reward - other) <= tolerance
                ended = any(ends[:2])
        env.close()
        twin.close()

    @each_file
    @pytest.mark.parametrize("mode", ["next_step", "same_step"])
    def test_a_vector_environment_equals_that_of_the_class(self, name, mode):
        config = str(EXAMPLES / f"{name}.toml")
        options = {"num_envs": 5, "autoreset_mode": mode}
        envs = gymnasium.make_vec("fmugym/FMU-v0", config=config, **options)
        assert envs.unwrapped.task.way == "expressions"
        twins = gymnasium.make_vec(TWINS[name][0], **options)
        envs.action_space.seed(0)
        same(envs.reset(seed=7), twins.reset(seed=7))
        for _ in range(230):
            actions = envs.action_space.sample()
            same(envs.step(actions), twins.step(actions))
        envs.close()
        twins.close()

    @each_file
    def test_a_file_survives_writing(self, name, tmp_path):
        task = Task.read(EXAMPLES / f"{name}.toml")
        (tmp_path / "folder").mkdir()
        task.write(tmp_path / "folder" / "copy.toml")
        assert Task.read(tmp_path / "folder" / "copy.toml") == task


TANK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.02,
    "episode_length": "1s",
    "variables": {
        "angle": {"name": "q", "unit": "deg", "min": -200, "max": 200},
        "rate": {"name": "q_dot", "unit": "rpm"},
        "torque": {"name": "tau", "unit": "N.mm", "min": -10, "max": 10},
    },
    "parameters": {"q_0": {"distribution": "uniform", "low": 0.5, "high": 1.0}, "m": 0.06},
    "agent": {"actions": ["torque"], "observations": ["angle", "rate", "error", "total"]},
    "memory": {
        "target": {"start": Uniform(-10, 10), "min": -10, "max": 10},
        "total": {"start": 0, "update": "total + dt * error"},
    },
    "expressions": {"error": "angle - target"},
    "reward": {
        "near": {"expr": "1 / (1 + abs(error))", "weight": 2},
        "calm": "-abs(torque - previous(torque)) if step > 1 else 0",
    },
    "costs": {"heat": {"expr": "torque**2 * dt_h", "limit": 10}, "fast": "abs(rate) > 5"},
    "terminated": "not (-170 < angle < 170)",
}


def changed(**sections):
    """``TANK`` with other sections."""
    return TANK | sections


def test_units_reach_observations_actions_and_rewards(load):
    env = load(TANK)
    observation, info = env.reset(seed=1)
    assert observation[0] == np.float32(env.state[0] * 180 / np.pi)
    np.testing.assert_array_equal(env.action_space.high, np.float32([10]))
    assert info["reward_terms"] == {"near": 0.0, "calm": 0.0}
    assert info["cost"] == 0.0
    observation, reward, _, _, info = env.step(np.float32([5]))
    assert env.inputs == (pytest.approx(0.005),)
    rate = env.state[1] * 60 / (2 * np.pi)
    assert observation[1] == pytest.approx(rate)
    error = env.state[0] * 180 / np.pi - env.variables["target"]
    assert reward == pytest.approx(2 / (1 + abs(error)))
    assert info["reward_terms"]["near"] == pytest.approx(reward)
    assert info["costs"]["heat"] == pytest.approx(25 * 0.02 / 3600)
    assert info["costs"]["fast"] == float(abs(rate) > 5)
    assert info["cost"] == info["costs"]["heat"] + info["costs"]["fast"]
    assert env.cost_limits == {"heat": 10.0}


@pytest.mark.parametrize("hooks", ["expressions", "arrays", "one by one"])
def test_many_environments_equal_single_ones_to_the_last_bit(hooks):
    assert require_same_alone(partial(fmugym.load, TANK), 60, "same_step", way=hooks)


def test_samples_over_the_substeps_of_a_step(load):
    variables = {
        "energy": {"name": "q_dot", "sample": "integral", "unit": "deg"},
        "q": {"sample": "max", "unit": "deg"},
    }
    task = changed(
        substeps=4,
        variables=variables,
        agent={"actions": "tau", "observations": ["energy", "q"]},
        memory={},
        expressions={},
        reward="energy - previous(q)",
        costs={},
        terminated=False,
    )
    env, fine = load(task), load(task | {"time_step": 0.005, "substeps": 1})
    start, _ = env.reset(seed=3)
    fine.reset(seed=3)
    assert start[0] == 0.0
    steps = [fine.step([0.01])[0] for _ in range(4)]
    seen, reward, *_ = env.step([0.01])
    np.testing.assert_allclose(seen[0], sum(step[0] for step in steps), rtol=1e-6)
    assert seen[1] == max(step[1] for step in steps)
    assert reward == pytest.approx(float(seen[0]) - float(start[1]), rel=1e-6)


def test_an_expression_writes_an_input(load):
    task = changed(
        variables={"gain": {"min": 0, "max": 1}},
        inputs={"tau": "-0.001 * gain * q_dot"},
        agent={"actions": "gain", "observations": ["q", "q_dot"]},
        memory={},
        expressions={},
        reward=1,
        costs={},
        terminated=False,
    )
    env = load(task)
    env.reset(seed=0)
    env.step([1.0])
    rate = env.state[1]
    env.step([0.5])
    assert env.inputs == (-0.0005 * rate,)


def test_levels_of_two_actions(load):
    task = {
        "fmu": {"bundled": "DoublePendulum"},
        "variables": {
            "tau1": {"levels": [-1, 0, 1]},
            "other": {"name": "tau2", "levels": [0.5, -0.5]},
        },
        "agent": {"actions": ["tau1", "other"], "observations": ["q1"]},
        "time_step": "20ms",
        "reward": "previous(other) + other",
    }
    env = load(task)
    assert env.action_space == gymnasium.spaces.MultiDiscrete([3, 2])
    env.reset(seed=0)
    assert env.step(np.array([2, 0]))[1] == 1.0  # what came before is the first element
    assert env.inputs == (1.0, 0.5)
    assert env.step(np.array([0, 1]))[1] == 0.0
    assert env.inputs == (-1.0, -0.5)


def write(folder, name, text):
    path = folder / name
    path.write_text(textwrap.dedent(text), encoding="utf-8")
    return path


SMALL = """\
    fmu = { bundled = "Pendulum" }
    time_step = "20ms"
    reward = "-abs(q)"
    [variables]
    tau = { min = -1, max = 1 }
    [agent]
    actions = ["tau"]
    observations = ["q", "q_dot"]
    """


class TestFiles:
    def test_a_file_extends_another_in_another_folder(self, tmp_path, load):
        (tmp_path / "base").mkdir()
        fmu = tmp_path / "base" / "pendulum.fmu"
        fmu.write_bytes(fmugym.bundled_fmu("Pendulum").read_bytes())
        base = SMALL.replace('{ bundled = "Pendulum" }', '"pendulum.fmu"')
        write(tmp_path / "base", "base.toml", base)
        path = write(
            tmp_path,
            "own.toml",
            """\
            extends = "base/base.toml"
            [variables]
            tau = { max = 0.5 }
            [parameters]
            m = { distribution = "uniform", low = 0.05, high = 0.06 }
            """,
        )
        env = load(path)
        assert env.fmu.path == fmu
        np.testing.assert_array_equal(env.action_space.low, [-1])
        np.testing.assert_array_equal(env.action_space.high, [0.5])
        assert env.config.model_parameters == {"m": Uniform(0.05, 0.06)}
        env.task.write(tmp_path / "whole.toml")
        assert Task.read(tmp_path / "whole.toml") == env.task
        assert 'fmu = "base/pendulum.fmu"' in (tmp_path / "whole.toml").read_text()

    def test_libraries_to_load_first_are_found_beside_the_file_that_names_them(self, tmp_path):
        (tmp_path / "base").mkdir()
        config = '\n[foreign]\npreload = ["./a.so", "lib/b.so", "libm.so.6"]\n'
        write(tmp_path / "base", "base.toml", textwrap.dedent(SMALL) + config)
        task = Task.read(write(tmp_path, "own.toml", 'extends = "base/base.toml"\n'))
        found = [str(tmp_path / "base" / name) for name in ("a.so", "lib/b.so")] + ["libm.so.6"]
        assert task.document["foreign"]["preload"] == found
        task.write(tmp_path / "base" / "copy.toml")
        written = tomllib.loads((tmp_path / "base" / "copy.toml").read_text())
        assert written["foreign"]["preload"] == ["./a.so", "lib/b.so", "libm.so.6"]
        assert Task.read(tmp_path / "base" / "copy.toml") == task
        with pytest.raises(fmugym.FMULoadError, match=re.escape(found[0])):
            fmugym.load(task)

    def test_a_mistake_in_the_extended_file_is_found_there(self, tmp_path):
        write(tmp_path, "base.toml", SMALL.replace('"-abs(q)"', '"-abs(qq)"'))
        path = write(tmp_path, "own.toml", 'extends = "base.toml"\n')
        with pytest.raises(TaskError, match=r"^base\.toml, line 3, reward: .*'qq'"):
            fmugym.load(path)

    def test_files_that_extend_each_other_are_refused(self, tmp_path):
        path = write(tmp_path, "a.toml", 'extends = "b.toml"\n')
        write(tmp_path, "b.toml", '\nextends = "a.toml"\n')
        with pytest.raises(TaskError, match=r"b\.toml, line 2, extends: .*circle"):
            fmugym.load(path)

    def test_objects_that_cannot_be_written_are_named(self, tmp_path):
        class Own:
            def sample(self, rng):
                return 1.0

        task = Task.from_dict(changed(parameters={"m": Own()}))
        with pytest.raises(ConfigError, match=r"parameters\.m .*Own"):
            task.write(tmp_path / "a.toml")
        assert list(tmp_path.iterdir()) == []

    def test_distributions_are_written(self, tmp_path):
        task = Task.from_dict(TANK)
        task.write(tmp_path / "a.toml")
        assert Task.read(tmp_path / "a.toml") == task

    def test_an_existing_file_stays(self, tmp_path):
        path = write(tmp_path, "a.toml", SMALL)
        with pytest.raises(FileExistsError):
            Task.read(path).write(path)


MISTAKES = {
    "sample of an action": ("max = 1", 'max = 1, sample = "mean"', "line 5", "read from"),
    "read twice": (
        '"-abs(q)"\n[variables]',
        '"p"\n[variables]\np = { name = "q", sample = "max" }',
        "line 5|variables.q",
        "'q'.*'p'|'p'.*'q'",
    ),
    "tiny step": ('"20ms"', '1e-320\nepisode_length = "1s"', "line 3", "multiple"),
    "class": ("[variables]", "class = 'math:Pie'\n[variables]", "line 4", "class of math 'Pie'"),
    "previous of memory": ('"-abs(q)"', '"previous(time)"', "line 3", "'time'"),
}


@pytest.mark.parametrize(("old", "new", "place", "fact"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_placed_and_explained(old, new, place, fact, tmp_path):
    text = textwrap.dedent(SMALL)
    assert old in text
    path = write(tmp_path, "task.toml", text.replace(old, new, 1))
    with pytest.raises(TaskError, match=rf"{place}.*({fact})"):
        fmugym.load(path).close()


@pytest.mark.parametrize(
    ("old", "new", "line"), [('"-abs(q)"', "-abs(q)", 3), ('"20ms"', "20 ms", 2)]
)
def test_a_text_that_lacks_its_quotes(old, new, line, tmp_path):
    path = write(tmp_path, "task.toml", textwrap.dedent(SMALL).replace(old, new))
    with pytest.raises(ConfigError, match=rf"task\.toml.*line {line}.*quotes"):
        fmugym.load(path)


def test_a_name_with_dots_that_lacks_its_quotes(tmp_path):
    """TOML takes it for tables in tables."""
    variables = (*zoo_tools.VARIABLES, ("mass.rotor.m", "parameter", 'start="0"'))
    fmu = model_tools.model_fmu(tmp_path / "Zoo.fmu", "zoo", 2, "{zoo}", variables)
    text = f'fmu = "{fmu.name}"\ntime_step = 1\nreward = "y"\n'
    text += "[parameters]\nmass.rotor.m = 3\n"
    text += '[variables]\nu = { min = 0, max = 1 }\n[agent]\nactions = "u"\nobservations = "y"\n'
    path = write(tmp_path, "task.toml", text)
    with pytest.raises(TaskError, match=r'line 5.*quotes.*"mass\.rotor\.m"'):
        fmugym.load(path)


def test_an_action_without_limits(tmp_path):
    text = textwrap.dedent(SMALL).replace("tau = { min = -1, max = 1 }", "u = { min = 0 }")
    path = write(tmp_path, "task.toml", text.replace('["tau"]', '["u"]'))
    with pytest.raises(TaskError, match=r"line 5.*'u' needs limits"):
        fmugym.load(path)


@pytest.mark.parametrize(
    ("path", "fact"),
    [("cart_pol.toml", "'cart_pole.toml'"), ("../resources/fmus/2.0/CartPole.fmu", "fmugym new")],
)
def test_a_path_that_is_no_task_file(path, fact):
    with pytest.raises(ConfigError, match=fact):
        fmugym.load(EXAMPLES / path)


class Damped(TaskEnv):
    """A task with a hook of its own."""

    def __init__(self, config, gain=1.0, **arguments):
        self.gain = gain
        super().__init__(config, **arguments)

    def _reward_policy(self):
        return -self.gain * abs(self.state[0])


class TestClasses:
    def test_a_class_replaces_declared_hooks(self, tmp_path, load):
        head = "class = 'test_declared:Damped'\n"
        text = textwrap.dedent(SMALL).replace('reward = "-abs(q)"\n', "")
        path = write(tmp_path, "task.toml", head + text + "[arguments]\ngain = 3.0\n")
        env = load(path)
        env.reset(seed=0)
        assert env.step([0.1])[1] == -3.0 * abs(env.state[0])

    def test_another_class_takes_its_arguments(self, load):
        env = load({"class": "fmugym.envs:CartPoleEnv", "arguments": {"fmi_version": 3.0}})
        assert env.fmu.description.fmi_major_version == 3

    def test_sections_for_another_class_are_refused(self):
        with pytest.raises(TaskError, match=r"reward.*CartPoleEnv"):
            fmugym.load({"class": "fmugym.envs:CartPoleEnv", "reward": "1"})


def test_pickles_make_the_same_environment_without_the_file(tmp_path, load):
    path = write(tmp_path, "task.toml", SMALL)
    env = load(path)
    path.unlink()
    twin = pickle.loads(pickle.dumps(env))
    same(env.reset(seed=2), twin.reset(seed=2))
    same(env.step([0.3]), twin.step([0.3]))
    twin.close()


def test_specs_of_files_and_dicts_are_text():
    for config in (str(EXAMPLES / "cart_pole.toml"), changed(memory={"target": 1.0, "total": 0})):
        spec = gymnasium.make("fmugym/FMU-v0", config=config).spec
        env = gymnasium.make(EnvSpec.from_json(spec.to_json()))
        env.reset(seed=0)
        env.close()


def test_the_tasks_in_the_documentation_run():
    text = (DOCS / "task-file.md").read_text(encoding="utf-8")
    first, *others = re.findall(r"^```toml\n(.*?)^```", text, re.M | re.S)
    base = tomllib.loads(first)
    for other in [{}, *map(tomllib.loads, others)]:
        env = fmugym.load({k: merged(base.get(k), other.get(k)) for k in base | other})
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()
    assert len(others) > 2


def merged(base, own):
    return {**base, **own} if isinstance(base, dict) and isinstance(own, dict) else own or base


def test_the_table_of_the_documentation_is_complete():
    text = (DOCS / "task-file.md").read_text(encoding="utf-8")
    part = text.split("\n## Expressions\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (`.+?`) \|", part, re.M)
    told = re.findall(r"`(?:\{ )?(\w+)(?: = \{?.*?)?`", " ".join(rows))
    names = [*FUNCTIONS, "previous", *BUILT_IN, *CONSTANTS]
    assert sorted(name for name in told if not name.isdigit()) == sorted(names)


def test_the_id_needs_a_task():
    with pytest.raises(ConfigError, match="config"):
        gymnasium.make("fmugym/FMU-v0")


COMMENTED = """
# the swing of a pendulum
fmu = { bundled = "Pendulum" }  # ours
time_step = "20ms"

[variables]  # what is used
tau = { min = -0.01, max = 0.01 }  # N m

[agent]
actions = ["tau"]
observations = [
    "q",  # rad
]

# how good it is
[reward]
upright = "-abs(q)"  # the nearer, the better
"""


class TestComments:
    def written(self, task, folder):
        task.write(folder / "written.toml")
        assert Task.read(folder / "written.toml") == task
        return (folder / "written.toml").read_text()

    def test_are_kept(self, tmp_path):
        (tmp_path / "task.toml").write_text(COMMENTED)
        task = Task.read(tmp_path / "task.toml")
        (tmp_path / "folder").mkdir()
        assert self.written(task, tmp_path / "folder") == COMMENTED

    def test_of_what_stays_are_kept_where_something_changes(self, tmp_path):
        (tmp_path / "task.toml").write_text(COMMENTED)
        task = Task.read(tmp_path / "task.toml")
        variables = {"tau": {"min": -0.01, "max": 0.02}}
        changed = Task(
            task.document | {"variables": variables, "episode_length": "1s", "costs": {"c": "q"}},
            task.sources,
        )
        text = self.written(changed, tmp_path)
        for line in COMMENTED.splitlines():
            if "max" not in line:
                assert line in text
        assert "max = 0.02 }  # N m" in text

    def test_of_a_file_that_extends_another(self, tmp_path):
        (tmp_path / "base.toml").write_text(COMMENTED)
        own = '# mine\nextends = "base.toml"\n[reward]\nupright = "q"  # instead\n'
        (tmp_path / "own.toml").write_text(own)
        text = self.written(Task.read(tmp_path / "own.toml"), tmp_path)
        assert "# mine" in text
        assert "# instead" in text
        assert "extends" not in text


def test_spawned_workers_play_a_task_file(tmp_path):
    """Gymnasium's own vector environment, whose workers are started anew."""
    (tmp_path / "task.toml").write_text(COMMENTED)
    make = partial(gymnasium.make, "fmugym:fmugym/FMU-v0", config=str(tmp_path / "task.toml"))
    theirs = gymnasium.vector.AsyncVectorEnv([make, make], context="spawn")
    ours = gymnasium.make_vec("fmugym/FMU-v0", 2, config=str(tmp_path / "task.toml"))
    np.testing.assert_array_equal(theirs.reset(seed=1)[0], ours.reset(seed=1)[0])
    for _ in range(5):
        actions = ours.action_space.sample()
        for one, other in zip(theirs.step(actions)[:4], ours.step(actions)[:4], strict=True):
            np.testing.assert_array_equal(one, other)
    theirs.close()
    ours.close()
