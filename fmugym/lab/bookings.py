"""Tokens, leases and sessions: who uses which cell.

Nothing here waits or locks. The lab calls it while holding its lock.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Sequence
from typing import Final, TypeVar

from fmugym.lab.cell import Cell
from fmugym.lab.data import CellType, LabError
from fmugym.lab.request_checks import Request, text_of
from fmugym.lab.sessions import Gym, Session

__all__ = ["Bookings", "new_token"]

_REMEMBERED: Final = 256  # ended sessions and leases

_Owner = TypeVar("_Owner", Gym, Session)


class Bookings:
    """The running and the ended leases and sessions of a lab.

    Args:
        cells: The cells of the lab.

    Attributes:
        cells: The cells of the lab.
    """

    def __init__(self, cells: Sequence[Cell]) -> None:
        self.cells = list(cells)
        self._live: dict[str, Gym | Session] = {}
        self._ended: OrderedDict[str, Gym | Session] = OrderedDict()
        self._in_use: set[Cell] = set()

    def get(self, token: str) -> Gym | Session | None:
        """Return the lease or session of a token, or None; long ended ones are forgotten."""
        return self._live.get(token) or self._ended.get(token)

    def find(self, token: str, owner_type: type[_Owner], kind: str) -> _Owner:
        """Return the lease or session of a token.

        Args:
            token: The token.
            owner_type: The class that it must stand for.
            kind: "gym", "experiment", "episode", or "session" for both of the latter.

        Raises:
            LabError: If the token is no text, is unknown, or stands for something else.
        """
        owner = self.get(text_of(kind, token))
        if owner is None:
            raise LabError(f"this {kind} token is not valid: it is unknown or has long expired")
        if not isinstance(owner, owner_type) or kind not in (owner.kind, "session"):
            raise LabError(
                f"this {kind} token is not valid: it is for another purpose ({owner.kind})"
            )
        return owner

    @property
    def kinds(self) -> list[str]:
        """What runs: the kind of each lease, experiment and episode, in alphabetical order."""
        return sorted(owner.kind for owner in self._live.values())

    def settle(self, now: float) -> None:
        """Bring everything to the present, and remove what has ended.

        Args:
            now: The lab's time, in s.
        """
        for owner in sorted(self._live.values(), key=lambda owner: isinstance(owner, Gym)):
            owner.bring_to(now)
            if owner.ended is not None:
                self._put_aside(owner)

    def lease(self, gym: Gym, wanted: Sequence[CellType]) -> bool:
        """Give a lease its cells and begin it, if enough cells are free.

        Args:
            gym: The lease.
            wanted: The type of each cell.

        Returns:
            Whether the lease began.
        """
        free = [cell for cell in self.cells if cell not in self._leased() | self._in_use]
        cells: list[Cell] = []
        for kind in wanted:
            found = next((c for c in free if c.cell_type is kind and c not in cells), None)
            if found is None:
                return False
            cells.append(found)
        gym.cells = cells
        self._live[gym.token] = gym
        return True

    def take(self, request: Request, gym: Gym | None) -> Cell | None:
        """Take a cell for a session, from the lease if given; None if no cell is free."""
        taken = self._in_use if gym is not None else self._leased() | self._in_use
        cell = next((c for c in self.fitting(request, gym) if c not in taken), None)
        if cell is not None:
            self._in_use.add(cell)
        return cell

    def fitting(self, request: Request, gym: Gym | None) -> list[Cell]:
        """Return the cells that fit a request, whether free or not."""
        cells, kind, number = (gym or self).cells, request.cell_type, request.cell_id
        return [c for c in cells if c.cell_type is kind and number in (None, c.cell_id)]

    def begin(self, session: Session) -> None:
        """Add a session on a cell that was taken."""
        self._live[session.token] = session

    def give_back(self, cell: Cell) -> None:
        """Free a cell that was taken but has no session."""
        self._in_use.discard(cell)
        cell.park()

    def end_all(self, reason: str, gym: Gym | None = None) -> None:
        """End the episodes of a lease; without a lease, end everything."""
        for owner in self._live.values():
            if gym is None or (isinstance(owner, Session) and owner.gym is gym):
                owner.end(reason)

    def _leased(self) -> set[Cell]:
        gyms = (owner for owner in self._live.values() if isinstance(owner, Gym))
        return {cell for gym in gyms for cell in gym.cells}

    def _put_aside(self, owner: Gym | Session) -> None:
        self._ended[owner.token] = self._live.pop(owner.token)
        if isinstance(owner, Session):
            self._in_use.discard(owner.cell)
        while len(self._ended) > _REMEMBERED:
            self._ended.popitem(last=False)


def new_token() -> str:
    """Return a random decimal number of 19 digits."""
    return str(10**18 + secrets.randbelow(9 * 10**18))
