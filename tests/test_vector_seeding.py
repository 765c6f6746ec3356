"""Seeds and draws of vector environments are those of single ones."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from vector_tools import (
    Drawing,
    each_backend,
    each_way,
    make_pair,
    require_equal,
    require_same_infos,
    run_side_by_side,
    sampled_actions,
)

from fmugym import Choice, Normal, Uniform
from fmugym.vector import FMUVectorEnv

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
