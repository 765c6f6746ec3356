"""FMUs stepped by FMPy's own classes: the reference that the engine is compared with."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, ParamSpec, TypeVar

from fmpy.fmi1 import FMICallException, FMU1Slave
from fmpy.fmi2 import FMU2Slave, fmi2Terminated
from fmpy.fmi3 import FMU3Slave

from fmugym.archive.fmu import FMU
from fmugym.archive.variable import Variable
from fmugym.errors import ConfigError, FMULoadError, SimulationError
from fmugym.fmi.status import Status, failed_call, sane
from fmugym.pool.backend.messages import Messages, fmi1_callbacks, fmi2_callbacks
from fmugym.pool.backend.pool import BackendPool
from fmugym.pool.backend.rig import FaultError
from fmugym.pool.patience import licence_errors
from fmugym.pool.spec import START_TIME, PoolSpec, ResetMethod
from fmugym.signals import ordinary

__all__ = ["FMPyInstance", "fmpy_pool"]

P = ParamSpec("P")
R = TypeVar("R")

_SLAVES: Final = {1: FMU1Slave, 2: FMU2Slave, 3: FMU3Slave}
_MISDECLARED: Final = ("fmi1InitializeSlave", "fmi1DoStep")
"""The functions whose status FMPy takes for a text, and dereferences."""

_CONVERSIONS: Final[dict[str, Callable[[Any], Any]]] = {
    "real": float,
    "boolean": bool,
    "string": str,
}
_loading: Final = threading.Lock()


class FMPyInstance:
    """A ``Backend``: one instance of an FMU for co-simulation, as FMPy's own simulation sets it up.

    Each episode has a new instance, for which the library is loaded anew.

    Args:
        fmu: The FMU. No other instance should use its folder, as both would share one library.
        spec: What to do at each reset and step.
        log: Gets the FMU's messages.
    """

    def __init__(self, fmu: FMU, spec: PoolSpec, log: logging.Logger) -> None:
        self._fmu, self._spec, self._log = fmu, spec, log
        self._version = fmu.description.fmi_major_version
        self._inputs = {variable.name: variable for variable in spec.inputs}
        self._messages = Messages(fmu.description.model_identifier, log)
        self._slave: Any = None
        self._status: int = Status.OK
        self._is_initialized = self._is_blind = False
        self._start_time, self._count = spec.start_time, 0

    def check(self) -> None:
        """Make an instance and free it.

        Raises:
            FMULoadError: If the FMU cannot be loaded or instantiated.
        """
        self._instantiate()
        self.stop()

    def reset(self, start_values: Mapping[str, Any]) -> list[Any]:
        """See ``Backend.reset``; the name of ``START_TIME`` stands for the start time."""
        self.stop()
        self._messages.forget()
        starts = dict(start_values)
        self._start_time, self._count = starts.pop(START_TIME.name, self._spec.start_time), 0
        self._instantiate()
        variables = {name: self._fmu.variable(name) for name in starts}
        self._initialize(variables, starts)
        self._is_initialized = True
        return self._outputs_at_start()

    def step(self, inputs: Mapping[str, float]) -> tuple[list[Any], int]:
        """See ``Backend.step``."""
        if self._slave is None:
            raise SimulationError("the instance needs a reset before it can be stepped")
        bad = [f"{name} = {value}" for name, value in inputs.items() if not math.isfinite(value)]
        if bad:
            raise FaultError(f"the inputs are not finite: {', '.join(bad)}", Status.NOT_FINITE)
        self._set("setting the inputs", self._inputs, inputs)
        for _ in range(self._spec.substeps):
            if self._advance():
                outputs = self._outputs()
                self.stop()
                return outputs, Status.TERMINATED
        return self._outputs(), Status.OK

    def stop(self) -> None:
        """Free the instance and its library; see ``Backend.stop``."""
        slave, self._slave = self._slave, None
        if slave is None:
            return
        if self._is_initialized and self._status < Status.ERROR:
            with contextlib.suppress(FaultError):
                self._call("the end", slave.terminate)
        if self._status == Status.FATAL:  # the standard forbids to free the instance
            slave.freeLibrary()
        else:
            slave.freeInstance()  # and its library
        self._messages.pass_on()

    def _call(
        self, doing: str, function: Callable[P, R], *arguments: P.args, **named: P.kwargs
    ) -> R:
        """Call FMPy; a bad status becomes a failure with the reason."""
        try:
            return function(*arguments, **named)
        except FMICallException as error:
            self._status = sane(error.status)
            text = failed_call(doing, self._status, "")
            raise FaultError(f"{text}{self._messages.said()}", self._status) from None
        finally:
            self._messages.pass_on()

    # The beginning of an episode.

    def _instantiate(self) -> None:
        self._status, self._is_initialized = Status.OK, False
        slave = self._load()
        wants_all = self._messages.wants_all
        try:
            if self._version == 1:
                slave.instantiate(functions=fmi1_callbacks, loggingOn=wants_all)
            elif self._version == 2:
                slave.instantiate(callbacks=fmi2_callbacks, loggingOn=wants_all)
            else:
                slave.instantiate(
                    loggingOn=wants_all,
                    logMessage=self._messages.note,
                    intermediateUpdate=_decline_early_return,
                )
        except ordinary(Exception):
            slave.component = None
        if not slave.component:
            slave.freeLibrary()
            name, said = self._fmu.description.model_name, self._messages.said()
            raise FMULoadError(f"{name} refused to be instantiated{said}")
        self._slave = slave

    def _load(self) -> Any:
        fmu, description = self._fmu, self._fmu.description
        fmu.prepare_library()
        with _loading:
            working_directory = os.getcwd()
            try:
                slave = _SLAVES[self._version](
                    guid=description.instantiation_token,
                    modelIdentifier=description.model_identifier,
                    unzipDirectory=str(fmu.extract()),
                    instanceName=self._messages.name,
                )
            except ordinary(Exception) as error:
                raise FMULoadError(f"{fmu.path.name} cannot be loaded: {error}") from None
            finally:
                os.chdir(working_directory)  # FMPy leaves it changed after a failed load
        if self._version == 1:
            for name in _MISDECLARED:
                slave._functions[name].restype = ctypes.c_int
        return slave

    def _initialize(self, variables: Mapping[str, Variable], values: Mapping[str, Any]) -> None:
        slave, start_time, stop_time = self._slave, self._start_time, self._spec.stop_time
        times = {"startTime": start_time, "stopTime": stop_time, "tolerance": self._spec.tolerance}
        if self._version == 2:
            self._call("setting up the experiment", slave.setupExperiment, **times)
            times = {}
        self._set("setting the start values", variables, values)
        if self._version == 1:
            self._call("initialization", slave.initialize, start_time, stop_time)
            return
        self._call("entering initialization", slave.enterInitializationMode, **times)
        self._call("initialization", slave.exitInitializationMode)

    def _outputs_at_start(self) -> list[Any]:
        """The outputs; start values if the FMU cannot be read before its first step."""
        try:
            return self._outputs()
        except FaultError as failure:
            if failure.status != Status.ERROR:
                raise
            if not self._is_blind:
                self._log.warning("%s; until the first step it has start values", failure)
            self._is_blind, self._status = True, Status.OK
            return [
                v.start or "" if v.kind == "string" else v.start_number for v in self._spec.outputs
            ]

    # A step.

    def _advance(self) -> bool:
        """Do one communication step; returns whether the FMU asks to stop."""
        spec = self._spec
        time = spec.communication_point(self._count, self._start_time)
        step_size = spec.communication_step_size
        self._count += 1
        doing = f"the step at t = {time:g} s"
        try:
            result = self._call(doing, self._slave.doStep, time, step_size)
        except FaultError as failure:
            if self._version == 2 and failure.status == Status.DISCARD and self._asks_to_stop():
                return True
            raise
        if self._version < 3:
            return False
        _, asks_to_stop, is_early, reached = result
        if is_early and not asks_to_stop and reached < time + step_size:
            raise FaultError(f"{doing} ended early, at t = {reached:g} s", Status.DISCARD)
        return bool(asks_to_stop)

    def _asks_to_stop(self) -> bool:
        asking = self._slave.getBooleanStatus
        return bool(self._call("asking why the step was discarded", asking, fmi2Terminated))

    # Values.

    def _outputs(self) -> list[Any]:
        return [self._get(variable) for variable in self._spec.outputs]

    def _get(self, variable: Variable) -> Any:
        getter = getattr(self._slave, f"get{self._type(variable)}")
        value = self._call("reading the outputs", getter, [variable.value_reference])[0]
        return value.decode(errors="replace") if isinstance(value, bytes) else value

    def _set(
        self, doing: str, variables: Mapping[str, Variable], values: Mapping[str, Any]
    ) -> None:
        for name, value in values.items():
            variable = variables[name]
            own = _CONVERSIONS.get(variable.kind, round)(value)
            setter = getattr(self._slave, f"set{self._type(variable)}")
            self._call(doing, setter, [variable.value_reference], [own])

    def _type(self, variable: Variable) -> str:
        """The type in the names of FMPy's methods."""
        if variable.kind != "enumeration":
            return variable.type
        return "Int64" if self._version == 3 else "Integer"


def _decline_early_return(*arguments: Any) -> None:
    """Ask for no early return in an intermediate update, which the FMU may allow unasked."""
    if arguments[6]:
        arguments[6][0] = False


@licence_errors()
def fmpy_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    *,
    reset_method: str | None = None,
    isolation: str | None = None,
) -> BackendPool:
    """Make a pool of instances that FMPy steps, one after another, in this process.

    Several instances have a copy of the FMU's files each, and so share no library.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: Gets the FMU's messages.
        reset_method: What the user asks for; refused, because each episode has a new instance.
        isolation: What the user asks for.

    Raises:
        ConfigError: If the FMU or the user needs what FMPy's classes are not used for here.
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """
    asked_for = {
        "reset_method": reset_method is not None,
        "isolation='process'": isolation == "process",
    }
    refused = [name for name, wish in (_needs(fmu, spec) | asked_for).items() if wish]
    if refused:
        fmu.close()
        raise ConfigError(
            "FMPy steps FMUs for co-simulation with scalar variables here. "
            f"{fmu.path.name} needs the C extension (backend='native') for: {', '.join(refused)}"
        )
    instances = _Instances(fmu, replace(spec, reset_method=ResetMethod.INSTANCE), log)
    return BackendPool(fmu, instances.spec, num_instances, instances, is_real=False)


def _needs(fmu: FMU, spec: PoolSpec) -> dict[str, bool]:
    """What only the engine can do, and whether it is needed."""
    about, variables = fmu.description, (*spec.inputs, *spec.outputs)
    return {
        "a system": bool(fmu.parts),
        "model exchange": about.interface != "co_simulation",
        "clocks and event mode": about.uses_event_mode,
        "libraries for Windows": fmu.in_wine,
        "arrays": bool(about.structure) or any(not v.is_scalar for v in variables),
        "samplings": bool(spec.samplings),
        "fault_retries": bool(spec.fault_retries),
    }


class _Instances:
    """Makes the instances of a pool, and removes what they share at its end."""

    def __init__(self, fmu: FMU, spec: PoolSpec, log: logging.Logger) -> None:
        self.spec, self._log = spec, log
        self._fmus = [fmu]

    def __call__(self, count: int) -> Sequence[FMPyInstance]:
        FMPyInstance(self._fmus[0], self.spec, self._log).check()
        self._fmus += [self._fmus[0].again() for _ in range(1, count)]
        return [FMPyInstance(fmu, self.spec, self._log) for fmu in self._fmus]

    def close(self) -> None:
        """Remove the copies of the FMU's files."""
        for fmu in self._fmus:
            fmu.close()
