"""Seats: how many instances of an FMU may exist at once on this machine.

Each environment that limits its instances takes a seat for each of them. It keeps a locked file
with their number, so that other environments, in this process and in others, can count the seats
that are taken. The system releases the lock when the process ends in whatever way.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import sys
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fmugym.errors import ConfigError, LicenceError, printable
from fmugym.pool.locks import exclusively, is_locked, release, try_lock
from fmugym.pool.spec import PoolSpec
from fmugym.signals import Ignoring, ordinary

__all__ = ["Claim", "Seats", "taking"]

_LARGEST: Final = 4096


@dataclass(frozen=True)
class _Holder:
    """Who has taken how many seats."""

    process: int
    program: str
    seats: int
    purpose: str

    @classmethod
    def read(cls, path: Path) -> _Holder:
        """Read a file of ``Claim``; one that cannot be read stands for one seat."""
        try:
            with path.open(encoding="utf-8") as file:
                data = json.loads(file.read(_LARGEST))
            return cls(int(data["process"]), str(data["program"]), int(data["seats"]), data["for"])
        except ordinary(OSError, ValueError, KeyError, TypeError):
            return cls(0, "", 1, "")

    def __str__(self) -> str:
        if self.process == os.getpid():
            return f"{self.seats} by this process for {self.purpose}"
        return printable(
            f"{self.seats} by process {self.process} ({self.program}) for {self.purpose}"
        )


class Claim:
    """Seats that are taken until this object is released or gone.

    Args:
        path: The file of the claim.
        handle: The same, open and locked.
    """

    def __init__(self, path: Path, handle: int) -> None:
        self._finalizer = weakref.finalize(self, _leave, path, handle)
        self._handle = handle
        _claims.add(self)

    def release(self) -> None:
        """Let others have the seats; more than one call is fine."""
        self._finalizer()

    def forget(self) -> None:
        """Leave the seats to the process that this one was forked from."""
        if self._finalizer.detach() is not None:
            os.close(self._handle)


_claims: Final[weakref.WeakSet[Claim]] = weakref.WeakSet()


def _forget_all() -> None:
    for claim in list(_claims):
        claim.forget()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_all)


def _leave(path: Path, handle: int) -> None:
    release(handle)
    with Ignoring(OSError):  # somebody else may have removed it just now
        path.unlink()


@dataclass(frozen=True)
class Seats:
    """The seats of one FMU.

    Attributes:
        name: The FMU, for messages.
        place: The folder of the claims and the beginning of their names, which stands for the FMU.
        most: How many instances may exist at once.
    """

    name: str
    place: Path
    most: int

    @classmethod
    def of(cls, name: str, spec: PoolSpec) -> Seats | None:
        """The seats of an FMU of this name; None if their number is not limited."""
        if spec.max_instances is None or not spec.locks:
            return None
        return cls(name, Path(spec.locks), spec.max_instances)

    def take(self, count: int, purpose: str) -> Claim:
        """Take seats.

        Args:
            count: How many.
            purpose: What for, for the messages that others get.

        Raises:
            LicenceError: If there are not so many left; the text tells who has them.
            ConfigError: If the claim cannot be written.
        """
        claim = self._attempt(count, purpose)
        if claim is None and any(h.process == os.getpid() for h in self._holders()):
            gc.collect()  # environments that nobody uses any more still have their seats
            claim = self._attempt(count, purpose)
        if claim is None:
            raise LicenceError(self._refusal(count, purpose))
        return claim

    def _attempt(self, count: int, purpose: str) -> Claim | None:
        try:
            with exclusively(Path(f"{self.place}.lock")):
                taken = sum(holder.seats for holder in self._holders())
                return self._claim(count, purpose) if taken + count <= self.most else None
        except ordinary(OSError) as error:
            raise ConfigError(
                f"{self.name}: config key 'max_instances' needs files in {self.place.parent}: "
                f"{error}"
            ) from None

    def _claim(self, count: int, purpose: str) -> Claim:
        handle, name = tempfile.mkstemp(dir=self.place.parent, prefix=f"{self.place.name}-")
        program = Path(sys.argv[0] if sys.argv else "").name
        data = {"process": os.getpid(), "program": program, "seats": count, "for": purpose}
        os.write(handle, json.dumps(data).encode())
        try_lock(handle)
        return Claim(Path(name), handle)

    def _holders(self) -> list[_Holder]:
        """Who has seats; removes what processes that have ended have left."""
        holders = []
        for path in sorted(self.place.parent.glob(f"{self.place.name}-*")):
            holder = _Holder.read(path)
            if is_locked(path):
                holders.append(holder)
            else:
                with Ignoring(OSError):
                    path.unlink()
        return holders

    def _refusal(self, count: int, purpose: str) -> str:
        holders = self._holders()
        taken = ", ".join(map(str, holders)) or "none any more"
        own = any(holder.process == os.getpid() for holder in holders)
        advice = "; close environments that you no longer use" if own else ""
        return (
            f"{self.name} needs {count} more instance(s) for {purpose}, but config key "
            f"'max_instances' allows {self.most} at once on this machine, and of these are in "
            f"use: {taken}{advice}"
        )


@contextlib.contextmanager
def taking(seats: Seats | None, count: int, purpose: str) -> Iterator[None]:
    """Take seats for this context, if they are limited; see ``Seats.take``."""
    claim = None if seats is None else seats.take(count, purpose)
    try:
        yield
    finally:
        if claim is not None:
            claim.release()
