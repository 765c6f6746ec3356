"""A config with its names looked up in one FMU."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import ModelDescription, Variable, unlisted
from fmugym.archive.texts import with_texts
from fmugym.checks import LARGEST_COUNT, check_number, integer_of, parts_of_array
from fmugym.config import EnvConfig
from fmugym.distributions import as_distribution, is_distribution
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
    "checked_column",
    "checked_value",
    "input_variable",
    "output_variable",
    "outputs_named",
    "readable_named",
    "resolve",
    "spread",
    "start_values",
    "start_variable",
    "structural_values",
]

_Value = TypeVar("_Value")
_LARGEST_FLOAT32: Final = float(np.finfo(np.float32).max)
_LARGEST_EXACT_INTEGER: Final = 2.0**53


@dataclass(frozen=True)
class Interface:
    """A config with its names looked up in one FMU.

    Attributes:
        inputs, outputs, monitors: The variables.
        parameters: The parameters and their values, texts or distributions by name, a start time
            that is drawn last.
        config: The config.
        description: That of the FMU.
        texts: By name, those that Strings may get besides what ``parameters`` has.
    """

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    monitors: tuple[Variable, ...]
    parameters: Mapping[str, Any]
    config: EnvConfig
    description: ModelDescription
    limits: Mapping[str, tuple[float, float]]
    texts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The names of the inputs; arrays are inputs by the names of their elements."""
        return tuple(variable.name for variable in self.inputs)

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
        variable = self.description.variable(name)
        if variable.kind != "string":
            return variable
        return with_texts(variable, (*_texts_in(variable, value), *self.texts.get(name, ())))

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
            values[variable.name] = value
        return values

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
        low, high = self.limits.get(variable.name, (variable.minimum, variable.maximum))
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
        names = self.config.ramped_inputs
        inputs = {variable.name: variable for variable in self.inputs}
        ramped = tuple(inputs[name] for name in names)
        for variable in ramped:
            unable = self.description.unable_to_interpolate(variable)
            if unable is not None:
                raise ConfigError(
                    f"config key 'input_interpolation': {unable} cannot interpolate "
                    "inputs, which is an option of FMI 1.0 and 2.0 for co-simulation; "
                    f"{variable.name!r} can only hold"
                )
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
        read = self.outputs + self.monitors
        given = _by_scalar(self.description, self.config.samplings, read, "output in 'samplings'")
        for variable in read:
            if variable.kind == "string" and given.get(variable.name, "last") != "last":
                raise ConfigError(
                    f"config key 'samplings': {variable.name!r} is a String, expected 'last', got "
                    f"{given[variable.name]!r}"
                )
        if set(given.values()) <= {"last"}:
            return ()
        return tuple(given.get(v.name, "last") for v in read)

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
    structural = structural_values(description, config.model_parameters)
    starts = {n: value for n, value in config.model_parameters.items() if n not in structural}
    given = start_values(description, starts)
    drawn = {"start_time": config.start_time} if config.draws_start_time else {}
    inputs = _resolved(description, config.model_input_names, _check_input)
    outputs = outputs_named(description, config.model_output_names)
    read = readable_named(description, config.model_output_names + config.monitor_names)
    monitors = read[len(outputs) :]
    bounded = inputs + outputs
    _check_inputs_are_whole(inputs, [variable for variable, _ in given])
    _check_rest_is_known(inputs)
    return Interface(
        inputs=inputs,
        outputs=outputs,
        monitors=monitors,
        parameters={v.name: value for v, value in given} | drawn,
        config=config,
        description=description,
        limits=_by_scalar(description, config.bounds, bounded, "input or output in 'bounds'"),
    )


def outputs_named(description: ModelDescription, names: Sequence[str]) -> tuple[Variable, ...]:
    """Find the variables that can be read after every step: scalars, and all elements of arrays.

    Raises:
        ConfigError: If there is no variable of a name, one is named twice, or a float cannot hold
            its value.
    """
    return _resolved(description, names, _check_output)


def readable_named(description: ModelDescription, names: Sequence[str]) -> tuple[Variable, ...]:
    """Do what ``outputs_named`` does, but find Strings, too, which cannot be observed."""
    return _resolved(description, names, _check_readable)


def _resolved(
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
    """Spread what is given for arrays and elements; what is given for an element counts more.

    Raises:
        ConfigError: If a name is not that of any of the allowed variables.
    """
    names = {variable.name for variable in allowed}
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


def start_values(
    description: ModelDescription, given: Mapping[str, Any]
) -> list[tuple[Variable, Any]]:
    """Check start values by name: numbers, distributions, texts, and lists of them for arrays.

    Returns:
        The scalars and what each starts with; an element that is named itself comes in its place in
        the array, and counts more than what is given for the array.

    Raises:
        ConfigError: If a name is unknown, or its variable cannot start with the value.
    """
    found: dict[str, tuple[Variable, Any]] = {}
    elements = {}
    for name, value in given.items():
        scalars = description.scalars(name)
        for variable, own in zip(scalars, spread(name, scalars, value), strict=True):
            _check_start(description, variable, own)
            pair = variable, checked(variable, own)
            found.setdefault(variable.name, pair)
            if variable.name == name:
                elements[name] = pair
    _check_rest_is_known([variable for variable, _ in found.values()])
    return [elements.get(name, pair) for name, pair in found.items()]


def _check_rest_is_known(variables: Sequence[Variable]) -> None:
    """Elements that are not written keep their start values, but who knows those of a new size?"""
    for missing in unlisted(variables):
        array = missing.array
        if array is not None and array.start is None and array.dimensions:
            raise ConfigError(
                f"there is no value of {missing.name!r}: {array.name!r} has a size of its own, "
                f"{array.shape}, for which the FMU has no start values; give all elements"
            )


def structural_values(description: ModelDescription, given: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the given values that are of structural parameters, by which arrays get their sizes.

    Raises:
        ConfigError: If one is a distribution: the sizes of spaces do not change.
    """
    found = {n: v for n, v in given.items() if n in description.variables}
    found = {n: v for n, v in found.items() if description.variables[n].is_structural}
    for name, value in found.items():
        if is_distribution(value):
            raise ConfigError(
                f"{name!r} is a structural parameter: it cannot be drawn, since spaces keep their "
                f"sizes; expected an integer, got {shown(value)}"
            )
    return found


def spread(name: str, scalars: Sequence[Variable], value: Any) -> list[Any]:
    """Give each of the scalars that a name stands for its part of a value.

    Args:
        name: The name.
        scalars: The variables.
        value: For an array nested lists of its shape, a flat list in row-major order, or one value
            for all elements, a distribution from which each is drawn for itself.

    Raises:
        ConfigError: If the shape of the value is not that of the array.
    """
    array = scalars[0].array if scalars else None
    is_array = len(scalars) != 1 or (array is not None and array.name == name)
    if not is_array:
        return [value]
    shape = (len(scalars),) if array is None else array.shape
    return [as_distribution(repr(name), part) for part in parts_of_array(name, shape, value)]


def _interval(frequency: float | None) -> float:
    return 0.0 if frequency is None else 1.0 / frequency


def input_variable(description: ModelDescription, name: str) -> Variable:
    """Find a variable that can be written before every step.

    Raises:
        ConfigError: If no variable has this name, or it must not be written before a step.
    """
    variable = description.variable(name)
    _check_input(description, variable)
    return variable


def _check_input(description: ModelDescription, variable: Variable) -> None:
    _require_numeric(variable, "an input")
    _require_known_clock(description, variable, "an input")
    if not variable.settable_in_step:
        _require_not_driven(description, variable, "be an input")
        raise ConfigError(
            f"{variable.name!r} cannot be an input: it is a {variable.variability} "
            f"{variable.causality}; only inputs and tunable parameters may be set between steps"
        )


def _require_not_driven(description: ModelDescription, variable: Variable, what: str) -> None:
    source = description.what_drives(variable)
    if source is not None:
        raise ConfigError(
            f"{variable.name!r} cannot {what}: it gets its value from {source!r}, which the system "
            "connects with it"
        )


def output_variable(description: ModelDescription, name: str) -> Variable:
    """Find a variable that can be read after every step.

    Raises:
        ConfigError: If no variable has this name, or a float cannot hold its value.
    """
    variable = description.variable(name)
    _check_output(description, variable)
    return variable


def _check_output(description: ModelDescription, variable: Variable) -> None:
    _require_numeric(variable, "an output")
    _require_known_clock(description, variable, "an output")


def _check_readable(description: ModelDescription, variable: Variable) -> None:
    if variable.kind != "string" or variable.shape or variable.array is not None:
        _check_output(description, variable)


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


_CURES: Final = {
    "String": ". A scalar String can be given a text in 'model_parameters', and hooks can read it "
    "if it is in 'monitor_names'; to observe one, let the FMU tell the same by a number or an "
    "Enumeration",
    "Binary": ". Nobody but the FMU knows what its bytes mean: let it tell what you need by "
    "numbers",
}


def start_variable(description: ModelDescription, name: str, value: Any) -> Variable:
    """Find a variable that can be set before initialization.

    Raises:
        ConfigError: If no variable has this name, it cannot be set, or a float cannot hold its
            value.
    """
    variable = description.variable(name)
    _check_start(description, variable, value)
    return variable


def _check_start(description: ModelDescription, variable: Variable, value: Any) -> None:
    name = variable.name
    if variable.ticking:
        raise ConfigError(f"{name!r} cannot be set at the start: it is a clock")
    if variable.is_structural:
        raise ConfigError(
            f"{name!r} cannot be set here: it is a structural parameter, which is set under "
            "'model_parameters' of the config"
        )
    if not variable.settable_at_start:
        _require_not_driven(description, variable, "be set")
        raise ConfigError(
            f"{name!r} cannot be set: it is a {variable.variability} {variable.causality} "
            f"with initial={variable.initial!r}"
        )
    if variable.kind == "string" and not variable.shape and variable.array is None:
        for text in _texts_in(variable, value):
            _require_text(name, text)
    else:
        _require_numeric(variable, "given a start value")


def _texts_in(variable: Variable, value: Any) -> Sequence[str]:
    """The texts that a String may get: the given one, or those of a distribution.

    Raises:
        ConfigError: If the distribution does not tell them.
    """
    if not is_distribution(value):
        return (value,)
    texts = getattr(value, "values", None)
    if not isinstance(texts, Sequence) or isinstance(texts, str) or not texts:
        raise ConfigError(
            f"{variable.name!r} is a String, which is drawn from a Choice of texts, or from an "
            f"object with a list of its texts as 'values', got {shown(value)}"
        )
    return texts


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
    """Check a start value; distributions are checked when they are drawn."""
    if is_distribution(value):
        return value
    return str.__str__(value) if variable.kind == "string" else checked_value(variable, value)


def checked_value(variable: Variable, value: Any) -> float:
    """Convert a value for a variable to a number, without loss.

    Of a String, this is the number of one of the texts that the variable knows.

    Raises:
        ConfigError: If the value is not finite, not of the variable's kind, or outside its type's
            range.
    """
    if isinstance(value, str) and variable.items:
        return _item_value(variable, str.__str__(value))
    number = check_number(repr(variable.name), value)
    if variable.kind == "string" and number not in dict(variable.items).values():
        raise ConfigError(f"{variable.name!r} is a String, got {shown(value)}")
    if variable.type == "Float32" and abs(number) > _LARGEST_FLOAT32:
        raise ConfigError(f"{variable.name!r} is a Float32, too narrow for {number}")
    if variable.kind == "boolean" and number not in {0.0, 1.0}:
        raise ConfigError(f"{variable.name!r} is a Boolean, got {number}")
    if variable.kind in {"integer", "enumeration"}:
        whole = integer_of(value)  # which no float has rounded
        _check_integer(variable, number if whole is None else whole)
    return number


def checked_column(variable: Variable, values: Sequence[Any]) -> npt.NDArray[Any]:
    """Check the values of a parameter in N environments.

    Returns:
        Numbers, or the texts of a String as objects, shape (N,).

    Raises:
        ConfigError: If the variable cannot start with one of them.
    """
    if variable.kind != "string":
        return np.array([checked_value(variable, value) for value in values])
    for value in values:
        _require_text(variable.name, value)
    return np.array([str.__str__(value) for value in values], object)


def _item_value(variable: Variable, name: str) -> float:
    items = dict(variable.items)
    if name not in items:
        raise unknown_name(f"item of {variable.name!r}", name, items)
    return float(items[name])


def _check_integer(variable: Variable, number: float) -> None:
    low, high = variable.integer_limits
    if not float(number).is_integer() or not low <= number <= high:
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
