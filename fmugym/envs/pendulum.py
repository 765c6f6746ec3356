"""The pendulum FMU as a replacement for Gymnasium's Pendulum-v1."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from fmugym.environment.distributions import Uniform
from fmugym.environment.env import FMUEnv
from fmugym.envs.task_numbers import TaskNumber, largest, with_task_numbers
from fmugym.fmi.bundled import bundled_fmu
from fmugym.rendering import PendulumFrame, PendulumScene

__all__ = ["PendulumEnv"]

_GYMNASIUM_PLANT = {
    "m": 1.0,
    "l": 1.0,
    "body": "uniform_rod",
    "b": 0.0,
    "c": 0.0,
    "tau_max": 2.5,  # the environment limits the torque itself, to 2 N m, before rounding it
    "theta_dot_max": 8.0,
    "solver": "semi_implicit_euler",
    "max_step": 1.0,
}


_NUMBERS = {"max_speed": 8.0, "max_torque": 2.0}
"""Numbers of the task: the limits of the observation in rad/s, and of the torque in N m."""

_TORQUE = "clip(action[0], -max_torque, max_torque)"

_ANGLE = "((previous(theta) + pi) % (2 * pi) - pi)"


class PendulumEnv(FMUEnv):
    """Swing a rod up and hold it upright, with a torque too weak to lift it directly.

    ## Description
    A drop-in replacement for Gymnasium's ``Pendulum-v1``, simulated by a compiled FMU. Spaces,
    rewards, limits, start distribution, arguments and reset options are the same. From the same
    seed and actions the observations and rewards are the same, too, bit for bit, on processors
    where numpy's sine equals the C library's. The plant is a uniform rod of 1 kg and 1 m on a
    frictionless pivot.

    ## Action Space
    ``Box(-2.0, 2.0, (1,), float32)``

    | Num | Action                                    | Min  | Max |
    |-----|-------------------------------------------|------|-----|
    | 0   | torque [N m], counter-clockwise positive  | -2.0 | 2.0 |

    ## Observation Space
    ``Box(float32)`` of shape (3,); theta is the angle from upright, counter-clockwise positive

    | Num | Observation               | Min  | Max |
    |-----|---------------------------|------|-----|
    | 0   | cos theta                 | -1.0 | 1.0 |
    | 1   | sin theta                 | -1.0 | 1.0 |
    | 2   | angular velocity [rad/s]  | -8.0 | 8.0 |

    ## Rewards
    ``-(theta^2 + 0.1 theta_dot^2 + 0.001 torque^2)`` with the angle, normalized to [-pi, pi), and
    the velocity before the step.

    ## Starting State
    The angle uniform in [-pi, pi), the velocity in [-1, 1). The reset options ``x_init`` and
    ``y_init`` replace the bounds pi and 1 for one episode.

    ## Episode End
    Never terminated; truncated after 200 steps of 0.05 s (by ``gymnasium.make``).

    ## Arguments
    * ``g``: acceleration of gravity in m/s^2, by default 10.
    * ``fmi_version``: which FMU to use: "1.0", "2.0" (default) or "3.0".
    * ``model_parameters``: values or distributions that override those of Gymnasium's plant, or
      the task's ``max_torque`` [N m] and ``max_speed`` [rad/s].
    * ``render_mode``: "human", "rgb_array" or None.
    * ``options``: more arguments of ``FMUEnv``, such as ``isolation``.

    ## Version History
    * v0: Initial version, equal to Gymnasium's v1.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012  (see FMUEnv)
    steps_after_end: ClassVar[bool] = True
    reset_options: ClassVar[tuple[str, ...]] = ("model_parameters", "x_init", "y_init")
    render_size: ClassVar[tuple[int, int]] = (500, 500)

    max_speed, max_torque = TaskNumber(), TaskNumber()

    def __init__(
        self,
        render_mode: str | None = None,
        g: float = 10.0,
        *,
        fmi_version: str | float = "2.0",
        model_parameters: Mapping[str, Any] | None = None,
        log_level: int = logging.WARNING,
        **options: Any,
    ) -> None:
        given = {} if model_parameters is None else model_parameters
        parameters, numbers = with_task_numbers(_NUMBERS, given)
        start = {"theta_0": Uniform(-np.pi, np.pi), "theta_dot_0": Uniform(-1.0, 1.0)}
        # Gymnasium rounds 3 * u to float32. The FMU computes 3 / (m l^2) * tau in float64: three
        # times a third of a float64 is exact. Its squares are those of the functions of C.
        effort = f"float32(float32(0.001) * powf({_TORQUE}, 2))"
        config = {
            "model_input_names": "tau",
            "model_output_names": ["theta", "theta_dot"],
            "model_parameters": {**start, **_GYMNASIUM_PLANT, "g": g, **parameters},
            "episode_variables": numbers,
            "time_step": 0.05,
            "inputs": {"tau": f"float32(3 * {_TORQUE}) / 3"},
            "terminated": False,
            "reward": f"-(pow({_ANGLE}, 2) + 0.1 * pow(previous(theta_dot), 2) + {effort})",
            "observations": ["cos(theta)", "sin(theta)", "theta_dot"],
        }
        fmu_path = bundled_fmu("Pendulum", fmi_version)
        super().__init__(fmu_path, config, log_level, render_mode=render_mode, **options)

    def _get_action_space(self) -> spaces.Space[Any]:
        limit = largest(self.config.episode_variables["max_torque"])
        return spaces.Box(-limit, limit, shape=(1,), dtype=np.float32)

    def _get_observation_space(self) -> spaces.Space[Any]:
        max_speed = largest(self.config.episode_variables["max_speed"])
        high = np.array([1.0, 1.0, max_speed], dtype=np.float32)
        return spaces.Box(-high, high, dtype=np.float32)

    def _get_episode_parameters(self, options: Mapping[str, Any]) -> Mapping[str, Any]:
        parameters = dict(super()._get_episode_parameters(options))
        for option, name in (("x_init", "theta_0"), ("y_init", "theta_dot_0")):
            if option in options:
                limit = Uniform(0.0, options[option]).high  # which checks it
                parameters[name] = Uniform(-limit, limit)
        return parameters

    def _get_scene(self) -> PendulumScene:
        return PendulumScene(torque_limit=self.max_torque)

    def _get_frame(self) -> PendulumFrame:
        return PendulumFrame(self.state[0], self.inputs[0])

    def _describe_action(self) -> str:
        return f"{self.inputs[0]:+.2f} N m"
