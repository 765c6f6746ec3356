"""Default section ``[plant]`` of a task: a server on the loopback, with a tag for each value."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from typing import Any, Final

from fmugym.declared import Task, TaskEnv
from fmugym.declared.spelling import as_declared
from fmugym.errors import ConfigError
from fmugym.plant.live import forecasts, horizon
from fmugym.plant.serving import environment

__all__ = ["with_plant"]

_SECTIONS: Final[dict[str, dict[str, Any]]] = {
    "modbus": {"protocol": "modbus", "address": "127.0.0.1:502"},
    "opcua": {"protocol": "opcua", "address": "opc.tcp://127.0.0.1:4840", "encryption": False},
}
"""Of the loopback, on which nobody reads along."""


def with_plant(task: Task, protocol: str) -> Task:
    """Give a task a plant on the loopback if it has none, and check the protocol of its own.

    There are tags for the clock, the actions, the outputs that the task reads, and for its data, as
    far ahead as the agent sees them.

    Args:
        task: The task.
        protocol: ``"modbus"`` or ``"opcua"``.

    Raises:
        ConfigError: If the plant of the task has another protocol, or the task has a mistake.
    """
    own = task.document.get("plant", {}).get("protocol", protocol)
    if own != protocol:
        raise ConfigError(f"[plant] of the task has the protocol {own!r}, not {protocol!r}")
    if "plant" in task.document:
        return task
    with closing(environment(task)) as env:
        return replace(task, document={**task.document, "plant": _section(env, protocol)})


def _section(env: Any, protocol: str) -> dict[str, Any]:
    """All tags, one after another."""
    register = 4  # the clock takes those before
    found: dict[str, dict[str, Any]] = {"tags": {}, "data": {}}
    for one in env.resolved.quantities().all:
        if one.kind not in ("action", "output", "data"):
            continue
        ahead = _ahead(env, one.name) if one.kind == "data" else {}
        where = {"node": f"ns=2;s={one.name}"} if protocol == "opcua" else {"register": register}
        found["data" if one.kind == "data" else "tags"][one.name] = where | ahead
        register += 2 * ahead.get("count", 1)
    clock = {"node": "ns=2;s=clock"} if protocol == "opcua" else {"register": 0, "type": "float64"}
    return {**_SECTIONS[protocol], "clock": clock, **{k: v for k, v in found.items() if v}}


def _ahead(env: TaskEnv, name: str) -> dict[str, Any]:
    """Number of data values that the agent's forecasts need."""
    root = as_declared(env.task.root, env.fmu.description)[0]
    own = env.pool_spec.time_step
    steps = [one.get("step") or own for one in forecasts(root, name)]
    if not steps:
        return {}
    return {"count": round(horizon(root, name) / min(steps)) + 1, "step": min(steps)}
