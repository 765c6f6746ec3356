"""FMUs without inputs run in every setting; a task may choose parameters instead."""

import gymnasium
import pytest
from vector_tools import require_same_alone

import fmugym

SETTINGS = [
    (hooks, isolation)
    for hooks in ("array", "per_env", "auto")
    for isolation in ("none", "process")
]
SETTINGS.append(("compiled", "none"))


class FallingEnv(fmugym.FMI2CSEnv):
    """A pendulum that nobody drives."""

    def __init__(self, **options):
        config = {
            "model_input_names": [],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": fmugym.Uniform(0.1, 1.0)},
            "time_step": 0.02,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config, **options)

    def _get_action_space(self):
        return gymnasium.spaces.Discrete(1)

    def _get_inputs(self):
        return ()

    def _is_done(self):
        return abs(self.out["q"]) > 2.0


@pytest.mark.parametrize(("hooks", "isolation"), SETTINGS)
def test_vector_equals_single(hooks, isolation):
    require_same_alone(FallingEnv, 5, hooks=hooks, isolation=isolation)
