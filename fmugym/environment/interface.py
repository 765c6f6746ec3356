"""A config with its names looked up in one FMU."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy.typing as npt

from fmugym.checks import LARGEST_COUNT
from fmugym.environment.config import EnvConfig
from fmugym.environment.fmu_variables import (
    check_input,
    check_output,
    check_readable,
    check_rest_is_known,
    checked,
    start_values,
    structural_values,
    texts_in,
    within,
)
from fmugym.errors import ConfigError, unknown_name
from fmugym.expressions.language import Expression
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.variable import Variable, with_texts
from fmugym.pool.pool_spec import FIXED_STEP_SOLVERS, START_TIME, PoolSpec, whole_number_of_steps

__all__ = [
    "Interface",
    "readable_named",
    "resolve",
]

_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Interface:
    """A config with its names looked up in one FMU.

    Attributes:
        inputs, outputs, monitors: The variables, with their bounds and samplings.
        parameters: The parameters and their values, texts or distributions by name, a start time
            that is drawn last.
        config: The config.
        description: That of the FMU.
        resolved: By name, the variables to which the config gives bounds or a sampling.
        texts: By name, those that Strings may get besides what ``parameters`` has.
    """

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    monitors: tuple[Variable, ...]
    parameters: Mapping[str, Any]
    config: EnvConfig
    description: ModelDescription
    resolved: Mapping[str, Variable]
    texts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The names of the inputs; arrays are inputs by the names of their elements."""
        return tuple(variable.name for variable in self.inputs)

    @cached_property
    def expressions_of_inputs(self) -> dict[str, Expression]:
        """The expressions that write inputs, by the inputs' names."""
        given, scalars = self.config.inputs, self.description.scalars
        return {v.name: one for name, one in given.items() for v in scalars(name)}

    @property
    def chosen_inputs(self) -> tuple[Variable, ...]:
        """The inputs that the action writes: those without an expression."""
        return tuple(v for v in self.inputs if v.name not in self.expressions_of_inputs)

    @cached_property
    def output_count(self) -> int:
        """The number of outputs, without the monitored variables."""
        return len(self.outputs)

    @cached_property
    def start_inputs(self) -> list[tuple[str, float]]:
        """The names and start values of the inputs."""
        return [(v.name, v.start_number) for v in self.inputs]

    @property
    def time_step(self) -> float:
        """Length of one step in seconds."""
        step = self.config.time_step or self.description.step_size
        if step is None:
            raise ConfigError(
                f"config key 'time_step' is missing, and {self.description.model_name} "
                "has no default step size"
            )
        return step

    def parameter(self, name: str, value: Any) -> Variable:
        """The variable of one of the parameters, to which a start time belongs if it is drawn.

        Args:
            name: Its name.
            value: What it starts with, or is drawn from; a String knows these texts then.

        Raises:
            ConfigError: If the FMU has no variable of this name.
        """
        if name == "start_time" and self.config.draws_start_time:
            return START_TIME
        variable = self.resolved.get(name) or self.description.variable(name)
        if variable.kind != "string":
            return variable
        return with_texts(variable, (*self.texts.get(name, ()), *texts_in(variable, value)))

    @cached_property
    def parameter_variables(self) -> dict[str, Variable]:
        """The variables of ``parameters``, by the same names."""
        return {name: self.parameter(name, value) for name, value in self.parameters.items()}

    def with_parameter(self, name: str, values: npt.NDArray[Any], index: int) -> Interface:
        """The same with another value of a parameter, whose values in N environments differ.

        Args:
            name: A parameter.
            values: Checked values: numbers, or the texts of a String, shape (N,).
            index: Which of them is the value.
        """
        own = values[index : index + 1].tolist()[0]
        parameters = {**self.parameters, name: own}
        if values.dtype != object:
            return replace(self, parameters=parameters)
        return replace(self, parameters=parameters, texts={**self.texts, name: tuple(values)})

    def start_values(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Check the parameters of episodes, by the names of scalars and elements.

        Raises:
            ConfigError: If a name is unknown, or its variable cannot start with the value.
        """
        own = {n: v for n, v in given.items() if n == "start_time" and self.config.draws_start_time}
        values = {name: checked(START_TIME, value) for name, value in own.items()}
        rest = {name: value for name, value in given.items() if name not in own}
        for variable, value in start_values(self.description, rest):
            values[variable.name] = self.within(variable, value)
        return values

    def within(self, variable: Variable, value: Any) -> Any:
        """Check that a start value lies in its range; see ``fmugym.environment.fmu_variables``."""
        return within(self.resolved.get(variable.name, variable), value)

    def pool_spec(self) -> PoolSpec:
        """The pool's part of the config.

        Raises:
            ConfigError: If the warm-up is not a whole number of steps.
        """
        config, description = self.config, self.description
        self._require_retries()
        start, drawn = config.start_time, config.draws_start_time
        return PoolSpec(
            inputs=self.inputs,
            outputs=self.outputs + self.monitors,
            time_step=self.time_step,
            num_observed=len(self.outputs),
            substeps=config.substeps,
            start_time=description.start_time if start is None or drawn else start,
            stop_time=config.stop_time,
            tolerance=description.tolerance if config.tolerance is None else config.tolerance,
            warm_up_steps=self._warm_up_steps(),
            fault_retries=config.fault_retries,
            leak_limit=config.foreign.leak_limit,
            max_instances=config.foreign.max_instances,
            licence_wait=config.foreign.licence_wait,
            solver=config.solver,
            max_step=self._max_step(),
        )

    def _max_step(self) -> float | None:
        """The config's, or else, for a solver of fixed steps, the FMU's default step size."""
        fixed = self.config.solver in FIXED_STEP_SOLVERS
        default = self.description.step_size if fixed else None
        return default if self.config.max_step is None else self.config.max_step

    def _warm_up_steps(self) -> int:
        duration, step = self.config.warm_up, self.time_step
        if duration / step > LARGEST_COUNT:
            raise ConfigError(
                f"warm_up must be at most {LARGEST_COUNT} steps of {step} s, got {duration}"
            )
        count = whole_number_of_steps(duration, step)
        if count is None:
            raise ConfigError(
                f"warm_up must be a multiple of the time step of {step} s, got {duration}"
            )
        return count

    def _require_retries(self) -> None:
        able = self.description.capabilities
        if not self.config.fault_retries or (
            able.can_handle_variable_communication_step_size and able.can_get_and_set_fmu_state
        ):
            return
        raise ConfigError(
            "config key 'fault_retries' needs an FMU that can get and set its state and handle "
            f"variable communication step sizes; {self.description.model_name} cannot do both"
        )


def resolve(config: EnvConfig, description: ModelDescription) -> Interface:
    """Look up all names in the FMU, which completes the config.

    Raises:
        ConfigError: If a name is unknown, or its variable cannot be used in that role.
    """
    structural = structural_values(description, config.model_parameters)
    starts = {n: value for n, value in config.model_parameters.items() if n not in structural}
    given = start_values(description, starts)
    drawn = {"start_time": config.start_time} if config.draws_start_time else {}
    inputs = _found(description, config.model_input_names, check_input)
    outputs = _found(description, config.model_output_names, check_output)
    read = readable_named(description, config.model_output_names + config.monitor_names)
    _by_scalar(description, config.inputs, inputs, "input in 'inputs'")  # which knows them all
    _check_inputs_are_whole(inputs, [variable for variable, _ in given])
    check_rest_is_known(inputs)
    resolved = _resolved(config, description, inputs + outputs, read)

    def own(variable: Variable) -> Variable:
        return resolved.get(variable.name, variable)

    return Interface(
        inputs=tuple(map(own, inputs)),
        outputs=tuple(map(own, outputs)),
        monitors=tuple(map(own, read[len(outputs) :])),
        parameters={v.name: within(own(v), value) for v, value in given} | drawn,
        config=config,
        description=description,
        resolved=resolved,
    )


def _resolved(
    config: EnvConfig,
    description: ModelDescription,
    bounded: Sequence[Variable],
    read: Sequence[Variable],
) -> dict[str, Variable]:
    """The variables to which the config gives bounds or a sampling.

    Inputs, outputs and what can be given a start value have bounds; what is read is sampled.
    """
    named = [v for name in config.bounds for v in _known_scalars(description, name)]
    allowed = [*bounded, *(variable for variable in named if variable.settable_at_start)]
    kind = "input, output or parameter in 'bounds'"
    bounds = _by_scalar(description, config.bounds, allowed, kind)
    samplings = _by_scalar(description, config.samplings, read, "output in 'samplings'")
    return {
        v.name: replace(v, bounds=bounds.get(v.name), sampling=samplings.get(v.name, "last"))
        for v in (*allowed, *read)
        if v.name in bounds or v.name in samplings
    }


def readable_named(description: ModelDescription, names: Sequence[str]) -> tuple[Variable, ...]:
    """Find variables that can be read after every step: scalars, and all elements of arrays.

    Raises:
        ConfigError: If there is no variable of a name, one is named twice, or its value is no
            number.
    """
    return _found(description, names, check_readable)


def _found(
    description: ModelDescription,
    names: Sequence[str],
    check: Callable[[ModelDescription, Variable], None],
) -> tuple[Variable, ...]:
    """Look up the scalars that names stand for, each at most once."""
    found: dict[Variable, str] = {}
    for name in names:
        for variable in description.scalars(name):
            if variable in found:
                raise ConfigError(f"{variable.name!r} is named twice: it is in {found[variable]!r}")
            check(description, variable)
            found[variable] = name
    return tuple(found)


def _by_scalar(
    description: ModelDescription,
    given: Mapping[str, _Value],
    allowed: Sequence[Variable],
    kind: str,
) -> dict[str, _Value]:
    """Spread values of arrays over their elements; a value of an element itself counts more.

    Raises:
        ConfigError: If a name is not that of any of the allowed variables.
    """
    names = dict.fromkeys(variable.name for variable in allowed)
    arrays: dict[str, _Value] = {}
    scalars: dict[str, _Value] = {}
    for name, value in given.items():
        meant = [v.name for v in _known_scalars(description, name) if v.name in names]
        if not meant:
            raise unknown_name(kind, name, names)
        (scalars if meant == [name] else arrays).update(dict.fromkeys(meant, value))
    return arrays | scalars


def _known_scalars(description: ModelDescription, name: str) -> tuple[Variable, ...]:
    try:
        return description.scalars(name)
    except ConfigError:  # the caller says which names it knows
        return ()


def _check_inputs_are_whole(inputs: Sequence[Variable], started: Sequence[Variable]) -> None:
    """An array is set as a whole, so elements that are no inputs would lose their start values."""
    names = {variable.name for variable in inputs}
    arrays = {variable.array for variable in inputs}
    for variable in started:
        array = variable.array
        if array is None or variable.is_apart:
            continue
        if array in arrays and variable.name not in names:
            raise ConfigError(
                f"{variable.name!r} cannot be given a start value while other elements of "
                f"{array.name!r} are inputs; let all of {array.name!r} be inputs"
            )
