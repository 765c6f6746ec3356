"""Vector environments: each environment in them is what it is alone."""

import json
import logging
import pickle
import warnings
from collections.abc import Mapping

import fmu_tools
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import fmugym
from fmugym import Choice, ConfigError, ContractError, Normal, SimulationError, Uniform
from fmugym.pool import has_native_pool
from fmugym.testing import check_hooks
from fmugym.vector import FMUVectorEnv
from fmugym.vector.engines.batch import BatchEngine

BACKENDS = ("python", "native") if has_native_pool() else ("python",)
WAYS = [(backend, hooks) for backend in BACKENDS for hooks in ("array", "per_env")]
WAYS += [("native", "auto")] if has_native_pool() else []  # compiled, where that is possible
IDS = (
    "fmugym/CartPole-v0",
    "fmugym/Pendulum-v0",
    "fmugym/ModelicaCartPole-v0",
    "fmugym/CloudPendulum-v0",
)
MODES = tuple(AutoresetMode)
ABSURD = 1e308

each_backend = pytest.mark.parametrize("backend", BACKENDS)
each_way = pytest.mark.parametrize(("backend", "hooks"), WAYS)
each_mode = pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)


# Comparing with Gymnasium's loop over single environments.


def require_equal(first, second, rtol=0.0):
    """Same types, shapes and values; dicts and arrays of objects element by element."""
    if isinstance(first, Mapping):
        assert first.keys() == second.keys()
        for key in first:
            require_equal(first[key], second[key], rtol)
        return
    first, second = np.asarray(first), np.asarray(second)
    assert (first.dtype, first.shape) == (second.dtype, second.shape)
    if rtol:
        np.testing.assert_allclose(first, second, rtol=rtol, atol=0)
    else:
        np.testing.assert_array_equal(first, second)


def require_same_infos(first, second):
    """What counts of an entry is only what its mask says."""
    assert first.keys() == second.keys()
    for key in first:
        if f"_{key}" not in first:
            continue
        mask = first[f"_{key}"]
        assert mask.dtype == second[f"_{key}"].dtype == np.bool_
        assert mask.tolist() == second[f"_{key}"].tolist(), key
        if isinstance(first[key], Mapping):
            require_same_infos(first[key], second[key])
            continue
        for left, right in zip(first[key][mask], second[key][mask], strict=True):
            require_equal(left, right)


def sampled_actions(env, count, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def run_side_by_side(ours, theirs, mode, steps, seed=3, rtol=0.0):
    """Step both with the same actions; returns how many episodes have ended."""
    first, second = ours.reset(seed=seed), theirs.reset(seed=seed)
    require_equal(first[0], second[0])
    require_same_infos(first[1], second[1])
    ends = 0
    for actions in sampled_actions(ours, steps):
        a, b = ours.step(actions), theirs.step(actions)
        require_equal(a[0], b[0])
        require_equal(a[1], b[1], rtol)
        require_equal(a[2], b[2])
        require_equal(a[3], b[3])
        require_same_infos(a[4], b[4])
        ended = a[2] | a[3]
        ends += int(ended.sum())
        if mode is AutoresetMode.DISABLED and ended.any():
            first = ours.reset(options={"reset_mask": ended})
            second = theirs.reset(options={"reset_mask": ended.copy()})
            require_equal(first[0], second[0])
            require_same_infos(first[1], second[1])
    return ends


def make_pair(cls, mode=AutoresetMode.NEXT_STEP, num_envs=4, hooks="array", backend="auto", **kw):
    ours = FMUVectorEnv(
        lambda: cls(**kw), num_envs, autoreset_mode=mode, hooks=hooks, backend=backend
    )
    theirs = SyncVectorEnv([lambda: cls(**kw)] * num_envs, autoreset_mode=mode)
    return ours, theirs


def require_pair_equal(cls, steps=60, mode=AutoresetMode.NEXT_STEP, rtol=0.0, **keywords):
    ours, theirs = make_pair(cls, mode, **keywords)
    ends = run_side_by_side(ours, theirs, mode, steps, rtol=rtol)
    ours.close()
    theirs.close()
    return ends


@each_way
@each_mode
@pytest.mark.parametrize("env_id", IDS)
def test_each_environment_is_what_it_is_alone(env_id, mode, backend, hooks):
    options = {"max_episode_steps": 25}
    ours = gym.make_vec(
        env_id, num_envs=5, autoreset_mode=mode, hooks=hooks, backend=backend, **options
    )
    theirs = SyncVectorEnv([lambda: gym.make(env_id, **options)] * 5, autoreset_mode=mode)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is mode
    rtol = 1e-7 if "Pendulum" in env_id else 0.0  # numpy's powers of arrays and of scalars
    ends = run_side_by_side(ours, theirs, mode, 120, rtol=rtol)
    assert ends >= 20
    assert ours.observation_space.contains(ours.reset(seed=1)[0])
    ours.close()
    theirs.close()


@each_backend
@pytest.mark.parametrize("fmi_version", ["1.0", "3.0"])
def test_other_fmi_versions(fmi_version, backend):
    ours, theirs = make_pair(fmugym.envs.CartPoleEnv, backend=backend, fmi_version=fmi_version)
    assert run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 100) > 5
    ours.close()
    theirs.close()


@each_backend
@pytest.mark.parametrize("num_envs", [1, 2, 7, 64])
def test_any_number_of_environments(num_envs, backend):
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=num_envs, backend=backend)
    theirs = gym.make_vec("fmugym/CartPole-v0", num_envs=num_envs, vectorization_mode="sync")
    assert run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 60) > 0
    ours.close()
    theirs.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_equal_to_gymnasiums_cart_poles_over_many_episodes(mode):
    """The streams of 40 episodes and more: values drawn ahead are used up and drawn again.

    Then two of the three are seeded anew.
    """
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=3, autoreset_mode=mode)
    theirs = gym.make_vec(
        "CartPole-v1",
        num_envs=3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
    )
    for seed in (7, [8, None, 9]):
        first, second = ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0]
        ends = 0
        for actions in sampled_actions(ours, 1500):
            require_equal(first, second)
            first, *ours_said, _ = ours.step(actions)
            second, *they_said, _ = theirs.step(actions)
            require_equal(np.array(ours_said), np.array(they_said))
            ends += int((ours_said[1] | ours_said[2]).sum())
        assert ends > 120
    ours.close()
    theirs.close()


def test_equal_to_gymnasiums_own_vector_environment_from_one_state():
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=8)
    theirs = gym.make_vec("CartPole-v1", num_envs=8, vectorization_mode="vector_entry_point")
    theirs.reset(seed=1)
    ours.reset(seed=1)
    theirs.unwrapped.state = ours.get_attr("state")
    theirs.unwrapped.state = np.array(theirs.unwrapped.state).T
    for actions in sampled_actions(ours, 8):
        a, b = ours.step(actions), theirs.step(actions)
        require_equal(a[0], b[0])
        assert a[1].tolist() == b[1].tolist()
        assert a[2].tolist() == b[2].tolist()
    ours.close()
    theirs.close()


def test_a_thousand_environments_equal_single_ones():
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=1000)
    first, _ = vector.reset(seed=5)
    chosen = (0, 499, 999)
    singles = [gym.make("fmugym/CartPole-v0") for _ in chosen]
    for single, index in zip(singles, chosen, strict=True):
        assert single.reset(seed=5 + index)[0].tolist() == first[index].tolist()
    ended = np.zeros(1000, bool)
    for actions in sampled_actions(vector, 40):
        observations, *_ = result = vector.step(actions)
        for single, index in zip(singles, chosen, strict=True):
            alone = single.reset()[0] if ended[index] else single.step(actions[index])[0]
            assert alone.tolist() == observations[index].tolist()
        ended = result[2] | result[3]
    assert ended.any()
    vector.close()
    for single in singles:
        single.close()


# Draws.


class Drawing(fmugym.FMUEnv):
    """All start values drawn; what is drawn is up to the config."""

    def __init__(self, **changes):
        config = {
            "model_input_names": ["tau"],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": Uniform(-1.0, 1.0), "q_dot_0": Uniform(-0.5, 0.5)},
            "bounds": {"tau": (-0.01, 0.01)},
            "time_step": 0.02,
            "max_episode_steps": 3,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config | changes)

    def _is_done(self):
        return self.state[0] != self.state[0]


UNIFORM = {"q_0": Uniform(-1.0, 1.0), "m": Uniform(0.05, 0.07)}
PARAMETERS = {
    "uniform": UNIFORM,
    "constant": {"q_0": 0.3},
    "normal": {"q_0": Normal(0.0, 0.3), "m": Uniform(0.05, 0.07)},
    "choice": {"q_0": Uniform(-1.0, 1.0), "body": Choice([1, 2]), "b": Choice([0.0, 1e-5, 2e-5])},
}
VARIABLES = {"target": Uniform(-1.0, 1.0), "gain": 2.0}
OPTIONS = (
    None,
    {"model_parameters": {"q_0": 0.25}},
    {"model_parameters": {"q_0": Uniform(0.4, 0.5)}},
    {"model_parameters": {"b": Uniform(0.0, 1e-5), "m": 0.06}},
    {"model_parameters": {"body": Choice([1, 2]), "q_0": Normal(0.0, 0.1)}},
    None,
    {"model_parameters": {"body": Choice([1, 2])}},
    None,
)


@each_way
@pytest.mark.parametrize("kind", PARAMETERS)
def test_options_take_the_streams_back(kind, backend, hooks):
    keywords = {"model_parameters": PARAMETERS[kind], "episode_variables": VARIABLES}
    ours, theirs = make_pair(Drawing, hooks=hooks, backend=backend, **keywords)
    run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 5)
    for options in OPTIONS * 2:
        mask = np.array([True, False, True, True])
        for masked in ({}, {"reset_mask": mask}):
            given = None if options is None and not masked else {**(options or {}), **masked}
            first, second = ours.reset(options=given), theirs.reset(options=given and dict(given))
            require_equal(first[0], second[0])
            require_same_infos(first[1], second[1])
        for actions in sampled_actions(ours, 9):  # two resets each
            first, second = ours.step(actions), theirs.step(actions)
            require_equal(first[0], second[0])
            require_same_infos(first[4], second[4])
    ours.close()
    theirs.close()


@each_backend
def test_drawn_values_are_told_and_used(backend):
    vector = FMUVectorEnv(
        lambda: Drawing(model_parameters=UNIFORM, episode_variables=VARIABLES), 6, backend=backend
    )
    observations, infos = vector.reset(seed=0)
    drawn = infos["drawn"]
    assert set(drawn) == {"q_0", "_q_0", "m", "_m", "target", "_target"}
    np.testing.assert_allclose(observations[:, 0], drawn["q_0"], rtol=1e-6)
    assert len(set(drawn["target"].tolist())) == 6
    assert [p["m"] for p in vector.get_attr("parameters")] == drawn["m"].tolist()
    assert [v["target"] for v in vector.get_attr("variables")] == drawn["target"].tolist()
    vector.close()


@each_way
def test_seeds(backend, hooks):
    vector = FMUVectorEnv(Drawing, 3, hooks=hooks, backend=backend)
    first = vector.reset(seed=10)[0]
    following = vector.reset()[0]
    assert first.tolist() != following.tolist()
    assert vector.reset(seed=[10, 11, 12])[0].tolist() == first.tolist()
    assert vector.reset(seed=np.int64(10))[0].tolist() == first.tolist()
    mixed = vector.reset(seed=[None, 99, 12])[0]
    assert mixed[0].tolist() == following[0].tolist()
    assert mixed[2].tolist() == first[2].tolist()
    vector.close()


@each_way
def test_an_unseeded_reset_draws_from_somewhere(backend, hooks):
    starts = []
    for _ in range(2):
        vector = FMUVectorEnv(Drawing, 3, hooks=hooks, backend=backend)
        starts += vector.reset()[0][:, 0].tolist()
        vector.close()
    assert len(set(starts)) == 6


@pytest.mark.parametrize("seed", [[1, 2], [1, 2, 3, 4], 1.5])
def test_seeds_that_do_not_fit(seed):
    vector = FMUVectorEnv(Drawing, 3)
    with pytest.raises(ConfigError, match="seed"):
        vector.reset(seed=seed)
    vector.close()


# Partial resets.


@each_way
def test_a_partial_reset_leaves_the_others_alone(backend, hooks):
    vector, untouched = (FMUVectorEnv(Drawing, 3, hooks=hooks, backend=backend) for _ in range(2))
    vector.reset(seed=0)
    untouched.reset(seed=0)
    actions = sampled_actions(vector, 3)
    vector.step(actions[0])
    last = untouched.step(actions[0])[0]
    mask = np.array([False, True, False])
    options = {"reset_mask": mask, "model_parameters": {"q_0": 0.5}}
    observations, infos = vector.reset(options=options)
    assert observations[[0, 2]].tolist() == last[[0, 2]].tolist()
    assert observations[1, 0] == np.float32(0.5)
    assert options.keys() == {"reset_mask", "model_parameters"}
    assert mask.tolist() == infos["_drawn"].tolist() == [False, True, False]
    mask[:] = True
    assert infos["_drawn"].tolist() == [False, True, False]
    for action in actions[1:]:
        first, second = vector.step(action), untouched.step(action)
        assert first[0][[0, 2]].tolist() == second[0][[0, 2]].tolist()
        assert first[3][[0, 2]].tolist() == second[3][[0, 2]].tolist()
    assert first[3].tolist() == [True, False, True]
    vector.close()
    untouched.close()


@pytest.mark.parametrize(
    "mask",
    [
        [True, False],
        [1, 0, 1],
        np.zeros(3, bool),
        np.ones((3, 1), bool),
        np.ones(3),
        "all",
    ],
)
def test_masks_that_do_not_fit(mask):
    vector = FMUVectorEnv(Drawing, 3)
    vector.reset(seed=0)
    with pytest.raises(ConfigError, match="must be a Boolean array of shape"):
        vector.reset(options={"reset_mask": mask})
    vector.close()


def test_the_first_reset_is_of_all():
    vector = FMUVectorEnv(Drawing, 2)
    with pytest.raises(ConfigError, match="first reset must be of all"):
        vector.reset(options={"reset_mask": np.array([True, False])})
    vector.close()


@each_way
def test_unknown_options_are_named(backend, hooks):
    vector = FMUVectorEnv(Drawing, 2, hooks=hooks, backend=backend)
    with pytest.raises(ConfigError, match="did you mean 'model_parameters'"):
        vector.reset(options={"model_parameter": {}})
    with pytest.raises(ConfigError, match="unknown"):
        vector.reset(options={"model_parameters": {"q_00": 1.0}})
    vector.close()


@each_way
def test_disabled_autoreset_wants_a_reset(backend, hooks):
    vector = FMUVectorEnv(Drawing, 2, autoreset_mode="disabled", hooks=hooks, backend=backend)
    vector.reset(seed=0)
    actions = sampled_actions(vector, 4)
    for action in actions[:3]:
        vector.step(action)
    with pytest.raises(SimulationError, match="environment 0 has ended"):
        vector.step(actions[3])
    vector.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(SimulationError, match="environment 1 has ended"):
        vector.step(actions[3])
    vector.reset(options={"reset_mask": np.array([False, True])})
    vector.step(actions[3])
    vector.close()


# Limits.


@each_way
@pytest.mark.parametrize(("own", "given", "expected"), [(3, None, 3), (8, 4, 4), (2, 9, 2)])
def test_truncation_at_the_smaller_limit(own, given, expected, backend, hooks):
    vector = FMUVectorEnv(
        lambda: Drawing(max_episode_steps=own),
        3,
        max_episode_steps=given,
        hooks=hooks,
        backend=backend,
    )
    vector.reset(seed=0)
    for _ in range(3):  # episodes
        said = [vector.step(action)[3].tolist() for action in sampled_actions(vector, expected)]
        assert said == [[False] * 3] * (expected - 1) + [[True] * 3]
        vector.step(sampled_actions(vector, 1)[0])
    vector.close()


@each_way
def test_the_reset_step_does_not_step_the_fmu(backend, hooks, make_env):
    """The probe FMU counts its steps."""
    vector = FMUVectorEnv(
        lambda: make_env(model_output_names=["steps", "sum"], max_episode_steps=2),
        2,
        hooks=hooks,
        backend=backend,
    )
    vector.reset()
    counts, rewards = [], []
    for _ in range(7):
        observations, reward, *_ = vector.step(np.ones((2, 1), np.float32))
        counts.append(observations[1, 0])
        rewards.append(reward[1])
    assert counts == [1, 2, 0, 1, 2, 0, 1]
    assert rewards == [1, 1, 0, 1, 1, 0, 1]
    vector.close()


# Arrays in and out.


def arrays_of(value):
    if isinstance(value, Mapping):
        return [array for inner in value.values() for array in arrays_of(inner)]
    return [value] if isinstance(value, np.ndarray) else []


@each_way
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_results_belong_to_the_caller(mode, backend, hooks):
    """Spoiling results changes nothing, and later steps do not change results."""
    keywords = {"autoreset_mode": mode, "hooks": hooks, "backend": backend}
    for cls in (Remembering, fmugym.envs.CartPoleEnv):
        careful, careless = (FMUVectorEnv(cls, 3, **keywords) for _ in range(2))
        kept = [careful.reset(seed=0)]
        careless.reset(seed=0)
        copies = [pickle.dumps(kept[0])]
        for actions in sampled_actions(careful, 40):
            kept.append(careful.step(actions))
            copies.append(pickle.dumps(kept[-1]))
            given = actions.copy()
            result = careless.step(given)
            require_equal(result[0], kept[-1][0])
            require_equal(np.array(result[1:4]), np.array(kept[-1][1:4]))
            for array in [a for part in result for a in arrays_of(part)]:
                array[...] = None if array.dtype == object else 1
            given[...] = 0
        assert [pickle.dumps(result) for result in kept] == copies
        careful.close()
        careless.close()


# Hooks.


class Remembering(Drawing):
    """Reads everything that a hook may read, with arithmetic that is exact in numpy."""

    def __init__(self, **changes):
        config = {
            "model_parameters": {"q_0": Uniform(-1.0, 1.0), "m": Uniform(0.05, 0.07)},
            "episode_variables": {"target": Uniform(-1.0, 1.0), "sum": 0.0, "last": 5.0, "pace": 0},
            "monitor_names": ["theta_ddot"],
            "max_episode_steps": 7,
        }
        super().__init__(**(config | changes))

    def _update(self):
        self.variables["pace"] = self.out["q"] - self.variables["last"]
        self.variables["last"] = self.out["q"]
        self.variables["sum"] += self.variables["target"] - self.out["q"]

    def _is_done(self):
        return abs(self.variables["sum"]) > 4.0

    def _is_truncated(self):
        return (self.time > 0.11) & (self.out["theta_ddot"] > 0)

    def _reward_policy(self):
        q, q_dot = self.previous_state
        effort = self.action[0] - 0.5 * self.previous_action[0]
        reward = -abs(q) - q_dot * q_dot - np.float64(effort) - self.parameters["m"]
        return np.where(self.done, -10.0, reward)

    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        return gym.spaces.Dict({"plant": box, "task": gym.spaces.Box(-np.inf, np.inf, (2,))})

    def _get_observation(self):
        q, q_dot = self.state
        plant = np.array([q, q_dot, self.previous_state[0]], np.float32)
        task = np.array([self.variables["sum"], self.variables["pace"]], np.float32)
        return {"plant": plant, "task": task}

    def _get_info(self):
        return {
            "acceleration": self.out["theta_ddot"],
            "input": self.inputs[0],
            "before": self.previous_action,
            "time": self.time,
            "steps": self.step_count,
            "last": self.variables["last"],
            "done": self.done,
            "kind": "brake",
            "nested": {"target": self.variables["target"]},
        }


@each_way
@each_mode
def test_hooks_read_what_they_read_in_a_single_environment(mode, backend, hooks):
    ends = require_pair_equal(
        Remembering, mode=mode, hooks=hooks, backend=backend, substeps=2, warm_up=0.04
    )
    assert ends > 10


class Imprecise(Drawing):
    def _get_observation(self):
        return np.array(self.state)  # float64


@each_way
def test_observations_have_the_type_of_the_space(backend, hooks):
    require_pair_equal(Imprecise, hooks=hooks, backend=backend)


class Reaching(Drawing):
    """A goal task."""

    def __init__(self, **changes):
        super().__init__(episode_variables={"goal": Uniform(-1.0, 1.0)}, **changes)

    def _get_observation_space(self):
        box = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        return gym.spaces.Dict({"achieved_goal": box, "desired_goal": box, "observation": box})

    def _get_observation(self):
        q, q_dot = self.state
        goal = self.variables["goal"]
        parts = {"achieved_goal": q, "desired_goal": goal, "observation": q_dot}
        return {name: np.array([part]) for name, part in parts.items()}

    def _goal_reward(self, achieved_goal, desired_goal):
        return -(np.abs(achieved_goal - desired_goal)[..., 0] > 0.5).astype(np.float64)


@each_way
def test_goal_tasks(backend, hooks):
    require_pair_equal(Reaching, hooks=hooks, backend=backend)
    vector = FMUVectorEnv(Reaching, 3, hooks=hooks, backend=backend)
    vector.reset(seed=0)
    observations, rewards, *_, infos = vector.step(sampled_actions(vector, 1)[0])
    goals = observations["achieved_goal"], observations["desired_goal"]
    assert vector.call("compute_reward", *goals, infos)[0].tolist() == rewards.tolist()
    vector.close()


class Historic(Drawing):
    """Keeps several numbers in one episode variable."""

    def __init__(self):
        super().__init__(episode_variables={"history": 0.0})

    def _update(self):
        q, q_dot = self.state
        self.variables["history"] = np.array([q, q_dot]) + 0.5 * self.variables["history"]

    def _reward_policy(self):
        return self.variables["history"][0] + self.variables["history"][1]


@each_way
def test_an_episode_variable_may_hold_several_numbers(backend, hooks):
    require_pair_equal(Historic, hooks=hooks, backend=backend)


class Shifted(Drawing):
    """A ``Discrete`` that does not begin with 0; what was before the first action is its start."""

    def _get_action_space(self):
        return gym.spaces.Discrete(3, start=-1)

    def _get_inputs(self):
        return 0.01 * self.action

    def _reward_policy(self):
        return self.action + 10 * self.previous_action

    def _get_info(self):
        return {"action": self.action, "before": self.previous_action}


@each_way
def test_discrete_actions_with_another_start(backend, hooks):
    require_pair_equal(Shifted, hooks=hooks, backend=backend)


@each_way
@pytest.mark.parametrize(
    "config",
    [
        {"model_input_names": ["c", "a", "b"], "model_output_names": ["mix", "sum"]},
        {"model_input_names": ["a", "n", "on"], "model_output_names": ["n_out", "on_out", "sum"]},
        {"model_input_names": "n", "model_output_names": ["n_out", "steps"]},
        {"model_input_names": "mode", "model_output_names": ["mode_out", "mix"]},
        {"model_input_names": "on", "model_output_names": "on_out"},
        {"model_input_names": ["on", "trim"], "model_output_names": ["on_out", "mix"]},
        {"model_parameters": {"a": 0.5, "trim": Uniform(0, 1)}, "monitor_names": "steps"},
    ],
    ids=["reals", "mixed", "integer", "enumeration", "boolean", "tunable", "start"],
)
def test_types_of_inputs_and_outputs(config, backend, hooks, probe):
    class Typed(fmu_tools.PlainEnv):
        def __init__(self):
            defaults = {"max_episode_steps": 4, "episode_variables": {"x": Uniform(0, 1)}}
            super().__init__(probe(), fmu_tools.probe_config(**defaults | config))

        def _get_info(self):
            return {"inputs": np.array(self.inputs), "x": self.variables["x"]}

    require_pair_equal(Typed, steps=30, hooks=hooks, backend=backend)


@each_backend
def test_discrete_observations(backend, make_env):
    """The default hook looks a value up, which takes one environment at a time."""
    vector = FMUVectorEnv(lambda: make_env(model_output_names="mode_out"), 3, backend=backend)
    observations, _ = vector.reset()
    assert observations.dtype == np.int64
    assert observations.tolist() == [0, 0, 0]
    vector.close()


def test_actions_may_be_lists_and_any_integers():
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=2)
    given = ([1, 0], np.array([1, 0], np.uint8), np.array([True, False]), np.arange(4)[1:-4:-1])
    results = []
    for actions in (*given, np.array([1, 0])):
        vector.reset(seed=0)
        results.append(vector.step(actions)[0].tolist() if len(actions) == 2 else results[0])
    assert results == [results[-1]] * 5
    vector.close()


@each_way
def test_actions_that_do_not_fit(backend, hooks):
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=2, hooks=hooks, backend=backend)
    vector.reset(seed=0)
    for actions in ([0], [0, 1, 1], [0, 2], [-1, 0]):
        with pytest.raises(ConfigError, match="action"):
            vector.step(np.array(actions))
    if hooks != "per_env":
        for actions in (1, [0.0, 1.0], [None, 1], [[0], [1]], "01", [[0, 1], 0]):
            with pytest.raises(ConfigError, match="action"):
                vector.step(actions)
    vector.step(np.array([0, 1]))
    vector.close()


@each_backend
def test_a_bad_action_is_forgotten(backend):
    vector, theirs = make_pair(Remembering, backend=backend, num_envs=2)
    vector.reset(seed=0)
    theirs.reset(seed=0)
    good, better = sampled_actions(vector, 2)
    vector.step(good)
    theirs.step(good)
    for bad in (np.full((2, 1), np.nan), np.array([[0.0], [np.inf]]), np.zeros((2, 2))):
        with pytest.raises(ConfigError):
            vector.step(bad)
    first, second = vector.step(better), theirs.step(better)
    require_equal(first[1], second[1])
    require_same_infos(first[4], second[4])
    vector.close()
    theirs.close()


class NoInputs(Drawing):
    def _get_inputs(self):
        return None


class NoReward(Drawing):
    def _reward_policy(self):
        return None


class NoDone(Drawing):
    def _is_done(self):
        return None


class NoObservation(Drawing):
    def _get_observation(self):
        return None


class TooManyInputs(Drawing):
    def _get_inputs(self):
        return [self.action[0], self.action[0]]


class RandomHook(Drawing):
    def _reward_policy(self):
        return self.np_random.random()


def reset_and_step(vector):
    vector.reset(seed=0)
    vector.step(np.zeros((2, 1), np.float32))


@pytest.mark.parametrize(
    ("cls", "error", "text"),
    [
        (NoInputs, ConfigError, "_get_inputs returned None"),
        (NoReward, ConfigError, "_reward_policy returned None"),
        (NoDone, ConfigError, "_is_done returned None"),
        (NoObservation, ConfigError, "_get_observation returned None"),
        (TooManyInputs, ConfigError, "2 values, expected 1"),
        (RandomHook, SimulationError, "a hook drew random numbers"),
    ],
)
@each_way
def test_mistakes_in_hooks(cls, error, text, backend, hooks):
    vector = FMUVectorEnv(cls, 2, hooks=hooks, backend=backend)
    with pytest.raises(error, match=text):
        reset_and_step(vector)
    vector.close()


# The probe.


class Branching(Drawing):
    def _is_done(self):
        if abs(self.state[0]) > 0.5:
            return True
        return self.state[1] > 1.0


class AnyOf(Drawing):
    def _is_done(self):
        return np.any(np.abs(self.state) > 0.9)


class FarLimit(Drawing):
    """No state that the probe's own steps reach is beyond the limit."""

    def _is_done(self):
        return np.any(self.state[0] > 40.0)


class FarLimitInPython(Drawing):
    def _reward_policy(self):
        return -1.0 if np.any(self.state[0] > 40.0) else 1.0


class Norm(Drawing):
    def _reward_policy(self):
        return -float(np.linalg.norm(self.state))


class NormOfArray(Drawing):
    def _reward_policy(self):
        return -np.linalg.norm(self.state)


class LargestOf(Drawing):
    def _reward_policy(self):
        return max(self.state)


class Mean(Drawing):
    def _get_observation(self):
        return np.array(self.state, np.float32) - np.mean(self.state)


class BranchingInputs(Drawing):
    def _get_inputs(self):
        return self.action if self.action[0] > 0 else -self.action


class BranchingUpdate(Drawing):
    def __init__(self):
        super().__init__(episode_variables={"count": 0.0})

    def _update(self):
        if self.state[0] > 0.3:
            self.variables["count"] = self.variables["count"] + 1.0

    def _get_info(self):
        return {"count": self.variables["count"]}


class BranchingTruncation(Drawing):
    def _is_truncated(self):
        return bool(self.state[0] > 0.8)


class BranchingInfo(Drawing):
    def _get_info(self):
        return {"fast": "yes" if self.state[1] > 0.1 else "no"}


class InPlace(Drawing):
    """Changes numbers of its own, but arrays of everyone's."""

    def _reward_policy(self):
        q, q_dot = self.state
        q *= 2.0
        return q + q_dot


class InPlaceByName(Drawing):
    def _is_done(self):
        speed = self.out["q_dot"]
        speed -= 0.1
        return speed > 1.0


class Rounding(Drawing):
    def _reward_policy(self):
        return float(round(self.state[0], 1))


class Table(Drawing):
    """Fails for states of other magnitudes."""

    def _reward_policy(self):
        return (1.0, 2.0, 3.0)[1 + int(np.sign(self.state[0]) * (abs(self.state[0]) < 2.0) * 1.0)]


class Counting(Drawing):
    """Remembers in attributes."""

    def __init__(self):
        super().__init__()
        self.seen = []
        self.total = 0.0

    def _update(self):
        self.seen.append(self.state[0])
        self.total += self.state[0]

    def _get_info(self):
        return {"seen": len(self.seen), "total": self.total}


class OwnGenerator(Drawing):
    def __init__(self):
        super().__init__()
        self.rng = np.random.default_rng(3)

    def _update(self):
        self.noise = self.rng.normal()

    def _reward_policy(self):
        return self.noise


class OwnStep(Drawing):
    """Overrides what the tutorial's class overrides."""

    def __init__(self):
        super().__init__()
        self.steps = 0

    def step(self, action):
        self.steps += 1
        observation, reward, *ends, info = super().step(action)
        return observation, reward + self.steps, *ends, info


class OwnReset(Drawing):
    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed, options=options)
        return observation + np.float32(1), info


DIFFERENT = {
    Branching: "_is_done fails on arrays",
    AnyOf: "_is_done gives other values",
    FarLimit: "_is_done gives other values",
    FarLimitInPython: "_reward_policy gives other values",
    Norm: "_reward_policy gives other values",
    NormOfArray: "_reward_policy gives other values",
    LargestOf: "_reward_policy fails on arrays",
    Mean: "_get_observation gives other values",
    BranchingInputs: "_get_inputs fails on arrays",
    BranchingUpdate: "_update fails on arrays",
    BranchingTruncation: "_is_truncated fails on arrays",
    BranchingInfo: "_get_info fails on arrays",
    InPlace: "_reward_policy changes the arrays in self.state in place",
    InPlaceByName: "_is_done changes the arrays in self.out in place",
    Rounding: "_reward_policy fails on arrays",
    Table: "_reward_policy fails on arrays",
    Counting: "_update changes self.seen",
    OwnGenerator: "_update changes self.rng",
    OwnStep: "step is overridden",
    OwnReset: "reset is overridden",
}


@each_backend
@pytest.mark.parametrize("cls", DIFFERENT, ids=lambda cls: cls.__name__)
def test_hooks_for_one_environment_only_are_called_one_by_one(cls, backend, caplog):
    with caplog.at_level(logging.WARNING, "fmugym"):
        require_pair_equal(cls, steps=30, hooks="auto", backend=backend)
    (message,) = [r.getMessage() for r in caplog.records if "one environment" in r.getMessage()]
    assert message.startswith(f"{cls.__name__}: {DIFFERENT[cls]}")


@pytest.mark.parametrize("cls", DIFFERENT, ids=lambda cls: cls.__name__)
def test_they_can_be_found_ahead(cls):
    with pytest.raises(ContractError, match=DIFFERENT[cls]) as caught:
        check_hooks(cls)
    assert str(caught.value).startswith(cls.__name__)
    assert "numpy.where for 'if'" in str(caught.value)
    for hooks in ("array", "compiled"):
        with pytest.raises(ConfigError, match=DIFFERENT[cls]):
            FMUVectorEnv(cls, 2, hooks=hooks)


@pytest.mark.parametrize("cls", [Drawing, Remembering, Reaching, Historic, Shifted])
def test_element_wise_hooks_pass_without_a_word(cls, caplog):
    assert check_hooks(cls) is None
    vector = FMUVectorEnv(cls, 2)
    vector.close()
    assert not caplog.records


@pytest.mark.parametrize("env_id", IDS)
def test_hooks_of_all_ids_pass(env_id):
    check_hooks(gym.make, id=env_id)


def test_check_hooks_is_for_environments_of_this_package():
    with pytest.raises(ConfigError, match="expected an environment of fmugym, got CartPoleEnv"):
        check_hooks(lambda: gym.make("CartPole-v1"))


class Powers(Drawing):
    """Arithmetic that only numbers and arrays can do: it is not compiled, and no mistake."""

    def _reward_policy(self):
        q, q_dot = self.state
        return -(q**2) - abs(q_dot) % 0.1 + float(len(self.state)) // 2


@each_backend
def test_what_cannot_be_compiled_is_left_to_numpy(backend):
    require_pair_equal(Powers, hooks="auto", backend=backend, rtol=1e-12)
    with pytest.raises(ConfigError, match="cannot be compiled"):
        FMUVectorEnv(Powers, 2, hooks="compiled", backend=backend)


@pytest.mark.skipif(not has_native_pool(), reason="hooks are compiled for the native pool")
def test_plain_arithmetic_is_compiled():
    for cls in (fmugym.envs.CartPoleEnv, fmugym.envs.ModelicaCartPoleEnv, PushedCart):
        FMUVectorEnv(cls, 2, hooks="compiled").close()
    with pytest.raises(ConfigError, match="the pool is not the native one"):
        FMUVectorEnv(fmugym.envs.CartPoleEnv, 2, hooks="compiled", backend="python")


class Arithmetic(Drawing):
    """All that is compiled."""

    def __init__(self, **changes):
        parameters = {"q_0": Uniform(-1.0, 1.0), "q_dot_0": 0.3, "m": Uniform(0.05, 0.07)}
        super().__init__(model_parameters=parameters, max_episode_steps=20, start_time=1.0)

    def _get_action_space(self):
        return gym.spaces.Discrete(3, start=-1)

    def _get_inputs(self):
        return [np.where(self.action == 1, 0.004, 0.01) * np.minimum(self.action, 0.5)]

    def _is_done(self):
        q, q_dot = self.state
        near, slow = (abs(q) > 0.9) & np.logical_not(q_dot < -1.0), np.less_equal(q_dot, 0.2)
        return near | np.logical_and(q > 0.5, slow) | np.logical_or(q == 0.25, q_dot >= 8.0)

    def _is_truncated(self):
        return (self.time > 1.2) & (self.step_count != 12) & np.not_equal(self.step_count, 13)

    def _reward_policy(self):
        q, q_dot = self.state
        first = np.sqrt(np.abs(q)) + np.square(q_dot) / (1.0 + np.fabs(self.inputs[0]))
        second = np.maximum(2 * q, -0.1) * np.negative(self.out["q_dot"]) - self.parameters["m"]
        return first - second + np.where(self.done, -1.0, -0.0) * (0.5 - self.action)


class MoreArithmetic(Arithmetic):
    def _is_done(self):
        return self.state[0] > 0.9

    def _is_truncated(self):
        return np.equal(self.step_count, 7)

    def _reward_policy(self):
        q, q_dot = self.state
        first = np.true_divide(np.add(q, 1), 3) + np.multiply(q, np.subtract(2.0, q_dot))
        second = np.where(np.greater(q, 0.3) | np.greater_equal(q_dot, 1.0), -first, 4.0 / (5 + q))
        return first + second - 1


@each_way
@each_mode
@pytest.mark.parametrize("cls", [Arithmetic, MoreArithmetic])
def test_compiled_arithmetic_is_that_of_numbers(cls, mode, backend, hooks):
    ways = {"backend": backend, "hooks": hooks if hooks != "auto" else "compiled"}
    assert require_pair_equal(cls, steps=150, mode=mode, num_envs=7, **ways) > 20


def many_operations(env):
    total = env.state[0]
    for _ in range(100):
        total = 0.5 * total + env.state[1]
    return total


NOT_COMPILED = {
    "it uses numpy.sin": lambda env: np.sin(env.state[0]),
    "it uses numpy.clip": lambda env: np.clip(env.state[0], -1, 1),
    "it uses numpy.stack": lambda env: np.stack([env.state[0]])[0],
    "it looks at the step before": lambda env: env.previous_state[0],
    "it does arithmetic with Booleans": lambda env: (env.state[0] > 0) * (env.state[1] > 0),
    "it does bit arithmetic": lambda env: 1.0 * (env.action & 1),
    "values of different types": lambda env: np.where(env.done, True, 0.0),
    "it computes with float32": lambda env: env.state[0] * np.float32(0.1),
    r"more than \d+ operations": many_operations,
    "unsupported operand": lambda env: env.state[0] ** 2,
}


@pytest.mark.skipif(not has_native_pool(), reason="hooks are compiled for the native pool")
@pytest.mark.parametrize("reason", NOT_COMPILED)
def test_reasons_against_compiling(reason):
    class Other(Arithmetic):
        def _reward_policy(self):
            return NOT_COMPILED[reason](self)

    with pytest.raises(ConfigError, match=f"Other cannot be compiled: .*{reason}"):
        FMUVectorEnv(Other, 2, hooks="compiled")
    require_pair_equal(Other, steps=20, hooks="auto", rtol=1e-6)


class Delegating(fmugym.envs.CartPoleEnv):
    """Keeps bound methods of its own in attributes."""

    def __init__(self):
        super().__init__()
        self.judge = self._lean

    def _lean(self):
        return 1.0 - abs(self.state[2])

    def _reward_policy(self):
        return self.judge()


@each_way
def test_bound_methods_in_attributes(backend, hooks):
    require_pair_equal(Delegating, hooks=hooks, backend=backend)


def test_unknown_ways_and_modes():
    with pytest.raises(ConfigError, match="did you mean 'array'"):
        FMUVectorEnv(Drawing, 2, hooks="arrays")
    with pytest.raises(ConfigError, match="did you mean 'next_step'"):
        FMUVectorEnv(Drawing, 2, autoreset_mode="nextstep")
    with pytest.raises(ConfigError, match="unwrapped environment of fmugym, got CartPoleEnv"):
        FMUVectorEnv(lambda: gym.make("CartPole-v1").unwrapped, 2)


@pytest.mark.parametrize("num_envs", [0, -1, 2.5])
def test_numbers_of_environments_that_make_no_sense(num_envs):
    with pytest.raises(ConfigError, match="num_envs must be a positive integer"):
        FMUVectorEnv(Drawing, num_envs)


# Attributes and parameters of single environments.

CART_POLE = fmugym.envs.CartPoleEnv


def cart_pole_with(attributes=None, **parameters):
    env = CART_POLE(model_parameters=parameters)
    for name, value in (attributes or {}).items():
        setattr(env, name, value)
    return env


@each_way
def test_attributes_for_each_environment(backend, hooks):
    forces, limits = [5.0, 10.0, 15.0], [0.1, 2.4, 0.2]
    vector = FMUVectorEnv(CART_POLE, 3, hooks=hooks, backend=backend)
    vector.set_attr("force_mag", forces)
    vector.set_attr("x_threshold", np.array(limits))
    vector.set_attr("sutton_barto_reward", True)
    assert vector.get_attr("force_mag") == tuple(forces)
    assert vector.get_attr("sutton_barto_reward") == (True,) * 3
    theirs = SyncVectorEnv(
        [
            lambda f=force, x=limit: cart_pole_with(
                {"force_mag": f, "x_threshold": x, "sutton_barto_reward": True}
            )
            for force, limit in zip(forces, limits, strict=True)
        ]
    )
    assert run_side_by_side(vector, theirs, AutoresetMode.NEXT_STEP, 100) > 5
    vector.close()
    theirs.close()


@each_way
def test_parameters_for_each_environment(backend, hooks):
    """They hold from the next episode on, several at a time, and options come before them."""
    masses, frictions = [0.05, 0.1, 0.2], [0.0, 0.5, 1.0]
    vector = FMUVectorEnv(CART_POLE, 3, hooks=hooks, backend=backend)
    vector.reset(seed=8)
    vector.set_attr("m_pole", masses)
    vector.set_attr("m_cart", 0.9)
    vector.set_attr("g", frictions)
    assert [p["m_pole"] for p in vector.get_attr("parameters")] == [0.1] * 3
    theirs = SyncVectorEnv(
        [
            lambda m=m, g=g: cart_pole_with(m_pole=m, m_cart=0.9, g=g)
            for m, g in zip(masses, frictions, strict=True)
        ]
    )
    assert run_side_by_side(vector, theirs, AutoresetMode.NEXT_STEP, 100) > 5
    assert [p["m_pole"] for p in vector.get_attr("parameters")] == masses
    options = {"model_parameters": {"m_pole": 0.3}}
    require_equal(vector.reset(options=options)[0], theirs.reset(options=dict(options))[0])
    assert [p["m_pole"] for p in vector.get_attr("parameters")] == [0.3] * 3
    vector.close()
    theirs.close()


@each_way
def test_parameters_that_the_config_does_not_name_or_draws(backend, hooks):
    vector = FMUVectorEnv(Drawing, 3, hooks=hooks, backend=backend)
    vector.reset(seed=0)
    vector.set_attr("b", [0.0, 1e-4, 2e-4])
    vector.set_attr("q_0", [0.1, 0.2, 0.3])
    theirs = SyncVectorEnv(
        [
            lambda b=b, q=q: Drawing(
                model_parameters={"q_0": q, "q_dot_0": Uniform(-0.5, 0.5), "b": b}
            )
            for b, q in ((0.0, 0.1), (1e-4, 0.2), (2e-4, 0.3))
        ]
    )
    run_side_by_side(vector, theirs, AutoresetMode.NEXT_STEP, 20)
    vector.close()
    theirs.close()


class OwnStep(CART_POLE):
    """Its hooks branch, and its ``step`` does more than the inherited one."""

    def _is_done(self):
        return True if abs(self.out["x"]) > 0.1 else super()._is_done()

    def step(self, action):
        *result, info = super().step(action)
        return *result, info | {"force": self.inputs[0]}


class Branching(CART_POLE):
    def _is_done(self):
        return True if abs(self.out["x"]) > 0.1 else super()._is_done()


@pytest.mark.parametrize("cls", [OwnStep, Branching])
@each_backend
@each_mode
def test_hooks_that_branch(cls, backend, mode):
    assert require_pair_equal(cls, mode=mode, hooks="per_env", backend=backend) > 5


@each_backend
def test_fmus_step_together_whatever_the_hooks_are(backend, monkeypatch):
    vector = FMUVectorEnv(Branching, 5, hooks="per_env", backend=backend)
    vector.reset(seed=0)
    calls, pool = [], type(vector.unwrapped._prototype._pool)
    step = pool.step
    monkeypatch.setattr(pool, "step", lambda *given: calls.append(1) or step(*given))
    for actions in sampled_actions(vector, 30):
        vector.step(actions)
    assert len(calls) == 30
    vector.close()


@each_way
def test_an_action_that_does_not_fit_changes_nothing(backend, hooks):
    vector = FMUVectorEnv(CART_POLE, 3, hooks=hooks, backend=backend)
    first = vector.reset(seed=0)[0]
    with pytest.raises(ConfigError, match=r"environment 2.* is not in Discrete"):
        vector.step(np.array([0, 1, 7]))
    assert vector.get_attr("step_count") == (0, 0, 0)
    assert vector.get_attr("action") == (0, 0, 0)
    np.testing.assert_array_equal(np.array(vector.get_attr("state"), np.float32), first)
    twin = FMUVectorEnv(CART_POLE, 3, hooks=hooks, backend=backend)
    twin.reset(seed=0)
    for actions in sampled_actions(vector, 20):
        require_equal(vector.step(actions)[0], twin.step(actions)[0])
    vector.close()
    twin.close()


CHANGES = {
    "options": lambda vector: vector.reset(
        options={
            "model_parameters": {"m_pole": 0.3},
            "reset_mask": np.array([True, False, False]),
        }
    ),
    "parameters": lambda vector: vector.set_attr("m_pole", [0.05, 0.2, 0.3]),
    "another parameter": lambda vector: vector.set_attr("theta_dot_0", [0.01, 0.02, 0.03]),
    "an attribute": lambda vector: vector.set_attr("x_threshold", 0.05),
}


@pytest.mark.skipif(not has_native_pool(), reason="hooks are compiled for the native pool")
@pytest.mark.parametrize("change", CHANGES)
def test_compiled_hooks_after_a_change(change, monkeypatch):
    """Once the episodes from before have ended, steps are as fast as before."""
    on_arrays = []
    step = BatchEngine.step
    monkeypatch.setattr(
        BatchEngine, "step", lambda engine, *given: on_arrays.append(1) or step(engine, *given)
    )
    ours, theirs = (
        FMUVectorEnv(CART_POLE, 3, hooks=hooks, max_episode_steps=12)
        for hooks in ("compiled", "per_env")
    )
    run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 7)
    assert not on_arrays
    first, second = CHANGES[change](ours), CHANGES[change](theirs)
    if first is not None:
        require_equal(first[0], second[0])
    for actions in sampled_actions(ours, 60):
        already = len(on_arrays)
        first, second = ours.step(actions), theirs.step(actions)
        for ours_said, theirs_said in zip(first[:4], second[:4], strict=True):
            require_equal(ours_said, theirs_said)
        require_same_infos(first[4], second[4])
    assert len(on_arrays) == already < 30
    ours.close()
    theirs.close()


@each_way
def test_values_that_do_not_fit(backend, hooks):
    vector = FMUVectorEnv(CART_POLE, 3, hooks=hooks, backend=backend)
    with pytest.raises(ConfigError, match="there are 2 values of 'force_mag', expected 3"):
        vector.set_attr("force_mag", [1.0, 2.0])
    for values in (["a", 1.0, 1.0], [1.0, 1.0, np.nan]):
        with pytest.raises(ConfigError, match="m_pole"):
            vector.set_attr("m_pole", values)
    if hooks != "per_env":
        with pytest.raises(ConfigError, match="one number for each environment"):
            vector.set_attr("force_mag", np.ones((3, 2)))
    vector.close()


@each_way
def test_misspelt_attributes_and_parameters(backend, hooks):
    vector = FMUVectorEnv(CART_POLE, 3, hooks=hooks, backend=backend)
    for misspelt, meant in (("force_magg", "force_mag"), ("m_poles", "m_pole")):
        with pytest.raises(ConfigError, match=f"{misspelt!r}; did you mean {meant!r}"):
            vector.set_attr(misspelt, [1.0, 2.0, 3.0])
        with pytest.raises(ConfigError, match="unknown attribute or parameter"):
            vector.set_attr(misspelt, 1.0)
        with pytest.raises(AttributeError):
            vector.get_attr(misspelt)
    vector.close()


@each_way
def test_methods_are_called_for_each_environment(backend, hooks):
    vector = FMUVectorEnv(CART_POLE, 2, hooks=hooks, backend=backend)
    observations, _ = vector.reset(seed=0)
    read = vector.call("read_variables", "x")
    if hooks == "per_env":
        assert [np.float32(values["x"]) for values in read] == observations[:, 0].tolist()
    assert vector.call("force_mag") == (10.0, 10.0)
    assert vector.call("_describe_action") == ("+0.0 N", "+0.0 N")
    assert vector.get_attr("time") == (0.0, 0.0)
    vector.close()


# Faults.


class Cart(fmugym.FMUEnv):
    """A cart-pole that fails (Discard) under an absurd force."""

    def __init__(self, **config):
        defaults = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot"],
            "model_parameters": {"x_0": Uniform(-1.0, 1.0)},
            "time_step": 0.02,
            "fault_reward": -7.0,
            "episode_variables": {"steps": 0.0},
            "max_episode_steps": 9,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), defaults | config)

    def _update(self):
        self.variables["steps"] = self.variables["steps"] + 1.0

    def _get_action_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def _get_info(self):
        return {"steps": self.variables["steps"]}

    def _is_done(self):
        return abs(self.state[0]) > 5.0


class PushedCart(Cart):
    """The same with two actions and plain hooks, which can be compiled."""

    _update = fmugym.FMUEnv._update
    _get_info = fmugym.FMUEnv._get_info

    def __init__(self, **config):
        super().__init__(episode_variables={}, **config)

    def _get_action_space(self):
        return gym.spaces.Discrete(2)

    def _get_inputs(self):
        return self.action * ABSURD


@each_way
@each_mode
@pytest.mark.parametrize("on_fault", ["truncate", "terminate"])
def test_a_fault_ends_its_own_episode_only(on_fault, mode, backend, hooks):
    for cls, fine, absurd in ((Cart, [0.5], [ABSURD]), (PushedCart, 0, 1)):
        vector, healthy = (
            FMUVectorEnv(
                lambda c=cls: c(on_fault=on_fault),
                3,
                autoreset_mode=mode,
                hooks=hooks,
                backend=backend,
            )
            for _ in range(2)
        )
        logging.getLogger(f"fmugym.{cls.__name__}").setLevel(logging.CRITICAL)
        first = vector.reset(seed=1)[0]
        healthy.reset(seed=1)
        good = np.array([fine] * 3)
        bad = np.array([fine, absurd, fine])
        others = [0, 2]
        result, expected = vector.step(bad), healthy.step(good)
        last = result[4]["final_obs"][1] if mode is AutoresetMode.SAME_STEP else result[0][1]
        assert last.tolist() == first[1].tolist()
        assert result[1].tolist() == [1.0, -7.0, 1.0]
        ends = [False, True, False]
        assert result[2].tolist() == (ends if on_fault == "terminate" else [False] * 3)
        assert result[3].tolist() == (ends if on_fault == "truncate" else [False] * 3)
        infos = result[4]["final_info"] if mode is AutoresetMode.SAME_STEP else result[4]
        assert infos["_fault"].tolist() == ends
        assert "returned Discard" in infos["fault"][1]
        if mode is not AutoresetMode.SAME_STEP:
            assert infos["fault"][0] is None
        if mode is AutoresetMode.DISABLED:
            vector.reset(options={"reset_mask": result[2] | result[3]})
        for _ in range(6):  # the failed one starts again and goes on
            assert result[0][others].tolist() == expected[0][others].tolist()
            result, expected = vector.step(good), healthy.step(good)
            assert np.isfinite(result[0]).all()
            assert "fault" not in result[4]
        assert vector.get_attr("step_count")[1] == 6 - (mode is AutoresetMode.NEXT_STEP)
        vector.close()
        healthy.close()


@each_way
@each_mode
def test_faults_are_those_of_single_environments(mode, backend, hooks):
    logging.getLogger("fmugym.Cart").setLevel(logging.CRITICAL)
    ours, theirs = make_pair(Cart, mode, hooks=hooks, backend=backend)
    for env in (ours, theirs):
        env.reset(seed=4)
    rng = np.random.default_rng(1)
    reasons = 0
    for _ in range(40):
        actions = np.where(rng.random((4, 1)) < 0.1, ABSURD, rng.uniform(-1, 1, (4, 1)))
        a, b = ours.step(actions), theirs.step(actions)
        for left, right in zip(a[:4], b[:4], strict=True):
            require_equal(left, right)
        for infos in (a[4], b[4]):
            said = infos.get("final_info", infos)
            if "fault" in said:  # the name of an instance has its number
                reasons += int(said["_fault"].sum())
                said["fault"] = np.array([str(t)[-20:] for t in said["fault"]], dtype=object)
        require_same_infos(a[4], b[4])
        ended = a[2] | a[3]
        if mode is AutoresetMode.DISABLED and ended.any():
            for env in (ours, theirs):
                env.reset(options={"reset_mask": ended.copy()})
    assert reasons > 10
    ours.close()
    theirs.close()


@each_way
@pytest.mark.parametrize("cls", [Cart, PushedCart])
def test_a_fault_may_be_raised(cls, backend, hooks):
    vector = FMUVectorEnv(lambda: cls(on_fault="raise"), 3, hooks=hooks, backend=backend)
    vector.reset(seed=0)
    fine, absurd = ([0.5], [ABSURD]) if cls is Cart else (0, 1)
    with pytest.raises(SimulationError, match="returned Discard"):
        vector.step(np.array([fine, absurd, fine]))
    vector.reset(seed=0)
    assert np.isfinite(vector.step(np.array([fine] * 3))[0]).all()
    vector.close()


@each_way
@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_may_ask_for_the_end(version, backend, hooks, probe):
    """The one whose parameters say so stops in its third step."""

    class Stopping(fmu_tools.PlainEnv):
        def __init__(self, **parameters):
            config = fmu_tools.probe_config(model_parameters=parameters)
            super().__init__(probe(version), config)

        def _reward_policy(self):
            return np.where(self.done, -5.0, self.inputs[0])

    stop = {"fault": 6, "fault_step": 3}
    vector = FMUVectorEnv(Stopping, 3, hooks=hooks, backend=backend)
    for name, value in stop.items():
        vector.set_attr(name, [0, value, 0])
    theirs = SyncVectorEnv([Stopping, lambda: Stopping(**stop), Stopping])
    vector.reset(seed=0)
    theirs.reset(seed=0)
    ends = []
    for actions in sampled_actions(vector, 10):
        a, b = vector.step(actions), theirs.step(actions)
        for left, right in zip(a[:4], b[:4], strict=True):
            require_equal(left, right)
        ends.append(a[2].tolist())
        if a[2].any():
            require_same_infos(
                {k: v for k, v in a[4].items() if "fmu" in k},
                {k: v for k, v in b[4].items() if "fmu" in k},
            )
    assert [index for index, end in enumerate(ends) if end[1]] == [2, 6]
    assert not any(end[0] or end[2] for end in ends)
    vector.close()
    theirs.close()


class StoppingSteered(fmu_tools.PlainEnv):
    """Compiled, with a reward that depends on the action."""

    def __init__(self, path):
        config = fmu_tools.probe_config(model_parameters={"fault": 6, "fault_step": 2})
        super().__init__(path, config)

    def _get_action_space(self):
        return gym.spaces.Discrete(3)

    def _get_inputs(self):
        return self.action - 1.0

    def _reward_policy(self):
        return np.where(self.done, 10.0, 1.0) * self.action


@each_way
def test_the_reward_of_a_step_with_which_the_fmu_stops(backend, hooks, probe):
    vector = FMUVectorEnv(lambda: StoppingSteered(probe()), 3, hooks=hooks, backend=backend)
    vector.reset()
    assert vector.step(np.array([2, 1, 0]))[1].tolist() == [2.0, 1.0, 0.0]
    assert vector.step(np.array([0, 1, 2]))[1].tolist() == [0.0, 10.0, 20.0]
    vector.close()


@each_way
def test_a_start_that_fails_is_an_error(backend, hooks, make_env):
    vector = FMUVectorEnv(make_env, 2, hooks=hooks, backend=backend)
    vector.reset()
    with pytest.raises(SimulationError, match="init"):
        vector.reset(options={"model_parameters": {"init_status": 3}})
    vector.reset()
    vector.step(np.zeros((2, 1), np.float32))
    vector.close()


# Gymnasium's wrappers and ways of making.


def test_wrappers_for_statistics_and_normalization():
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=4)
    wrapped = gym.wrappers.vector.RecordEpisodeStatistics(vector)
    wrapped = gym.wrappers.vector.NormalizeObservation(wrapped)
    wrapped = gym.wrappers.vector.ClipReward(wrapped, 0.0, 0.5)
    wrapped = gym.wrappers.vector.NormalizeReward(wrapped)
    wrapped.reset(seed=0)
    lengths = []
    for actions in sampled_actions(vector, 300):
        observations, rewards, _, _, infos = wrapped.step(actions)
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
        if "episode" in infos:
            mask = infos["_episode"]
            assert infos["episode"]["r"][mask].tolist() == infos["episode"]["l"][mask].tolist()
            lengths += infos["episode"]["l"][mask].tolist()
    assert len(lengths) > 20
    assert 8 < np.mean(lengths) < 60
    wrapped.close()


def test_statistics_of_partial_resets():
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=2, autoreset_mode="disabled")
    wrapped = gym.wrappers.vector.RecordEpisodeStatistics(vector)
    wrapped.reset(seed=0)
    for _ in range(5):
        wrapped.step(np.array([0, 1]))
    wrapped.reset(options={"reset_mask": np.array([True, False])})
    assert wrapped.episode_lengths.tolist() == list(vector.get_attr("step_count")) == [0, 5]
    wrapped.close()


@each_way
def test_infos_as_lists(backend, hooks):
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=2, hooks=hooks, backend=backend)
    wrapped = gym.wrappers.vector.DictInfoToList(vector)
    _, infos = wrapped.reset(seed=0)
    assert [sorted(info["drawn"]) for info in infos] == [
        ["phi_0", "phi_dot_0", "x_0", "x_dot_0"]
    ] * 2
    drawn = []
    for actions in sampled_actions(vector, 60):
        *_, infos = wrapped.step(actions)
        drawn += [info["drawn"]["x_0"] for info in infos if "drawn" in info]
    assert len(set(drawn)) > 2
    wrapped.close()


def test_array_wrappers_over_single_transforms():
    vector = gym.make_vec("fmugym/Pendulum-v0", num_envs=3)
    wrapped = gym.wrappers.vector.RescaleAction(vector, np.float32(-1), np.float32(1))
    wrapped = gym.wrappers.vector.FlattenObservation(wrapped)
    wrapped.reset(seed=0)
    observations, *_ = wrapped.step(np.ones((3, 1), np.float32))
    assert observations.shape == (3, 3)
    assert vector.unwrapped.get_attr("inputs") == ((2.0,),) * 3
    wrapped.close()


@each_way
def test_pictures_of_all(backend, hooks):
    vector = gym.make_vec(
        "fmugym/ModelicaCartPole-v0",
        num_envs=3,
        render_mode="rgb_array",
        hooks=hooks,
        backend=backend,
        theta_0=Uniform(1.4, 1.7),
    )
    with pytest.raises(SimulationError, match="before the first reset"):
        vector.render()
    vector.reset(seed=0)
    pictures = vector.render()
    assert [picture.shape for picture in pictures] == [(400, 600, 3)] * 3
    assert not np.array_equal(pictures[0], pictures[1])
    kept = pictures[0].copy()
    vector.step(np.array([0, 1, 1]))
    assert not np.array_equal(vector.render()[0], kept)
    assert np.array_equal(pictures[0], kept)
    vector.close()
    with pytest.raises(SimulationError, match="closed"):
        vector.render()


def test_no_pictures_without_a_render_mode():
    vector = FMUVectorEnv(Drawing, 2)
    assert vector.render() is None
    assert vector.render_mode is None
    vector.close()


def test_videos(tmp_path):
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=2, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # moviepy's own
        recorder = gym.wrappers.vector.RecordVideo(
            vector, str(tmp_path), video_length=5, step_trigger=lambda step: step == 0
        )
        recorder.reset(seed=0)
        for actions in sampled_actions(vector, 7):
            recorder.step(actions)
        recorder.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
@pytest.mark.parametrize("vectorization_mode", ["sync", "async"])
def test_gymnasiums_own_ways(vectorization_mode):
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=2)
    theirs = gym.make_vec("fmugym/CartPole-v0", num_envs=2, vectorization_mode=vectorization_mode)
    assert run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 60) > 2
    ours.close()
    theirs.close()


@pytest.mark.parametrize("env_id", IDS)
def test_specs(env_id):
    vector = gym.make_vec(env_id, num_envs=2, max_episode_steps=11, hooks="array")
    spec = json.loads(vector.spec.to_json())
    assert spec["id"] == env_id
    assert spec["kwargs"]["max_episode_steps"] == 11
    again = gym.make_vec(gym.envs.registration.EnvSpec.from_json(vector.spec.to_json()), num_envs=2)
    require_equal(vector.reset(seed=0)[0], again.reset(seed=0)[0])
    assert repr(vector.unwrapped) == f"FMUVectorEnv({env_id[7:-3]}Env, num_envs=2)"
    vector.close()
    again.close()


def test_registered_classes_of_ones_own():
    fmugym.register("tests/Drawing-v0", Drawing)
    vector = gym.make_vec("tests/Drawing-v0", num_envs=2, time_step=0.05)
    vector.reset(seed=0)
    vector.step(np.zeros((2, 1), np.float32))
    assert vector.get_attr("time") == (0.05, 0.05)
    vector.close()
    del gym.registry["tests/Drawing-v0"]


def test_thousands_in_one_call():
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=4096)
    vector.reset(seed=0)
    for actions in sampled_actions(vector, 20):
        observations, rewards, *_ = vector.step(actions)
    assert observations.shape == (4096, 4)
    assert rewards.shape == (4096,)
    vector.close()


# Order of calls.


@each_way
def test_calls_out_of_order(backend, hooks):
    vector = FMUVectorEnv(Drawing, 2, hooks=hooks, backend=backend)
    actions = np.zeros((2, 1), np.float32)
    with pytest.raises(SimulationError, match="step was called before the first reset"):
        vector.step(actions)
    vector.reset(seed=0)
    vector.step(actions)
    vector.close()
    vector.close()
    with pytest.raises(SimulationError, match="step was called on a closed"):
        vector.step(actions)
    with pytest.raises(SimulationError, match="reset was called on a closed"):
        vector.reset()


def test_a_prototype_that_does_not_fit_is_closed(temp_root):
    with pytest.raises(ConfigError):
        FMUVectorEnv(Branching, 2, hooks="array")
    assert not list(temp_root.iterdir())


def test_single_environments_are_read_one_by_one():
    envs = gym.make_vec("fmugym/CartPole-v0", num_envs=3)
    envs.reset(seed=1)
    envs.set_attr("m_pole", [0.1, 0.2, 0.3])
    envs.reset(seed=1)
    assert envs.get_attr("m_pole") == (0.1, 0.2, 0.3)
    assert [read["m_pole"] for read in envs.call("read_variables", "m_pole")] == [0.1, 0.2, 0.3]
    envs.close()
