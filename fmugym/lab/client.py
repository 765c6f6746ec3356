"""The client: the interface of a program to the lab."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fmugym.errors import ConfigError, shown
from fmugym.lab.current import CURRENT
from fmugym.lab.data import ActuatorInfo, CellInfo, CellType, UserInfo
from fmugym.lab.disturbance import Disturbance
from fmugym.lab.lab_error import LabError
from fmugym.lab.request_checks import Request
from fmugym.lab.service import Service
from fmugym.signals import ordinary

__all__ = ["Client"]

Disturbances = str | Disturbance | Sequence[Disturbance] | None
Reading = float | list[float]


class Client:
    """A client of the simulated lab, with the methods of the real lab's client.

    Create one for each thread. Every failure raises `LabError`, which is a RuntimeError. Angles are
    0 hanging and positive counter-clockwise.

    Args:
        lab: A `Lab`. By default the lab of ``with lab:``, or else the default lab of the process,
            which the first such client creates.

    Raises:
        ConfigError: If the argument is not a lab.
    """

    def __init__(self, lab: Service | None = None) -> None:
        if lab is not None and not isinstance(lab, Service):
            raise ConfigError(f"a client needs a Lab, not {shown(lab)}")
        self._lab = CURRENT.get() if lab is None else lab

    @property
    def lab(self) -> Service:
        """The lab that this client uses."""
        return self._lab

    def get_user_info(self, user_token: str) -> UserInfo:
        """Return a user's rights, and how much of them is left."""
        return self._lab.user_info(user_token)

    def get_cells(self, user_token: str) -> list[CellInfo]:
        """Return all cells of the lab."""
        return self._lab.cell_infos(user_token)

    def start_gym(self, user_token: str, gym_time: float, cell_types: Sequence[CellType]) -> str:
        """Reserve cells, and wait until enough are free. The log shows the livestream's address.

        Args:
            user_token: The token of a user with gym permission.
            gym_time: Length of the lease, in s. `stop_gym` ends it earlier.
            cell_types: The type of each cell.

        Returns:
            The gym token.
        """
        return self._lab.start_gym(user_token, gym_time, cell_types)

    def stop_gym(self, gym_token: str) -> None:
        """End a lease and its running episodes. It may already have ended by time."""
        self._lab.stop_gym(gym_token)

    def start_experiment(
        self,
        user_token: str,
        experiment_type: str,
        experiment_time: float,
        preparation_time: float = 0.0,
        record: bool = False,
        initial_state: Sequence[float] | None = None,
        *,
        initial_position: Sequence[float] | float | None = None,
        cell_id: int | None = None,
        disturbances: Disturbances = None,
    ) -> tuple[str, str]:
        """Start an experiment on a cell, and return when it has begun.

        Args:
            user_token: The token of the user.
            experiment_type: "DoubleIntegrator", "SimplePendulum", "DoublePendulum", "Acrobot" or
                "Pendubot".
            experiment_time: Length of the experiment, in s. `stop_experiment` ends it earlier.
            preparation_time: How long the arm is held before the start, in s.
            record: Whether `stop_experiment` returns a video.
            initial_state: The older name of `initial_position`. It may include velocities, which
                must be 0.
            initial_position: The start angle of each joint, in rad.
            cell_id: The number of the cell; None for any free cell.
            disturbances: See `fmugym.lab.disturbance`.

        Returns:
            The session token, and an address in place of a livestream's.
        """
        request = Request(
            experiment_type,
            experiment_time,
            preparation_time,
            _start_position(initial_position, initial_state),
            record,
            cell_id,
            disturbances,
        )
        token = self._lab.start_experiment(user_token, request)
        return token, self._lab.livestream_url(token)

    def start_episode(
        self,
        gym_token: str,
        experiment_type: str,
        episode_time: float,
        preparation_time: float = 0.0,
        record: bool = False,
        initial_state: Sequence[float] | None = None,
        *,
        initial_position: Sequence[float] | float | None = None,
        cell_id: int | None = None,
        disturbances: Disturbances = None,
    ) -> tuple[str, str]:
        """Start an episode on a cell of a lease, and return when it has begun.

        Args:
            gym_token: The token of the lease.
            experiment_type: See `start_experiment`.
            episode_time: Length of the episode, in s. It ends earlier with `stop_episode` or with
                its lease.
            preparation_time: See `start_experiment`.
            record: Whether `stop_episode` returns a video.
            initial_state: See `start_experiment`.
            initial_position: See `start_experiment`.
            cell_id: The number of the cell; None for any free cell of the lease.
            disturbances: See `fmugym.lab.disturbance`.

        Returns:
            The episode token, and an address in place of a livestream's.
        """
        request = Request(
            experiment_type,
            episode_time,
            preparation_time,
            _start_position(initial_position, initial_state),
            record,
            cell_id,
            disturbances,
        )
        token = self._lab.start_episode(gym_token, request)
        return token, self._lab.livestream_url(token)

    def stop_experiment(self, session_token: str) -> str:
        """End an experiment. It may already have ended by itself.

        Returns:
            The address of the video, or "" without one.
        """
        return self._lab.stop_session(session_token, "experiment")

    def stop_episode(self, episode_token: str) -> str:
        """End an episode. It may already have ended by itself.

        Returns:
            The address of the video, or "" without one.
        """
        return self._lab.stop_session(episode_token, "episode")

    def get_position(self, token: str) -> Reading:
        """Return the angle in rad: a float for one actuator, a list for two."""
        return self._lab.read(token, "position")

    def get_velocity(self, token: str) -> Reading:
        """Return the angular velocity in rad/s: a float for one actuator, a list for two."""
        return self._lab.read(token, "velocity")

    def get_torque(self, token: str) -> Reading:
        """Return the motor's torque in N m: a float for one actuator, a list for two."""
        return self._lab.read(token, "torque")

    def set_position(self, position: Any, token: str) -> None:
        """Set the target of the stiffness, in rad; a None entry leaves a joint unchanged."""
        self._lab.command(token, "position", position)

    def set_velocity(self, velocity: Any, token: str) -> None:
        """Set the target of the damping, in rad/s; a None entry leaves a joint unchanged."""
        self._lab.command(token, "velocity", velocity)

    def set_torque(self, torque: Any, token: str) -> None:
        """Set the feed-forward torque, in N m; a None entry leaves a joint unchanged."""
        self._lab.command(token, "torque", torque)

    def set_impedance_controller_params(self, kp: Any, kd: Any, token: str) -> None:
        """Set stiffness in N m/rad and damping in N m s/rad. Torque control is 0 and 0.

        The drive's torque is tau = kp (q* - q) + kd (qd* - qd) + tau_ff, within its limits.
        """
        self._lab.set_gains(token, kp, kd)

    def get_actuator_info(self, token: str) -> list[ActuatorInfo]:
        """Return a description of each joint's actuator."""
        return self._lab.actuator_info(token)

    def get_logs(self, token: str) -> str:
        """Return the events of the session so far, one per line."""
        return self._lab.logs(token)


def _start_position(position: Sequence[float] | float | None, state: Any) -> Any:
    """Return the position from either argument, without velocities that are 0."""
    if state is None or position is not None:
        return position
    try:
        entries = list(state) if len(state) <= 4 else state
        half = len(entries) // 2
        has_velocities = len(entries) in (2, 4) and not any(entries[half:])
    except ordinary(Exception):  # objects may do anything when they are looked at
        raise LabError(f"initial_state must be a list of numbers, not {shown(state)}") from None
    return entries[:half] if has_velocities else entries
