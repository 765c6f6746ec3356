"""Numbers of the bundled tasks, such as limits: episode variables that are attributes, too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Never

from fmugym.checks import check_mapping
from fmugym.environment.distributions import is_distribution, support_of
from fmugym.errors import ConfigError

__all__ = ["TaskNumber", "largest", "with_task_numbers"]


class TaskNumber:
    """A number of a task as an attribute, which is the episode variable of this name.

    Expressions read the variable. So assigning to the attribute raises a ``ConfigError``.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, env: Any, owner: type) -> Any:
        return self if env is None else env.variables[self._name]

    def __set__(self, env: Any, value: object) -> Never:
        name = self._name
        raise ConfigError(
            f"{name!r} cannot be assigned: it is a number of the task. Give it to the constructor, "
            f"or set env.variables[{name!r}] for this episode"
        )


def with_task_numbers(
    numbers: Mapping[str, Any], given: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Tell the numbers of a task from the parameters of its FMU.

    Args:
        numbers: Numbers of the task by name, with their defaults.
        given: Values or distributions that the user gives, of both.

    Returns:
        What is given for parameters, and all numbers of the task.

    Raises:
        ConfigError: If ``given`` is no mapping.
    """
    given = check_mapping("model_parameters", given)
    own = {name: given.get(name, default) for name, default in numbers.items()}
    return {name: value for name, value in given.items() if name not in own}, own


def largest(number: Any) -> float:
    """The largest value of a number that may be drawn."""
    return float(support_of(number)[1] if is_distribution(number) else number)
