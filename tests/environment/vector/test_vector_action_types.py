"""Actions of all types that spaces have: hooks on arrays give what they give one by one."""

import gymnasium as gym
import numpy as np
from combinations import in_turn
from vector_tools import Drawing, require_pair_equal

SPACES = {
    "float64": gym.spaces.Box(-1.0, 1.0, (2, 3), np.float64),
    "float32": gym.spaces.Box(-1.0, 1.0, (2,), np.float32),
    "int64": gym.spaces.Box(-5, 5, (2,), np.int64),
    "discrete": gym.spaces.Discrete(4, start=-1),
    "multi": gym.spaces.MultiDiscrete([3, 5]),
    "binary": gym.spaces.MultiBinary(3),
    "float16": gym.spaces.Box(-1.0, 1.0, (2,), np.float16),
    "int32": gym.spaces.Box(-5, 5, (2,), np.int32),
    "uint8": gym.spaces.Box(0, 255, (2,), np.uint8),
    "int16": gym.spaces.Box(-5, 5, (2,), np.int16),
}


class Acting(Drawing):
    def _get_inputs(self):
        return [0.001 * np.sum(np.reshape(self.action, (-1, *np.shape(self.state[0]))), axis=0)]

    def _get_observation_space(self):
        return gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def _get_observation(self):
        flat = np.reshape(self.action, (-1, *np.shape(self.state[0])))
        before = np.reshape(self.previous_action, (-1, *np.shape(self.state[0])))
        return np.array([0.25 * flat[0], 0.5 * before[-1], self.inputs[0]])


@in_turn({"name": list(SPACES), "mode": list(gym.vector.AutoresetMode)})
def test_actions_of_all_types(name, mode):
    own = type("Own", (Acting,), {"_get_action_space": lambda self: SPACES[name]})
    assert require_pair_equal(own, steps=25, mode=mode, rtol=1e-6) > 8
