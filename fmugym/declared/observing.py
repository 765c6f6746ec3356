"""What the agent observes: values, forecasts and histories."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from fmugym.declared.declarations import Declarations
from fmugym.declared.entries import Entry
from fmugym.declared.naming import Moment, Naming
from fmugym.declared.quantities import duration
from fmugym.pool.spec import whole_number_of_steps

__all__ = ["History", "Seen", "histories", "normalized", "observed_values", "remember"]


class Seen(NamedTuple):
    """A number that the agent observes.

    Attributes:
        entry: Where it is declared.
        name: What it is the value of.
        code: Its code.
        low, high: Its limits.
        place: Which value of a forecast or history it is, such as ``"[+3600 s]"``.
    """

    entry: Entry
    name: str
    code: str
    low: float
    high: float
    place: str = ""


class History(NamedTuple):
    """The last values of a name.

    Attributes:
        name: The name.
        variable: The episode variable that holds them, the latest first.
        length: How many they are.
        now: Code for the value that is added when the FMU has stepped.
        fill: Code for the other values in the first step.
        first: Code for all values at the beginning of an episode.
    """

    name: str
    variable: str
    length: int
    now: str
    fill: str
    first: str


def histories(declared: Declarations, naming: Naming, time_step: float) -> list[History]:
    """The histories that the agent sees, of values that no function of time gives.

    The history of a variable holds its values before the present one. That of an action begins with
    the action of the step that has just ended.

    Raises:
        ConfigError: If a name has no value before the step.
    """
    entry = declared.root.child("agent").child("history")
    kept = []
    for name in declared.remembered:
        if name in declared.series:
            continue
        present, codes = naming.code_of(name, Moment.SEEN), naming.kept(name)
        if present is None or codes is None:
            raise entry.error(
                f"there is no history of {name!r}: it is kept for variables of the FMU, actions, "
                "data and schedules"
            )
        length = _count(entry.required("length"), time_step)
        kept.append(History(name, f"history of {name}", length, *codes, present.text))
    return kept


def observed_values(
    declared: Declarations, naming: Naming, kept: list[History], time_step: float
) -> list[Seen]:
    """The numbers that the agent observes, in their order.

    Raises:
        ConfigError: If one is a constant, or there is no forecast or history of it.
    """
    present = list(_present(declared, naming))
    return [
        *present,
        *_forecasts(declared, naming, time_step),
        *_past(declared, naming, kept, time_step),
    ]


def _present(declared: Declarations, naming: Naming) -> Iterator[Seen]:
    for entry, name in declared.observed:
        code = naming.code_of(name, Moment.SEEN)
        if code is None or code.value is not None:
            raise entry.error(f"{name!r} is a constant, which an agent need not observe")
        yield Seen(entry, name, code.number.text, *declared.limits_of(name))


def _forecasts(declared: Declarations, naming: Naming, time_step: float) -> Iterator[Seen]:
    section = declared.root.child("agent").child("forecast")
    if section.value is None:
        return
    for entry in [section] if isinstance(section.value, Mapping) else section.elements():
        table = entry.table(("of", "horizon", "step"))
        step = table["step"].check(duration) if "step" in table else time_step
        count = _count(entry.required("horizon"), step)
        names = entry.required("of")
        for one in [names] if isinstance(names.value, str) else names.elements():
            name = one.text()
            for index in range(1, count + 1):
                code = naming.forecast(one, name, index * step)
                place = f"[+{index * step:g} s]"
                yield Seen(one, name, code, *declared.limits_of(name), place)


def _past(
    declared: Declarations, naming: Naming, kept: list[History], time_step: float
) -> Iterator[Seen]:
    entry = declared.root.child("agent").child("history")
    of_variables = {history.name: history for history in kept}
    for name in declared.remembered:
        limits = declared.limits_of(name)
        for index in range(_count(entry.required("length"), time_step)):
            if name in of_variables:
                history = of_variables[name]
                past = f"env.variables[{history.variable!r}][{index}]"
                code = f"where(env.step_count == 0, {history.first}, {past})"
            else:
                code = naming.forecast(entry, name, -(index + 1) * time_step)
            yield Seen(entry, name, code, *limits, f"[-{(index + 1) * time_step:g} s]")


def _count(entry: Entry, step: float) -> int:
    length = entry.check(duration)
    count = whole_number_of_steps(length, step) if step > 0 else 0
    if not count:
        raise entry.error(f"{length:g} s is no multiple of the step of {step:g} s")
    return count


def normalized(seen: Seen) -> str:
    """Code for a value that lies between -1 and 1 where it is within its limits.

    Raises:
        ConfigError: If a limit is infinite.
    """
    if not np.isfinite([seen.low, seen.high]).all():
        raise seen.entry.error(
            f"{seen.name!r} needs 'min' and 'max' so that observations can be normalized"
        )
    middle, half = (seen.low + seen.high) / 2, (seen.high - seen.low) / 2
    return f"(({seen.code} - {middle!r}) / {half!r})"


def remember(
    kept: list[History], values: Callable[[Any], Any], fills: Callable[[Any], Any]
) -> Callable[[Any], None]:
    """Make a function of the environment that adds the latest values to histories.

    Args:
        kept: The histories.
        values: Gives the values to add.
        fills: Gives the other values in the first step.
    """
    names = [history.variable for history in kept]

    def update(env: Any) -> None:
        is_first, variables = env.step_count == 1, env.variables
        for name, value, fill in zip(names, values(env), fills(env), strict=True):
            variables[name] = _pushed(variables[name], value, fill, is_first)

    return update


def _pushed(past: Any, value: Any, fill: Any, is_first: Any) -> Any:
    before = np.where(is_first, np.asarray(fill)[np.newaxis], past)
    return np.concatenate([np.asarray(value)[np.newaxis], before[:-1]])
