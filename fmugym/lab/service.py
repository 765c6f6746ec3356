"""The service behind the clients: it admits users, starts and stops sessions, and shows cells.

The service has no thread of its own. Each request brings the cells that it needs to the present,
and ends what should have ended since the last request.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from fmugym.checks import check_dict, check_integer, check_option
from fmugym.errors import ConfigError, shown
from fmugym.lab.bookings import Bookings, new_token
from fmugym.lab.cell import Cell, checked_parameters
from fmugym.lab.cell_pictures import CellFrame, CellPicture, LiveView
from fmugym.lab.data import CellInfo, CellType, LabError, UserInfo, as_lab_error
from fmugym.lab.presets import Options, make_options
from fmugym.lab.request_checks import Request, cell_types_of, check_range, text_of
from fmugym.lab.sessions import Gym, Session
from fmugym.lab.timekeeper import Delays, Timekeeper
from fmugym.lab.users import Account, Accounts, User
from fmugym.lab.videos import Recording, VideoFolder
from fmugym.pool.backend.clocks import Clock, RealClock

__all__ = ["Service"]

logger = logging.getLogger(__name__)

_LONGEST_PREPARATION: Final = 60.0  # s
_POLL: Final = 0.02  # s between two attempts to get a cell
_RENDER_MODES: Final = ("rgb_array", "human")

_CELLS: Final = {CellType.SINGLE: 4, CellType.DOUBLE: 2}
_FIRST_ID: Final = {CellType.SINGLE: 101, CellType.DOUBLE: 201}
_MOST_CELLS: Final = 100  # of a type, so that the numbers of the types do not overlap
_LARGEST_SEED: Final = 2**128 - 1

_Answer = TypeVar("_Answer")


class Service:
    """Answers the requests of clients.

    See ``fmugym.lab.Lab`` for the arguments, the attributes and the errors.
    """

    def __init__(
        self,
        preset: str | Options = "hardware",
        *,
        clock: Clock | None = None,
        speed: float = 1.0,
        users: Mapping[str, User] | None = None,
        cells: Mapping[CellType, int] | None = None,
        seed: int | None = None,
        parameters: Mapping[CellType, Mapping[str, float]] | None = None,
        video_folder: str | Path | None = None,
        **changes: Any,
    ) -> None:
        if seed is not None:
            seed = check_integer("seed", seed, 0, _LARGEST_SEED)
        seeds = np.random.SeedSequence(seed)
        rng = _rng(seeds)
        self.options = options = make_options(preset, **changes)
        self.clock = RealClock(speed) if clock is None else clock
        made = _make_cells(options, seeds, _numbers(cells), _parameters(parameters))
        self._time = Timekeeper(self.clock)
        self._delays = Delays(options, self._time, rng)
        self._bookings = Bookings(made)
        self._accounts = Accounts(users, options, self._time.opened)
        self._videos = VideoFolder(video_folder)
        self._lock = threading.RLock()
        self._is_closed = False

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self._is_closed

    @property
    def running(self) -> list[str]:
        """What runs now: the kind of each lease, experiment and episode, in alphabetical order."""
        with self._lock:
            self._bookings.settle(self.clock.time())
            return self._bookings.kinds

    def close(self) -> None:
        """End all sessions, free the cells and remove temporary videos; twice is fine."""
        with self._lock:
            self._is_closed = True
            self._bookings.end_all("the lab was closed")
            self._bookings.settle(0.0)  # the time does not matter: everything has ended
            for cell in self._bookings.cells:
                cell.close()
            self._videos.close()

    # Users.

    def user_info(self, user_token: str) -> UserInfo:
        """See ``Client.get_user_info``."""
        self._delays.wait_for_getter()
        with self._lock:
            return self._account(user_token).info(self._now())

    def cell_infos(self, user_token: str) -> list[CellInfo]:
        """See ``Client.get_cells``."""
        self._delays.wait_for_getter()
        with self._lock:
            self._account(user_token)
            return [CellInfo(cell.cell_id, cell.cell_type) for cell in self._bookings.cells]

    # Starts.

    def start_gym(self, user_token: str, length: float, wanted: Sequence[CellType]) -> str:
        """See ``Client.start_gym``."""
        self._delays.wait_for_setter()
        kinds = cell_types_of(wanted)
        with self._lock:
            account = self._account(user_token)
            seconds = self._checked_lease(account.user, length, kinds)
            account.take_gym(self._now())
        while (gym := self._lease(account, seconds, kinds)) is None:
            self._time.wait(_POLL)
        logger.info("livestream: %s", self.livestream_url(gym.token))
        return gym.token

    def start_experiment(self, user_token: str, request: Request) -> str:
        """See ``Client.start_experiment``; returns the session token."""
        self._delays.wait_for_setter()
        with self._lock:
            account = self._account(user_token)
            self._admit(account.user, request, None)
            account.take_experiment(self._now())
        return self._start_session(request, None)

    def start_episode(self, gym_token: str, request: Request) -> str:
        """See ``Client.start_episode``; returns the episode token."""
        self._delays.wait_for_setter()
        with self._lock:
            gym = self._open_gym(gym_token)
            self._admit(gym.account.user, request, gym)
            gym.account.take_start(self._now())
        return self._start_session(request, gym)

    # Stops.

    def stop_session(self, token: str, kind: Literal["experiment", "episode"]) -> str:
        """See ``Client.stop_experiment`` and ``Client.stop_episode``."""
        self._delays.wait_for_setter()
        with self._lock:
            session = self._bookings.find(token, Session, kind)
            session.bring_to(self._now())
            session.stop()
            self._bookings.settle(self._now())
            recording, session.recording = session.recording, None
        if recording is None:
            return ""
        name = f"cell{session.cell.cell_id}-{session.token[-8:]}"
        return self._videos.write(recording, self._picture(session.cell), name)

    def stop_gym(self, gym_token: str) -> None:
        """See ``Client.stop_gym``."""
        self._delays.wait_for_setter()
        with self._lock:
            now = self._now()
            gym = self._bookings.find(gym_token, Gym, "gym")
            self._bookings.settle(now)
            gym.stop()
            self._bookings.end_all("its gym was stopped", gym)
            self._bookings.settle(now)

    # Requests to a session. Each one is a heartbeat.

    def ask(self, token: str, question: Callable[..., _Answer], *arguments: Any) -> _Answer:
        """Call a method of a running session that only reads something."""
        self._delays.wait_for_getter()
        with self._lock:
            return question(self._session(token), *arguments)

    def tell(self, token: str, command: Callable[..., None], *arguments: Any) -> None:
        """Call a method of a running session that changes something."""
        self._delays.wait_for_setter()
        with self._lock:
            command(self._session(token), *arguments)

    # Pictures.

    def view(
        self, gym_token: str, render_mode: Literal["rgb_array", "human"] = "rgb_array"
    ) -> npt.NDArray[np.uint8] | None:
        """Show the present state of all cells of a lease side by side.

        It is not a request to a session, so it is not a heartbeat. Use windows from one thread
        only.

        Args:
            gym_token: The token of the lease.
            render_mode: ``"human"`` for a window, ``"rgb_array"`` for an array.

        Returns:
            An array of shape (height, number of cells * height, 3), or None for a window.

        Raises:
            ConfigError: If the mode does not exist.
            LabError: If the lease does not exist or has ended, or there is no display.
        """
        mode = check_option("render mode", render_mode, _RENDER_MODES)
        with self._lock:
            gym = self._open_gym(gym_token)
            if gym.view is None:
                gym.view = LiveView([self._picture(cell) for cell in gym.cells])
            view = gym.view
            frames = [CellFrame(cell.position, cell.torque, cell.time) for cell in gym.cells]
        picture = view.draw(frames)
        if mode == "rgb_array":
            return picture
        with as_lab_error():
            view.show(picture)
        return None

    def livestream_url(self, token: str) -> str:
        """Return an address in place of a livestream's; `view` shows the picture.

        Args:
            token: The token of a gym, an experiment or an episode.

        Raises:
            LabError: If the token is unknown.
        """
        with self._lock:
            owner = self._bookings.get(text_of("gym or session", token))
        if owner is None:
            raise LabError("unknown token")
        cells = owner.cells if isinstance(owner, Gym) else [owner.cell]
        return "fmugym-lab://cells/" + "+".join(str(cell.cell_id) for cell in cells)

    # Lookups; the caller holds the lock.

    def _now(self) -> float:
        if self._is_closed:
            raise LabError("the lab is closed")
        return self._time.time()

    def _account(self, user_token: str) -> Account:
        now, token = self._now(), text_of("user", user_token)
        if not token:
            raise LabError("user token must be a text that is not empty")
        if self._bookings.get(token) is not None:
            raise LabError("this token is not a user token")
        return self._accounts.find(token, now)

    def _session(self, token: str) -> Session:
        """Find a running session, and bring its cell to the present."""
        now = self._now()
        session = self._bookings.find(token, Session, "session")
        session.request(now)
        return session

    def _open_gym(self, token: str) -> Gym:
        """Find a running lease, and bring everything to the present."""
        now = self._now()
        gym = self._bookings.find(token, Gym, "gym")
        self._bookings.settle(now)
        if gym.ended is not None:
            raise LabError(gym.ended)
        return gym

    def _picture(self, cell: Cell) -> CellPicture:
        return CellPicture(cell.cell_id, cell.cell_type, self.options.torque_limit)

    # Parts of a start.

    def _checked_lease(self, user: User, length: Any, wanted: Sequence[CellType]) -> float:
        """Refuse what no lease can have; returns the length in s."""
        checked = check_range("gym_time", length, user.max_gym_length if user.gym else math.inf)
        for kind in CellType:
            available = sum(cell.cell_type is kind for cell in self._bookings.cells)
            number = sum(each is kind for each in wanted)
            if number > available:
                raise LabError(f"the lab has {available} cells of type {kind.name}, not {number}")
        return checked

    def _admit(self, user: User, request: Request, gym: Gym | None) -> None:
        """Refuse a start that the user has no right to, or that does not fit the lab."""
        kind, limit = request.experiment_type, self.options.position_limit
        if kind not in user.experiment_types:
            raise LabError(f"user {user.name!r} may not start experiments of type {kind!r}")
        if not self._bookings.fitting(request, gym):
            number = "" if request.cell_id is None else f" and number {request.cell_id:g}"
            raise LabError(f"no cell of type {request.cell_type.name}{number} for {kind} exists")
        check_range("the experiment's time", request.length, user.max_experiment_length)
        check_range("preparation_time", request.preparation_time, _LONGEST_PREPARATION, 0.0)
        for angle in request.angles:
            check_range("initial_position", angle, limit, -limit)
        _ = request.acting  # raises for a disturbance that does not fit
        if request.record:
            self._videos.prepare()

    def _lease(self, account: Account, length: float, wanted: Sequence[CellType]) -> Gym | None:
        with self._lock:
            now = self._now()
            self._bookings.settle(now)
            gym = Gym(new_token(), account, [], now + length)
            return gym if self._bookings.lease(gym, wanted) else None

    def _start_session(self, request: Request, gym: Gym | None) -> str:
        while (cell := self._take_cell(request, gym)) is None:
            self._time.wait(_POLL)
        recording = Recording() if request.record else None
        try:
            with as_lab_error():
                cell.start(request.experiment_type, request.angles, request.acting, recording)
            self._time.sleep(self.options.homing_time + request.preparation_time)
            return self._begin(request, cell, gym, recording)
        except BaseException:
            with self._lock:
                self._bookings.give_back(cell)
            raise

    def _take_cell(self, request: Request, gym: Gym | None) -> Cell | None:
        with self._lock:
            self._bookings.settle(self._now())
            if gym is not None and gym.ended is not None:
                raise LabError(gym.ended)
            return self._bookings.take(request, gym)

    def _begin(
        self, request: Request, cell: Cell, gym: Gym | None, recording: Recording | None
    ) -> str:
        with self._lock:
            now = self._now()
            if gym is not None:
                self._open_gym(gym.token)
            session = Session(
                token=new_token(),
                cell=cell,
                experiment=request.experiment_type,
                began=now,
                length=request.length,
                heartbeat=self.options.heartbeat,
                grace=self.options.session_grace,
                gym=gym,
                recording=recording,
            )
            self._bookings.begin(session)
            return session.token


def _make_cells(
    options: Options,
    seeds: np.random.SeedSequence,
    numbers: Mapping[CellType, int],
    parameters: Mapping[CellType, Mapping[str, float]],
) -> list[Cell]:
    return [
        Cell(_FIRST_ID[kind] + i, kind, options, _rng(seeds), parameters.get(kind, {}))
        for kind in CellType
        for i in range(numbers.get(kind, 0))
    ]


def _numbers(cells: Any) -> Mapping[CellType, int]:
    numbers = _by_type("cells", _CELLS if cells is None else cells)
    return {
        kind: check_integer(f"cells: the number of {kind.name} cells", count, 0, _MOST_CELLS)
        for kind, count in numbers.items()
    }


def _parameters(parameters: Any) -> dict[CellType, dict[str, float]]:
    by_type = _by_type("parameters", {} if parameters is None else parameters)
    return {kind: checked_parameters(kind, values) for kind, values in by_type.items()}


def _by_type(what: str, value: Any) -> dict[CellType, Any]:
    entries = check_dict(what, value)
    for kind in entries:
        if not isinstance(kind, CellType):
            raise ConfigError(f"{what}: expected a CellType as a key, not {shown(kind)}")
    return entries


def _rng(seeds: np.random.SeedSequence) -> np.random.Generator:
    return np.random.default_rng(seeds.spawn(1)[0])
