"""Every mistake of a user: the class of the error, its text, and that nothing stays behind."""

import copy
import math
import pickle
import sys

import gymnasium
import mistakes
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import PlainEnv, probe_config, probe_fmu

import fmugym
from fmugym import (
    FMU,
    Choice,
    Component,
    ConfigError,
    Connection,
    FMI1CSEnv,
    FMI2CSEnv,
    FMI3CSEnv,
    FMULoadError,
    FMUVectorEnv,
    SimulationError,
    Uniform,
    bundled_fmu,
)
from fmugym.control import PID
from fmugym.environment.config import EnvConfig
from fmugym.environment.episode import READABLE
from fmugym.environment.snapshots import plain_attributes
from fmugym.errors import ArgumentError
from fmugym.fmi import ArchiveLimits


@pytest.mark.parametrize("group", mistakes.GROUPS)
def test_each_message_tells_what_is_wrong_and_what_was_meant(group, tmp_path, monkeypatch):
    mistakes.make_folder(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    made = mistakes.GROUPS[group]()
    flaws = [line for mistake in made for line in mistakes.flaws_of(mistake)]
    for module in ("drive", "broken"):
        sys.modules.pop(module, None)
    assert made
    assert not flaws, "\n".join(flaws)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"model_input_names": "aa"}, "unknown variable of Probe 'aa'"),
        ({"render_mode": "human"}, "'render_mode' .*constructor"),
        ({"seed": 3}, "'seed' .*reset"),
    ],
)
def test_config(probe, temp_root, same_working_directory, changes, match):
    """A refused one leaves nothing; test_config.py has what is refused."""
    with pytest.raises(ConfigError, match=match):
        PlainEnv(probe(2), probe_config(**changes))
    assert list(temp_root.iterdir()) == []


def test_unknown_render_mode(probe, temp_root):
    with pytest.raises(ConfigError, match="'rgb_aray'; did you mean 'rgb_array'"):
        fmugym.envs.CartPoleEnv(render_mode="rgb_aray")
    with pytest.raises(ConfigError, match="render mode 3; known are: none"):
        PlainEnv(probe(2), probe_config(), render_mode=3)
    assert list(temp_root.iterdir()) == []


@pytest.mark.parametrize("mode", ["human", "rgb_array", "rgb_array_list"])
def test_a_render_mode_that_the_class_does_not_have(make_env, mode):
    """As in Gymnasium a warning; libraries ask for pictures of any environment."""
    with pytest.warns(UserWarning, match=f"PlainEnv has no render_mode '{mode}'"):
        env = make_env(render_mode=mode)
    assert env.render_mode is None
    env.reset()
    env.step(0.0)


def test_make_asks_for_pictures_of_a_class_without_render_modes(probe):
    """What Stable-Baselines3's make_vec_env does first; on a TypeError it goes without."""

    class Modest(PlainEnv):
        def __init__(self, render_mode=None):
            super().__init__(probe(2), probe_config(), render_mode=render_mode)

    fmugym.register("tests/Modest-v0", Modest)
    with pytest.warns(UserWarning, match="rgb_array"):
        env = gymnasium.make("tests/Modest-v0", render_mode="rgb_array")
    env.reset()
    env.close()
    del gymnasium.registry["tests/Modest-v0"]


def test_unknown_arguments_are_type_errors_of_the_family():
    with pytest.raises(TypeError, match="'graviti'") as caught:
        gymnasium.make("fmugym/Pendulum-v0", graviti=1.0)
    assert isinstance(caught.value, fmugym.ConfigError)
    assert isinstance(pickle.loads(pickle.dumps(caught.value)), TypeError)


@pytest.mark.parametrize(
    ("make", "given", "nearest"),
    [
        (lambda: Component("a.fmu", isolated=True), "isolated", "isolate"),
        (lambda: Connection("a.y", "b.u", gaim=2), "gaim", "gain"),
        (lambda: FMU("a.fmu", sise={}), "sise", "sizes"),
        (lambda: ArchiveLimits(max_entry=3), "max_entry", "max_entries"),
        (lambda: Choice([1, 2], probability=[1, 0]), "probability", "probabilities"),
        (lambda: PID("y", 1.0, offsett=2), "offsett", "offset"),
    ],
)
def test_misspelt_arguments_of_constructors(make, given, nearest):
    with pytest.raises(ArgumentError, match=f"'{given}'.*'{nearest}'"):
        make()


def test_arguments_of_constructors_survive_copies():
    connection = Connection("a.y", "b.u", gain=2)
    for copied in (pickle.loads(pickle.dumps(connection)), copy.deepcopy(connection)):
        assert copied == connection


NUMBERS = [
    (lambda true: EnvConfig.from_dict(probe_config(time_step=true)), "time_step"),
    (lambda true: EnvConfig.from_dict(probe_config(start_time=true)), "start_time"),
    (lambda true: Connection("a.y", "b.u", gain=true), "gain"),
    (lambda true: Component("a.fmu", steps=true), "steps"),
    (lambda true: Uniform(true, 2), "low"),
    (lambda true: PID("y", 1.0, kp=true), "kp"),
    (lambda true: bundled_fmu("CartPole", true), "version"),
]


@in_turn({"make,name": NUMBERS, "true": [True, np.True_, np.array(True)]})
def test_true_is_no_number(make, name, true):
    with pytest.raises(ConfigError, match=f"{name}.*True"):
        make(true)


def test_true_is_a_number_where_a_variable_may_be_a_boolean():
    flags = {"on": True, "off": Choice([True])}
    config = EnvConfig.from_dict(
        probe_config(episode_variables=flags, bounds={"mix": (False, True)})
    )
    assert config.bounds["mix"] == (0.0, 1.0)
    assert config.episode_variables["on"] == 1.0
    assert config.episode_variables["off"].sample(np.random.default_rng(0)) == 1.0


def test_names_in_bounds_are_listed_in_the_order_of_the_config(probe):
    """Texts hash anew in each process, so the order of a set would change."""
    names = ["steps", "mix", "sum", "mode"]
    config = probe_config(model_output_names=names, bounds={"zzz": (0, 1)})
    with pytest.raises(ConfigError, match=r"'zzz'.*'a', 'steps', 'mix', 'sum', 'mode'"):
        PlainEnv(probe(2), config)


@pytest.mark.parametrize("seed", [1.0, True, [1], np.ones(2), {}])
def test_seeds_that_are_none(make_env, seed):
    env, twin = make_env(), make_env()
    env.reset(seed=5)
    twin.reset(seed=5)
    env.step(0.5)
    with pytest.raises(ConfigError, match="seed must be an integer of at least 0"):
        env.reset(seed=seed)
    assert env.step_count == 1  # the episode goes on, and so does the generator
    env.step(0.5)
    assert env.np_random.random() == twin.np_random.random()


@pytest.mark.parametrize("seed", [0, 2**40, np.uint8(7), np.array(7)])
def test_seeds_of_any_type_of_integers(make_env, seed):
    env = make_env()
    env.reset(seed=seed)
    assert env.np_random_seed == int(seed)
    assert env.np_random.random() == np.random.default_rng(int(seed)).random()


def test_a_refused_option_leaves_the_generator_alone(make_env):
    env, twin = make_env(), make_env()
    env.reset(seed=5)
    twin.reset(seed=5)
    with pytest.raises(ConfigError):
        env.reset(seed=6, options={"parameters": {}})
    assert env.np_random_seed == 5
    assert env.np_random.random() == twin.np_random.random()


@pytest.mark.parametrize(
    ("base", "version", "match"),
    [
        (
            FMI1CSEnv,
            2,
            r"made for FMI 1\.0, but Probe\.fmu is an FMU of FMI 2\.0; derive from FMI2",
        ),
        (FMI2CSEnv, 3, r"made for FMI 2\.0, but .* FMI 3\.0; derive from FMI3CSEnv instead"),
        (FMI3CSEnv, 1, r"made for FMI 3\.0, but .* FMI 1\.0; derive from FMI1CSEnv instead"),
    ],
)
def test_class_of_another_fmi_version(probe, temp_root, base, version, match):
    cls = type("Mine", (base,), {"_is_done": lambda self: False})
    with pytest.raises(ConfigError, match=f"Mine is {match}"):
        cls(probe(version), probe_config())
    assert list(temp_root.iterdir()) == []


def test_a_library_of_the_other_interface(probe, tmp_path, temp_root, same_working_directory):
    path = probe_fmu(tmp_path, 2, {"CoSimulation": "ModelExchange"})
    with pytest.raises(FMULoadError, match=r"Probe\.fmu cannot be loaded: .* fmi2"):
        PlainEnv(path, probe_config())
    assert list(temp_root.iterdir()) == []


@pytest.mark.parametrize("path", [None, 3, ["a.fmu"]])
def test_no_path(path):
    with pytest.raises((ConfigError, TypeError)):
        PlainEnv(path, probe_config())


def test_a_class_that_does_not_call_its_base():
    class Forgetful(FMI2CSEnv):
        def __init__(self):
            pass

        def _is_done(self):
            return False

    for use in (lambda: Forgetful().reset(), lambda: FMUVectorEnv(Forgetful, num_envs=2)):
        with pytest.raises(ConfigError, match=r"Forgetful.*super\(\).__init__"):
            use()


def test_misspelt_hooks_are_warned_of_once(probe, caplog):
    class Misspelt(PlainEnv):
        def _get_observations(self):
            return self.state

        def is_truncated(self):
            return True

        def _is_done_early(self):
            """No hook, nor is a method with other arguments."""

        def _updates(self, number):
            """No hook."""

    for _ in range(2):
        Misspelt(probe(2), probe_config()).close()
    named = [[text for text in r.args if "_" in str(text)] for r in caplog.records]
    assert named == [["_get_observations", "_get_observation"], ["is_truncated", "_is_truncated"]]


def test_hooks_that_are_there_are_not_misspelt(probe, caplog):
    """A helper beside the hook may have a similar name."""

    class Helped(PlainEnv):
        def _get_observation(self):
            return self._get_observation_2()

        def _get_observation_2(self):
            return super()._get_observation()

    Helped(probe(2), probe_config()).close()
    assert not caplog.records


@pytest.mark.parametrize("many", [False, True])
def test_an_unknown_parameter_in_a_hook(probe, many):
    class Asking(PlainEnv):
        def _is_done(self):
            return self.state[0] > self.parameters["gian"]

    def make():
        return Asking(probe(2), probe_config(model_parameters={"gain": 1.0}))

    def play():
        env = FMUVectorEnv(make, num_envs=2) if many else make()
        env.reset(seed=0)
        env.step(env.action_space.sample())

    with pytest.raises(ConfigError, match="parameter 'gian'; did you mean 'gain'") as caught:
        play()
    assert isinstance(caught.value, KeyError)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_a_class_without_is_done(probe):
    class Unfinished(fmugym.FMUEnv):
        pass

    with pytest.raises(ConfigError, match=r"'terminated', .*, or override _is_done"):
        Unfinished(probe(2), probe_config())


class TestActions:
    @pytest.mark.parametrize(
        ("names", "action", "match"),
        [
            ("a", [math.inf], "makes a = inf; every input must be finite"),
            (["a", "b"], [0.0, -math.inf], r"makes a = 0\.0, b = -inf; every input must be finite"),
            (["a", "on"], [0.0, math.nan], r"action \[0\.0, nan\] .* finite"),
            (["b", "a"], [0.0], r"makes 1 values, expected 2, one for each input \(b, a\)"),
            (["b", "a"], 0.0, "makes 1 values, expected 2"),
            ("a", [], "makes 0 values, expected 1"),
            ("a", "0.5", "action '0.5' does not make numbers"),
            ("a", None, "returned None, expected a number"),
            ("a", {"a": 1.0}, r"action \{'a': 1\.0\}"),
            ("a", 1j, "does not make numbers"),
            ("a", 10**400, "number"),
            ("n", 11, r"action 11 is not in Discrete\(11\)"),
            ("n", -1, r"action -1 is not in Discrete\(11\)"),
            ("n", 1.0, r"action 1\.0 is not in Discrete"),
            ("n", np.array([1]), r"action .* is not in Discrete"),
            ("mode", "turbo", "action 'turbo' is not in Discrete"),
            ("mode", None, "action None is not in Discrete"),
            (["n", "a"], [3e9, 0.0], "'n' is of type Integer: expected an integer from"),
            (["mode", "a"], [9.0, 0.0], "'mode': expected one of 1"),
        ],
    )
    def test_that_do_not_fit(self, make_env, names, action, match):
        env = make_env(model_input_names=names)
        env.reset()
        before, inputs = env.action, env.inputs
        with pytest.raises(ConfigError, match=match):
            env.step(action)
        assert env.action is before
        assert (env.step_count, env.time, env.inputs) == (0, 0.0, inputs)
        env.step(env.action_space.sample())  # the episode goes on with a better action
        assert env.step_count == 1


class TestOrder:
    def test_step_after_the_end(self, make_env):
        env = make_env(max_episode_steps=2)
        env.reset()
        env.step(0.0)
        assert env.step(0.0)[3]
        for _ in range(2):
            with pytest.raises(SimulationError, match="after the end of the episode; call reset"):
                env.step(0.0)
        env.reset()
        env.step(0.0)

    def test_after_close(self, make_env):
        env = make_env()
        env.reset()
        env.close()
        for method, call in [
            ("step", lambda: env.step(0.0)),
            ("reset", env.reset),
            ("read_variables", lambda: env.read_variables("sum")),
        ]:
            with pytest.raises(SimulationError, match=f"{method} was called on a closed PlainEnv"):
                call()

    def test_reading_variables_before_reset(self, make_env):
        with pytest.raises(SimulationError, match="read_variables was called before the first"):
            make_env().read_variables("sum")

    def test_reading_what_is_not_there(self, make_env):
        env = make_env()
        env.reset()
        with pytest.raises(ConfigError, match="'sume'; did you mean 'sum'"):
            env.read_variables("sume")
        with pytest.raises(ConfigError, match="'label' cannot be read in episodes"):  # a String
            env.read_variables("label")

    def test_render_before_reset(self):
        env = fmugym.envs.CartPoleEnv(render_mode="rgb_array")
        with pytest.raises(SimulationError, match="render was called before the first reset"):
            env.render()
        env.close()

    def test_render_without_a_mode(self, make_env):
        env = make_env()
        env.reset()
        with pytest.warns(UserWarning, match="no render_mode was given at construction"):
            assert env.render() is None

    def test_render_modes_without_a_scene(self, make_env):
        class Drawn(PlainEnv):
            metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (Gymnasium's own form)

        env = make_env(cls=Drawn, render_mode="rgb_array")
        env.reset()
        with pytest.raises(SimulationError, match="Drawn has render modes, but no _get_scene"):
            env.render()


class TestResetOptions:
    @pytest.mark.parametrize(
        ("options", "match"),
        [
            ({"model_parameters": [1]}, "option 'model_parameters' must be a dict"),
            (["gain"], "option"),
            ({"model_parameters": {"gain": math.nan}}, "'gain' must be finite"),
            ({"model_parameters": {"leaky": fmugym.Uniform(0, 1)}}, "'leaky' is a Boolean, got 0"),
        ],
    )
    def test_that_do_not_fit(self, make_env, options, match):
        env = make_env()
        env.reset()
        with pytest.raises(ConfigError, match=match):
            env.reset(options=options)
        env.reset()
        env.step(0.0)

    def test_an_fmu_that_cannot_be_initialized(self, make_env):
        env = make_env()
        env.reset()
        with pytest.raises(SimulationError, match="initialization returned Error; the FMU said"):
            env.reset(options={"model_parameters": {"init_status": 3}})
        with pytest.raises(SimulationError, match="call reset"):
            env.step(0.0)
        env.reset()
        env.step(0.0)


def one_step(env):
    env.reset(seed=1)
    env.step(0.0)


class TestHooks:
    def test_unknown_names_in_hooks(self, make_env):
        class Misspelt(PlainEnv):
            def _update(self):
                self.variables["integrl"] += self.out["sum"]

        env = make_env(cls=Misspelt, episode_variables={"integral": 0.0})
        env.reset()
        with pytest.raises(ConfigError, match="'integrl'; did you mean 'integral'"):
            env.step(0.0)
        with pytest.raises(ConfigError, match="unknown output 'summ'; did you mean 'sum'"):
            env.out["summ"]

    @pytest.mark.parametrize("name", READABLE)
    def test_attributes_in_the_place_of_what_they_read(self, make_env, name):
        def early(self, *args, **keywords):
            setattr(self, name, 1.0)
            PlainEnv.__init__(self, *args, **keywords)

        for contents in ({name: 1.0}, {"__init__": early}):
            with pytest.raises(ConfigError, match=f"'{name}' .*hooks read.* another name"):
                make_env(cls=type("Own", (PlainEnv,), contents))

    def test_a_goal_reward_that_is_not_there(self, make_env):
        with pytest.raises(AttributeError, match="PlainEnv is no goal task"):
            make_env().compute_reward(np.zeros(1), np.zeros(1), {})


class TestBundled:
    @pytest.mark.parametrize(
        ("name", "options"),
        [
            ("CartPole", {"low": 1.0}),
            ("CartPole", {"high": None}),
            ("Pendulum", {"x_init": "x"}),
            ("Pendulum", {"x_init": -1.0}),
            ("Pendulum", {"y_int": 1.0}),
        ],
    )
    def test_reset_options(self, name, options):
        env = gymnasium.make(f"fmugym/{name}-v0", disable_env_checker=True)
        with pytest.raises(ConfigError):
            env.reset(options=options)
        env.reset()
        env.close()


def test_a_step_smaller_than_the_internal_one_is_warned_of(tmp_path, caplog):
    flag = 'canHandleVariableCommunicationStepSize="true"'
    path = probe_fmu(tmp_path, 3, {flag: flag + ' fixedInternalStepSize="0.2"'})
    PlainEnv(path, probe_config(time_step=0.2)).close()
    assert caplog.text == ""
    PlainEnv(path, probe_config(time_step=0.2, substeps=2)).close()
    assert "step of 0.1 s is smaller than the internal step of 0.2 s of Probe.fmu" in caplog.text


def test_errors_survive_pickling():
    for error in (ConfigError("a"), FMULoadError("b"), SimulationError("c")):
        copy = pickle.loads(pickle.dumps(error))
        assert (type(copy), str(copy)) == (type(error), str(error))
        assert isinstance(copy, fmugym.FMUGymError)


def test_lists_that_contain_themselves(make_env):
    endless = [1.0]
    endless.append(endless)
    with pytest.raises(ConfigError, match="'target' must be an array of numbers"):
        make_env(episode_variables={"target": (0.0, endless)})
    assert plain_attributes({"own": [1.0], "endless": endless}, ()) == {"own": [1.0]}
