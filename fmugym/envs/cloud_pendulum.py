"""Cell of the CloudPendulum lab as a Gymnasium environment: simulated by an FMU, or remote.

Cells are backends. They use the methods of the published client only. So the client of the real lab
fits as well as that of the simulated lab, and neither is imported here.
"""

from __future__ import annotations

import importlib
import logging
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium import spaces

from fmugym.checks import check_mapping, check_number, check_text, has_method, number_of
from fmugym.environment.distributions import Uniform
from fmugym.environment.env import FMUEnv
from fmugym.envs.task_numbers import TaskNumber
from fmugym.errors import ConfigError, shown
from fmugym.fmi.bundled import bundled_fmu
from fmugym.fmi.status import Status
from fmugym.pool import Paced
from fmugym.pool.rig.clocks import RealClock
from fmugym.rendering import PendulumFrame, PendulumScene

__all__ = ["CellBackend", "CloudPendulumEnv", "Lease", "paced_cells"]

logger = logging.getLogger(__name__)

EXPERIMENT: Final = "SimplePendulum"

_DEFAULT_GYM_TIME: Final = 600.0  # s, of leases for several cells

_ANY_USER: Final = "fmugym"  # by default the simulated lab takes any user token

_METHODS: Final = (
    "start_experiment",
    "stop_experiment",
    "get_position",
    "get_velocity",
    "set_torque",
    "set_impedance_controller_params",
)
"""Methods of every client; methods about leases are needed for leases only."""

_LEAVING = re.compile("(Position|Velocity) ?Limit ?Violation")
"""The lab's message that it has ended a session because the arm passed a limit."""


def paced_cells(
    client: Any,
    user_token: str | None,
    gym_token: str | None,
    gym_time: float | None,
    session_time: float,
) -> Paced:
    """Make cells that are stepped in the lab's time.

    Args:
        client: A client of a lab.
        user_token: For experiments, or for a new lease.
        gym_token: The token of an existing lease.
        gym_time: Length of a new lease, in s.
        session_time: Longest time of an episode, in s.

    Raises:
        ConfigError: If that is no client, or the tokens or times do not fit.
    """
    if not _is_client(client):
        raise ConfigError(
            "backend must be 'fmu', or a client of the lab such as fmugym.lab.Client(), "
            f"not {shown(client)}"
        )
    lab = _simulated_lab(client)
    if user_token is None and gym_token is None:
        if lab is None:
            raise ConfigError("the lab needs user_token= or gym_token=")
        user_token = _ANY_USER
    if gym_token is not None and (user_token is not None or gym_time is not None):
        raise ConfigError("gym_token= names a lease: give no user_token and no gym_time with it")
    for name, token in (("user_token", user_token), ("gym_token", gym_token)):
        if token is not None:
            check_text(name, token)
    session_time = check_number("session_time", session_time, positive=True)
    if gym_time is not None:
        gym_time = check_number("gym_time", gym_time, positive=True)
    lease = Lease(client, user_token, gym_token, gym_time, session_time)
    return Paced(lease, RealClock() if lab is None else lab.clock)


@dataclass(eq=False, repr=False)  # which would show the tokens
class Lease:
    """The source of the cells' sessions. A call with a number returns that many cells.

    Args:
        client: The client; each cell gets its own client of the same kind.
        user_token: The user of the experiments or of the lease.
        gym_token: An existing lease, which is not stopped.
        gym_time: Length of the lease that `open` makes and `close` stops, in s. None: a lease is
            made for several cells only.
        session_time: Longest time of an episode, in s.
    """

    client: Any
    user_token: str | None
    gym_token: str | None
    gym_time: float | None
    session_time: float
    _count: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self._is_own = self.gym_token is None

    def __call__(self, count: int) -> list[CellBackend]:
        """Make backends for a number of cells."""
        self._count = count
        if count > 1 and self.gym_time is None:
            self.gym_time = _DEFAULT_GYM_TIME
        return [CellBackend(self, _like(self.client)) for _ in range(count)]

    def open(self) -> None:
        """Make the lease if one is needed and there is none."""
        if self.gym_time is not None and self.gym_token is None:
            cell_types = [_cell_type(self.client)] * self._count
            self.gym_token = self.client.start_gym(self.user_token, self.gym_time, cell_types)

    def close(self) -> None:
        """Stop the lease if it was made here."""
        if self._is_own and self.gym_token is not None:
            gym_token, self.gym_token = self.gym_token, None
            self.client.stop_gym(gym_token)

    def start(self, client: Any, angle: float) -> tuple[str, bool]:
        """Start a session at an angle in rad; returns its token and whether a lease has it."""
        is_leased = self.gym_token is not None
        start = client.start_episode if is_leased else client.start_experiment
        owner = self.gym_token if is_leased else self.user_token
        token, _ = start(owner, EXPERIMENT, self.session_time, 0.0, initial_position=[angle])
        return token, is_leased


class CellBackend:
    """A cell as a backend: it reads position and velocity at the tick, then sets the torque.

    See ``Backend``.

    Args:
        lease: Makes its sessions.
        client: A client for the thread that steps it.
    """

    def __init__(self, lease: Lease, client: Any) -> None:
        self._lease, self._client = lease, client
        self._session: tuple[str, bool] | None = None
        self._outputs: dict[str, float] = {}

    def reset(self, start_values: Mapping[str, float]) -> dict[str, float]:
        """Start a session in torque control, with the torque zero."""
        self._end_session()
        client = self._client
        self._session = self._lease.start(client, start_values["q_0"])
        token = self._session[0]
        client.set_impedance_controller_params(0.0, 0.0, token)
        client.set_torque(0.0, token)
        return self._read(token)

    def step(self, inputs: Mapping[str, float]) -> tuple[dict[str, float], Status]:
        """Read the arm and set the torque that acts until the next step.

        Returns:
            The outputs and a status. If the lab has ended the session because the arm passed a
            limit, these are the last outputs and ``TERMINATED``.
        """
        token = self._token()
        try:
            outputs = self._read(token)
            self._client.set_torque(inputs["tau"], token)
        except RuntimeError as error:
            if _LEAVING.search(str(error)) is None:
                raise
            return self._outputs, Status.TERMINATED
        return outputs, Status.OK

    def hold(self) -> None:
        """Set the torque to zero, which also keeps the session alive."""
        self._client.set_torque(0.0, self._token())

    def stop(self) -> None:
        """End the session."""
        self._end_session()

    def _token(self) -> str:
        if self._session is None:
            raise RuntimeError("the cell has no session")
        return self._session[0]

    def _read(self, token: str) -> dict[str, float]:
        q, q_dot = self._client.get_position(token), self._client.get_velocity(token)
        self._outputs = {"q": q, "q_dot": q_dot}
        return self._outputs

    def _end_session(self) -> None:
        if self._session is None:
            return
        (token, is_leased), self._session = self._session, None
        try:
            self._client.set_torque(0.0, token)
        except Exception as error:  # whatever it is, the session is to be stopped
            logger.debug("the torque was not taken away: %s", error)
        stop = self._client.stop_episode if is_leased else self._client.stop_experiment
        try:
            stop(token)
        except RuntimeError as error:
            logger.debug("the session was not stopped: %s", error)


def _is_client(client: Any) -> bool:
    return all(has_method(client, method) for method in _METHODS)


def _simulated_lab(client: Any) -> Any:
    """Return the simulated lab, which has a clock, of a client; None for other clients."""
    lab = getattr(client, "lab", None)
    return lab if hasattr(lab, "clock") else None


def _like(client: Any) -> Any:
    """Make a client of the same lab, because each thread needs its own."""
    lab = _simulated_lab(client)
    return type(client)() if lab is None else type(client)(lab)


def _cell_type(client: Any) -> Any:
    """Return the cell type with one joint, from the package of the client."""
    package = type(client).__module__.rpartition(".")[0]
    try:
        return importlib.import_module(f"{package}.data").CellType.SINGLE
    except (ImportError, AttributeError, ValueError):
        name = type(client).__name__
        raise ConfigError(
            f"{package or name} has no data.CellType: make the lease yourself and give gym_token="
        ) from None


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
