"""Roles of variables: inputs and outputs of an environment."""

from __future__ import annotations

from typing import Final

from fmugym.archive.description import ModelDescription
from fmugym.archive.variable import Variable
from fmugym.errors import ConfigError

__all__ = [
    "check_input",
    "check_output",
    "check_readable",
    "require_not_driven",
    "require_numeric",
]

_CURES: Final = {
    "String": ". 'model_parameters' can give a scalar String the text that it starts with; to read "
    "what a String tells, let the FMU tell the same by a number or an Enumeration",
    "Binary": ". Nobody but the FMU knows what its bytes mean: let it tell what you need by "
    "numbers",
}


def check_input(description: ModelDescription, variable: Variable) -> None:
    """Check that a variable can be written before every step.

    Raises:
        ConfigError: If it cannot.
    """
    require_numeric(variable, "an input")
    _require_known_clock(description, variable, "an input")
    if not variable.settable_in_step:
        require_not_driven(description, variable, "be an input")
        raise ConfigError(
            f"{variable.name!r} cannot be an input: it is a {variable.variability} "
            f"{variable.causality}; only inputs and tunable parameters may be set between steps"
        )


def require_not_driven(description: ModelDescription, variable: Variable, what: str) -> None:
    """Check that no connection of a system gives a variable its values.

    Args:
        description: That of the FMU or the system.
        variable: One of its variables.
        what: What the variable cannot do if it is driven, for the message.

    Raises:
        ConfigError: If something drives it.
    """
    source = description.what_drives(variable)
    if source is not None:
        raise ConfigError(
            f"{variable.name!r} cannot {what}: the system connects it with {source!r}, which gives "
            "it its value"
        )


def check_output(description: ModelDescription, variable: Variable) -> None:
    """Check that a variable can be read after every step, and observed.

    Raises:
        ConfigError: If it cannot.
    """
    require_numeric(variable, "an output")
    _require_known_clock(description, variable, "an output")


def check_readable(description: ModelDescription, variable: Variable) -> None:
    """Check a variable that is read, but not observed; see ``check_output``.

    Raises:
        ConfigError: If it cannot be read.
    """
    require_numeric(variable, "read in episodes")
    _require_known_clock(description, variable, "read in episodes")


def _require_known_clock(description: ModelDescription, variable: Variable, role: str) -> None:
    if not variable.ticking:
        return
    if variable not in description.clocks:
        raise ConfigError(
            f"{variable.name!r} cannot be {role}: it is a clock, and {description.model_name} has "
            "no event mode in co-simulation"
        )
    if role == "an input" and not variable.settable_in_step:
        raise ConfigError(
            f"{variable.name!r} cannot be {role}: it is a clock of "
            f"causality={variable.causality!r} and intervalVariability={variable.ticking!r}, which "
            "ticks by itself; only triggered input clocks may be set"
        )


def require_numeric(variable: Variable, role: str) -> None:
    """Check that a variable is a number, or a clock.

    Raises:
        ConfigError: If it is not; the message names the role that it should have.
    """
    if variable.numeric or variable.ticking:
        return
    if variable.is_number:
        raise ConfigError(
            f"{variable.name!r} cannot be {role}: it is an array; name its elements, as in "
            f"'{variable.name}[1]'"
        )
    element = "" if variable.array is None else "an element of an array "
    raise ConfigError(
        f"{variable.name!r} cannot be {role}: it is {element}of type {variable.type}; "
        f"expected a Real, Integer, Boolean or Enumeration{_CURES.get(variable.type, '')}"
    )
