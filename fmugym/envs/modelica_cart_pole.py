"""The cart-pole of the ModelicaGym study: plant, task and class names of its tutorial."""

from __future__ import annotations

import logging
import math
import os
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.checks import check_number
from fmugym.environment.env import FMI1CSEnv, FMI2CSEnv, FMUEnv
from fmugym.envs.task_numbers import TaskNumber
from fmugym.fmi.bundled import bundled_fmu
from fmugym.rendering import CartPoleFrame, CartPoleScene

__all__ = ["DymolaCSCartPoleEnv", "JModelicaCSCartPoleEnv", "ModelicaCartPoleEnv"]

THETA_0 = math.radians(85)
"""Lean of the pole at the start, from the positive x-axis, in rad."""


_NUMBERS: Final = {"x_threshold": 2.4, "theta_threshold": math.radians(12)}
"""The limits of the task in m and rad."""


class ModelicaCartPoleEnv(FMUEnv):
    """Balance a heavy pole that starts at a lean of 5 degrees, as in the ModelicaGym study.

    ## Description
    A cart of 10 kg carries a cylinder of 1 m and 1.77 kg with a point mass of 1 kg at its end.
    The angle theta counts from the positive x-axis, counter-clockwise, so that pi/2 is upright.
    Plant and task follow Lukianykhin and Bogodorova, "ModelicaGym: Applying Reinforcement
    Learning to Modelica Models" (2019); there is no friction, g is 9.81 m/s^2.

    ## Action Space
    ``Discrete(2)``

    | Num | Action                               |
    |-----|--------------------------------------|
    | 0   | push the cart to the left (-force)   |
    | 1   | push the cart to the right (+force)  |

    ## Observation Space
    ``Box(float32)`` of shape (4,), centred on the upright pole

    | Num | Observation                 | Min              | Max              |
    |-----|-----------------------------|------------------|------------------|
    | 0   | cart position x [m]         | -4.8             | 4.8              |
    | 1   | cart velocity [m/s]         | -inf             | inf              |
    | 2   | pole angle theta [rad]      | pi/2 - 24 deg    | pi/2 + 24 deg    |
    | 3   | pole velocity [rad/s]       | -inf             | inf              |

    ## Rewards
    ``negative_reward`` (-100) for the step that ends the task, ``positive_reward`` (+1) for all
    others.

    ## Starting State
    The cart is at rest in the centre. The pole is at the angle ``theta_0`` (85 degrees) with the
    velocity ``theta_dot_0`` (0). Every parameter may be a distribution.

    ## Episode End
    Terminated when the cart is more than 2.4 m from the centre or the pole leans more than
    12 degrees; truncated after 200 steps (by ``gymnasium.make``).

    ## Arguments
    * ``m_cart``, ``m_pole`` [kg], ``theta_0`` [rad], ``theta_dot_0`` [rad/s]: the plant.
    * ``time_step`` [s], ``positive_reward``, ``negative_reward``, ``force`` [N]: the task.
    * ``log_level``: level of the class's logger.
    * ``fmu_path``: an FMU with the same variables; by default the bundled one.
    * ``fmi_version``: "1.0", "2.0" (default) or "3.0", which of the bundled FMUs.
    * ``render_mode``: "human", "rgb_array" or None.
    * ``options``: more arguments of ``FMUEnv``, such as ``isolation``.

    ## Version History
    * v0: Initial version.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012  (see FMUEnv)

    force, x_threshold, theta_threshold = TaskNumber(), TaskNumber(), TaskNumber()

    def __init__(
        self,
        m_cart: Any = 10.0,
        m_pole: Any = 1.0,
        theta_0: Any = THETA_0,
        theta_dot_0: Any = 0.0,
        time_step: float = 0.05,
        positive_reward: float = 1.0,
        negative_reward: float = -100.0,
        force: float = 12.0,
        log_level: int = logging.WARNING,
        fmu_path: str | os.PathLike[str] | None = None,
        *,
        fmi_version: str | float = "2.0",
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        names = self._variable_names(own_fmu=fmu_path is not None)
        numbers = {"force": check_number("force", force), **_NUMBERS}
        x, _, theta, _ = names["outputs"]
        parameters = (m_cart, m_pole, theta_0, theta_dot_0)
        config = {
            "model_input_names": names["input"],
            "model_output_names": names["outputs"],
            "model_parameters": dict(zip(names["parameters"], parameters, strict=True)),
            "episode_variables": numbers,
            "time_step": time_step,
            "inputs": {names["input"]: "force * (2 * action - 1)"},
            "terminated": f"abs({x}) > x_threshold or abs({theta} - pi / 2) > theta_threshold",
            "positive_reward": positive_reward,
            "negative_reward": negative_reward,
        }
        path = bundled_fmu("CartPole", fmi_version) if fmu_path is None else fmu_path
        super().__init__(path, config, log_level, render_mode=render_mode, **options)

    def _variable_names(self, own_fmu: bool) -> dict[str, Any]:
        """The FMU's names for the input, the outputs and the parameters of the constructor."""
        return {
            "input": "f",
            "outputs": ["x", "x_dot", "theta", "theta_dot"],
            "parameters": ["m_cart", "m_pole", "theta_0", "theta_dot_0"],
        }

    def _get_action_space(self) -> spaces.Space[Any]:
        return spaces.Discrete(2)

    def _get_observation_space(self) -> spaces.Space[Any]:
        centre = np.array([0.0, 0.0, np.pi / 2, 0.0])
        x, theta = _NUMBERS["x_threshold"], _NUMBERS["theta_threshold"]
        reach = np.array([2 * x, np.inf, 2 * theta, np.inf])
        low, high = (centre - reach).astype(np.float32), (centre + reach).astype(np.float32)
        return spaces.Box(low, high, dtype=np.float32)

    def _get_scene(self) -> CartPoleScene:
        return CartPoleScene(self.x_threshold, 1.0, self.theta_threshold, self.force)

    def _get_frame(self) -> CartPoleFrame:
        x, _, theta, _ = self.state
        return CartPoleFrame(x, math.pi / 2 - theta, self.inputs[0])

    def _describe_action(self) -> str:
        return f"{self.inputs[0]:+.1f} N"


class JModelicaCSCartPoleEnv(ModelicaCartPoleEnv, FMI2CSEnv):
    """The task with an FMU of FMI 2.0 that JModelica exported."""


class DymolaCSCartPoleEnv(ModelicaCartPoleEnv, FMI1CSEnv):
    """The task with an FMU of FMI 1.0 that Dymola exported.

    The arguments are those of ``ModelicaCartPoleEnv``, with the variables' names in Dymola's
    export. Without ``fmu_path`` the environment uses the bundled FMU of FMI 1.0, whose variables
    have the names of the bundled model.
    """

    def __init__(
        self,
        m_trolley: Any = 10.0,
        m_load: Any = 1.0,
        phi1_start: Any = THETA_0,
        w1_start: Any = 0.0,
        *task: Any,
        **options: Any,
    ) -> None:
        super().__init__(
            m_trolley, m_load, phi1_start, w1_start, *task, fmi_version="1.0", **options
        )

    def _variable_names(self, own_fmu: bool) -> dict[str, Any]:
        if not own_fmu:
            return super()._variable_names(own_fmu)
        return {
            "input": "u",
            "outputs": ["s", "v", "phi1", "w"],
            "parameters": ["m_trolley", "m_load", "phi1_start", "w1_start"],
        }
