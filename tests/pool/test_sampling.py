"""What a step gives of the values after each of its substeps, in every pool."""

import numpy as np
import pytest
from fmu_tools import PlainEnv
from pool_tools import KINDS, open_pool, start, step

from fmugym import FMU, ConfigError, bundled_fmu
from fmugym.pool.pool_spec import SAMPLINGS

SUBSTEPS, STEP = 5, 0.1
OUTPUTS = ("x", "x_dot", "theta", "theta_dot", "f")


@pytest.fixture(params=KINDS)
def make(request, opened):
    def make(**spec):
        fmu = FMU(bundled_fmu("CartPole"))
        return opened(open_pool(fmu, ["f"], OUTPUTS, n=3, options=KINDS[request.param], **spec))

    return make


def rollout(pool, inputs):
    first = start(pool, {"phi_0": [0.1, -0.2, 0.3]}).outputs.copy()
    return first, np.array([step(pool, *row) for row in inputs])


def expected(fine):
    """By numpy, of the values after each substep, shape (steps, substeps, outputs, N)."""
    parts = [
        fine[:, -1, 0],
        np.add.accumulate(fine[:, :, 1], axis=1)[:, -1] / SUBSTEPS,
        np.add.accumulate(fine[:, :, 2], axis=1)[:, -1] * (STEP / SUBSTEPS),
        fine[:, :, 3].min(axis=1),
        fine[:, :, 4].max(axis=1),
    ]
    return np.stack(parts, axis=1)


def test_a_step_gives_what_its_substeps_give(make):
    inputs = np.random.default_rng(0).uniform(-5, 5, (8, 1, 3))
    pool = make(time_step=STEP, substeps=SUBSTEPS, samplings=SAMPLINGS)
    fine = make(time_step=STEP / SUBSTEPS)
    for _ in range(3):  # the third time, an episode may begin with a saved state
        first, results = rollout(pool, inputs)
        first_of_fine, values = rollout(fine, np.repeat(inputs, SUBSTEPS, axis=0))
        np.testing.assert_array_equal(first[[0, 1, 3, 4]], first_of_fine[[0, 1, 3, 4]])
        np.testing.assert_array_equal(first[2], 0.0)
        values = values.reshape(8, SUBSTEPS, len(OUTPUTS), 3)
        np.testing.assert_array_equal(results, expected(values))


def test_an_integral_over_one_substep(make):
    pool = make(time_step=0.1, samplings=("last", "integral", "last", "last", "last"))
    plain = make(time_step=0.1)
    inputs = np.full((2, 1, 3), 2.0)
    results, values = rollout(pool, inputs)[1], rollout(plain, inputs)[1]
    np.testing.assert_array_equal(results[:, 1], values[:, 1] * 0.1)
    np.testing.assert_array_equal(results[:, 0], values[:, 0])


@pytest.mark.parametrize(
    ("samplings", "fact"), [({"x": "avg"}, "'avg'"), ({"y": "mean"}, "'y'"), (["x"], "dict")]
)
def test_mistakes_are_named(samplings, fact):
    config = {"model_input_names": "f", "model_output_names": "x", "samplings": samplings}
    with pytest.raises(ConfigError, match=fact):
        PlainEnv(bundled_fmu("CartPole"), config)
