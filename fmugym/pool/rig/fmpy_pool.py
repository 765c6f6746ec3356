"""Pool of an FMU stepped by FMPy's own classes: the reference that the engine is compared with.

The logger of FMI 1.0 and 2.0 has a variable number of arguments, which ctypes cannot make. FMPy has
a native proxy that formats the text, but it knows one receiver per process. So there is one for all
instances, which lives as long as the process and knows them by their names. From it, messages go to
Python's ``logging``.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import itertools
import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar
from weakref import WeakValueDictionary

import fmpy
from fmpy.fmi1 import FMICallException, FMU1Slave, fmi1CallbackFunctions
from fmpy.fmi2 import FMU2Slave, fmi2CallbackFunctions, fmi2Terminated
from fmpy.fmi3 import FMU3Slave
from fmpy.logging import addLoggerProxy

from fmugym.errors import ConfigError, FMULoadError, SimulationError
from fmugym.fmi.fmu import FMU, copy_libraries
from fmugym.fmi.status import Status, failed_call, sane
from fmugym.fmi.variable import Variable
from fmugym.pool.c_extension import needs_engine
from fmugym.pool.failure_texts import Message, as_log_record, quoted
from fmugym.pool.held_signals import signals_held
from fmugym.pool.licences import licence_errors
from fmugym.pool.pool_spec import START_TIME, PoolSpec
from fmugym.pool.rig.rig import FaultError
from fmugym.pool.rig.rig_pool import BackendPool

__all__ = [
    "FMPyInstance",
    "Messages",
    "fmi1_callbacks",
    "fmi2_callbacks",
    "fmpy_pool",
]


_ids = itertools.count(1)
_by_name: WeakValueDictionary[bytes, Messages] = WeakValueDictionary()


class Messages:
    """The messages of one instance.

    A message is only noted while the FMU runs: no exception could pass through it.

    Args:
        model: The model's name, the first part of the instance name.
        log: Gets the messages.

    Attributes:
        name: An instance name that is unique in the process.
    """

    def __init__(self, model: str, log: logging.Logger) -> None:
        self.name = f"{model}_{next(_ids)}"
        self._log = log
        self._noted: deque[tuple[int, bytes, bytes]] = deque()
        self._recent: deque[Message] = deque(maxlen=10)
        _by_name[self.name.encode()] = self

    @property
    def wants_all(self) -> bool:
        """Whether the FMU is asked to log more than errors."""
        return self._log.isEnabledFor(logging.INFO)

    def note(self, _: Any, status: int, category: bytes, text: bytes) -> None:
        """Take a message; the callback of FMI 3.0."""
        self._noted.append((status, category or b"", text or b""))

    def pass_on(self) -> None:
        """Log the noted messages, each at the level of its status."""
        while self._noted:
            status, category, text = self._noted.popleft()
            line = _readable(text)
            self._recent.append((status, line))
            level, told = as_log_record(self.name, status, _readable(category), line)
            self._log.log(level, "%s", told)

    def forget(self) -> None:
        """Forget the messages of the episode before; they would not explain a failure."""
        self._recent.clear()

    def said(self) -> str:
        """The recent messages, to end an error's text."""
        self.pass_on()
        return quoted(tuple(self._recent))


def _readable(text: bytes) -> str:
    return text.decode(errors="replace").rstrip()


def _receive(instance: Any, name: bytes, status: int, category: bytes, text: bytes) -> None:
    messages = _by_name.get(name)
    if messages is not None:
        messages.note(instance, status, category, text)


def _callbacks(structure: Any) -> Any:
    """Fill a structure; the members used here are the same in FMI 1.0 and 2.0."""
    types = dict(structure._fields_)
    callbacks = structure()
    callbacks.logger = types["logger"](_receive)
    callbacks.allocateMemory = ctypes.cast(fmpy.calloc, types["allocateMemory"])
    callbacks.freeMemory = ctypes.cast(fmpy.free, types["freeMemory"])
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


fmi1_callbacks: Final = _callbacks(fmi1CallbackFunctions)
fmi2_callbacks: Final = _callbacks(fmi2CallbackFunctions)

_SLAVES: Final = {1: FMU1Slave, 2: FMU2Slave, 3: FMU3Slave}
_MISDECLARED: Final = ("fmi1InitializeSlave", "fmi1DoStep")
"""The functions whose status FMPy takes for a text, and dereferences."""

_CONVERSIONS: Final[dict[str, Callable[[Any], Any]]] = {
    "real": float,
    "boolean": bool,
    "string": str,
}
_loading: Final = threading.Lock()

P = ParamSpec("P")
R = TypeVar("R")


def _undisturbed(method: Callable[P, R]) -> Callable[P, R]:
    """Let signals wait while an FMU of Python works, which would get their exceptions."""

    @functools.wraps(method)
    def call(*arguments: P.args, **named: P.kwargs) -> R:
        me: Any = arguments[0]
        with signals_held() if me.calls_python else contextlib.nullcontext():
            return method(*arguments, **named)

    return call


class FMPyInstance:
    """A ``Backend``: one instance of an FMU for co-simulation, as FMPy's own simulation sets it up.

    Each episode has a new instance, for which the library is loaded anew.

    Args:
        fmu: The FMU.
        spec: What to do at each reset and step.
        log: Gets the FMU's messages.
        library: The FMU's library, or a copy of it. No other instance should load the same file.

    Raises:
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """

    def __init__(self, fmu: FMU, spec: PoolSpec, log: logging.Logger, library: Path) -> None:
        self._fmu, self._spec, self._library = fmu, spec, library
        self.calls_python = fmu.calls_python()
        self._version = fmu.description.fmi_major_version
        self._messages = Messages(fmu.description.model_identifier, log)
        self._slave: Any = None
        self._status: int = Status.OK
        self._is_initialized = False
        self._start_time, self._count = spec.start_time, 0
        self._instantiate()
        self.stop()

    @_undisturbed
    def reset(self, start_values: Mapping[str, Any]) -> list[Any]:
        """See ``Backend.reset``; the name of ``START_TIME`` stands for the start time."""
        self.stop()
        self._messages.forget()
        starts = dict(start_values)
        self._start_time, self._count = starts.pop(START_TIME.name, self._spec.start_time), 0
        self._instantiate()
        self._initialize(starts)
        self._is_initialized = True
        return list(self._spec.start_outputs) if self._spec.blind_start else self._outputs()

    @_undisturbed
    def step(self, inputs: Mapping[str, float]) -> tuple[list[Any], int]:
        """See ``Backend.step``."""
        if self._slave is None:
            raise SimulationError("the instance needs a reset before it can be stepped")
        self._set("setting the inputs", inputs)
        for _ in range(self._spec.substeps):
            if self._advance():
                outputs = self._outputs()
                self.stop()
                return outputs, Status.TERMINATED
        return self._outputs(), Status.OK

    @_undisturbed
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

    def _call(self, doing: str, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
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

    @_undisturbed
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
                slave.instantiate(loggingOn=wants_all, logMessage=self._messages.note)
        except Exception:
            slave.component = None
        if not slave.component:
            slave.freeLibrary()
            name, said = self._fmu.description.model_name, self._messages.said()
            raise FMULoadError(f"{name} refused to be instantiated{said}")
        self._slave = slave

    def _load(self) -> Any:
        fmu, description = self._fmu, self._fmu.description
        try:
            with _loading, contextlib.chdir("."):  # FMPy goes elsewhere meanwhile
                slave = _SLAVES[self._version](
                    guid=description.instantiation_token,
                    modelIdentifier=description.model_identifier,
                    unzipDirectory=str(fmu.extract()),
                    instanceName=self._messages.name,
                    libraryPath=str(self._library),
                )
        except Exception as error:
            raise FMULoadError(f"{fmu.path.name} cannot be loaded: {error}") from None
        if self._version == 1:
            for name in _MISDECLARED:
                slave._functions[name].restype = ctypes.c_int
        return slave

    def _initialize(self, values: Mapping[str, Any]) -> None:
        slave, start_time, stop_time = self._slave, self._start_time, self._spec.stop_time
        times = {"startTime": start_time, "stopTime": stop_time, "tolerance": self._spec.tolerance}
        if self._version == 2:
            self._call("setting up the experiment", slave.setupExperiment, **times)
            times = {}
        self._set("setting the start values", values)
        if self._version == 1:
            self._call("initialization", slave.initialize, start_time, stop_time)
            return
        self._call("entering initialization", slave.enterInitializationMode, **times)
        self._call("initialization", slave.exitInitializationMode)

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
            if self._version == 2 and failure.status == Status.DISCARD:
                why, ask = "asking why the step was discarded", self._slave.getBooleanStatus
                if self._call(why, ask, fmi2Terminated):
                    return True
            raise
        if self._version < 3:
            return False
        _, asks_to_stop, is_early, reached = result
        if is_early and not asks_to_stop and reached < time + step_size:
            raise FaultError(f"{doing} ended early, at t = {reached:g} s", Status.DISCARD)
        return bool(asks_to_stop)

    # Values.

    def _outputs(self) -> list[Any]:
        found = (
            (v, self._call("reading the outputs", self._method("get", v), [v.value_reference])[0])
            for v in self._spec.outputs
        )
        return [_opposite(v, value) if v.negated else value for v, value in found]

    def _set(self, doing: str, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            variable = self._fmu.variable(name)
            own = _CONVERSIONS.get(variable.kind, round)(value)
            own = _opposite(variable, own) if variable.negated else own
            self._call(doing, self._method("set", variable), [variable.value_reference], [own])

    def _method(self, verb: str, variable: Variable) -> Callable[..., Any]:
        """FMPy's method that gets or sets variables of a type."""
        of_enumerations = "Int64" if self._version == 3 else "Integer"
        kind = of_enumerations if variable.kind == "enumeration" else variable.type
        method: Callable[..., Any] = getattr(self._slave, f"{verb}{kind}")
        return method


def _opposite(variable: Variable, value: Any) -> Any:
    """The value behind a negated alias, or the other way round."""
    return not value if variable.kind == "boolean" else 0 - value


@licence_errors()
def fmpy_pool(
    fmu: FMU,
    spec: PoolSpec,
    num_instances: int,
    log: logging.Logger,
    reset_method: str | None = None,
    isolation: str | None = None,
) -> BackendPool:
    """Make a pool of instances that FMPy steps, one after another, in this process.

    Each of them has a copy of the FMU's library.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        reset_method: One that the caller asks for, which is refused.
        isolation: ``"process"`` is refused.

    Raises:
        ConfigError: If FMPy cannot do what is asked for.
        FMULoadError: If the FMU cannot be loaded.
    """
    needs = _beyond_fmpy(fmu, spec) | {
        "reset_method": reset_method is not None,
        "isolation='process'": isolation == "process",
    }
    refused = [name for name, is_needed in needs.items() if is_needed]
    if refused:
        raise ConfigError(
            "FMPy steps FMUs for co-simulation with scalar variables here. "
            + needs_engine(f"{fmu.path.name} ({', '.join(refused)})")
        )

    def instances(count: int) -> list[FMPyInstance]:
        fmu.prepare_libraries()
        libraries = copy_libraries(fmu, count)
        return [FMPyInstance(fmu, spec, log, library) for library in libraries]

    pool = BackendPool(fmu, spec, num_instances, instances, is_real=False)
    text = "by FMPy in this process, one after another, each with a copy of the library"
    pool.execution = (f"{fmu.path.name}: {num_instances} instance(s) are stepped {text}",)
    log.info("%s", *pool.execution)
    return pool


def _beyond_fmpy(fmu: FMU, spec: PoolSpec) -> dict[str, bool]:
    """Abilities of the engine that FMPy lacks, and whether they are needed."""
    about, variables = fmu.description, (*spec.inputs, *spec.outputs)
    return {
        "a system": bool(about.components),
        "model exchange": about.interface != "co_simulation",
        "clocks and event mode": about.uses_event_mode,
        "libraries for Windows": fmu.in_wine,
        "arrays": bool(about.structure) or any(not v.is_scalar for v in variables),
        "samplings": bool(spec.samplings),
        "fault_retries": bool(spec.fault_retries),
    }
