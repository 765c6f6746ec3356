"""Cells of the CloudPendulum lab, as backends.

They use the methods of the published client only. So the client of the real lab fits as well as
that of the simulated lab, and neither is imported here.
"""

from __future__ import annotations

import importlib
import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from fmugym.checks import check_number, check_text, has_method
from fmugym.errors import ConfigError, shown
from fmugym.fmi.status import Status
from fmugym.pool import Paced
from fmugym.pool.backend.clocks import RealClock

__all__ = ["CellBackend", "Lease", "paced_cells"]

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
