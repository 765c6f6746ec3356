"""Live data of a task, which a plant or a refreshed file tells while an episode runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from fmugym.archive.units import conversion_between
from fmugym.declared.data_rows import read_rows
from fmugym.declared.entries import Entry
from fmugym.declared.spelling import as_declared
from fmugym.errors import ConfigError, shown
from fmugym.logs import declared_as
from fmugym.plant.tags import DATA_PREFIX, Plant
from fmugym.pool.base import FloatArray

__all__ = ["Live", "forecasts", "horizon"]

_JUST = 1e-6


class Live:
    """The data of environments, as they are known at a tick.

    Args:
        envs: They read the data; the agent of the first one sees them.
        plant: Says where they come from.

    Raises:
        ConfigError: If the agent sees data that have no live source, or not far enough ahead.
    """

    def __init__(self, envs: Sequence[Any], plant: Plant) -> None:
        self._envs = envs
        root = as_declared(envs[0].task.root, envs[0].fmu.description)[0]
        self._standard, self._entries = plant.standard, plant.data
        self._ahead = {name: horizon(root, name) for name in self._entries}
        for name in sorted(_seen(root)):
            if name not in self._entries:
                text = f"the agent sees {name!r}: say in [plant.data] where it comes from"
                raise root.child("data").child(name).error(text)
        history = root.child("agent").child("history").value or {}
        self._kept = history.get("length", 0.0) + 3 * plant.step
        self._past: dict[str, list[tuple[float, float]]] = {name: [] for name in self._entries}
        self._require_tags()
        self._units = envs[0].fmu.description.units
        self._relative = set(_relative(envs[0], self._past))
        self._own = {name: root.child("data").child(name).value.get("unit") for name in self._past}

    def _require_tags(self) -> None:
        """Refuse tags that do not tell as much as the agent sees."""
        for name, entry in self._entries.items():
            count, step = entry.value.get("count", 1), entry.value.get("step")
            if "file" in entry.value or count == 1:
                continue
            ahead = self._ahead[name]
            if step is None or (count - 1) * step < ahead:
                raise entry.error(
                    f"the agent sees {ahead:g} s ahead: expected 'count' values that are "
                    f"'step' apart to go as far, got {count} and {step}"
                )

    def refresh(self, now: float, tags: dict[str, tuple[float, ...]]) -> dict[str, str]:
        """Let environments look up the data that are known now.

        Args:
            now: The plant's time, in seconds of the year.
            tags: The values of the tags.

        Returns:
            What is wrong with files, by the names of data.
        """
        faults: dict[str, str] = {}
        for name, entry in self._entries.items():
            try:
                rows = self._rows(name, entry, now, tags)
            except ConfigError as error:
                faults[DATA_PREFIX + name] = str(error)
            else:
                self._write(name, *rows)
        return faults

    def _rows(
        self, name: str, entry: Entry, now: float, tags: dict[str, tuple[float, ...]]
    ) -> tuple[FloatArray, FloatArray]:
        """Times from now on, in seconds of the year, and the values in the unit of the data."""
        if "file" not in entry.value:
            values = np.array(tags[DATA_PREFIX + name])
            return now + np.arange(len(values)) * (entry.value.get("step") or 1.0), values
        rows = read_rows(entry, self._standard)
        with entry.placing():
            rows.require_no_gap(None)
        times, values = rows.known()
        given, own = entry.value.get("unit"), self._own[name]
        unit: Any = conversion_between(given, own, self._units)
        values = unit.of_differences(name in self._relative)(values)
        holds = entry.value["interpolation"] == "previous"
        end = times[-1] + (times[-1] - times[-2] if holds and len(times) > 1 else 0.0)
        ahead = self._ahead[name]
        if not times[0] <= now + _JUST or end < now + ahead:
            raise ConfigError(
                f"{shown(entry.value['file'])} has {times[0]:.10g} s to {end:.10g} s, expected "
                f"{now:.10g} s and {ahead:g} s more"
            )
        first = np.searchsorted(times, now + _JUST, side="right")
        present = values[first - 1] if holds else np.interp(now, times, values)
        return np.append(now, times[first:]), np.append(present, values[first:])

    def _write(self, name: str, times: FloatArray, values: FloatArray) -> None:
        past, now = self._past[name], float(times[0])
        past[:] = [one for one in past if now - self._kept < one[0] < now]
        before = np.reshape(past, (-1, 2)).T
        past.append((now, float(values[0])))
        times, values = np.append(before[0], times), np.append(before[1], values)
        for env in self._envs:
            if lookup := env.resolved.future.lookups.get(name):
                fits = times < times[0] + lookup.period
                table = lookup.table_of(name, (times[fits], values[fits]))
                lookup.tables[lookup.key] = table


def forecasts(root: Entry, name: str) -> list[Any]:
    """The forecasts in which the agent sees some data."""
    return [one for one in root.child("agent").child("forecast").value or () if name in one["of"]]


def _relative(env: Any, names: Iterable[str]) -> Iterator[str]:
    """The data that an input gets which is a difference, whose unit has no offset."""
    for name in names:
        to = env.task.root.child("data").child(name).value.get("input")
        variable = env.fmu.description.find(declared_as(env, to)[0]) if to else None
        if variable is not None and variable.relative:
            yield name


def horizon(root: Entry, name: str) -> float:
    """Largest forecast horizon of some data, in seconds."""
    return max((float(one["horizon"]) for one in forecasts(root, name)), default=0.0)


def _seen(root: Entry) -> set[str]:
    """The data that the agent sees: now, ahead, in the past, and in expressions."""
    agent = root.child("agent").value or {}
    left = {*agent.get("observations", ()), *(agent.get("history") or {}).get("of", ())}
    left |= {name for one in agent.get("forecast") or () for name in one["of"]}
    data, expressions, setpoints = (
        root.child(key).value or {} for key in ("data", "expressions", "setpoints")
    )
    looked_at: set[str] = set()
    while left := left - looked_at:
        name = left.pop()
        looked_at.add(name)
        if name in expressions:
            left |= expressions[name]["expr"].names
        if (setpoints.get(name) or {}).get("data") is not None:
            raise (
                root.child("setpoints")
                .child(name)
                .error(
                    f"the agent sees {name!r}, which follows data: a plant has set points with a "
                    "schedule or a value"
                )
            )
    return looked_at & data.keys()
