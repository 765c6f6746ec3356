"""The choice of a reset method for each component of a system, by comparison with fresh systems."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from fmugym.fmi.description import ModelDescription
from fmugym.pool.pool_spec import ResetMethod

__all__ = ["find_component_resets", "offers_of"]

ComponentResets = tuple[ResetMethod, ...]

_METHODS: Final = list(ResetMethod)


def offers_of(component: ModelDescription, *, reloads: bool) -> list[ResetMethod]:
    """The reset methods that a component offers, the fastest first.

    Args:
        component: The description of its FMU.
        reloads: Whether libraries can be loaded anew.
    """
    offers = [ResetMethod.RESTORE] if component.capabilities.can_get_and_set_fmu_state else []
    offers += [ResetMethod.RESET] if component.has_reset else []
    offers += [ResetMethod.INSTANCE]
    return [*offers, ResetMethod.LIBRARY] if reloads else offers


def find_component_resets(
    offers: Sequence[Sequence[ResetMethod]],
    base: ResetMethod,
    is_right: Callable[[ComponentResets], bool],
) -> ComponentResets:
    """Find the fastest reset method of each component with which the system begins anew.

    Often all honest components can begin by the fastest method that they offer. If not, each one
    is tried while the others begin by a method that is known to work.

    Args:
        offers: For each component, the methods that it offers, the fastest first.
        base: The method with which the system begins anew as a whole.
        is_right: Whether the system begins anew with a method for each component, bit by bit.

    Returns:
        A method for each component; empty if none can begin by a faster one than ``base``.
    """
    sure = _METHODS[_METHODS.index(base) :]
    slow = tuple(next((one for one in own if one in sure), own[-1]) for own in offers)
    fast = tuple(own[0] for own in offers)
    if fast == slow:
        return ()
    if is_right(fast):
        return fast
    found = tuple(_fastest(slow, index, own, is_right) for index, own in enumerate(offers))
    changes = sum(one is not other for one, other in zip(found, slow, strict=True))
    good = changes == 1 or (changes > 1 and is_right(found))
    return found if good else ()


def _fastest(
    slow: ComponentResets,
    index: int,
    offers: Sequence[ResetMethod],
    is_right: Callable[[ComponentResets], bool],
) -> ResetMethod:
    """The fastest method by which one component can begin while the others begin as before."""
    return next(
        method
        for method in offers
        if method is slow[index] or is_right((*slow[:index], method, *slow[index + 1 :]))
    )
