"""Lab: cells, leases of cells, and sessions on them.

The lab has no thread of its own. Each request brings the cells that it needs to the present, and
ends the sessions that should have ended since the last request. Requests are delayed on their way
to a cell and back.
"""

from __future__ import annotations

import logging
import math
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Final, TypeVar

import numpy as np

from fmugym.checks import check_dict, check_integer, check_number, check_option, check_text
from fmugym.errors import ConfigError, shown
from fmugym.lab.cell import Cell, checked_parameters
from fmugym.lab.data import EXPERIMENTS, PLANTS, CellType, LabError, UserInfo, as_lab_error
from fmugym.lab.lab_options import Options
from fmugym.lab.sessions import Gym, Session, entries_of
from fmugym.pool.rig.clocks import Clock, RealClock

__all__ = ["Delays", "Lab", "current_lab"]

_P99: Final = 2.3263478740408408  # the 99th percentile of the standard normal distribution


class Delays:
    """Delays of requests.

    They have a log-normal distribution with the median and the 99th percentile of the options.
    Some requests stall in addition. A request takes effect after its whole delay.

    Args:
        options: The distributions.
        clock: The lab's clock.
        rng: The random generator.
    """

    def __init__(self, options: Options, clock: Clock, rng: np.random.Generator) -> None:
        self._options, self._clock, self._rng = options, clock, rng
        self._drawing = threading.Lock()

    def wait_for_getter(self) -> None:
        """Wait as long as a getter takes."""
        self._wait(self._options.get_time)

    def wait_for_setter(self) -> None:
        """Wait as long as any other request takes."""
        self._wait(self._options.set_time)

    def _wait(self, quantiles: tuple[float, float]) -> None:
        if quantiles[0] > 0.0:
            arrival = self._clock.time() + self._draw(*quantiles)
            self._clock.sleep(arrival - self._clock.time())

    def _draw(self, median: float, p99: float) -> float:
        options = self._options
        with self._drawing:
            spread = math.log(p99 / median) / _P99
            duration = median * math.exp(spread * self._rng.standard_normal())
            if self._rng.random() < options.stall_share:
                duration += self._rng.uniform(options.shortest_stall, options.longest_stall)
        return float(duration)


logger = logging.getLogger(__name__)

_USER: Final = UserInfo()
_LONGEST_PREPARATION: Final = 60.0  # s
_POLL: Final = 0.02  # s between two attempts to get a cell
_REMEMBERED: Final = 256  # ended sessions and leases
_CELLS: Final = {CellType.SINGLE: 4, CellType.DOUBLE: 2}
_FIRST_ID: Final = {CellType.SINGLE: 101, CellType.DOUBLE: 201}
_MOST_CELLS: Final = 100  # of a type, so that the numbers of the types do not overlap
_LARGEST_SEED: Final = 2**128 - 1

_Answer = TypeVar("_Answer")
_Booking = TypeVar("_Booking", Gym, Session)


class Lab:
    """A lab with simulated cells.

    `Client(lab)` uses it. Within ``with lab:`` every new `Client()` uses it too, in all threads.
    The end of the block closes the lab.

    Args:
        clock: The lab's time; by default a `RealClock`.
        speed: Speed of the default clock: 2 is twice as fast as real time.
        cells: The number of cells of each type; by default four single and two double ones.
        seed: Seed of noise, friction and delays; None for a random one.
        parameters: Parameters of the cells' FMUs, by type of cell.
        **options: See `Options`.

    Attributes:
        options: The properties of the cells and of the way to them.
        clock: The lab's time.

    Raises:
        ConfigError: If an argument has a wrong type or is out of its range.
    """

    def __init__(
        self,
        *,
        clock: Clock | None = None,
        speed: float = 1.0,
        cells: Mapping[CellType, int] | None = None,
        seed: int | None = None,
        parameters: Mapping[CellType, Mapping[str, float]] | None = None,
        **options: Any,
    ) -> None:
        for name in options:
            check_option("option of the lab", name, Options.__dataclass_fields__)
        if seed is not None:
            seed = check_integer("seed", seed, 0, _LARGEST_SEED)
        self.options = Options(**options)
        self.clock = RealClock(speed) if clock is None else clock
        numbers, parameters = _numbers(cells), _parameters(parameters)
        seeds = iter(np.random.SeedSequence(seed).spawn(1 + sum(numbers.values())))
        self._delays = Delays(self.options, self.clock, np.random.default_rng(next(seeds)))
        self._cells = [
            Cell(
                _FIRST_ID[kind] + i,
                kind,
                self.options,
                np.random.default_rng(next(seeds)),
                parameters.get(kind, {}),
            )
            for kind, number in numbers.items()
            for i in range(number)
        ]
        self._running: dict[str, Gym | Session] = {}
        self._ended: OrderedDict[str, Gym | Session] = OrderedDict()
        self._in_use: set[Cell] = set()
        self._lock = threading.RLock()
        self._is_closed = False

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

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self._is_closed

    @property
    def running(self) -> list[str]:
        """The kind of each running lease, experiment and episode, in alphabetical order."""
        with self._lock:
            self._settle(self.clock.time())
            return sorted(booking.kind for booking in self._running.values())

    def close(self) -> None:
        """End all sessions and leases, and free the cells; a second call does nothing."""
        with self._lock:
            self._is_closed = True
            for booking in self._running.values():
                booking.end("the lab was closed")
            self._settle(self.clock.time())
            for cell in self._cells:
                cell.close()

    def user_info(self, user_token: str) -> UserInfo:
        """See ``Client.get_user_info``."""
        self._delays.wait_for_getter()
        with self._lock:
            self._check_user(user_token)
        return _USER

    def start_gym(self, user_token: str, gym_time: float, cell_types: Sequence[CellType]) -> str:
        """See ``Client.start_gym``."""
        self._delays.wait_for_setter()
        with self._lock:
            self._check_user(user_token)
            self._check_types(cell_types)
            _check_range("gym_time", gym_time, _USER.max_gym_length)
        while (gym := self._leased(gym_time, cell_types)) is None:
            self.clock.sleep(_POLL)
        logger.info("livestream: %s", _address(gym.cells))
        return gym.token

    def start_experiment(
        self, user_token: str, experiment: str, length: float, preparation: float, position: Any
    ) -> tuple[str, str]:
        """See ``Client.start_experiment``."""
        self._delays.wait_for_setter()
        with self._lock:
            self._check_user(user_token)
        return self._start(None, experiment, length, preparation, position)

    def start_episode(
        self, gym_token: str, experiment: str, length: float, preparation: float, position: Any
    ) -> tuple[str, str]:
        """See ``Client.start_episode``."""
        self._delays.wait_for_setter()
        with self._lock:
            gym = self._open_gym(gym_token)
        return self._start(gym, experiment, length, preparation, position)

    def stop_session(self, token: str, kind: str) -> str:
        """See ``Client.stop_experiment`` and ``Client.stop_episode``."""
        self._delays.wait_for_setter()
        with self._lock:
            now = self._now()
            session = self._found(token, Session, kind)
            session.bring_to(now)
            self._stop(session)
            self._settle(now)
        return ""

    def stop_gym(self, gym_token: str) -> None:
        """See ``Client.stop_gym``."""
        self._delays.wait_for_setter()
        with self._lock:
            now = self._now()
            gym = self._found(gym_token, Gym, "gym")
            self._settle(now)
            self._stop(gym)
            for booking in self._running.values():
                if isinstance(booking, Session) and booking.gym is gym:
                    booking.end("its gym was stopped")
            self._settle(now)

    def ask(self, token: str, question: Callable[..., _Answer], *arguments: Any) -> _Answer:
        """Call a method of a running session that only reads; this is a heartbeat."""
        self._delays.wait_for_getter()
        with self._lock:
            return question(self._session(token), *arguments)

    def tell(self, token: str, command: Callable[..., None], *arguments: Any) -> None:
        """Call a method of a running session that changes something; this is a heartbeat."""
        self._delays.wait_for_setter()
        with self._lock:
            command(self._session(token), *arguments)

    # Starts of leases and sessions.

    def _leased(self, length: float, kinds: Sequence[CellType]) -> Gym | None:
        """Begin a lease if enough cells are free."""
        with self._lock:
            now = self._now()
            self._settle(now)
            free = self._free_cells(None)
            cells: list[Cell] = []
            for kind in kinds:
                found = [cell for cell in free if cell.cell_type is kind and cell not in cells]
                if not found:
                    return None
                cells.append(found[0])
            gym = Gym(_new_token(), cells, now + length)
            self._running[gym.token] = gym
            return gym

    def _start(
        self, gym: Gym | None, experiment: str, length: float, preparation: float, position: Any
    ) -> tuple[str, str]:
        """Wait for a cell, bring it to its start position, and begin a session."""
        angles = self._checked_start(gym, experiment, length, preparation, position)
        kind = EXPERIMENTS[experiment].cell_type
        while (cell := self._taken(kind, gym)) is None:
            self.clock.sleep(_POLL)
        try:
            with as_lab_error():
                cell.start(experiment, angles)
            self.clock.sleep(self.options.homing_time + preparation)
            return self._begun(cell, length, gym), _address([cell])
        except BaseException:
            with self._lock:
                self._in_use.discard(cell)
                cell.park()
            raise

    def _checked_start(
        self, gym: Gym | None, experiment: str, length: float, preparation: float, position: Any
    ) -> list[float]:
        """Refuse a start that does not fit the lab; return the start angles in rad."""
        with as_lab_error():
            check_option("experiment type", experiment, EXPERIMENTS)
        kind, limit = EXPERIMENTS[experiment].cell_type, self.options.position_limit
        if all(cell.cell_type is not kind for cell in (gym.cells if gym else self._cells)):
            raise LabError(f"no cell of type {kind.name} for {experiment} exists")
        _check_range("the experiment's time", length, _USER.max_experiment_length)
        _check_range("preparation_time", preparation, _LONGEST_PREPARATION, 0.0)
        joints = PLANTS[kind].joints
        entries = entries_of(
            [0.0] * joints if position is None else position, joints, "initial_position"
        )
        angles = [entry or 0.0 for entry in entries]
        for angle in angles:
            _check_range("initial_position", angle, limit, -limit)
        return angles

    def _taken(self, kind: CellType, gym: Gym | None) -> Cell | None:
        """Take a free cell of a type, out of the lease if there is one."""
        with self._lock:
            self._settle(self._now())
            if gym is not None and gym.ended is not None:
                raise LabError(gym.ended)
            for cell in self._free_cells(gym):
                if cell.cell_type is kind:
                    self._in_use.add(cell)
                    return cell
            return None

    def _begun(self, cell: Cell, length: float, gym: Gym | None) -> str:
        with self._lock:
            now = self._now()
            if gym is not None:
                self._open_gym(gym.token)
            session = Session(_new_token(), cell, now, length, gym)
            self._running[session.token] = session
            return session.token

    # Bookings; the caller holds the lock.

    def _now(self) -> float:
        if self._is_closed:
            raise LabError("the lab is closed")
        return self.clock.time()

    def _settle(self, now: float) -> None:
        """Bring sessions and then leases to the present, and put ended ones aside."""
        for booking in sorted(self._running.values(), key=lambda each: isinstance(each, Gym)):
            booking.bring_to(now)
            if booking.ended is not None:
                self._ended[booking.token] = self._running.pop(booking.token)
                if isinstance(booking, Session):
                    self._in_use.discard(booking.cell)
        while len(self._ended) > _REMEMBERED:
            self._ended.popitem(last=False)

    def _free_cells(self, gym: Gym | None) -> list[Cell]:
        """The free cells of a lease, or of the lab beside its leases."""
        if gym is not None:
            return [cell for cell in gym.cells if cell not in self._in_use]
        gyms = [booking for booking in self._running.values() if isinstance(booking, Gym)]
        leased = {cell for each in gyms for cell in each.cells}
        return [cell for cell in self._cells if cell not in leased | self._in_use]

    def _session(self, token: str) -> Session:
        """Find a running session, and bring its cell to the present."""
        session = self._found(token, Session, "session")
        session.request(self._now())
        return session

    def _open_gym(self, token: str) -> Gym:
        """Find a running lease, and bring everything to the present."""
        gym = self._found(token, Gym, "gym")
        self._settle(self._now())
        if gym.ended is not None:
            raise LabError(gym.ended)
        return gym

    def _found(self, token: str, wanted: type[_Booking], kind: str) -> _Booking:
        """Return the lease or session of a token.

        Raises:
            LabError: If the token is no text, is unknown, or stands for something else.
        """
        self._now()  # a closed lab refuses everything
        booking = self._booking(token, kind)
        if booking is None:
            raise LabError(f"this {kind} token is not valid: it is unknown or has long expired")
        if not isinstance(booking, wanted) or kind not in (booking.kind, "session"):
            raise LabError(f"this {kind} token is not valid: it is one of a {booking.kind}")
        return booking

    def _booking(self, token: str, kind: str) -> Gym | Session | None:
        with as_lab_error():
            text = check_text(f"{kind} token", token)
        return self._running.get(text) or self._ended.get(text)

    def _check_user(self, token: str) -> None:
        """Refuse a user token that is no text, is empty, or is a token of something else."""
        self._now()
        if self._booking(token, "user") is not None:
            raise LabError("this token is not a user token")
        if not token:
            raise LabError("user token must be a text that is not empty")

    def _check_types(self, kinds: Any) -> None:
        """Check a list of cell types, and refuse more cells than the lab has."""
        if not isinstance(kinds, list | tuple) or not kinds:
            raise LabError(f"a gym needs a list of cell types, not {shown(kinds)}")
        if not all(isinstance(kind, CellType) for kind in kinds):
            raise LabError(f"a gym needs a list of cell types, not {shown(kinds)}")
        for kind in CellType:
            available = sum(cell.cell_type is kind for cell in self._cells)
            if (number := kinds.count(kind)) > available:
                raise LabError(f"the lab has {available} cells of type {kind.name}, not {number}")

    def _stop(self, booking: Gym | Session) -> None:
        """End a lease or a session at the user's request, also one that has ended by itself."""
        if booking.is_stopped:
            raise LabError(f"the {booking.kind} was stopped before")
        booking.is_stopped = True
        booking.end("it was stopped")


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


def _numbers(cells: Any) -> dict[CellType, int]:
    return {
        kind: check_integer(f"cells: the number of {kind.name} cells", count, 0, _MOST_CELLS)
        for kind, count in _by_type("cells", _CELLS if cells is None else cells).items()
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


def _check_range(name: str, value: Any, highest: float, lowest: float | None = None) -> None:
    """Refuse a value outside of a range; without a lowest value it must be above 0."""
    with as_lab_error():
        number = check_number(name, value)
    if number > highest or (number <= 0.0 if lowest is None else number < lowest):
        wanted = (
            f"above 0 and up to {highest:g}" if lowest is None else f"{lowest:g} to {highest:g}"
        )
        raise LabError(f"{name} {shown(value)} is outside the limits: {wanted}")


def _address(cells: Sequence[Cell]) -> str:
    """The address in place of a livestream's."""
    return "fmugym-lab://cells/" + "+".join(str(cell.cell_id) for cell in cells)


def _new_token() -> str:
    """A random decimal number of 19 digits."""
    return str(10**18 + secrets.randbelow(9 * 10**18))
