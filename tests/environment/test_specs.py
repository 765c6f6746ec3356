"""Specs of registered environments: as text, pickled, and in another program."""

import copy
import json
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from process_tools import run_python

import fmugym
from fmugym import Choice, ConfigError, LogUniform, Normal, Uniform

DISTRIBUTIONS = {
    "q_0": Uniform(0.5, 1),
    "m": LogUniform(0.05, 0.07),
    "b": Normal(4e-4, 1e-5, low=0),
    "solver": Choice(["rk4", "semi_implicit_euler"], [0.25, 0.75]),
}


class Swing(fmugym.FMUEnv):
    """A pendulum; its parameters are those of the constructor."""

    def __init__(self, parameters=None, time_step=0.02, render_mode=None):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": parameters or {"q_0": 1.0},
            "time_step": time_step,
            "bounds": {"tau": (-1, 1)},
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config, render_mode=render_mode)

    def _is_done(self):
        return self.out["q"] > 2.0


@pytest.fixture
def swing_id():
    env_id = "tests/SpecSwing-v0"
    fmugym.register(env_id, Swing, max_episode_steps=50)
    yield env_id
    del gymnasium.registry[env_id]


ROUND_TRIPS = {
    "json": lambda spec: EnvSpec.from_json(spec.to_json()),
    "pickle": lambda spec: pickle.loads(pickle.dumps(spec)),
}
round_trips = pytest.mark.parametrize("through", ROUND_TRIPS.values(), ids=ROUND_TRIPS)


@round_trips
def test_the_spec_of_an_environment_makes_the_same_one(swing_id, through):
    env = gymnasium.make(swing_id, time_step=0.01, parameters=DISTRIBUTIONS)
    twin = gymnasium.make(through(env.spec))
    assert twin.unwrapped.config == env.unwrapped.config
    for seed in (3, None, None):
        (first, info), (second, same) = env.reset(seed=seed), twin.reset(seed=seed)
        np.testing.assert_array_equal(first, second)
        assert info == same
        assert set(info["drawn"]) == set(DISTRIBUTIONS)
    env.close()
    twin.close()


@round_trips
def test_the_spec_of_a_vector_environment_makes_the_same_one(swing_id, through):
    envs = gymnasium.make_vec(swing_id, num_envs=3, parameters={"q_0": Uniform(0.5, 1)})
    twins = gymnasium.make_vec(through(envs.spec), num_envs=3)
    assert repr(twins).startswith("<FMUVectorEnv of 3: <Swing of ")
    np.testing.assert_array_equal(envs.reset(seed=4)[0], twins.reset(seed=4)[0])
    envs.close()
    twins.close()


@pytest.mark.parametrize(
    "env_id",
    [
        env_id
        for env_id in gymnasium.registry
        if env_id.startswith("fmugym/") and env_id != "fmugym/FMU-v0"  # which needs a task
    ],
)
@round_trips
def test_registered_environments(env_id, through):
    spec = through(gymnasium.spec(env_id))
    assert isinstance(spec.vector_entry_point, str)
    gymnasium.make(spec).close()
    gymnasium.make_vec(spec, num_envs=2).close()


LOAD = """
import sys, gymnasium
from gymnasium.envs.registration import EnvSpec
env = gymnasium.make(EnvSpec.from_json(sys.stdin.read()))
env.reset(seed=1)
print(env.unwrapped.state[0] > 0.0)
"""


def load_elsewhere(text):
    """Make an environment of a spec in a program that has not imported fmugym."""
    return run_python("-c", LOAD, input=text)


def test_a_spec_in_another_program(swing_id):
    env = gymnasium.make(swing_id, parameters=DISTRIBUTIONS)
    done = load_elsewhere(env.spec.to_json())
    assert (done.stdout, done.returncode) == ("True\n", 0), done.stderr
    env.close()


SCRIPT = """
import multiprocessing, sys
import gymnasium
from gymnasium.envs.registration import EnvSpec
import fmugym

class Swing(fmugym.FMUEnv):
    def __init__(self):
        config = {"model_input_names": "tau", "model_output_names": "q", "time_step": 0.02,
                  "model_parameters": {"q_0": 1.0}}
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self):
        return False

fmugym.register("script/Swing-v0", Swing)

def look(text):
    env = gymnasium.make(EnvSpec.from_json(text))
    env.reset()
    return env.unwrapped.state[0]

if __name__ == "__main__":
    text = gymnasium.make("script/Swing-v0").spec.to_json()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(look, (text,)) == look(text) == 1.0
    sys.stdout.write(text)
"""


def test_a_class_of_a_script(tmp_path):
    """Its own processes find it; another program does not, and is told the name of the class."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    done = run_python(script)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["entry_point"] == "__main__:Swing"
    elsewhere = load_elsewhere(done.stdout)
    assert elsewhere.returncode != 0
    assert "'Swing'" in elsewhere.stderr.splitlines()[-1]


def test_a_class_within_a_function_works_here_only():
    class Local(Swing):
        pass

    fmugym.register("tests/Local-v0", Local)
    try:
        env = gymnasium.make("tests/Local-v0")
        with pytest.raises(ValueError, match="Callable found"):
            env.spec.to_json()
        env.close()
        gymnasium.make_vec("tests/Local-v0", num_envs=2).close()
    finally:
        del gymnasium.registry["tests/Local-v0"]


def test_what_json_cannot_hold_is_refused(swing_id):
    stats = pytest.importorskip("scipy.stats")
    env = gymnasium.make(swing_id, parameters={"q_0": stats.uniform(0.5, 1.0)})
    with pytest.raises(TypeError, match="not JSON serializable"):
        env.spec.to_json()
    env.close()


@pytest.mark.parametrize(
    ("value", "names"),
    [
        ({"low": 0.0, "high": 1.0}, ["q_0", "'distribution'"]),
        ({"distribution": "unifrom", "low": 0, "high": 1}, ["unifrom", "uniform"]),
        ({"distribution": "uniform", "lo": 0, "high": 1}, ["'lo'", "'low'"]),
        ({"distribution": "uniform", "low": 0}, ["q_0", "Uniform"]),
        ({"distribution": ["uniform"]}, ["['uniform']"]),
    ],
)
def test_dicts_that_are_no_distributions(value, names):
    with pytest.raises(ConfigError) as caught:
        Swing({"q_0": value})
    assert all(name in str(caught.value) for name in names)


@pytest.mark.parametrize(
    ("env_id", "env", "name"),
    [
        ("tests/Odd", 3, "3"),
        ("tests/Odd", "test_specs.Swing", "'test_specs.Swing'"),
        ("tests/ Odd v0", Swing, "tests/ Odd v0"),
        (3, Swing, "3"),
    ],
)
def test_what_cannot_be_registered(env_id, env, name):
    with pytest.raises(ConfigError, match=name):
        fmugym.register(env_id, env)


LENGTH = 30
TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": "20ms",
    "episode_length": "600ms",
    "variables": {"tau": {"min": -0.01, "max": 0.01}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
    "scenarios": {"short": {"start": "1d", "length": "100ms"}},
    "clock": "0s",
    "reward": "-abs(q)",
}


class Config(fmugym.FMUEnv):
    """A class with more keys in its config."""

    def __init__(self, **changes):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "time_step": 0.02,
            "bounds": {"tau": (-1, 1)},
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config | changes)

    def _is_done(self):
        return False


class TestEpisodeLength:
    """The spec tells after how many steps an episode is truncated."""

    def make(self, way, **options):
        if way == "load":
            return fmugym.load(TASK, **options)
        return gymnasium.make("fmugym/FMU-v0", config=TASK, **options)

    @pytest.fixture(params=["load", "make"])
    def env(self, request, opened):
        return opened(self.make(request.param))

    def test_is_in_the_spec(self, env):
        assert env.spec.max_episode_steps == LENGTH
        assert env.unwrapped.spec.max_episode_steps == LENGTH

    def test_is_known_to_wrappers(self, env):
        wrapped = gymnasium.wrappers.TimeAwareObservation(env, normalize_time=True)
        seen = [wrapped.reset(seed=0)[0][-1]]
        truncated = False
        while not truncated:
            observation, _, _, truncated, _ = wrapped.step(env.action_space.sample())
            seen.append(observation[-1])
        np.testing.assert_allclose(seen, np.arange(LENGTH + 1) / LENGTH, rtol=1e-6)

    def test_is_that_of_a_scenario(self, opened):
        env = opened(fmugym.load(TASK, scenario="short"))
        assert env.spec.max_episode_steps == 5

    @pytest.mark.parametrize("way", ["load", "make"])
    @round_trips
    def test_the_spec_makes_the_same_again(self, way, through, opened):
        env = opened(self.make(way, scenario="short"))
        twin = opened(gymnasium.make(through(env.spec)))
        assert twin.spec.max_episode_steps == 5
        np.testing.assert_array_equal(env.reset(seed=4)[0], twin.reset(seed=4)[0])
        assert twin.unwrapped.config == env.unwrapped.config

    def test_a_copy_has_it(self, env, opened):
        assert opened(copy.deepcopy(env.unwrapped)).spec.max_episode_steps == LENGTH
        assert opened(pickle.loads(pickle.dumps(env.unwrapped))).spec.max_episode_steps == LENGTH

    def test_of_bundled_environments(self, opened):
        assert opened(gymnasium.make("fmugym/House-v0")).spec.max_episode_steps == 672
        assert opened(gymnasium.make_vec("fmugym/House-v0", 2)).spec.max_episode_steps == 672
        assert opened(gymnasium.make("fmugym/CartPole-v0")).spec.max_episode_steps == 500

    @pytest.mark.parametrize(
        ("limits", "expected"),
        [
            ({"max_episode_steps": 7}, 7),
            ({"stop_time": 0.2}, 10),
            ({"max_episode_steps": 7, "stop_time": 0.1}, 5),
            ({}, None),
        ],
    )
    def test_of_classes(self, limits, expected, opened):
        fmugym.register("tests/Limited-v0", Config, kwargs=limits)
        try:
            env = opened(gymnasium.make("tests/Limited-v0"))
            envs = opened(gymnasium.make_vec("tests/Limited-v0", 2))
        finally:
            del gymnasium.registry["tests/Limited-v0"]
        assert env.spec.max_episode_steps == envs.spec.max_episode_steps == expected


class TestShorterLimits:
    """They win."""

    def test_of_one(self, opened):
        env = opened(gymnasium.make("fmugym/FMU-v0", config=TASK, max_episode_steps=4))
        assert env.spec.max_episode_steps == 4
        env.reset(seed=0)
        ends = [env.step(env.action_space.sample())[3] for _ in range(4)]
        assert ends == [False, False, False, True]

    @pytest.mark.parametrize("given", [4, LENGTH, None])
    def test_of_many(self, given, opened):
        options = {} if given is None else {"max_episode_steps": given}
        envs = opened(gymnasium.make_vec("fmugym/FMU-v0", 3, config=TASK, **options))
        expected = given or LENGTH
        assert envs.spec.max_episode_steps == expected
        envs.reset(seed=0)
        ends = [envs.step(envs.action_space.sample())[3].tolist() for _ in range(expected)]
        assert ends == [[False] * 3] * (expected - 1) + [[True] * 3]

    def test_copies_keep_them(self, opened):
        envs = gymnasium.make_vec("fmugym/FMU-v0", 3, config=TASK, max_episode_steps=4)
        twins = opened(pickle.loads(pickle.dumps(opened(envs))))
        assert twins.spec.max_episode_steps == 4


TOO_LONG = {
    "make": lambda: gymnasium.make("fmugym/FMU-v0", config=TASK, max_episode_steps=31),
    "make_vec": lambda: gymnasium.make_vec("fmugym/FMU-v0", 2, config=TASK, max_episode_steps=31),
    "many": lambda: fmugym.FMUVectorEnv(lambda: fmugym.load(TASK), 2, max_episode_steps=31),
    "sync": lambda: gymnasium.make_vec(
        "fmugym/FMU-v0", 2, "sync", config=TASK, max_episode_steps=31
    ),
}


class TestLongerLimits:
    """They are refused: no episode would be as long."""

    @pytest.mark.parametrize("make", TOO_LONG.values(), ids=TOO_LONG)
    def test_name_the_length(self, make):
        with pytest.raises(ConfigError, match="episode_length") as caught:
            make()
        for fact in ("31", "30", "0.6 s"):
            assert fact in str(caught.value)

    def test_of_a_bundled_task(self):
        with pytest.raises(ConfigError, match=r"episode_length.*672"):
            gymnasium.make("fmugym/House-v0", max_episode_steps=673)
        with pytest.raises(ConfigError, match=r"episode_length.*672"):
            gymnasium.make_vec("fmugym/House-v0", 2, max_episode_steps=673)

    @pytest.mark.parametrize("make", [gymnasium.make, lambda name: gymnasium.make_vec(name, 2)])
    def test_of_an_id(self, make):
        options = {"config": TASK}
        fmugym.register("tests/Long-v0", "fmugym:load", max_episode_steps=31, kwargs=options)
        try:
            with pytest.raises(ConfigError, match="episode_length"):
                make("tests/Long-v0")
        finally:
            del gymnasium.registry["tests/Long-v0"]
