"""The cart-pole FMU as a replacement for Gymnasium's CartPole-v1."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from fmugym.checks import check_flag
from fmugym.environment.distributions import Uniform
from fmugym.environment.env import FMUEnv
from fmugym.envs.task_numbers import TaskNumber, largest, with_task_numbers
from fmugym.fmi.bundled import bundled_fmu
from fmugym.rendering import CartPoleFrame, CartPoleScene

__all__ = ["CartPoleEnv"]

START_VALUES = ("x_0", "x_dot_0", "phi_0", "phi_dot_0")

_GYMNASIUM_PLANT = {
    "m_cart": 1.0,
    "m_pole": 0.1,
    "pole_length": 1.0,
    "pole_type": "uniform_rod",
    "g": 9.8,
    "theta_0": math.pi / 2,
    "theta_dot_0": 0.0,
    "solver": "explicit_euler",
    "max_step": 1.0,
}


_NUMBERS = {
    "force_mag": 10.0,
    "x_threshold": 2.4,
    "theta_threshold_radians": 12 * 2 * math.pi / 360,
}
"""Numbers of the task: the force in N, and the limits in m and rad."""


class CartPoleEnv(FMUEnv):
    """Balance a pole on a cart by pushing the cart left or right.

    ## Description
    A drop-in replacement for Gymnasium's ``CartPole-v1``, simulated by a compiled FMU. Spaces,
    rewards, limits, start distribution, arguments and reset options are the same. From the same
    seed and actions the observations are the same, too, bit for bit, on processors where numpy's
    sine equals the C library's.

    The plant is that of Barto, Sutton and Anderson, "Neuronlike Adaptive Elements That Can Solve
    Difficult Learning Control Problems" (1983), in the corrected equations of Florian (2005).

    ## Action Space
    ``Discrete(2)``

    | Num | Action                              |
    |-----|-------------------------------------|
    | 0   | push the cart to the left (-10 N)   |
    | 1   | push the cart to the right (+10 N)  |

    ## Observation Space
    ``Box(float32)`` of shape (4,)

    | Num | Observation             | Min               | Max              |
    |-----|-------------------------|-------------------|------------------|
    | 0   | cart position [m]       | -4.8              | 4.8              |
    | 1   | cart velocity [m/s]     | -inf              | inf              |
    | 2   | pole angle [rad]        | -0.418 (-24 deg)  | 0.418 (24 deg)   |
    | 3   | pole velocity [rad/s]   | -inf              | inf              |

    ## Rewards
    +1 for each step, including the last one. With ``sutton_barto_reward=True``: -1 for the step
    that ends the task, and 0 for all others.

    ## Starting State
    Each of the four values uniform in [-0.05, 0.05). The reset options ``low`` and ``high``
    change the bounds for one episode.

    ## Episode End
    Terminated when the cart is more than 2.4 m from the centre or the pole leans more than
    12 degrees; truncated after 500 steps of 0.02 s (by ``gymnasium.make``).

    ## Arguments
    * ``sutton_barto_reward``: see above.
    * ``fmi_version``: which FMU to use: "1.0", "2.0" (default) or "3.0".
    * ``model_parameters``: values or distributions that override those of Gymnasium's plant, or
      the task's ``force_mag`` [N], ``x_threshold`` [m] and ``theta_threshold_radians``.
    * ``render_mode``: "human", "rgb_array" or None.
    * ``options``: more arguments of ``FMUEnv``, such as ``isolation``.

    ## Version History
    * v0: Initial version, equal to Gymnasium's v1.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012  (see FMUEnv)
    steps_after_end: ClassVar[bool] = True
    reset_options: ClassVar[tuple[str, ...]] = ("model_parameters", "low", "high")

    force_mag, x_threshold, theta_threshold_radians = TaskNumber(), TaskNumber(), TaskNumber()

    def __init__(
        self,
        sutton_barto_reward: bool = False,
        render_mode: str | None = None,
        *,
        fmi_version: str | float = "2.0",
        model_parameters: Mapping[str, Any] | None = None,
        log_level: int = logging.WARNING,
        **options: Any,
    ) -> None:
        is_sutton_barto = check_flag("sutton_barto_reward", sutton_barto_reward)
        given = {} if model_parameters is None else model_parameters
        parameters, numbers = with_task_numbers(_NUMBERS, given)
        start = {name: Uniform(-0.05, 0.05) for name in START_VALUES}
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "phi", "phi_dot"],
            "model_parameters": {**start, **_GYMNASIUM_PLANT, **parameters},
            "episode_variables": numbers,
            "time_step": 0.02,
            "inputs": {"f": "force_mag * (2 * action - 1)"},
            "terminated": "abs(x) > x_threshold or abs(phi) > theta_threshold_radians",
            "reward": "0 - done" if is_sutton_barto else "1 - (done and after_end)",
        }
        fmu_path = bundled_fmu("CartPole", fmi_version)
        super().__init__(fmu_path, config, log_level, render_mode=render_mode, **options)

    def _get_action_space(self) -> spaces.Space[Any]:
        return spaces.Discrete(2)

    def _get_observation_space(self) -> spaces.Space[Any]:
        numbers = self.config.episode_variables
        x, theta = (
            2 * largest(numbers[name]) for name in ("x_threshold", "theta_threshold_radians")
        )
        high = np.array([x, math.inf, theta, math.inf], dtype=np.float32)
        return spaces.Box(-high, high, dtype=np.float32)

    def _get_episode_parameters(self, options: Mapping[str, Any]) -> Mapping[str, Any]:
        parameters = dict(super()._get_episode_parameters(options))
        if "low" in options or "high" in options:
            start = Uniform(options.get("low", -0.05), options.get("high", 0.05))
            parameters |= dict.fromkeys(START_VALUES, start)
        return parameters

    def _get_scene(self) -> CartPoleScene:
        return CartPoleScene(self.x_threshold, 1.0, self.theta_threshold_radians)

    def _get_frame(self) -> CartPoleFrame:
        x, _, theta, _ = self.state
        return CartPoleFrame(x, theta, self.inputs[0])

    def _describe_action(self) -> str:
        return f"{self.inputs[0]:+.1f} N"
