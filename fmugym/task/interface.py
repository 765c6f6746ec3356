"""A config with its names looked up in one FMU."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.archive.description import ModelDescription, Variable
from fmugym.checks import LARGEST_COUNT, check_number
from fmugym.config import EnvConfig
from fmugym.distributions import is_distribution
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.pool.spec import (
    FIXED_STEP_SOLVERS,
    START_TIME,
    PoolSpec,
    whole_number_of_steps,
)

__all__ = [
    "Interface",
    "checked",
    "checked_value",
    "input_variable",
    "output_variable",
    "resolve",
    "start_variable",
]

_LARGEST_FLOAT32: Final = float(np.finfo(np.float32).max)
_LARGEST_EXACT_INTEGER: Final = 2.0**53


@dataclass(frozen=True)
class Interface:
    """A config with its names looked up in one FMU.

    Attributes:
        inputs, outputs, monitors: The variables.
        parameters: The numeric parameters and their values or distributions by name, a start time
            that is drawn last.
        strings: The parameters that are texts.
        config: The config.
        description: That of the FMU.
    """

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    monitors: tuple[Variable, ...]
    parameters: Mapping[str, Any]
    strings: tuple[tuple[Variable, str], ...]
    config: EnvConfig
    description: ModelDescription

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

    def parameter(self, name: str) -> Variable:
        """The variable of one of the parameters, to which a start time belongs if it is drawn.

        Raises:
            ConfigError: If the FMU has no variable of this name.
        """
        if name == "start_time" and self.config.draws_start_time:
            return START_TIME
        return self.description.variable(name)

    def bounds(self, variable: Variable) -> tuple[float, float]:
        """The limits of a variable: the config's, or else the FMU's.

        Raises:
            ConfigError: If the FMU's limits contradict each other.
        """
        low, high = self._limits(variable)
        if not low <= high:
            raise ConfigError(
                f"{variable.name!r} has min = {low} and max = {high} in the FMU; give it 'bounds'"
            )
        return low, high

    def _limits(self, variable: Variable) -> tuple[float, float]:
        low, high = self.config.bounds.get(variable.name, (variable.minimum, variable.maximum))
        return float(low), float(high)

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
            strings=self.strings,
            fault_retries=config.fault_retries,
            leak_limit=config.leak_limit,
            input_limits=tuple(map(self._limits, self.inputs)),
            initialization_interval=_interval(config.max_initializations_per_second),
            max_instances=config.max_instances,
            licence_wait=config.licence_wait,
            keep_states=bool(config.keep_initial_states),
            samplings=self._samplings(),
            solver=config.solver,
            max_step=self._max_step(),
            ramped=self._ramped(),
        )

    def _ramped(self) -> tuple[Variable, ...]:
        """The inputs that change linearly within a step.

        Raises:
            ConfigError: If the FMU cannot interpolate inputs, or one of them is no continuous Real.
        """
        inputs = {variable.name: variable for variable in self.inputs}
        ramped = tuple(inputs[name] for name in self.config.ramped_inputs)
        if ramped and not self.description.capabilities.can_interpolate_inputs:
            raise ConfigError(
                f"config key 'input_interpolation': {self.description.model_name} "
                f"(FMI {self.description.fmi_version}) cannot interpolate inputs, which is an "
                "option of FMI 1.0 and 2.0 for co-simulation; its inputs can only hold"
            )
        for variable in ramped:
            found = variable.kind, variable.variability, variable.causality, variable.shape
            if found != ("real", "continuous", "input", ()):
                raise ConfigError(
                    f"config key 'input_interpolation': {variable.name!r} cannot be linear: it is "
                    f"a {variable.variability} {variable.causality} of type {variable.type}, "
                    "expected a continuous Real input"
                )
        return ramped

    def _max_step(self) -> float | None:
        """The config's, or else, for a solver of fixed steps, the FMU's default step size."""
        fixed = self.config.solver in FIXED_STEP_SOLVERS
        default = self.description.step_size if fixed else None
        return default if self.config.max_step is None else self.config.max_step

    def _samplings(self) -> tuple[str, ...]:
        """One for each output; none if a step gives the last value of all."""
        given = self.config.samplings
        if set(given.values()) <= {"last"}:
            return ()
        return tuple(given.get(v.name, "last") for v in self.outputs + self.monitors)

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
            f"config key 'fault_retries': {self.description.model_name} must be able to get and "
            "set its FMU state and to handle variable communication step sizes, and is not"
        )


def resolve(config: EnvConfig, description: ModelDescription) -> Interface:
    """Look up all names in the FMU, and take from the FMU what the config leaves open.

    Raises:
        ConfigError: If a name is unknown, or its variable cannot be used in that role.
    """
    given = [
        (start_variable(description, name, value), value)
        for name, value in config.model_parameters.items()
    ]
    drawn = {"start_time": config.start_time} if config.draws_start_time else {}
    interface = Interface(
        inputs=tuple(input_variable(description, n) for n in config.model_input_names),
        outputs=tuple(output_variable(description, n) for n in config.model_output_names),
        monitors=tuple(output_variable(description, n) for n in config.monitor_names),
        parameters={v.name: checked(v, value) for v, value in given if v.numeric} | drawn,
        strings=tuple((v, str.__str__(value)) for v, value in given if not v.numeric),
        config=config,
        description=description,
    )
    for name in config.bounds:
        if name not in config.model_input_names + config.model_output_names:
            raise unknown_name(
                "input or output in 'bounds'",
                name,
                config.model_input_names + config.model_output_names,
            )
    return interface


def _interval(frequency: float | None) -> float:
    return 0.0 if frequency is None else 1.0 / frequency


def input_variable(description: ModelDescription, name: str) -> Variable:
    """Find a variable that can be written before every step.

    Raises:
        ConfigError: If no variable has this name, or it must not be written before a step.
    """
    variable = description.variable(name)
    _require_numeric(variable, "an input")
    _require_known_clock(description, variable, "an input")
    if not variable.settable_in_step:
        raise ConfigError(
            f"{name!r} cannot be an input: it is a {variable.variability} {variable.causality}; "
            "only inputs and tunable parameters may be set between steps"
        )
    return variable


def output_variable(description: ModelDescription, name: str) -> Variable:
    """Find a variable that can be read after every step.

    Raises:
        ConfigError: If no variable has this name, or a float cannot hold its value.
    """
    variable = description.variable(name)
    _require_numeric(variable, "an output")
    _require_known_clock(description, variable, "an output")
    return variable


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


def _require_numeric(variable: Variable, role: str) -> None:
    if not variable.numeric:
        what = "an array" if variable.shape else f"of type {variable.type}"
        raise ConfigError(
            f"{variable.name!r} cannot be {role}: it is {what}; expected a scalar Real, "
            "Integer, Boolean or Enumeration"
        )


def start_variable(description: ModelDescription, name: str, value: Any) -> Variable:
    """Find a variable that can be set before initialization.

    Raises:
        ConfigError: If no variable has this name, it cannot be set, or a float cannot hold its
            value.
    """
    variable = description.variable(name)
    if variable.ticking:
        raise ConfigError(f"{name!r} cannot be set at the start: it is a clock")
    if not variable.settable_at_start:
        raise ConfigError(
            f"{name!r} cannot be set: it is a {variable.variability} {variable.causality} "
            f"with initial={variable.initial!r}"
        )
    if variable.kind == "string" and not variable.shape:
        _require_text(name, value)
        return variable
    _require_numeric(variable, "given a start value")
    return variable


def _require_text(name: str, value: Any) -> None:
    if not isinstance(value, str):
        raise ConfigError(f"{name!r} is a String, got {shown(value)}")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{name!r} cannot be {shown(value)}: UTF-8 cannot encode it") from None
    if "\0" in value:
        raise ConfigError(f"{name!r} cannot be {shown(value)}: it holds a NUL character")


def checked(variable: Variable, value: Any) -> Any:
    """Check a start value of a numeric variable; distributions are checked when they are drawn."""
    return value if is_distribution(value) else checked_value(variable, value)


def checked_value(variable: Variable, value: Any) -> float:
    """Convert a value for a numeric variable, without loss.

    Raises:
        ConfigError: If the value is not finite, not of the variable's kind, or outside its type's
            range.
    """
    if isinstance(value, str) and variable.items:
        return _item_value(variable, str.__str__(value))
    number = check_number(repr(variable.name), value)
    if variable.type == "Float32" and abs(number) > _LARGEST_FLOAT32:
        raise ConfigError(f"{variable.name!r} is a Float32, too narrow for {number}")
    if variable.kind == "boolean" and number not in {0.0, 1.0}:
        raise ConfigError(f"{variable.name!r} is a Boolean, got {number}")
    if variable.kind in {"integer", "enumeration"}:
        _check_integer(variable, number)
    return number


def _item_value(variable: Variable, name: str) -> float:
    items = dict(variable.items)
    if name not in items:
        raise unknown_name(f"item of {variable.name!r}", name, items)
    return float(items[name])


def _check_integer(variable: Variable, number: float) -> None:
    low, high = variable.integer_limits
    if not number.is_integer() or not low <= number <= high:
        raise ConfigError(
            f"{variable.name!r} is of type {variable.type}: expected an integer from {low} to "
            f"{high}, got {number}"
        )
    if abs(number) > _LARGEST_EXACT_INTEGER:
        raise ConfigError(f"{variable.name!r}: integers beyond 2**53 are not exact, got {number}")
    values = [value for _, value in variable.items]
    if values and number not in values:
        listing = ", ".join(f"{value} ({name})" for name, value in variable.items)
        raise ConfigError(f"{variable.name!r}: expected one of {listing}, got {number:g}")
