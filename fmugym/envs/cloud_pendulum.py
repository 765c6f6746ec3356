"""A cell of the CloudPendulum lab as a Gymnasium environment: simulated by an FMU, or remote."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium import spaces

from fmugym.archive.bundled import bundled_fmu
from fmugym.checks import check_mapping, number_of
from fmugym.distributions import Uniform
from fmugym.env import FMUEnv
from fmugym.envs.cells import paced_cells
from fmugym.envs.task_numbers import TaskNumber
from fmugym.errors import ConfigError
from fmugym.rendering import PendulumFrame, PendulumScene

__all__ = ["CloudPendulumEnv"]

TIME_STEP: Final = 0.02
"""Control period in s."""

PLATFORM_TORQUE: Final = 0.15
"""Largest torque of a cell's drive, in N m."""

POSITION_LIMIT: Final = math.tau
"""Angle from hanging at which the lab ends a session, in rad."""

VELOCITY_LIMIT: Final = 50.0
"""Angular velocity at which the lab ends a session, in rad/s."""

_FMU_PARAMETERS: Final = {
    "theta_dot_max": 1000.0,  # rad/s: beyond the limit at which an episode ends
    "max_step": 0.002,  # s: error after 10 s 1e-4 rad with Coulomb friction, 4e-8 without
}

_VELOCITY_WEIGHT: Final = 0.1 * 15.0 / 98.1
_EFFORT_WEIGHT: Final = 0.001 * 2.0**2


class CloudPendulumEnv(FMUEnv):
    """Swing the pendulum of a CloudPendulum cell up and hold it upright.

    ## Description
    A pendulum of 0.06 kg and 0.1 m hangs at a motor. A controller sets the motor's torque 50 times
    a second. ``backend`` chooses where the environment runs: on the bundled FMU, on a cell of the
    simulated lab, or on a cell of the real lab.

    **Timing.** Observation k is sampled at the tick ``t_k = t_0 + k * 0.02 s``. The action computed
    from it takes effect at the next tick and lasts until the one after. So observation k + 2 is the
    first to show it. On the FMU these times are exact. In the lab each tick starts three requests,
    one after the other: position, velocity, torque.

    ## Action Space
    ``Box(-1.0, 1.0, (1,), float32)``

    | Num | Action                                                        | Min  | Max |
    |-----|---------------------------------------------------------------|------|-----|
    | 0   | torque in parts of ``torque_limit``, counter-clockwise positive | -1.0 | 1.0 |

    ## Observation Space
    ``Box(float32)`` of shape (3,); q is the angle from hanging, counter-clockwise positive

    | Num | Observation               | Min   | Max  |
    |-----|---------------------------|-------|------|
    | 0   | cos q                     | -1.0  | 1.0  |
    | 1   | sin q                     | -1.0  | 1.0  |
    | 2   | angular velocity [rad/s]  | -50.0 | 50.0 |

    ## Rewards
    ``-(theta^2 + 0.0153 q_dot^2 + 0.004 action^2)`` with theta, the angle from upright, normalized
    to [-pi, pi), and the velocity, both before the step. That is the reward of Gymnasium's
    ``Pendulum-v1`` in the units of this plant. The velocity counts relative to the natural
    frequency, whose square is 3 g / (2 l) = 15 there and g / l = 98.1 here; the torque counts
    relative to its limit. The step that violates a limit of the platform gets 1000 less. That is a
    little more than hanging still for ever costs at a discount of 0.99.

    ## Starting State
    At rest, q uniform in [-0.05, 0.05) rad. The arm of a lab's cell sags a little before the
    episode begins.

    ## Episode End
    Terminated when q is more than 2 pi or q_dot more than 50 rad/s from zero, as the lab ends a
    session there. Truncated after 500 steps, 10 s (by ``gymnasium.make``), and by faults.

    ## Information
    ``info`` has ``sample_age``, the age of the observation in s when ``step`` returned it; on the
    FMU it is 0. In the lab ``info`` also has ``deadline_misses`` (of this episode) and
    ``worst_lateness`` (in s). A late step delays the steps that follow. While no step comes, the
    torque is zero and the session is kept alive.

    ## Arguments
    * ``torque_limit``: the torque of an action of 1, at most 0.15 N m.
    * ``backend``: "fmu", or a client: ``fmugym.lab.Client()`` or the real
      ``cloudpendulumclient.client.Client()``.
    * ``model_parameters``: values or distributions for the FMU's parameters, such as ``l``, ``b``
      and ``c``. In the lab only ``q_0``, the start angle, can be given.
    * ``user_token``: the lab's user token, which the simulated lab does not need. Each episode is
      an experiment of its own, or an episode of a lease if ``gym_time`` is given.
    * ``gym_token``: a lease that you have already, instead of a user token. It is not stopped.
    * ``gym_time``: length in s of the lease that the first reset makes and ``close`` stops. A
      vector environment always makes one, of 600 s by default.
    * ``session_time``: longest time of an episode in the lab, in s, including pauses.
    * ``fmi_version``: which FMU to use: "1.0", "2.0" (default) or "3.0".
    * ``render_mode``: "human", "rgb_array" or None.
    * ``options``: more arguments of ``FMUEnv``, such as ``isolation``.

    ## Version History
    * v0: Initial version.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012  (see FMUEnv)
    render_size: ClassVar[tuple[int, int]] = (500, 500)

    torque_limit, limit_penalty = TaskNumber(), TaskNumber()

    def __init__(
        self,
        render_mode: str | None = None,
        torque_limit: float = PLATFORM_TORQUE,
        *,
        backend: Any = "fmu",
        model_parameters: Mapping[str, Any] | None = None,
        user_token: str | None = None,
        gym_token: str | None = None,
        gym_time: float | None = None,
        session_time: float = 30.0,
        fmi_version: str | float = "2.0",
        log_level: int = logging.WARNING,
        **options: Any,
    ) -> None:
        limit = number_of("torque_limit", torque_limit)
        if not 0.0 < limit <= PLATFORM_TORQUE:
            raise ConfigError(
                f"torque_limit must be more than 0 and at most {PLATFORM_TORQUE} N m, got {limit}"
            )
        self._in_lab = not isinstance(backend, str) or backend == "lab"  # an error will say how
        given = {} if model_parameters is None else model_parameters
        given = check_mapping("model_parameters", given)
        self._require_settable(given)
        if self._in_lab:
            backend = paced_cells(backend, user_token, gym_token, gym_time, session_time)
        plant = {} if self._in_lab else _FMU_PARAMETERS
        chosen = "clip(action[0], -1, 1)"
        torque = f"torque_limit * {chosen}"  # in the lab, the cells wait for the tick
        if not self._in_lab:  # the product with 0 refuses a NaN at once
            torque = f"torque_limit * clip(previous(action[0]), -1, 1) + 0 * {torque}"
        velocity = f"{_VELOCITY_WEIGHT} * previous(q_dot)**2"
        effort = f"{_EFFORT_WEIGHT} * (torque_limit * {chosen} / torque_limit)**2"
        cost = f"(previous(q) % (2 * pi) - pi)**2 + {velocity} + {effort}"
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": Uniform(-0.05, 0.05), **plant, **given},
            "episode_variables": {"torque_limit": limit, "limit_penalty": 1000.0},
            "time_step": TIME_STEP,
            "inputs": {"tau": torque},
            "terminated": f"abs(q) > {POSITION_LIMIT} or abs(q_dot) > {VELOCITY_LIMIT}",
            "reward": f"-({cost}) - limit_penalty * done",
            "observations": [
                "cos(q)",
                "sin(q)",
                f"clip(q_dot, -{VELOCITY_LIMIT}, {VELOCITY_LIMIT})",
            ],
            "info": {} if self._in_lab else {"sample_age": 0},
        }
        super().__init__(
            bundled_fmu("Pendulum", fmi_version),
            config,
            log_level,
            render_mode=render_mode,
            backend=backend if self._in_lab or backend != "fmu" else None,
            **options,
        )

    def _require_settable(self, names: Mapping[str, Any]) -> None:
        """Refuse parameters that no request to the lab can set."""
        for name in names:
            if self._in_lab and name != "q_0":
                raise ConfigError(
                    f"{name!r} cannot be set in the lab, only 'q_0', the start angle: a cell's "
                    "parameters are fixed, and its arm starts at rest"
                )

    def _get_action_space(self) -> spaces.Space[Any]:
        return spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)

    def _get_observation_space(self) -> spaces.Space[Any]:
        high = np.array([1.0, 1.0, VELOCITY_LIMIT], dtype=np.float32)
        return spaces.Box(-high, high, dtype=np.float32)

    def _get_episode_parameters(self, options: Mapping[str, Any]) -> Mapping[str, Any]:
        parameters = super()._get_episode_parameters(options)
        self._require_settable(parameters)
        return parameters

    def _get_scene(self) -> PendulumScene:
        return PendulumScene(torque_limit=self.torque_limit)

    def _get_frame(self) -> PendulumFrame:
        return PendulumFrame(self.state[0] - math.pi, self._present_torque())

    def _describe_action(self) -> str:
        return f"{self._present_torque():+.3f} N m"

    def _present_torque(self) -> float:
        """The torque of the action before, which acts now, in N m."""
        return float(self.torque_limit * np.clip(self.previous_action[0], -1.0, 1.0))
