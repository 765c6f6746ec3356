"""The client: the interface of a program to the lab, with the methods of the real lab's client."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fmugym.errors import ConfigError, shown
from fmugym.lab.data import CellType, UserInfo
from fmugym.lab.lab import Lab, current_lab
from fmugym.lab.sessions import Session

__all__ = ["Client"]

Reading = float | list[float]


class Client:
    """A client of the simulated lab.

    Create one for each thread. Every failure raises `LabError`, which is a RuntimeError. Angles are
    0 hanging and positive counter-clockwise.

    Args:
        lab: A `Lab`. By default the lab of ``with lab:``, or else the default lab of the process,
            which the first such client creates.

    Raises:
        ConfigError: If the argument is not a lab.
    """

    def __init__(self, lab: Lab | None = None) -> None:
        if lab is not None and not isinstance(lab, Lab):
            raise ConfigError(f"a client needs a Lab, not {shown(lab)}")
        self._lab = current_lab() if lab is None else lab

    @property
    def lab(self) -> Lab:
        """The lab that this client uses."""
        return self._lab

    def get_user_info(self, user_token: str) -> UserInfo:
        """Return a user's rights."""
        return self._lab.user_info(user_token)

    def start_gym(self, user_token: str, gym_time: float, cell_types: Sequence[CellType]) -> str:
        """Reserve cells, and wait until enough are free. The log shows the livestream's address.

        Args:
            user_token: Any text that is not empty.
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
        *,
        initial_position: Sequence[float] | float | None = None,
    ) -> tuple[str, str]:
        """Start an experiment on a cell, and return when it has begun.

        Args:
            user_token: Any text that is not empty.
            experiment_type: "DoubleIntegrator", "SimplePendulum", "DoublePendulum", "Acrobot" or
                "Pendubot".
            experiment_time: Length of the experiment, in s. `stop_experiment` ends it earlier.
            preparation_time: How long the arm is held before the start, in s.
            initial_position: The start angle of each joint, in rad; None for hanging.

        Returns:
            The session token, and an address in place of a livestream's.
        """
        return self._lab.start_experiment(
            user_token, experiment_type, experiment_time, preparation_time, initial_position
        )

    def start_episode(
        self,
        gym_token: str,
        experiment_type: str,
        episode_time: float,
        preparation_time: float = 0.0,
        *,
        initial_position: Sequence[float] | float | None = None,
    ) -> tuple[str, str]:
        """Start an episode on a cell of a lease, and return when it has begun.

        Args:
            gym_token: The token of the lease.
            experiment_type: See `start_experiment`.
            episode_time: Length of the episode, in s. It ends earlier with `stop_episode` or with
                its lease.
            preparation_time: See `start_experiment`.
            initial_position: See `start_experiment`.

        Returns:
            The episode token, and an address in place of a livestream's.
        """
        return self._lab.start_episode(
            gym_token, experiment_type, episode_time, preparation_time, initial_position
        )

    def stop_experiment(self, session_token: str) -> str:
        """End an experiment. It may already have ended by itself.

        Returns:
            "", in place of the address of a video.
        """
        return self._lab.stop_session(session_token, "experiment")

    def stop_episode(self, episode_token: str) -> str:
        """End an episode. It may already have ended by itself.

        Returns:
            "", in place of the address of a video.
        """
        return self._lab.stop_session(episode_token, "episode")

    def get_position(self, token: str) -> Reading:
        """Return the angle in rad: a float for one actuator, a list for two."""
        return self._lab.ask(token, Session.read, "position")

    def get_velocity(self, token: str) -> Reading:
        """Return the angular velocity in rad/s: a float for one actuator, a list for two."""
        return self._lab.ask(token, Session.read, "velocity")

    def get_torque(self, token: str) -> Reading:
        """Return the motor's torque in N m: a float for one actuator, a list for two."""
        return self._lab.ask(token, Session.read, "torque")

    def set_position(self, position: Any, token: str) -> None:
        """Set the target of the stiffness, in rad; a None entry leaves a joint unchanged."""
        self._lab.tell(token, Session.command, "position", position)

    def set_velocity(self, velocity: Any, token: str) -> None:
        """Set the target of the damping, in rad/s; a None entry leaves a joint unchanged."""
        self._lab.tell(token, Session.command, "velocity", velocity)

    def set_torque(self, torque: Any, token: str) -> None:
        """Set the feed-forward torque, in N m; a None entry leaves a joint unchanged."""
        self._lab.tell(token, Session.command, "torque", torque)

    def set_impedance_controller_params(self, kp: Any, kd: Any, token: str) -> None:
        """Set stiffness in N m/rad and damping in N m s/rad. Torque control is 0 and 0.

        The drive's torque is tau = kp (q* - q) + kd (qd* - qd) + tau_ff, within its limits.
        """
        self._lab.tell(token, Session.set_gains, kp, kd)
