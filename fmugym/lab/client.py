"""The lab, and the client: the interface of a program to it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from fmugym.errors import ConfigError, shown
from fmugym.lab.data import ActuatorInfo, CellInfo, CellType, LabError, UserInfo
from fmugym.lab.disturbance import Disturbance
from fmugym.lab.request_checks import Request
from fmugym.lab.service import Service
from fmugym.lab.sessions import Session
from fmugym.signals import ordinary

__all__ = ["Client", "Lab", "current_lab"]

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

    def __init__(self, lab: Lab | None = None) -> None:
        if lab is not None and not isinstance(lab, Lab):
            raise ConfigError(f"a client needs a Lab, not {shown(lab)}")
        self._lab = current_lab() if lab is None else lab

    @property
    def lab(self) -> Lab:
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

    def get_actuator_info(self, token: str) -> list[ActuatorInfo]:
        """Return a description of each joint's actuator."""
        return self._lab.ask(token, Session.actuators)

    def get_logs(self, token: str) -> str:
        """Return the events of the session so far, one per line."""
        return self._lab.ask(token, Session.events)


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


class Lab(Service):
    """A lab with simulated cells.

    `Client(lab)` uses it. Within ``with lab:`` every new `Client()` uses it too, in all threads.
    The end of the block closes the lab.

    Args:
        preset: ``"hardware"``, ``"ideal"``, or your own options.
        clock: The lab's time; by default a `RealClock`.
        speed: Speed of the default clock: 2 is twice as fast as real time.
        users: The users by their tokens. By default every token but an empty one is valid and has
            the rights of ``User()``.
        cells: The number of cells of each type; by default four single and two double ones.
        seed: Seed of noise, friction and delays; None for a random one.
        parameters: Parameters of the cells' FMUs, by type of cell.
        video_folder: The folder of videos. By default a temporary folder, which is removed when
            the lab is closed.
        **changes: Options that differ from the preset's; see `Options`.

    Attributes:
        options: What is simulated.
        clock: The lab's time.

    Raises:
        ConfigError: If an argument has a wrong type or is out of its range.
    """

    def __enter__(self) -> Lab:
        with _choosing:
            _blocks.append(self)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with _choosing:
            _blocks.remove(self)
            is_outermost = self not in _blocks
        if is_outermost:
            self.close()

    def __deepcopy__(self, memo: dict[int, Any]) -> Lab:
        """Return the lab itself, so that copies of an environment's arguments use this lab."""
        return self

    def client(self) -> Client:
        """Return a new client of this lab."""
        return Client(self)


_choosing = threading.RLock()
_blocks: list[Lab] = []
"""The labs of the open blocks ``with lab:``, the innermost last."""
_default: list[Lab] = []
"""The default lab, if there is one."""


def current_lab() -> Lab:
    """Return the lab of the innermost ``with lab:``, or else the default lab of the process."""
    with _choosing:
        if _blocks:
            return _blocks[-1]
        if not _default or _default[0].is_closed:
            _default[:] = [Lab()]
        return _default[0]
