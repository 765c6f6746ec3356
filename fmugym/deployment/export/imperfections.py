"""Imperfections of sensors and actuators, which a plant has and its controller leaves out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any, Final

from fmugym.environment.env import FMUEnv
from fmugym.task import TaskEnv
from fmugym.task.task_keys import DEVICE

__all__ = ["ideal", "without_imperfections"]

_OF_ACTUATORS: Final = ("delay", "bias", "noise", "drop_out")
"""An actuator has these itself. Its limits, steps and rates are the controller's to keep, too."""


@contextmanager
def without_imperfections(env: FMUEnv) -> Iterator[FMUEnv]:
    """Give an environment ideal sensors, so that a controller reads what they measure.

    The delay, bias, noise and drop-outs of actuators, errors of forecasts and warm-ups are left
    out, too: they happen to the controller, and are not its doing.

    Args:
        env: The environment of a task.

    Yields:
        The same environment if there is nothing to leave out; otherwise another one, which is
        closed in the end.
    """
    document = ideal(env.task.document) if isinstance(env, TaskEnv) else None
    if document is None or document == env.task.document:  # type: ignore[attr-defined]  # a TaskEnv
        yield env
        return
    task: Any = replace(env.task, document=document)  # type: ignore[attr-defined]  # as above
    other: Any = TaskEnv.__new__(type(env))
    TaskEnv.__init__(other, task)
    for name, value in vars(env).items():  # those that the class's own constructor has set
        if not name.startswith("_"):
            vars(other).setdefault(name, value)
    # the first sample is taken when the warm-up is over
    other.warm_up_steps = env.warm_up_steps
    with closing(other):
        yield other


def ideal(
    document: Mapping[str, Any], of_actuators: Iterable[str] = _OF_ACTUATORS
) -> dict[str, Any]:
    """Return a task's document without its sensors, errors of forecasts and warm-up.

    Args:
        document: The document.
        of_actuators: The keys of actuators that are left out, too.
    """
    ideal: dict[str, Any] = _without(document, ("warm_up",))
    agent = document.get("agent", {})
    actions = agent.get("actions", ())
    actions = [actions] if isinstance(actions, str) else actions
    if "variables" in document:
        ideal["variables"] = {
            name: _without(one, of_actuators if name in actions else DEVICE)
            for name, one in document["variables"].items()
        }
    if "forecast" in agent:
        ideal["agent"] = {**agent, "forecast": _exact(agent["forecast"])}
    return ideal


def _exact(forecast: Any) -> Any:
    if isinstance(forecast, Mapping):
        return _without(forecast, ("error",))
    return [_without(one, ("error",)) for one in forecast]


def _without(table: Any, keys: Iterable[str]) -> Any:
    if not isinstance(table, Mapping):
        return table
    return {key: value for key, value in table.items() if key not in keys}
