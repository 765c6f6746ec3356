"""Vector environments are copied, pickled and closed."""

import numpy as np
import pytest
from vector_tools import Drawing, each_way

from fmugym import SimulationError
from fmugym.vector import FMUVectorEnv


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
