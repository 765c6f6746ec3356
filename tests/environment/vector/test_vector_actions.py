"""Actions of vector environments: what is taken, what is refused, and what a refusal leaves."""

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import PlainEnv, probe_config
from vector_tools import (
    CART_POLE,
    HOOKS,
    Drawing,
    Remembering,
    each_way,
    make_pair,
    require_equal,
    results_of_both,
    sampled_actions,
)
from ways import ALL_WAYS, in_way, make_vec

import fmugym
from fmugym import ConfigError


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
def test_actions_that_do_not_fit(hooks):
    vector = make_vec(hooks, "fmugym/CartPole-v0", num_envs=2)
    vector.reset(seed=0)
    for actions in ([0], [0, 1, 1], [0, 2], [-1, 0]):
        with pytest.raises(ConfigError, match="action"):
            vector.step(np.array(actions))
    if hooks != "one by one":
        for actions in (1, [0.0, 1.0], [None, 1], [[0], [1]], "01", [[0, 1], 0]):
            with pytest.raises(ConfigError, match="action"):
                vector.step(actions)
    vector.step(np.array([0, 1]))
    vector.close()


def test_a_bad_action_is_forgotten():
    vector, theirs = make_pair(Remembering, num_envs=2)
    for _ in results_of_both(vector, theirs, 3):
        for bad in (np.full((2, 1), np.nan), np.array([[0.0], [np.inf]]), np.zeros((2, 2))):
            with pytest.raises(ConfigError):
                vector.step(bad)
    vector.close()
    theirs.close()


@pytest.mark.parametrize("given", [np.array, list, np.int16])
@pytest.mark.parametrize("hooks", ALL_WAYS)
def test_an_action_that_does_not_fit_changes_nothing(hooks, given, make_envs):
    vector = make_envs(in_way(hooks, CART_POLE), 3)
    first = vector.reset(seed=0)[0]
    with pytest.raises(ConfigError, match=r"environment 2.* is not in Discrete"):
        vector.step(given([0, 1, 7]))
    assert vector.get_attr("step_count") == (0, 0, 0)
    assert vector.get_attr("action") == (0, 0, 0)
    np.testing.assert_array_equal(np.array(vector.get_attr("state"), np.float32), first)
    twin = make_envs(in_way(hooks, CART_POLE), 3)
    twin.reset(seed=0)
    for actions in sampled_actions(vector, 20):
        require_equal(vector.step(actions)[0], twin.step(actions)[0])


@in_turn({"hooks": HOOKS, "env_id": ["fmugym/CartPole-v0", "fmugym/Pendulum-v0"]})
def test_actions_of_environments_about_to_be_reset_are_checked_too(env_id, hooks):
    """In the third step environment 1 starts its second episode."""
    vector = make_vec(hooks, env_id, num_envs=3, max_episode_steps=3)
    vector.reset(seed=0)
    good = np.zeros(vector.action_space.shape, vector.action_space.dtype)
    vector.step(good)
    vector.reset(options={"reset_mask": np.array([True, False, True])})
    vector.step(good)
    assert vector.step(good)[3].tolist() == [False, True, False]
    bad = good.copy()
    bad[1] = 7 if bad.dtype.kind == "i" else np.nan
    with pytest.raises(ConfigError, match="environment 1"):
        vector.step(bad)
    assert vector.step(good)[3].tolist() == [True, False, True]
    assert vector.get_attr("step_count") == (3, 0, 3)
    vector.close()


@each_way
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_nan_is_refused_even_where_no_hook_reads_it(hooks, dtype, make_envs):
    class Uninterested(Drawing):
        def _get_action_space(self):
            return gym.spaces.Box(-1.0, 1.0, (1,), dtype)

        def _get_inputs(self):
            return 0.0 * self.step_count

    vector = make_envs(in_way(hooks, Uninterested), 2)
    vector.reset(seed=0)
    with pytest.raises(ConfigError, match="environment 1"):
        vector.step(np.array([[0.0], [np.nan]], dtype))


def test_inputs_outside_of_their_type(probe, make_envs):
    class Typed(PlainEnv):
        def __init__(self):
            names = {"model_input_names": "n", "model_output_names": ["n_out", "steps"]}
            super().__init__(probe(), probe_config(**names))

        def _get_inputs(self):
            return np.where(self.action > 2, 3e9, 1.0)

    envs = make_envs(in_way("arrays", Typed), 2)
    envs.reset(seed=0)
    with pytest.raises(ConfigError, match="expected an integer from"):
        envs.step(np.array([1, 5]))


class OfNodes(fmugym.FMI2CSEnv):
    """An environment whose actions are graphs: the first node is the force."""

    def __init__(self):
        config = {"model_input_names": "f", "model_output_names": "x", "time_step": 0.05}
        super().__init__(fmugym.bundled_fmu("CartPole"), config)

    def _get_action_space(self):
        return gym.spaces.Graph(gym.spaces.Box(-1.0, 1.0, (1,)), None)

    def _get_inputs(self):
        return [float(self.action.nodes[0, 0])]

    def _is_done(self):
        return False


def test_who_uses_the_nodes_of_a_graph_again_leaves_the_latest_action_as_it_was():
    single, vector = OfNodes(), fmugym.FMUVectorEnv(OfNodes, 2)
    graph = single.action_space.sample(num_nodes=2)
    for env, action in ((single, graph), (vector, (graph, graph))):
        graph.nodes[:] = 0.5
        env.reset(seed=0)
        env.step(action)
        graph.nodes[:] = -0.5
        latest = [env.action] if env is single else env.get_attr("action")
        assert all(np.array_equal(one.nodes, np.full_like(graph.nodes, 0.5)) for one in latest)
        env.close()
