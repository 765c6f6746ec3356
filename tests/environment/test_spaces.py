"""Spaces from variables, and the way from actions to inputs and from outputs to observations."""

import gymnasium
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import MAJOR_VERSIONS, PlainEnv, probe_config, probe_fmu
from gymnasium import spaces
from ways import in_way

from fmugym import ConfigError, FMUVectorEnv, SimulationError

Box, Discrete, MultiBinary = spaces.Box, spaces.Discrete, spaces.MultiBinary


def box(low, high):
    return Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


class TestActionSpace:
    @in_turn(
        {
            "names,expected": [
                ("a", box([-1], [1])),
                (["a", "b"], box([-1, -1], [1, 1])),
                ("n", Discrete(11)),
                ("mode", Discrete(3)),
                ("on", MultiBinary(1)),
                (["a", "on", "n"], box([-1, 0, -5], [1, 1, 5])),
            ],
            "version": MAJOR_VERSIONS,
        }
    )
    def test_from_types_and_limits(self, make_env, version, names, expected):
        assert make_env(version, model_input_names=names).action_space == expected

    def test_enumerations_beside_others_span_their_values(self, make_env):
        assert make_env(2, model_input_names=["mode", "a"]).action_space == box([1, -1], [5, 1])

    def test_bounds_of_the_config(self, make_env):
        env = make_env(model_input_names="free", bounds={"free": (-2, 7)})
        assert env.action_space == box([-2], [7])
        env = make_env(model_input_names="n_free", bounds={"n_free": (-1.5, 2.5)})
        assert env.action_space == Discrete(4)  # -1, 0, 1, 2

    def test_a_wide_integer_takes_no_memory(self, make_env):
        limits = (-(2**31), 2**31 - 1)
        env = make_env(model_input_names="n_free", bounds={"n_free": limits})
        assert env.action_space.n == 2**32
        env.reset()
        env.step(0)
        assert env.inputs == (-(2.0**31),)

    @pytest.mark.parametrize("name", ["free", "n_free"])
    def test_an_unbounded_input_asks_for_bounds(self, make_env, name):
        with pytest.raises(ConfigError, match=f"input '{name}' has no min and max.*'bounds'"):
            make_env(model_input_names=["a", name])

    @pytest.mark.parametrize(
        ("name", "old", "new", "match"),
        [
            ("n", 'min="-5" max="5"', 'min="5" max="-5"', r"'n' has min = 5\.0 and max = -5\.0"),
            ("n", 'min="-5" max="5"', 'min="0.2" max="0.8"', "'n' has no integer from 0.2 to 0.8"),
            ("a", 'min="-1" max="1"', 'min="NaN" max="1"', "'a' has no min and max in the FMU"),
        ],
    )
    def test_limits_of_the_fmu_that_are_of_no_use(self, make_env, tmp_path, name, old, new, match):
        path = probe_fmu(tmp_path, 2, {old: new})
        with pytest.raises(ConfigError, match=f"{match}.*give (it )?'bounds'"):
            make_env(path=path, model_input_names=name)
        env = make_env(path=path, model_input_names=name, bounds={name: (0.0, 1.0)})
        assert env.action_space in (Discrete(2), box([0], [1]))

    def test_no_inputs(self, make_env):
        with pytest.raises(ConfigError, match="there are no inputs"):
            make_env(model_input_names=[])

    def test_a_subclass_without_inputs(self, make_env):
        class Idle(PlainEnv):
            def _get_action_space(self):
                return Discrete(1)

            def _get_inputs(self):
                return []

        env = make_env(cls=Idle, model_input_names=[], model_output_names="end")
        env.reset()
        observation, *_ = env.step(0)
        assert observation == pytest.approx(0.1)


class TestActions:
    @in_turn(
        {
            "names,action,inputs": [
                ("a", [0.5], (0.5,)),
                ("a", 0.5, (0.5,)),
                ("a", 1, (1.0,)),
                ("a", np.float32(0.25), (0.25,)),
                (["b", "a"], [0.1, 0.2], (0.1, 0.2)),
                ("n", 0, (-5.0,)),
                ("n", np.int64(10), (5.0,)),
                ("n", np.array(7), (2.0,)),
                ("on", [1], (1.0,)),
                ("on", np.array([0], np.int8), (0.0,)),
                (["on", "a"], [0.5, 0.5], (1.0, 0.5)),
                (["on", "a"], [0.49, 0.5], (0.0, 0.5)),
                (["n", "a"], [2.4, 0.0], (2.0, 0.0)),
                (["n", "a"], [-2.6, 0.0], (-3.0, 0.0)),
            ],
            "version": MAJOR_VERSIONS,
        }
    )
    def test_to_inputs(self, make_env, version, names, action, inputs):
        env = make_env(version, model_input_names=names)
        env.reset()
        env.step(action)
        assert env.inputs == pytest.approx(inputs, abs=1e-7)
        assert tuple(env.read_variables(*env.config.model_input_names).values()) == env.inputs

    @pytest.mark.parametrize(("action", "value"), [(0, 1.0), (1, 2.0), (2, 5.0)])
    def test_enumerations_with_gaps(self, make_env, action, value):
        env = make_env(model_input_names="mode", model_output_names="mode_out")
        env.reset()
        observation, *_ = env.step(action)
        assert env.inputs == (value,)
        assert observation == action

    @pytest.mark.parametrize(
        ("number", "value"), [(1.4, 1), (2.9, 2), (3.2, 2), (3.6, 5), (5.4, 5)]
    )
    def test_enumerations_in_a_box_take_the_nearest_value(self, make_env, number, value):
        env = make_env(model_input_names=["mode", "a"])
        env.reset()
        env.step([number, 0.0])
        assert env.inputs[0] == value

    def test_every_sample_is_taken(self, make_env):
        names = ["mode", "a", "on", "n", "Int8_in", "UInt16_in", "Int64_in", "Float32_in"]
        env = make_env(3, model_input_names=names)
        env.reset()
        env.action_space.seed(1)
        for _ in range(100):
            env.step(env.action_space.sample())


class TestObservations:
    @pytest.mark.parametrize("version", MAJOR_VERSIONS)
    def test_a_real_may_be_unbounded(self, make_env, version):
        env = make_env(version, model_output_names=["sum", "on_out", "n_out"])
        low, high = [-np.inf, 0, -5], [np.inf, 1, 1000]
        assert env.observation_space == box(low, high)

    @pytest.mark.parametrize("version", MAJOR_VERSIONS)
    def test_one_integer_one_boolean(self, make_env, version):
        env = make_env(version, model_output_names="steps")
        assert env.observation_space == Discrete(1006)
        env.reset()
        observation, *_ = env.step(0.0)
        assert observation == 6  # the sixth value from -5 on, counted from 0
        assert env.state == (1.0,)
        assert observation in env.observation_space
        env = make_env(version, model_output_names="on_out")
        assert env.observation_space == MultiBinary(1)
        observation, _ = env.reset()
        assert observation in env.observation_space

    @pytest.mark.parametrize("name", ["steps", "n_out", "mode_out"])
    def test_one_integer_of_many_environments(self, probe, name):
        """The default observation is element-wise, as hooks should be."""

        def observe(hooks):
            config = probe_config(model_output_names=name)
            envs = FMUVectorEnv(in_way(hooks, lambda: PlainEnv(probe(), config)), 3)
            observations = [envs.reset()[0]]
            observations += [envs.step(np.zeros((3, 1)))[0] for _ in range(3)]
            envs.close()
            return [(row.tolist(), row.dtype) for row in observations]

        assert observe("arrays") == observe("one by one")

    def test_observations_are_new_arrays(self, make_env):
        env = make_env()
        first, _ = env.reset()
        second, *_ = env.step(1.0)
        third, *_ = env.step(1.0)
        assert first.tolist() == [0.0, 0.0]
        assert second[0] == np.float32(0.1)
        assert not np.shares_memory(second, third)

    def test_a_space_of_the_users_own(self, make_env):
        class Precise(PlainEnv):
            def _get_observation_space(self):
                return Box(-5.0, 5.0, (2,), np.float64)

        env = make_env(cls=Precise)
        env.reset()
        observation, *_ = env.step(1.0)
        assert observation.dtype == np.float64
        assert observation[0] == 0.1
        assert observation in env.observation_space

    def test_a_discrete_space_that_starts_elsewhere(self, make_env):
        class Shifted(PlainEnv):
            def _get_observation_space(self):
                return Discrete(3, start=10)

        env = make_env(cls=Shifted, model_input_names="mode", model_output_names="mode_out")
        env.reset()
        assert env.step(2)[0] == 12

    def test_a_discrete_space_over_a_plain_count(self, make_env):
        class Counted(PlainEnv):
            def _get_observation_space(self):
                return Discrete(100)

        env = make_env(cls=Counted, model_output_names="steps")
        env.reset()
        assert env.step(0.0)[0] == 1

    def test_a_value_outside_of_the_declared_ones(self, make_env, tmp_path):
        path = probe_fmu(tmp_path, 2, {'min="-5" max="1000"': 'min="0" max="1"'})
        env = make_env(path=path, model_output_names="steps")
        env.reset()
        env.step(0.0)
        with pytest.raises(SimulationError, match=r"'steps' is 2, .*declared values"):
            env.step(0.0)

    @pytest.mark.parametrize(
        ("space", "names"),
        [
            (Box(-1, 1, (3,)), ["sum", "mix"]),
            (Box(-1, 1, (2, 1)), ["sum", "mix"]),
            (MultiBinary(1), ["sum", "mix"]),
            (Discrete(3), ["sum", "mix"]),
            (spaces.Dict({"x": Discrete(2)}), ["sum", "mix"]),
        ],
    )
    def test_a_space_that_does_not_fit(self, make_env, space, names):
        class Odd(PlainEnv):
            def _get_observation_space(self):
                return space

        with pytest.raises(ConfigError, match=r"do not make an element.*override _get_observation"):
            make_env(cls=Odd, model_output_names=names)

    @pytest.mark.parametrize("hook", ["_get_action_space", "_get_observation_space"])
    def test_a_hook_that_gives_no_space(self, make_env, hook):
        cls = type("Odd", (PlainEnv,), {hook: lambda self: None})
        with pytest.raises(ConfigError, match=f"Odd.{hook} returned None"):
            make_env(cls=cls)


def test_gymnasium_accepts_every_derived_space(make_env):
    env = make_env(model_input_names=["a", "on"], model_output_names=["n_out", "mode_out"])
    assert isinstance(gymnasium.spaces.flatten_space(env.action_space), Box)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(20):
        assert env.step(env.action_space.sample())[0] in env.observation_space
