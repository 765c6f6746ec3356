"""The formulas of a class: the expressions in its config, as values of one graph."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.environment.config import EnvConfig
from fmugym.environment.interface import Interface
from fmugym.environment.spaces import discrete_values
from fmugym.errors import ConfigError, shown
from fmugym.expressions.functions import FUNCTIONS
from fmugym.expressions.graph import Computed, Formulas, Graph, Value, where
from fmugym.expressions.language import CONSTANTS, Expression, Names
from fmugym.expressions.quantities import QUANTITIES
from fmugym.fmi.description import ModelDescription

__all__ = ["class_formulas", "with_monitors"]

_CLOCKS: Final = ("time", "clock", "elapsed", "step", "dt", "dt_h")
_FLAGS: Final = ("done", "after_end")
_ACTION: Final = "action"
_SECONDS_PER_HOUR: Final = 3600.0
_RESERVED: Final = frozenset({*CONSTANTS, *FUNCTIONS, *_CLOCKS, *_FLAGS, _ACTION, "previous"})


def with_monitors(config: EnvConfig, description: ModelDescription) -> EnvConfig:
    """The config that also reads those variables of the FMU that its expressions name."""
    own = {*CONSTANTS, *_CLOCKS, *_FLAGS, *config.variable_starts}
    known = own.union(config.model_input_names, config.model_output_names, config.model_parameters)
    names = sorted(set().union(*(one.names for one in config.expressions)) - known)
    found = dict.fromkeys(filter(None, map(description.find, names)))
    listed = {v for name in _listed(config) for v in description.scalars(name)}
    added = [variable.name for variable in found if variable not in listed]
    return replace(config, monitor_names=(*config.monitor_names, *added))


def _listed(config: EnvConfig) -> Iterator[str]:
    """Names of the inputs, outputs, monitored variables and parameters."""
    yield from config.model_input_names
    yield from config.model_output_names
    yield from config.monitor_names
    yield from config.model_parameters


def class_formulas(
    config: EnvConfig, interface: Interface, space: spaces.Space[Any], has_inputs: bool
) -> Formulas | None:
    """Make the formulas of a class.

    Args:
        config: The config.
        interface: The same with the variables of the FMU.
        space: The action space.
        has_inputs: Whether a hook of the class makes the inputs. Then the expressions for them need
            not fit the action space, which the class may have changed, too.

    Returns:
        None if the config has no expressions.

    Raises:
        ConfigError: If an expression does not fit; the text names the key, and all mistakes.
    """
    if not config.expressions:
        return None
    return _ClassFormulas(config, interface, space).made(has_inputs)


class _ClassFormulas:
    """Makes the formulas of a class, see ``class_formulas``."""

    def __init__(self, config: EnvConfig, interface: Interface, space: spaces.Space[Any]) -> None:
        self._config, self._interface, self._space = config, interface, space
        self._graph = Graph()
        self._mistakes: dict[str, None] = {}
        self._numbers = self._numbers_of_episodes()

    def made(self, has_inputs: bool) -> Formulas:
        """The formulas, in which no mistake is left."""
        config = self._config
        inputs = self._inputs() if config.inputs else None
        if self._mistakes and has_inputs:
            inputs, self._mistakes = None, {}
        for name in _RESERVED.intersection(config.variable_starts):
            text = f"the episode variable {name!r} has a name with a meaning of its own"
            self._mistakes[f"{text} in expressions; rename it"] = None
        formulas = Formulas(
            self._graph,
            inputs,
            [one for one in [self._updates()] if one],
            self._condition("terminated", config.terminated, is_judged=False),
            self._condition("truncated", config.truncated),
            self._reward(),
            self._observation(),
            self._info(),
        )
        if self._mistakes:
            raise ConfigError("; ".join(self._mistakes))
        return formulas

    # What names stand for.

    def _numbers_of_episodes(self) -> dict[str, Value]:
        """The values of an episode by name, those of the FMU last."""
        inputs, parameters = self._interface.inputs, self._interface.parameters
        read = self._interface.outputs + self._interface.monitors
        numbers = {v.name: self._read("inputs", i) for i, v in enumerate(inputs)}
        numbers |= {
            name: self._read("parameters", name)
            for name in parameters
            if self._interface.parameter_variables[name].kind != "string"
        }
        numbers |= {v.name: self._read("outputs", i) for i, v in enumerate(read)}
        for name, start in self._config.variable_starts.items():
            elements = _elements(name, np.shape(start))
            numbers |= {own: self._read("variables", name, *place) for own, place in elements}
        return numbers | self._actions(_ACTION)

    def _actions(self, quantity: str) -> dict[str, Value]:
        """The elements of the action, or of the one before, by the names of the action."""
        dtype = self._space.dtype
        return {
            name: Value.read(self._graph, quantity, *place, dtype=dtype).cast(np.float64)
            for name, place in _elements(_ACTION, self._space.shape or ())
            if dtype is not None
        }

    def _read(self, quantity: str, *keys: str | int) -> Value:
        return Value.read(self._graph, quantity, *keys)

    def _clock(self, name: str) -> Value:
        step, dt = self._read("step_count").number, self._interface.time_step
        match name:
            case "time" | "clock":
                return self._read("time")
            case "elapsed":
                return step * dt
            case "step":
                return step
            case "dt":
                return Value.of(self._graph, dt)
        return Value.of(self._graph, dt / _SECONDS_PER_HOUR)

    def _found(self, name: str, is_judged: bool) -> Value | None:
        if name in _CLOCKS:
            return self._clock(name)
        if name == "done" and not is_judged:
            places = "'reward', 'costs', 'info', 'observations' and 'truncated'"
            raise ConfigError(f"'done' is known in {places} only")
        if name in _FLAGS:
            return self._read(name)
        value = self._numbers.get(name)
        if value is None:
            variable = self._interface.description.find(name)
            if variable is not None and variable.kind == "string":
                raise ConfigError(f"{name!r} is a String: expressions have numbers only")
            value = None if variable is None else self._numbers.get(variable.name)
        return value

    def _found_before(self, name: str, has_stepped: bool) -> Value | None:
        """The value before the step: of actions, of other quantities that keep it, and of outputs.

        That of outputs is known once the FMU has stepped.
        """
        interface = self._interface
        variable = interface.description.find(name)
        own = name if variable is None else variable.name
        names: dict[str, Sequence[str]] = {"inputs": interface.input_names}
        if has_stepped:
            names["state"] = [one.name for one in interface.outputs]
        for quantity in QUANTITIES.values():
            if own in names.get(quantity.of, ()):
                return self._read(quantity.name, names[quantity.of].index(own))
        return self._actions("previous_action").get(name)

    def _names(self, is_judged: bool = True, has_stepped: bool = True) -> Names:
        known = [*_CLOCKS, *_FLAGS, *self._numbers]
        return Names(
            self._graph,
            lambda name: self._found(name, is_judged),
            lambda name: self._found_before(name, has_stepped),
            lambda: known,
        )

    def _value(self, key: str, expression: Expression, names: Names | None = None) -> Value:
        """The value of an expression; a mistake in it is noted."""
        try:
            return expression.value(self._names() if names is None else names)
        except ConfigError as error:
            self._mistakes[f"config key {key!r}: {error}"] = None
            return Value.of(self._graph, 0.0)

    def _number(self, key: str, expression: Expression, names: Names | None = None) -> Value:
        return self._value(key, expression, names).number

    # The formulas.

    def _inputs(self) -> Sequence[Value]:
        """The inputs; expressions of some read what the action writes to the others."""
        values, given = self._chosen(), self._interface.expressions_of_inputs
        names = self._names(is_judged=False, has_stepped=False)
        found = names.find
        names = names._replace(find=lambda name: values.get(name) or found(name))
        for name, expression in given.items():
            values[name] = self._number("inputs", expression, names)
        return [values[name] for name in self._interface.input_names]

    def _chosen(self) -> dict[str, Value]:
        """The elements of the action for the inputs that no expression writes, by their names."""
        chosen = self._interface.chosen_inputs
        elements = list(self._actions(_ACTION).values())
        if chosen and len(elements) != len(chosen):
            names = ", ".join(repr(v.name) for v in chosen)
            text = f"the action has {len(elements)} elements, so {names} need expressions, too"
            self._mistakes[f"config key 'inputs': {text}"] = None
            elements = [Value.of(self._graph, 0.0) for _ in chosen]
        values = discrete_values(chosen)
        if values is not None and isinstance(self._space, spaces.Discrete):
            self._graph.tables["values of the action"] = np.array(values, np.float64)
            index = Value.read(self._graph, _ACTION, dtype=np.int64)
            elements = [index.taken("values of the action")]
        return {v.name: one for v, one in zip(chosen, elements, strict=False)}

    def _updates(self) -> dict[str, Value]:
        """All values of the memory are computed before one of them is written."""
        names = self._names(is_judged=False)
        return {
            name: self._number("memory", one["update"], names)
            for name, one in self._config.memory.items()
            if one.get("update") is not None
        }

    def _condition(
        self, key: str, expression: Expression | None, is_judged: bool = True
    ) -> Value | None:
        if expression is None:
            return None
        value = self._value(key, expression, self._names(is_judged))
        if not value.is_flag and not any(key in one for one in self._mistakes):
            text = f"expected a condition such as 'x > 1', got {shown(expression.text)}"
            self._mistakes[f"config key {key!r}: {text}"] = None
        return value

    def _terms(self) -> dict[str, Value]:
        """The terms of the reward by name, weights included."""
        terms = {}
        for name, term in self._config.reward_terms.items():
            value = self._number("reward", term["expr"])
            terms[name] = value if term["weight"] == 1.0 else term["weight"] * value
        return terms

    def _reward(self) -> Value:
        terms, config = self._terms(), self._config
        if not terms:
            done = self._read("done")
            return where(done, config.negative_reward, config.positive_reward)
        return reduce(operator.add, terms.values())

    def _observation(self) -> list[Value] | None:
        if not self._config.observations:
            return None
        return [self._number("observations", one) for one in self._config.observations]

    def _info(self) -> Mapping[str, Computed]:
        config, parts = self._config, dict[str, Computed]()
        has_stepped = self._read("step_count") > 0

        def in_steps(values: Mapping[str, Value]) -> dict[str, Value]:
            return {name: where(has_stepped, value, 0.0) for name, value in values.items()}

        if isinstance(config.reward, Mapping):
            parts["reward_terms"] = in_steps(self._terms())
        costs = {name: self._number("costs", one) for name, one in config.costs.items()}
        if costs:
            parts |= in_steps({"cost": reduce(operator.add, costs.values())})
            parts["costs"] = in_steps(costs)
        return parts | {name: self._value("info", one) for name, one in config.info.items()}


def _elements(name: str, shape: tuple[int, ...]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """The names of the elements of an array and their places; no place for a number.

    Arrays of more axes have no names in expressions.
    """
    if not shape:
        yield name, ()
    for place in range(shape[0] if len(shape) == 1 else 0):
        yield f"{name}[{place}]", (place,)
