"""The client: what a program for the CloudPendulum lab talks to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fmugym.lab.data import ActuatorInfo, CellInfo, CellType, UserInfo
from fmugym.lab.disturbance import Disturbance
from fmugym.lab.lab import Lab, current_lab
from fmugym.lab.requests import Request

__all__ = ["Client"]

Disturbances = str | Disturbance | Sequence[Disturbance] | None
Reading = float | list[float]


class Client:
    """A client of the simulated lab, with the methods of the real lab's client.

    Make one for each thread. All failures are `LabError`, which is a RuntimeError. Angles are 0
    hanging and count counter-clockwise.

    Args:
        lab: The lab to talk to; by default that of ``with lab:``, or else the process's own, made
            when it is first needed.
    """

    def __init__(self, lab: Lab | None = None) -> None:
        self._lab = current_lab() if lab is None else lab

    @property
    def lab(self) -> Lab:
        """The lab this client talks to."""
        return self._lab

    def get_user_info(self, user_token: str) -> UserInfo:
        """Return what a user may do, and what is left of it."""
        return self._lab.user_info(user_token)

    def get_cells(self, user_token: str) -> list[CellInfo]:
        """Return all cells of the lab."""
        return self._lab.cell_infos(user_token)

    def start_gym(self, user_token: str, gym_time: float, cell_types: Sequence[CellType]) -> str:
        """Reserve cells, as soon as enough are free; where the livestream is goes to the log.

        Args:
            user_token: Of a user who may reserve gyms.
            gym_time: How long the lease lasts if it is not stopped, in s.
            cell_types: One entry for each cell.

        Returns:
            The gym token.
        """
        return self._lab.start_gym(user_token, gym_time, cell_types)

    def stop_gym(self, gym_token: str) -> None:
        """End a lease and the episodes that still run; no error if its time was over."""
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
        """Start an experiment on a cell of its own; returns when it has begun.

        Args:
            user_token: Whose attempt it is.
            experiment_type: "DoubleIntegrator", "SimplePendulum", "DoublePendulum", "Acrobot" or
                "Pendubot".
            experiment_time: How long it lasts if it is not stopped, in s.
            preparation_time: How long the arm is held before, in s.
            record: Whether `stop_experiment` gives a video.
            initial_state: The older name of `initial_position`; velocities may follow, all 0.
            initial_position: The angle of each joint to start from, in rad.
            cell_id: The cell; None for any that is free.
            disturbances: See `fmugym.lab.disturbance`.

        Returns:
            The session token, and what stands for a livestream's address.
        """
        position = _start_position(initial_position, initial_state)
        request = Request(
            experiment_type,
            experiment_time,
            preparation_time,
            position,
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
        """Start an episode on a cell of a lease; returns when it has begun.

        Args:
            gym_token: The lease.
            experiment_type: As for `start_experiment`.
            episode_time: How long it lasts if it is not stopped, in s; not longer than the lease.
            preparation_time: As for `start_experiment`.
            record: Whether `stop_episode` gives a video.
            initial_state: As for `start_experiment`.
            initial_position: As for `start_experiment`.
            cell_id: The cell; None for any of the lease that is free.
            disturbances: See `fmugym.lab.disturbance`.

        Returns:
            The episode token, and what stands for a livestream's address.
        """
        position = _start_position(initial_position, initial_state)
        request = Request(
            experiment_type,
            episode_time,
            preparation_time,
            position,
            record,
            cell_id,
            disturbances,
        )
        token = self._lab.start_episode(gym_token, request)
        return token, self._lab.livestream_url(token)

    def stop_experiment(self, session_token: str) -> str:
        """End an experiment; no error if it has ended by itself.

        Returns:
            The address of the video if there is one, otherwise "".
        """
        return self._lab.stop_session(session_token, "experiment")

    def stop_episode(self, episode_token: str) -> str:
        """End an episode; no error if it has ended by itself.

        Returns:
            The address of the video if there is one, otherwise "".
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
        """Set the angle that the stiffness pulls to, in rad; a None entry changes nothing."""
        self._lab.command(token, "position", position)

    def set_velocity(self, velocity: Any, token: str) -> None:
        """Set what the damping pulls to, in rad/s; a None entry changes nothing."""
        self._lab.command(token, "velocity", velocity)

    def set_torque(self, torque: Any, token: str) -> None:
        """Set the torque fed forward, in N m; a None entry changes nothing."""
        self._lab.command(token, "torque", torque)

    def set_impedance_controller_params(self, kp: Any, kd: Any, token: str) -> None:
        """Set stiffness in N m/rad and damping in N m s/rad; 0 and 0 is torque control.

        The drive gives tau = kp (q* - q) + kd (qd* - qd) + tau_ff, within its limits.
        """
        self._lab.set_gains(token, kp, kd)

    def get_actuator_info(self, token: str) -> list[ActuatorInfo]:
        """Return what moves each joint."""
        return self._lab.actuator_info(token)

    def get_logs(self, token: str) -> str:
        """Return what happened so far, one line each."""
        return self._lab.logs(token)


def _start_position(position: Sequence[float] | float | None, state: Sequence[float] | None) -> Any:
    """Take the position from whichever argument has it; an arm cannot be thrown."""
    if state is None or position is not None:
        return position
    entries = list(state)
    half = len(entries) // 2
    if len(entries) in (2, 4) and not any(entries[half:]):
        return entries[:half]
    return entries
