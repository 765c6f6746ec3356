"""The lab: cells, the tokens that give access to them, and the sessions that run on them.

The lab has no thread of its own. Whoever asks for something brings the cells concerned to the
present, and ends what should have ended since.
"""

from __future__ import annotations

import logging
import math
import shutil
import tempfile
import threading
import weakref
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt

from fmugym.errors import unknown_name
from fmugym.lab.bookings import Bookings, new_token
from fmugym.lab.cell import Cell
from fmugym.lab.data import ActuatorInfo, CellInfo, CellType, UserInfo
from fmugym.lab.errors import LabError
from fmugym.lab.experiments import EXPERIMENTS
from fmugym.lab.network import Network
from fmugym.lab.pictures import CellPicture, LiveView
from fmugym.lab.presets import Options, make_options
from fmugym.lab.recording import Recording, check_can_record, write_video
from fmugym.lab.requests import Request, check_range, entries_of, gains_of
from fmugym.lab.sessions import Gym, Session
from fmugym.lab.users import Account, User
from fmugym.pool.backend.clock import Clock, RealClock

if TYPE_CHECKING:
    from fmugym.lab.client import Client

__all__ = ["Lab", "current_lab"]

logger = logging.getLogger(__name__)

_POLL: Final = 0.02  # s between two looks for a free cell
_LONGEST_PREPARATION: Final = 60.0  # s
_CELLS: Final = {CellType.SINGLE: 4, CellType.DOUBLE: 2}
_FIRST_ID: Final = {CellType.SINGLE: 101, CellType.DOUBLE: 201}

Quantity = Literal["position", "velocity", "torque"]


class Lab:
    """A lab with simulated cells.

    `Client(lab)` uses it; between ``with lab:`` and the end of that block so does every `Client()`
    that is made, in all threads. The end of the block closes the lab.

    Args:
        preset: ``"hardware"``, ``"ideal"``, or options of one's own.
        clock: The lab's time; by default the real one.
        speed: How much faster than real time the default clock runs.
        users: The users by their tokens. By default any token but an empty one is a user's, with
            the rights of ``User()``.
        cells: How many cells there are of each kind; by default four single and two double ones.
        seed: Of noise, friction and delays.
        parameters: Parameters of the cells' FMUs, by kind of cell.
        video_folder: Where videos go. By default to a temporary folder, which goes with the lab.
        **changes: Options that differ from the preset's; see `Options`.

    Attributes:
        options: What is simulated.
        clock: The lab's time.

    Raises:
        ConfigError: If an argument makes no sense.
    """

    _current: ClassVar[list[Lab]] = []
    _default: ClassVar[Lab | None] = None
    _choosing: ClassVar[threading.Lock] = threading.Lock()

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
        self.options = make_options(preset, **changes)
        self.clock: Clock = RealClock(speed) if clock is None else clock
        seeds = np.random.SeedSequence(seed)
        self._network = Network(self.options, self.clock, _rng(seeds))
        numbers = _CELLS if cells is None else cells
        self._bookings = Bookings(self._make_cells(numbers, seeds, parameters or {}))
        self._users = users
        self._accounts: dict[str, Account] = {}
        self._opened, self._date = self.clock.time(), datetime.now(UTC)
        self._lock = threading.RLock()
        self._video_folder = None if video_folder is None else Path(video_folder)
        self._remove_videos: weakref.finalize[..., Lab] | None = None
        self._is_closed = False

    def __enter__(self) -> Lab:
        with Lab._choosing:
            Lab._current.append(self)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with Lab._choosing:
            Lab._current.remove(self)
        if self not in Lab._current:
            self.close()

    def client(self) -> Client:
        """Return a new client of this lab."""
        from fmugym.lab.client import Client

        return Client(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> Lab:
        """Return the lab itself: whoever copies the arguments of an environment means this one."""
        return self

    def close(self) -> None:
        """End all sessions, free the cells and remove the temporary folder; twice is fine."""
        with self._lock:
            self._is_closed = True
            self._bookings.end_all("the lab was closed")
            self._bookings.settle(self.clock.time())
            for cell in self._bookings.cells:
                cell.close()
            if self._remove_videos is not None:
                self._remove_videos()

    # Users.

    def user_info(self, user_token: str) -> UserInfo:
        """See ``Client.get_user_info``."""
        self._network.wait_for_getter()
        with self._lock:
            return self._account(user_token).info(self._now())

    def cell_infos(self, user_token: str) -> list[CellInfo]:
        """See ``Client.get_cells``."""
        self._network.wait_for_getter()
        with self._lock:
            self._account(user_token)
            return [CellInfo(cell.cell_id, cell.cell_type) for cell in self._bookings.cells]

    # Starts.

    def start_gym(self, user_token: str, length: float, wanted: Sequence[CellType]) -> str:
        """See ``Client.start_gym``."""
        self._network.wait_for_setter()
        with self._lock:
            account = self._account(user_token)
            self._check_lease(account.user, length, wanted)
            account.take_gym(self._now())
        while (gym := self._lease(account, length, wanted)) is None:
            self.clock.sleep(_POLL)
        logger.info("livestream: %s", self.livestream_url(gym.token))
        return gym.token

    def start_experiment(self, user_token: str, request: Request) -> str:
        """See ``Client.start_experiment``; returns the session token."""
        self._network.wait_for_setter()
        with self._lock:
            account = self._account(user_token)
            self._check_request(account.user, request, None)
            account.take_experiment(self._now())
        return self._start_session(request, None)

    def start_episode(self, gym_token: str, request: Request) -> str:
        """See ``Client.start_episode``; returns the episode token."""
        self._network.wait_for_setter()
        with self._lock:
            gym = self._open_gym(gym_token)
            self._check_request(gym.account.user, request, gym)
            gym.account.take_start(self._now())
        return self._start_session(request, gym)

    # Stops.

    def stop_session(self, token: str, kind: Literal["experiment", "episode"]) -> str:
        """See ``Client.stop_experiment`` and ``Client.stop_episode``."""
        self._network.wait_for_setter()
        with self._lock:
            session = self._bookings.find(token, Session, kind)
            session.bring_to(self._now())
            session.stop()
            self._bookings.settle(self._now())
            recording, session.recording = session.recording, None
        return "" if recording is None else self._write_video(session, recording)

    def stop_gym(self, gym_token: str) -> None:
        """See ``Client.stop_gym``."""
        self._network.wait_for_setter()
        with self._lock:
            now = self._now()
            gym = self._bookings.find(gym_token, Gym, "gym")
            self._bookings.settle(now)
            gym.stop()
            self._bookings.end_all("its gym was stopped", gym)
            self._bookings.settle(now)

    # Requests to a session; each of them is a heartbeat.

    def read(self, token: str, quantity: Quantity) -> float | list[float]:
        """Return what the newest sample of a cell says; a float for one actuator."""
        self._network.wait_for_getter()
        with self._lock:
            values: list[float] = getattr(self._session(token).cell.sensors.sample, quantity)
        return values[0] if len(values) == 1 else list(values)

    def command(self, token: str, quantity: Quantity, value: Any) -> None:
        """Set what the drive is to follow; None entries leave a joint as it was."""
        self._network.wait_for_setter()
        with self._lock:
            cell = self._session(token).cell
            entries = entries_of(value, cell.plant.joints, quantity)
            limited = [self._limited(entry, quantity) for entry in entries]
            _update(getattr(cell.drive, quantity), limited)

    def set_gains(self, token: str, kp: Any, kd: Any) -> None:
        """Set stiffness in N m/rad and damping in N m s/rad of the drive."""
        self._network.wait_for_setter()
        with self._lock:
            session = self._session(token)
            joints, drive = session.cell.plant.joints, session.cell.drive
            stiffness, damping = gains_of(kp, joints, "kp"), gains_of(kd, joints, "kd")
            _update(drive.kp, stiffness)
            _update(drive.kd, damping)
            session.note(f"kp {drive.kp} N m/rad, kd {drive.kd} N m s/rad")

    def actuator_info(self, token: str) -> list[ActuatorInfo]:
        """See ``Client.get_actuator_info``."""
        self._network.wait_for_getter()
        with self._lock:
            session = self._session(token)
        driven = EXPERIMENTS[session.experiment].driven
        names = session.cell.plant.joint_names
        return [self._actuator(*pair) for pair in zip(names, driven, strict=True)]

    def logs(self, token: str) -> str:
        """See ``Client.get_logs``."""
        self._network.wait_for_getter()
        with self._lock:
            return "\n".join(self._session(token).log)

    # What there is to see.

    def view(
        self, gym_token: str, render_mode: Literal["rgb_array", "human"] = "rgb_array"
    ) -> npt.NDArray[np.uint8] | None:
        """Show all cells of a lease side by side, as they are now.

        It is no request to a session, and so no heartbeat. Windows want one thread only.

        Args:
            gym_token: The lease.
            render_mode: ``"human"`` for a window, ``"rgb_array"`` for an array.

        Returns:
            An array of shape (height, number of cells * height, 3), or None for a window.

        Raises:
            ConfigError: If there is no such mode.
            LabError: If the lease has ended or there is no such lease.
        """
        if render_mode not in ("rgb_array", "human"):
            raise unknown_name("render mode", render_mode, ("rgb_array", "human"))
        with self._lock:
            gym = self._open_gym(gym_token)
            if gym.view is None:
                gym.view = LiveView([self._picture(cell) for cell in gym.cells])
            view = gym.view
            moments = [(cell.position, cell.torque, cell.time) for cell in gym.cells]
        picture = view.draw(moments)
        if render_mode == "rgb_array":
            return picture
        view.show(picture)
        return None

    def livestream_url(self, token: str) -> str:
        """Return what stands for the address of a livestream; `view` shows the picture.

        Args:
            token: Of a gym, an experiment or an episode.

        Raises:
            LabError: If there is no such token.
        """
        with self._lock:
            owner = self._bookings.get(token)
        if owner is None:
            raise LabError("unknown token")
        cells = owner.cells if isinstance(owner, Gym) else [owner.cell]
        return "fmugym-lab://cells/" + "+".join(str(cell.cell_id) for cell in cells)

    # Inside.

    def _make_cells(
        self,
        numbers: Mapping[CellType, int],
        seeds: np.random.SeedSequence,
        parameters: Mapping[CellType, Mapping[str, float]],
    ) -> list[Cell]:
        return [
            Cell(_FIRST_ID[kind] + i, kind, self.options, _rng(seeds), parameters.get(kind, {}))
            for kind in CellType
            for i in range(numbers.get(kind, 0))
        ]

    def _now(self) -> float:
        if self._is_closed:
            raise LabError("the lab is closed")
        return self.clock.time()

    def _account(self, user_token: str) -> Account:
        now = self._now()
        if not isinstance(user_token, str) or not user_token:
            raise LabError("a user token must be a text that is not empty")
        if self._bookings.get(user_token) is not None:
            raise LabError("this token is not a user token")
        if self._users is not None and user_token not in self._users:
            raise LabError("unknown user token")
        if user_token not in self._accounts:
            user = User() if self._users is None else self._users[user_token]
            account = Account(user, self.options, self._opened, self._date)
            self._accounts[user_token] = account
        self._accounts[user_token].check_valid(now)
        return self._accounts[user_token]

    def _session(self, token: str) -> Session:
        """Find a session that runs, and bring its cell to the present."""
        now = self._now()
        session = self._bookings.find(token, Session, "session")
        session.request(now)
        return session

    def _open_gym(self, token: str) -> Gym:
        """Find a lease that runs, and bring everything to the present."""
        now = self._now()
        gym = self._bookings.find(token, Gym, "gym")
        self._bookings.settle(now)
        if gym.ended is not None:
            raise LabError(gym.ended)
        return gym

    def _lease(self, account: Account, length: float, wanted: Sequence[CellType]) -> Gym | None:
        with self._lock:
            now = self._now()
            self._bookings.settle(now)
            gym = Gym(new_token(), account, [], now + length)
            return gym if self._bookings.lease(gym, wanted) else None

    def _start_session(self, request: Request, gym: Gym | None) -> str:
        while (cell := self._take_cell(request, gym)) is None:
            self.clock.sleep(_POLL)
        recording = Recording() if request.record else None
        try:
            cell.start(request.experiment_type, request.angles(), request.acting(), recording)
            self.clock.sleep(self.options.homing_time + request.preparation_time)
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

    def _check_lease(self, user: User, length: float, wanted: Sequence[CellType]) -> None:
        check_range("gym_time", length, user.max_gym_length if user.gym else math.inf)
        if not wanted or not all(isinstance(kind, CellType) for kind in wanted):
            raise LabError(f"a gym needs a list of cell types, not {wanted!r}")
        for kind in CellType:
            there = sum(cell.cell_type is kind for cell in self._bookings.cells)
            asked = sum(each is kind for each in wanted)
            if asked > there:
                raise LabError(f"the lab has {there} cells of type {kind.name}, not {asked}")

    def _check_request(self, user: User, request: Request, gym: Gym | None) -> None:
        kind = request.experiment_type
        if kind not in user.experiment_types:
            raise LabError(f"user {user.name!r} may not start experiments of type {kind!r}")
        if not self._bookings.fitting(request, gym):
            number = "" if request.cell_id is None else f" and number {request.cell_id}"
            raise LabError(f"there is no cell of type {request.cell_type.name}{number} for {kind}")
        check_range("the experiment's time", request.length, user.max_experiment_length)
        check_range("preparation_time", request.preparation_time, _LONGEST_PREPARATION, 0.0)
        limit = self.options.position_limit
        for angle in request.angles():
            check_range("initial_position", angle, limit, -limit)
        request.acting()
        if request.record:
            check_can_record()

    def _limited(self, value: float | None, quantity: Quantity) -> float | None:
        limit: float = getattr(self.options, f"{quantity}_limit")
        if value is None or abs(value) <= limit:
            return value
        if self.options.clamp_setters:
            return math.copysign(limit, value)
        raise LabError(f"{quantity} {value:g} is outside the limits of +-{limit:g}")

    def _actuator(self, name: str, is_driven: bool) -> ActuatorInfo:
        options = self.options
        return ActuatorInfo(
            name=name,
            motor="T-Motor GL35 (simulated)",
            drive="MAB MD80 (simulated)",
            torque_limit=options.torque_limit if is_driven else 0.0,
            velocity_limit=options.velocity_limit,
            position_limit=options.position_limit,
        )

    def _picture(self, cell: Cell) -> CellPicture:
        return CellPicture(cell.cell_id, cell.cell_type, self.options.torque_limit)

    def _write_video(self, session: Session, recording: Recording) -> str:
        name = f"cell{session.cell.cell_id}-{session.token[-8:]}"
        picture = self._picture(session.cell)
        return write_video(recording, picture, self._videos(), name).absolute().as_uri()

    def _videos(self) -> Path:
        with self._lock:
            self._now()
            if self._video_folder is None:
                folder = self._video_folder = Path(tempfile.mkdtemp(prefix="fmugym-lab-"))
                self._remove_videos = weakref.finalize(
                    self, shutil.rmtree, folder, ignore_errors=True
                )
            return self._video_folder


def current_lab() -> Lab:
    """Return the lab of the innermost ``with lab:``, or else the default lab of the process."""
    with Lab._choosing:
        if Lab._current:
            return Lab._current[-1]
        if Lab._default is None or Lab._default._is_closed:
            Lab._default = Lab()
        return Lab._default


def _rng(seeds: np.random.SeedSequence) -> np.random.Generator:
    return np.random.default_rng(seeds.spawn(1)[0])


def _update(target: list[float], entries: Sequence[float | None]) -> None:
    target[:] = [old if new is None else new for old, new in zip(target, entries, strict=True)]
