"""Tags: the places of a task's variables on the server of a plant."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fmugym.checks import Spellings, by_own_names
from fmugym.errors import ConfigError, unknown_name
from fmugym.fmi.units import IDENTITY, Conversion, conversion_between, conversion_of
from fmugym.fmi.variable import Variable
from fmugym.records.plant_log import declared_as
from fmugym.task import TaskEnv
from fmugym.task.data_rows import standard_time
from fmugym.task.task_entries import Entry

__all__ = ["DATA_PREFIX", "Plant", "Tag", "read_plant"]

DATA_PREFIX = "data."
"""Beginning of the names of tags of live data."""


@dataclass(frozen=True)
class Tag:
    """A variable of a plant.

    Attributes:
        name: The name in the task.
        entry: Entry of the task.
        address: The keys of its address.
        conversion: From the plant's number to the unit of the task.
        count: How many numbers there are.
        low, high: The limits of the task, infinite where there are none.
        own: The name in the FMU, if the task writes or reads it there; "" for time and data.
        to_task: From the FMU's unit to that of the task.
        sampling: What of its readings within a step counts.
    """

    name: str
    entry: Entry
    address: Mapping[str, Any]
    conversion: Conversion
    count: int = 1
    low: float = -math.inf
    high: float = math.inf
    own: str = ""
    to_task: Conversion = IDENTITY
    sampling: str = "last"

    def of_fmu(self, values: Mapping[str, Any]) -> Any:
        """Its value in the unit of the task, of the FMU's values by name."""
        return self.to_task(values[self.own])

    def misfit(self, number: float) -> str:
        """Describe a number that a wrong type would make; "" for a plausible one."""
        width = self.high - self.low
        if math.isinf(width) or self.low - width <= number <= self.high + width:
            return ""
        return (
            f"got {number:.6g}, expected {self.low:g} to {self.high:g} or not far from it: are "
            "'type', 'word_order', 'scale' and 'unit' right?"
        )


@dataclass(frozen=True)
class Plant:
    """The section ``[plant]`` of a task.

    Attributes:
        entry: Entry of the task.
        address: Address of the server.
        tags: By name.
        data: Sources of live data, by their names in the task.
        step: The time step of the task in seconds.
        poll, stale_after, hold: In seconds.
        standard: The offset of the task's standard time in seconds east of UTC; None if nothing
            tells it.
    """

    entry: Entry
    address: str
    tags: Mapping[str, Tag]
    data: Mapping[str, Entry]
    step: float
    poll: float
    stale_after: float
    hold: float
    standard: int | None = None

    def __getitem__(self, key: str) -> Any:
        """The value of a key; None if it is not given."""
        return self.entry.value.get(key)

    def of(self, variables: Iterable[Variable]) -> list[Tag]:
        """The tags of some of the FMU's variables."""
        names = {one.name for one in variables}
        return [tag for tag in self.tags.values() if tag.own in names]

    def require(self, variable: Variable, name: str = "") -> None:
        """Refuse a plant without a tag for a variable that the task needs, by its name there."""
        if not self.of([variable]):
            text = f"[plant] has no tag for {name or variable.name!r}, which the task needs"
            raise ConfigError(text)


def read_plant(env: TaskEnv, address: str | None = None) -> Plant:
    """Read the section of a plant.

    Args:
        env: The environment of its task.
        address: In the place of that of the task.

    Raises:
        ConfigError: If there is none, or a name or a unit is wrong. The text says where.
    """
    entry, step = env.task.root.child("plant"), env.pool_spec.time_step
    if entry.value is None:
        raise env.task.root.error("the task has no [plant], which says where a plant has what")
    data = _data(env, entry)
    tags = {tag.name: tag for tag in _tags(env, entry, data)}
    poll = entry.value.get("poll") or step / 10
    stale = entry.value.get("stale_after") or 3 * poll
    hold = entry.value.get("hold")
    address = address or entry.value["address"]
    standard = standard_time(env.task.root).offset
    hold = step if hold is None else hold
    return Plant(entry, address, tags, data, step, poll, stale, hold, standard)


def _data(env: TaskEnv, entry: Entry) -> dict[str, Entry]:
    """Sources of live data, by their names in the task."""
    spellings = Spellings("data", env.task.document.get("data", {}))
    given = entry.child("data").items()

    def own_name(name: str) -> str:
        with given[name].placing():
            return spellings.require(name)

    with entry.child("data").placing():
        return by_own_names("data of the plant", given, own_name)


def _tags(env: TaskEnv, entry: Entry, data: Mapping[str, Entry]) -> Iterator[Tag]:
    known = {one.name: one for one in env.resolved.quantities().all}
    others = {*env.task.document.get("variables", ()), *env.fmu.description.variables}
    spellings = Spellings("variable of the task", dict.fromkeys([*known, *others]))
    with entry.child("tags").placing():
        given = entry.child("tags").items()
        tags = by_own_names("tags", given, lambda name: spellings.find(name) or name)
    for name, one in tags.items():
        if name in known:
            low, high = known[name].low, known[name].high
            yield _tag(env, name, one, known[name].unit, low=low, high=high, **_in_fmu(env, name))
        elif name not in others:  # the task does not read the others
            raise one.error(unknown_name("variable of the task", name, [*known, *others]))
    if entry.child("clock").value is not None:
        yield _tag(env, "clock", entry.child("clock"), "s")
    for name, one in data.items():
        if "file" not in one.value:
            yield _tag(
                env, DATA_PREFIX + name, one, env.task.document["data"][name].get("unit", "")
            )


def _in_fmu(env: TaskEnv, name: str) -> dict[str, Any]:
    """Conversion from a tag to the FMU's variable of this name, if the task uses it."""
    own, unit = declared_as(env, name)
    spec = env.pool_spec
    for one in (*spec.outputs, *spec.inputs):
        if one.name == own:
            to_task = conversion_of(one, unit, env.fmu.description.units)
            sampling = "median" if one in spec.inputs else one.sampling
            return {"own": own, "to_task": to_task, "sampling": sampling}
    return {}


def _tag(env: TaskEnv, name: str, entry: Entry, unit: str, **others: Any) -> Tag:
    given = entry.value
    protocol = env.task.root.child("plant").child("protocol").value
    key = "node" if protocol == "opcua" else "register"
    if key not in given:
        raise entry.error(f"the protocol {protocol!r} needs the key {key!r}")
    with entry.placing():
        own = conversion_between(given.get("unit"), unit or None, env.fmu.description.units)
    in_fmu = env.fmu.description.find(others.get("own", ""))
    own = own.of_differences(in_fmu is not None and in_fmu.relative)
    raw = Conversion(given["scale"], given["offset"])
    return Tag(name, entry, given, own.after(raw), given.get("count", 1), **others)
