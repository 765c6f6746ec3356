"""Hooks that return something odd, or raise: the error, the fault, and what follows."""

import contextlib
import math
from decimal import Decimal

import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import PlainEnv
from gymnasium import spaces
from vector_tools import Drawing
from ways import in_way

import fmugym
from fmugym import ConfigError, SimulationError


def with_hooks(base=PlainEnv, **hooks):
    """A class whose hooks return these values, or what these functions of it return."""

    def hook(value):
        return lambda self: value(self) if callable(value) else value

    return type("Odd", (base,), {f"_{name}": hook(value) for name, value in hooks.items()})


class NumbersError:
    def __float__(self):
        raise ZeroDivisionError


ODD = [
    *(None, "", "1", b"1", [], [[1.0], [1.0, 2.0]], {}, {1: 2}, set(), object(), 1j, Ellipsis),
    *(np.ones(3), np.ones((2, 2)), np.array(["a", "b"]), np.array([None, None]), NumbersError()),
    *(np.datetime64("2020-01-01"), np.zeros(2, "i4,f4"), float, len, 10**400, (1, "a")),
]
HOOKS = (
    *("get_inputs", "is_done", "is_truncated", "reward_policy", "get_observation", "get_info"),
    "get_episode_parameters",
)


def one_step(env):
    env.reset(options={"model_parameters": {}})
    env.step(0.0)


@pytest.mark.parametrize("name", HOOKS)
def test_what_is_of_no_use_is_refused_with_the_name_of_the_hook(make_env, name):
    for value in ODD:
        cls = type("Odd", (PlainEnv,), {f"_{name}": lambda self, *options, value=value: value})
        is_good = isinstance(value, dict) and (
            name == "get_info" or (name.endswith("parameters") and not value)
        )
        refused = pytest.raises(ConfigError, match=f"_{name}")
        with contextlib.nullcontext() if is_good else refused:
            one_step(make_env(cls=cls))


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("is_done", np.True_, True),
        ("is_done", 1, True),
        ("is_done", np.array([False]), False),
        ("is_done", 0.0, False),
        ("is_truncated", np.array(True), True),
        ("reward_policy", 3, 3.0),
        ("reward_policy", np.float32(0.5), 0.5),
        ("reward_policy", np.array([2.0]), 2.0),
        ("reward_policy", Decimal("0.5"), 0.5),
        ("reward_policy", True, 1.0),
    ],
)
def test_forms_of_numbers_and_flags(make_env, name, value, expected):
    env = make_env(cls=with_hooks(**{name: value}))
    env.reset()
    _, reward, terminated, truncated, _ = env.step(0.0)
    got = {"is_done": terminated, "is_truncated": truncated, "reward_policy": reward}[name]
    assert (got, type(got)) == (expected, type(expected))


class TestNumbersThatAreNotFinite:
    def late(self, good, bad):
        """Good in the first two steps, bad in the third."""
        return lambda env: bad if env.step_count == 3 else good

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, np.float32(math.nan)])
    def test_a_reward_is_a_fault(self, make_env, bad):
        env = make_env(cls=with_hooks(reward_policy=self.late(1.0, bad)), fault_reward=-5.0)
        env.reset()
        env.step(1.0)
        before, *_ = env.step(1.0)
        state, out = env.state, dict(env.out)
        observation, reward, terminated, truncated, info = env.step(1.0)
        assert (reward, terminated, truncated) == (-5.0, False, True)
        assert "_reward_policy" in info["fault"]
        assert info["fault_rate"] == 1.0
        assert env.health["not_finite"] == 1
        assert observation.tolist() == before.tolist()
        assert (env.state, dict(env.out)) == (state, out)
        with pytest.raises(SimulationError, match="call reset"):
            env.step(1.0)
        env.reset()
        env.step(1.0)

    @in_turn({"bad": [math.nan, math.inf], "dtype": [np.float32, np.float64]})
    def test_an_observation_is_a_fault(self, make_env, bad, dtype):
        def observe(env):
            return np.array([bad if env.step_count == 3 else 0.25, env.state[0]], dtype)

        def count(env):
            env.variables["steps"] += 1

        def go_back(env):
            """Let the observation be made again with the count of before, where it was good."""
            env.step_count -= env.step_count == 3
            return {}

        cls = with_hooks(get_observation=observe, update=count, get_info=go_back)
        env = make_env(cls=cls, on_fault="terminate", episode_variables={"steps": 0})
        env.reset()
        for _ in range(2):
            before, *_ = env.step(1.0)
        observation, _, terminated, truncated, info = env.step(1.0)
        assert (terminated, truncated) == (True, False)
        assert "observation" in info["fault"]
        assert observation.tolist() == before.tolist()
        assert env.variables["steps"] == 2

    def test_one_that_stays_so_is_an_error(self, make_env):
        env = make_env(cls=with_hooks(get_observation=lambda env: np.full(2, self.of(env))))
        env.reset()
        with pytest.raises(SimulationError, match="nan"):
            env.step(0.0)

    def of(self, env):
        return math.nan if env.step_count else 0.0

    def test_the_first_one_is_an_error(self, make_env):
        env = make_env(cls=with_hooks(get_observation=np.array([0.0, math.nan])))
        with pytest.raises(SimulationError, match="first observation is not finite"):
            env.reset()
        with pytest.raises(SimulationError, match="reset"):
            env.step(0.0)

    def test_an_output_too_large_for_float32(self, make_env):
        """The output is finite in float64 and infinite in the observation."""
        env = make_env(model_parameters={"gain": 1e40})
        env.reset()
        assert env.observation_space.dtype == np.float32
        before = env.state
        observation, _, _, truncated, info = env.step(1.0)
        assert truncated
        assert np.isfinite(observation).all()
        assert "inf" in info["fault"]
        assert env.state == before

    def test_with_raise(self, make_env):
        env = make_env(cls=with_hooks(reward_policy=math.nan), on_fault="raise")
        env.reset()
        with pytest.raises(SimulationError, match="_reward_policy returned nan"):
            env.step(0.0)

    @in_turn(
        {
            "action": [math.nan, np.float32(math.nan), [math.nan], np.array([math.nan])],
            "hidden": [lambda env: 1.0, lambda env: 1.0 if env.action else 0.0],
        }
    )
    def test_nan_actions_are_refused_even_if_hooks_hide_them(self, make_env, hidden, action):
        env = make_env(cls=with_hooks(get_inputs=hidden))
        env.reset()
        with pytest.raises(ConfigError, match="finite"):
            env.step(action)
        assert env.step_count == 0
        env.step(0.5)


class OwnError(Exception):
    pass


class TestExceptionsOfHooks:
    @in_turn(
        {
            "name": ["update", *HOOKS[1:-1]],
            "kind": [OwnError, ZeroDivisionError, KeyboardInterrupt, SystemExit],
        }
    )
    def test_reach_the_caller_unchanged_and_end_the_episode(self, make_env, name, kind):
        error = kind("mine")
        original = getattr(PlainEnv, f"_{name}")

        def hook(env):
            if env.step_count == 2:
                raise error
            return original(env)

        env = make_env(cls=type("Raising", (PlainEnv,), {f"_{name}": hook}))
        env.reset()
        env.step(1.0)
        with pytest.raises(kind) as caught:
            env.step(1.0)
        assert caught.value is error
        with pytest.raises(SimulationError, match="call reset"):
            env.step(1.0)
        env.reset()
        assert env.step(1.0)[0].tolist() == pytest.approx([0.1, env.state[1]])
        assert 0 <= env.np_random.random() < 1  # no hook is running any more

    def test_of_get_inputs_leave_the_episode_as_it_was(self, make_env):
        def inputs(env):
            if env.action > 1.0:
                raise OwnError
            return env.action

        env = make_env(cls=with_hooks(get_inputs=inputs))
        env.reset()
        env.step(0.5)
        before = env.action, env.previous_action, env.state, env.inputs, env.time
        with pytest.raises(OwnError):
            env.step(2.0)
        assert (env.action, env.previous_action, env.state, env.inputs, env.time) == before
        env.step(0.5)
        assert env.step_count == 2

    def test_at_a_reset(self, make_env):
        trouble = []

        def observe(env):
            if trouble:
                raise OwnError
            return np.zeros(2)

        env = make_env(cls=with_hooks(get_observation=observe))
        env.reset()
        trouble.append(1)
        with pytest.raises(OwnError):
            env.reset()
        with pytest.raises(SimulationError, match="reset"):
            env.step(0.0)
        trouble.clear()
        env.reset()
        env.step(0.0)


class TestSuperOfObservation:
    def test_with_more_elements(self, make_env):
        class Longer(PlainEnv):
            def _get_observation_space(self):
                return spaces.Box(-math.inf, math.inf, (3,))

            def _get_observation(self):
                return np.append(super()._get_observation(), np.float32(7.0))

        env = make_env(cls=Longer)
        env.reset()
        observation, *_ = env.step(1.0)
        assert observation.tolist() == [*np.float32(env.state).tolist(), 7.0]
        assert observation.dtype == np.float32

    def test_in_the_type_of_the_own_space(self, make_env):
        class Precise(PlainEnv):
            def _get_observation_space(self):
                return spaces.Box(-math.inf, math.inf, (2,), np.float64)

            def _get_observation(self):
                return 2.0 * super()._get_observation()

        env = make_env(cls=Precise)
        env.reset()
        assert env.step(0.3)[0].tolist() == [2.0 * value for value in env.state]

    def test_in_a_dict(self, make_env):
        class Named(PlainEnv):
            def _get_observation_space(self):
                return spaces.Dict({"outputs": super()._get_observation_space()})

            def _get_observation(self):
                return {"outputs": super()._get_observation()}

        env = make_env(cls=Named)
        env.reset()
        assert env.observation_space.contains(env.step(0.3)[0])

    @pytest.mark.parametrize("hooks", ["arrays", "one by one"])
    def test_in_a_vector_environment(self, probe, hooks, make_envs):
        class Longer(PlainEnv):
            def __init__(self):
                super().__init__(
                    probe(2),
                    {"model_input_names": "a", "model_output_names": "sum", "time_step": 0.1},
                )

            def _get_observation_space(self):
                return spaces.Box(-math.inf, math.inf, (2,))

            def _get_observation(self):
                return np.concatenate([super()._get_observation(), np.float32(self.state)])

        envs = make_envs(in_way(hooks, Longer), 3)
        envs.reset()
        observations, *_ = envs.step(np.float32([[0.1], [0.2], [0.3]]))
        assert observations.tolist() == [[value] * 2 for value in observations[:, 0]]


class TestKindsOfObservations:
    SPACE = spaces.Dict(
        {
            "box": spaces.Box(-1.0, 1.0, (2,)),
            "pair": spaces.Tuple((spaces.Discrete(3), spaces.MultiBinary(2))),
            "text": spaces.Text(5),
        }
    )

    def observation(self, **changes):
        good = {"box": np.zeros(2, np.float32), "pair": (1, np.array([0, 1])), "text": "ab"}
        return {name: value for name, value in {**good, **changes}.items() if value is not None}

    def make(self, make_env, observation):
        return make_env(
            cls=with_hooks(get_observation_space=self.SPACE, get_observation=observation)
        )

    def test_that_fit(self, make_env):
        env = self.make(make_env, self.observation())
        env.reset()
        env.step(0.0)

    @pytest.mark.parametrize(
        "changes",
        [
            {"box": np.zeros(3)},
            {"box": None},
            {"more": 1},
            {"pair": (1,)},
            {"pair": [1, 2]},
            {"pair": (1, np.zeros(3, int))},
            {"pair": ("one", np.array([0, 1]))},
            {"text": "much too long"},
            {"text": 3},
        ],
    )
    def test_that_do_not(self, make_env, changes):
        env = self.make(make_env, self.observation(**changes))
        with pytest.raises(ConfigError, match="_get_observation"):
            env.reset()

    def test_that_are_not_finite(self, make_env):
        env = self.make(make_env, self.observation(box=np.array([0.0, math.inf])))
        with pytest.raises(SimulationError, match="not finite"):
            env.reset()


CALLS = []


class SpoiledGoals(Drawing):
    """Notes the calls of a hook; another one writes to what it gets."""

    def _get_observation_space(self):
        part = spaces.Box(-np.inf, np.inf, (1,), np.float64)
        return spaces.Dict({"achieved_goal": part, "desired_goal": part})

    def _is_done(self):
        return np.abs(self.out["q_dot"]) > 30.0

    def _get_observation(self):
        CALLS.append(type(self.out["q"]))
        return {
            "achieved_goal": np.array([self.out["q"]]),
            "desired_goal": np.array([0.0 * self.out["q"]]),
        }

    def _goal_reward(self, achieved_goal, desired_goal):
        achieved_goal[...] = 5.0
        return desired_goal[..., 0] - achieved_goal[..., 0]


class TestGoals:
    def test_without_goals_in_the_observation(self, make_env):
        cls = type("Goal", (PlainEnv,), {"_goal_reward": lambda self, a, d: 0.0})
        env = make_env(cls=cls)
        env.reset()
        with pytest.raises(ConfigError, match=r"_get_observation.*'achieved_goal'"):
            env.step(0.0)

    def test_a_step_asks_once_for_the_observation_which_the_reward_cannot_change(self):
        with SpoiledGoals() as env:
            env.reset(seed=0)
            CALLS.clear()
            observation, reward, *_ = env.step(env.action_space.sample())
            assert [float] == CALLS
            assert (reward, observation["achieved_goal"]) == (-5.0, env.state[0])

    def test_so_does_a_step_on_arrays(self):
        with contextlib.closing(fmugym.FMUVectorEnv(in_way("arrays", SpoiledGoals), 3)) as envs:
            envs.reset(seed=0)
            CALLS.clear()
            observations, rewards, *_ = envs.step(envs.action_space.sample())
            assert [np.ndarray] == CALLS
            assert rewards.tolist() == [-5.0] * 3
            np.testing.assert_array_equal(
                observations["achieved_goal"][:, 0], [state[0] for state in envs.get_attr("state")]
            )


class TestPictures:
    def draw(self, make_env, **hooks):
        class Drawn(PlainEnv):
            metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (Gymnasium's own form)

        env = make_env(cls=with_hooks(Drawn, **hooks), render_mode="rgb_array")
        env.reset()
        env.step(0.0)
        return env.render()

    @pytest.mark.parametrize("scene", [None, 3, "scene", {}])
    def test_no_scene(self, make_env, scene):
        with pytest.raises(ConfigError, match="_get_scene"):
            self.draw(make_env, get_scene=scene)

    @pytest.mark.parametrize("text", [None, 3, ["a"]])
    def test_no_text(self, make_env, text):
        scene = fmugym.rendering.PendulumScene(torque_limit=1.0)
        with pytest.raises(ConfigError, match="_describe_action"):
            self.draw(make_env, get_scene=lambda env: scene, describe_action=text)


class TestActionsOutsideOfTheSpace:
    def inputs(self, error):
        def get_inputs(env):
            if error:
                raise error
            return env.action[0]

        return get_inputs

    @pytest.mark.parametrize("action", [0.5, "left", {"a": 1.0}, None, object()])
    def test_of_no_use_to_the_hook(self, make_env, action):
        env = make_env(cls=with_hooks(get_inputs=self.inputs(None)))
        env.reset()
        with pytest.raises(ConfigError, match=r"action .* not"):
            env.step(action)
        env.step(np.array([0.5], np.float32))

    def test_errors_that_an_action_does_not_cause(self, make_env):
        for error, action in ((OwnError(), 0.5), (TypeError(), np.array([0.5], np.float32))):
            env = make_env(cls=with_hooks(get_inputs=self.inputs(error)))
            env.reset()
            with pytest.raises(type(error)) as caught:
                env.step(action)
            assert caught.value is error
