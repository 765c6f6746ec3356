"""Seeds and draws of vector environments are those of single ones."""

import numpy as np
import pytest
from contract_cases import Targets
from vector_tools import (
    Drawing,
    each_way,
    make_pair,
    require_equal,
    require_same_infos,
    require_same_starts,
    results_of_both,
    sampled_actions,
)
from ways import in_way

from fmugym import Choice, Normal, Uniform
from fmugym.environment.distributions import draw, is_distribution
from fmugym.environment.vector import FMUVectorEnv

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


@pytest.mark.parametrize("hooks", ["arrays"])
@pytest.mark.parametrize("kind", PARAMETERS)
def test_options_take_the_streams_back(kind, hooks):
    keywords = {"model_parameters": PARAMETERS[kind], "episode_variables": VARIABLES}
    ours, theirs = make_pair(Drawing, way=hooks, **keywords)
    list(results_of_both(ours, theirs, 5))
    for options in OPTIONS * 2:
        mask = np.array([True, False, True, True])
        for masked in ({}, {"reset_mask": mask}):
            given = None if options is None and not masked else {**(options or {}), **masked}
            require_same_starts(
                ours.reset(options=given), theirs.reset(options=given and dict(given))
            )
            assert not masked or given["reset_mask"].tolist() == [True, False, True, True]
        for actions in sampled_actions(ours, 9):  # two resets each
            first, second = ours.step(actions), theirs.step(actions)
            require_equal(first[0], second[0])
            require_same_infos(first[4], second[4])
    ours.close()
    theirs.close()


@each_way
def test_an_unseeded_reset_draws_from_somewhere(hooks):
    starts = []
    for _ in range(2):
        vector = FMUVectorEnv(in_way(hooks, Drawing), 3)
        starts += vector.reset()[0][:, 0].tolist()
        vector.close()
    assert len(set(starts)) == 6


# Arrays with a distribution for each element


def test_elements_are_drawn_in_the_documented_order():
    """First the parameters, then the variables in the order of their dict, then the elements."""
    env = Targets()
    _, info = env.reset(seed=7)
    variables = {n: np.array(v, object) for n, v in env.config.episode_variables.items()}
    rng = np.random.default_rng(7)
    drawn = [draw(one, rng) for one in env.config.model_parameters.values()]
    for name, value in variables.items():
        expected = [draw(one, rng) for one in value.reshape(-1)]
        assert np.ravel(env.variables[name]).tolist() == expected
        if any(map(is_distribution, value.reshape(-1))):
            assert np.ravel(info["drawn"][name]).tolist() == expected
        else:
            assert name not in info["drawn"]
    assert list(info["drawn"].values())[:2] == drawn
    assert env.variables["grid"].shape == info["drawn"]["grid"].shape == (2, 2)
    with pytest.raises(ValueError, match="read-only"):
        env.variables["target"][0] = 1.0  # as for constant arrays: assign a new one
    env.close()


@each_way
def test_options_and_arrays_with_distributions(hooks):
    ours, theirs = make_pair(Targets, way=hooks)
    options = {"model_parameters": {"b": Uniform(0.0, 1e-5)}}
    for given in (options, {}):
        require_same_starts(*(envs.reset(seed=3, options=dict(given)) for envs in (ours, theirs)))
        for actions in sampled_actions(ours, 5):
            first, second = ours.step(actions), theirs.step(actions)
            require_equal(first[1], second[1])
            require_same_infos(first[4], second[4])
    ours.close()
    theirs.close()
