"""Limit of the instances of an FMU in this process and its workers.

Each environment that limits its instances claims all that it makes, and so does a trial.
"""

from __future__ import annotations

import gc
import os
import threading
import weakref
from dataclasses import dataclass
from typing import Final

from fmugym.errors import LicenceError
from fmugym.fmi.fmu import FMU
from fmugym.pool.pool_spec import PoolSpec

__all__ = ["claim_instances"]


@dataclass(eq=False)
class Claim:
    """Instances of an FMU that count until this object is closed or gone."""

    content: str
    instances: int
    purpose: str

    def close(self) -> None:
        """Let others make instances; more than one call is fine."""
        _claims.pop(id(self), None)

    def __str__(self) -> str:
        return f"{self.instances} for {self.purpose}"


_claims: Final[weakref.WeakValueDictionary[int, Claim]] = weakref.WeakValueDictionary()
"""The claims by their ids; a list of ``valuerefs`` is made in one go, unlike one of a WeakSet."""

_lock: Final = threading.Lock()

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_claims.clear)


def claim_instances(fmu: FMU, spec: PoolSpec, count: int, purpose: str) -> Claim:
    """Claim instances of an FMU.

    Args:
        fmu: The FMU.
        spec: Says how many there may be.
        count: How many to claim.
        purpose: What for, for the messages that others get.

    Returns:
        The claim; it need not be closed if their number is not limited.

    Raises:
        LicenceError: If there are not so many left; the text tells what the others are for.
    """
    if spec.max_instances is None:
        return Claim("", count, purpose)
    content = fmu.content
    if sum(claim.instances for claim in _taken(content)) + count > spec.max_instances:
        gc.collect()  # environments that nobody uses any more still have their instances
    with _lock:
        taken = _taken(content)
        if sum(claim.instances for claim in taken) + count > spec.max_instances:
            name, most = fmu.path.name, spec.max_instances
            raise LicenceError(_refusal(name, most, count, purpose, taken))
        claim = Claim(content, count, purpose)
        _claims[id(claim)] = claim
    return claim


def _taken(content: str) -> list[Claim]:
    claims = [reference() for reference in _claims.valuerefs()]
    return [claim for claim in claims if claim is not None and claim.content == content]


def _refusal(name: str, most: int, count: int, purpose: str, taken: list[Claim]) -> str:
    told = ", ".join(sorted(map(str, taken))) or "none"
    advice = "; close environments that you no longer use" if taken else ""
    return (
        f"{name} needs {count} more instance(s) for {purpose}, but 'max_instances' of 'foreign' "
        f"allows {most} at once in this process, and of these are in use: {told}{advice}"
    )
