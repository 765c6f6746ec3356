"""The three versions of FMI behind one interface: the only module that knows their call order.

A ``Library`` is the shared library of one FMU, loaded once through FMPy; an ``Instance`` is one
simulation in it. Calls in the step loop go through ctypes with arguments prepared beforehand,
because FMPy's own wrappers build new arrays for every call.
"""

from __future__ import annotations

import copy
import ctypes
import enum
import functools
import logging
import os
import threading
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, Final, NamedTuple

import fmpy
import numpy as np
import numpy.typing as npt
from fmpy.fmi1 import FMU1Slave
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave, fmi3IntermediateUpdateCallback

from fmugym.archive import FMU
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmu_log import MessageLog, fmi1_callbacks, fmi2_callbacks, fmi3_log_message
from fmugym.model_description import Variable

__all__ = ["Access", "Instance", "Library", "Phase", "SavedState", "Status"]


class Status(enum.IntEnum):
    """What a call returned: FMI's own codes, and two of ours."""

    OK = 0
    WARNING = 1
    DISCARD = 2
    ERROR = 3
    FATAL = 4
    TERMINATED = 6
    """The FMU asked to stop; its outputs are valid."""
    NOT_FINITE = 7
    """An output is NaN or infinite."""


class Phase(enum.Enum):
    """Where an instance is in FMI's state machine, as far as it decides which call is legal."""

    INSTANTIATED = enum.auto()
    STEPPING = enum.auto()
    ENDED = enum.auto()
    """After a step that was not done: reading and a reset are legal."""
    FAILED = enum.auto()
    """After Error: a reset is legal."""
    DEAD = enum.auto()
    """After Fatal or free: no call is legal."""


_TRUE: Final = b"\x01"
_FALSE: Final = b"\x00"
_load_lock = threading.Lock()


class Span(NamedTuple):
    """What an FMU is told of the simulation at its start; see ``Instance.initialize``."""

    start_time: float
    stop_time: float | None
    tolerance: float | None

    @property
    def times(self) -> tuple[float, bool, float]:
        """Start time, whether there is a stop time, and that."""
        return self.start_time, self.stop_time is not None, self.stop_time or 0.0

    @property
    def tolerances(self) -> tuple[bool, float]:
        """Whether there is a tolerance, and that."""
        return self.tolerance is not None, self.tolerance or 0.0


Initialize = Callable[[Span, Callable[[], None]], None]
"""Takes what the FMU is told, and the function that sets the start values."""


class Access:
    """The values of a fixed list of variables, copied to or from the FMU one call per C type.

    Args:
        instance: The instance.
        variables: The variables, all of them numeric.
        values: Memory to be used, contiguous, float64; by default memory of its own.

    Attributes:
        values: The row of values, float64, in the order of the variables. Where all variables are
            of the C type ``double`` the FMU reads and writes this very memory.
    """

    def __init__(
        self,
        instance: Instance,
        variables: Sequence[Variable],
        values: npt.NDArray[np.float64] | None = None,
    ) -> None:
        self.values = np.zeros(len(variables)) if values is None else values
        by_type: dict[str, list[int]] = {}
        for index, variable in enumerate(variables):
            by_type.setdefault(instance.c_type(variable), []).append(index)
        references = np.array([v.value_reference for v in variables], np.uint32)
        self._groups: list[tuple[list[int], npt.NDArray[Any], Any]] = []
        for c_type, indices in by_type.items():
            dtype = instance.dtypes[c_type]
            shares = dtype == np.float64 and len(indices) == len(variables)
            buffer = self.values if shares else np.zeros(len(indices), dtype)
            calls = instance.prepare_access(c_type, references[indices], buffer)
            self._groups.append((indices, buffer, calls))
        self._use_single_call()

    def _use_single_call(self) -> None:
        """Where one call moves all values, as in nearly every FMU, let it be the method itself."""
        if len(self._groups) == 1 and self._groups[0][1] is self.values:
            get, set_, arguments = self._groups[0][2]
            self.get = functools.partial(get, *arguments)  # type: ignore[method-assign]
            self.set = functools.partial(set_, *arguments)  # type: ignore[method-assign]

    def get(self) -> int:
        """Read all values from the FMU; returns the worst status."""
        worst = 0
        for indices, buffer, (get, _, arguments) in self._groups:
            worst = max(worst, _sane(get(*arguments)))
            if worst > Status.WARNING:
                break
            if buffer is not self.values:
                self.values[indices] = buffer
        return worst

    def set(self) -> int:
        """Write all values to the FMU; returns the worst status."""
        worst = 0
        for indices, buffer, (_, set_, arguments) in self._groups:
            if buffer is not self.values:
                np.copyto(buffer, self.values[indices], casting="unsafe")
            worst = max(worst, _sane(set_(*arguments)))
            if worst > Status.WARNING:
                break
        return worst


def _sane(status: int) -> int:
    """Pending is an error, since no asynchronous step was asked for, and so is any other code."""
    return status if 0 <= status <= Status.FATAL else Status.ERROR


class Library:
    """The shared library of an FMU, loaded from the FMU's temporary folder.

    Args:
        fmu: The FMU. It is extracted if need be, and closed together with the library.
        target: The logger that gets the messages of all instances.

    Raises:
        FMULoadError: If the library cannot be loaded or lacks a function of the standard.
    """

    def __init__(self, fmu: FMU, target: logging.Logger) -> None:
        self._instance_class = _INSTANCE_CLASSES[fmu.description.fmi_major_version]
        self._fmu = fmu
        self._target = target
        self._native = _Native(fmu)
        try:
            self._native.load(self._instance_class)
        except BaseException:
            self._native.close()
            raise
        self.can_save_state = fmu.description.capabilities.can_get_and_set_fmu_state
        self.close = weakref.finalize(self, self._native.close)

    def instantiate(self) -> Instance:
        """Make a new instance.

        Raises:
            FMULoadError: If the FMU refuses.
        """
        if not self.close.alive:
            raise SimulationError(f"{self._fmu.path.name} is closed")
        instance = self._instance_class(self._fmu, self._native, self._target)
        self._native.instances.append(instance)
        return instance


class _Native:
    """What the finalizer of a library needs: it must not refer to the library itself."""

    def __init__(self, fmu: FMU) -> None:
        self.fmu = fmu
        self.slave: Any = None
        self.instances: list[Instance] = []

    def load(self, instance_class: type[Instance]) -> None:
        self.fmu.prepare_library()
        folder, description = self.fmu.extract(), self.fmu.description
        self.slave = instance_class.slave_class.__new__(instance_class.slave_class)
        arguments = {
            "guid": description.instantiation_token,
            "modelIdentifier": description.model_identifier,
            "unzipDirectory": str(folder),
        }
        with _load_lock:
            working_directory = os.getcwd()
            try:
                self.slave.__init__(**arguments)
            except Exception as error:
                raise FMULoadError(f"{self.fmu.path.name} cannot be loaded: {error}") from None
            finally:
                os.chdir(working_directory)  # FMPy leaves it changed after a failed load
        instance_class.mend(self.slave)

    def close(self) -> None:
        while self.instances:
            self.instances.pop().free()
        if hasattr(self.slave, "dll"):
            fmpy.freeLibrary(self.slave.dll._handle)
            self.slave = None
        self.fmu.close()


class Instance(ABC):
    """One co-simulation instance of an FMU; made by ``Library.instantiate``.

    Attributes:
        phase: Decides which calls are legal.
        step: Does one communication step; takes the current communication point and the step size
            in seconds, both finite, and returns a ``Status``. It never raises, since a failed step
            ends one episode only.
    """

    slave_class: ClassVar[Any]
    dtypes: ClassVar[dict[str, Any]]
    """numpy's type for each of the C types by which this FMI version gets and sets values."""
    enumeration_type: ClassVar = "Integer"
    """The C type of enumerations."""

    def __init__(self, fmu: FMU, native: _Native, target: logging.Logger) -> None:
        self.phase = Phase.DEAD
        self._description = fmu.description
        self._native = native
        self._slave = copy.copy(native.slave)  # shares the library and its functions
        self._log = MessageLog(fmu.description.model_identifier, target)
        self._slave.instanceName = self._log.instance_name
        self._instantiate_checked()
        self._component = ctypes.c_void_p(self._slave.component)
        self._saved_states: weakref.WeakSet[SavedState] = weakref.WeakSet()
        self.step = self._prepare_step()
        self._initialize = self._prepare_initialization()
        self._reset_function = self._function("Reset")

    def _instantiate_checked(self) -> None:
        failure = ""
        try:
            self._instantiate(self._log)
        except Exception as error:
            failure = f" ({error})"
        if not self._slave.component:
            said = self._log.said()
            self._log.close()
            raise FMULoadError(
                f"{self._description.model_name} refused to be instantiated{failure}{said}"
            )
        self.phase = Phase.INSTANTIATED

    # What the versions differ in.

    @classmethod
    def mend(cls, slave: Any) -> None:
        """Correct what FMPy has wrong for this version, which is nothing for most."""
        return

    @abstractmethod
    def _instantiate(self, log: MessageLog) -> None: ...

    @abstractmethod
    def _function_name(self, name: str) -> str: ...

    @abstractmethod
    def _prepare_step(self) -> Callable[[float, float], int]: ...

    @abstractmethod
    def _prepare_initialization(self) -> Initialize: ...

    # What they have in common.

    @property
    def _may_return(self) -> bool:
        """Whether states of earlier times may be restored, of which FMI tells the FMU."""
        return self._description.capabilities.can_get_and_set_fmu_state

    def _function(self, name: str, *argtypes: Any, restype: Any = ctypes.c_int) -> Any:
        """Look a function up anew, so that FMPy's prototype of it stays as it is."""
        function = self._slave.dll[self._function_name(name)]
        function.restype = restype
        if argtypes:
            function.argtypes = argtypes
        return function

    def c_type(self, variable: Variable) -> str:
        """The C type, in the standard's naming, by which a variable is got and set."""
        return self.enumeration_type if variable.kind == "enumeration" else variable.type

    def prepare_access(
        self, c_type: str, references: npt.NDArray[np.uint32], buffer: npt.NDArray[Any]
    ) -> tuple[Any, Any, tuple[Any, ...]]:
        """Prepare getting and setting of variables of one C type.

        Returns:
            The getter, the setter, and the arguments for both.
        """
        arguments = (
            self._component,
            references.ctypes.data_as(ctypes.c_void_p),
            ctypes.c_size_t(len(references)),
            buffer.ctypes.data_as(ctypes.c_void_p),
            *self._trailing_arguments(len(references)),
        )
        return self._function(f"Get{c_type}"), self._function(f"Set{c_type}"), arguments

    def _trailing_arguments(self, count: int) -> tuple[Any, ...]:
        return ()

    @contextmanager
    def muted(self) -> Iterator[None]:
        """Drop the messages of calls that nobody has asked for."""
        self._log.muted = True
        try:
            yield
        finally:
            self._log.muted = False

    def set_string(self, variable: Variable, value: str) -> None:
        """Set a String variable before initialization."""
        reference = ctypes.c_uint32(variable.value_reference)
        text = ctypes.c_char_p(value.encode())
        count = ctypes.c_size_t(1)
        status = self._function("SetString")(
            self._component,
            ctypes.byref(reference),
            count,
            ctypes.byref(text),
            *self._trailing_arguments(1),
        )
        self.check(f"setting {variable.name!r}", status)

    def initialize(
        self,
        start_time: float,
        stop_time: float | None,
        tolerance: float | None,
        set_start_values: Callable[[], None],
    ) -> None:
        """Take a just instantiated or reset instance to its first communication point.

        Args:
            start_time: In seconds.
            stop_time: In seconds, or None to leave it undefined.
            tolerance: For solvers inside of the FMU, or None to leave it to the FMU.
            set_start_values: Called where start values are to be set.

        Raises:
            SimulationError: If the FMU fails.
        """
        self._require(Phase.INSTANTIATED, "initialize")
        try:
            self._initialize(Span(start_time, stop_time, tolerance), set_start_values)
        except BaseException:  # half-way: whatever the status, only a reset is legal now
            if self.phase is Phase.INSTANTIATED:
                self.phase = Phase.FAILED
            raise
        self.phase = Phase.STEPPING

    def reset(self) -> None:
        """Return to the state just after instantiation, start values included.

        Raises:
            SimulationError: If the FMU fails, or is past any reset.
        """
        if self.phase is Phase.DEAD:
            raise SimulationError(
                f"{self._log.instance_name}: no reset is legal after a fatal error"
            )
        self.check("reset", self._reset_function(self._component))
        self.phase = Phase.INSTANTIATED

    def free(self) -> None:
        """Terminate and free the instance; more than one call is fine."""
        if not self._slave.component:
            return
        for state in self._saved_states:
            state.release()
        if self.can_read:
            self.judge(self._function("Terminate")(self._component))
        fatal, self.phase = self.phase is Phase.DEAD, Phase.DEAD
        if not fatal:  # after Fatal the standard forbids even this: the memory is given up
            self._function("FreeInstance", restype=None)(self._component)
        self._slave.component = None
        self._log.close()

    def discard(self) -> None:
        """Free the instance now instead of with its library."""
        if self in self._native.instances:
            self._native.instances.remove(self)
        self.free()

    def check(self, doing: str, status: int) -> None:
        """Raise for a status worse than a warning.

        Raises:
            SimulationError: With what failed and what the FMU logged.
        """
        if status > Status.WARNING or status < 0:
            raise SimulationError(self.describe_failure(doing, self.judge(status)))

    def describe_failure(self, doing: str, status: int) -> str:
        """Say what failed, in one sentence, with the FMU's own last messages."""
        label = Status(status).name.capitalize()
        return f"{self._log.instance_name}: {doing} returned {label}{self._log.said()}"

    def judge(self, status: int) -> int:
        """Note which calls are still legal after a status; returns it as a ``Status``."""
        status = _sane(status)
        if status == Status.FATAL:
            self.phase = Phase.DEAD
        elif status == Status.ERROR:
            self.phase = Phase.FAILED
        return status

    def judge_step(self, status: int) -> int:
        """Note that after a step that was not done FMI wants no other; otherwise as ``judge``."""
        if status != Status.TERMINATED:
            status = self.judge(status)
        if status > Status.WARNING:
            self.forbid_steps()
        return status

    def forbid_steps(self) -> None:
        """Let there be no more steps until a reset."""
        if self.phase is Phase.STEPPING:
            self.phase = Phase.ENDED

    @property
    def can_read(self) -> bool:
        """Whether variables may be read now."""
        return self.phase in (Phase.STEPPING, Phase.ENDED)

    def _require(self, phase: Phase, doing: str) -> None:
        if self.phase is not phase:
            raise SimulationError(
                f"{self._log.instance_name}: cannot {doing} while {self.phase.name.lower()}"
            )

    # Directional derivatives, where the FMU offers them (FMI 2.0 and 3.0).

    def jacobian(
        self, unknowns: Sequence[Variable], knowns: Sequence[Variable]
    ) -> npt.NDArray[np.float64]:
        """Differentiate variables by others, at the present communication point.

        Args:
            unknowns: What is differentiated: outputs or derivatives of states, scalar reals.
            knowns: By what: continuous inputs or states, scalar reals.

        Returns:
            The partial derivatives, shape (len(unknowns), len(knowns)), in the variables' units.

        Raises:
            SimulationError: If the FMU provides no directional derivatives, or fails.
        """
        if not self._description.capabilities.provides_directional_derivatives:
            raise SimulationError(
                f"{self._description.model_name} provides no directional derivatives"
            )
        self._require(Phase.STEPPING, "differentiate")
        result = np.zeros((len(unknowns), len(knowns)))
        for column, known in zip(result.T, knowns, strict=True):
            column[:] = self._partial_derivatives(unknowns, known)
        return result

    def _partial_derivatives(
        self, unknowns: Sequence[Variable], known: Variable
    ) -> npt.NDArray[np.float64]:
        count, reference, seed = len(unknowns), known.value_reference, ctypes.c_double(1.0)
        sensitivity = np.zeros(count)
        status = self._function("GetDirectionalDerivative")(
            self._component,
            (ctypes.c_uint32 * count)(*(v.value_reference for v in unknowns)),
            ctypes.c_size_t(count),
            ctypes.byref(ctypes.c_uint32(reference)),
            ctypes.c_size_t(1),
            ctypes.byref(seed),
            *self._trailing_arguments(1),
            sensitivity.ctypes.data_as(ctypes.c_void_p),
            *self._trailing_arguments(count),
        )
        self.check(f"the derivative by {known.name!r}", status)
        return sensitivity

    # FMU state, where the FMU offers it (FMI 2.0 and 3.0).

    def save_state(self) -> SavedState:
        """Copy the FMU state.

        Raises:
            SimulationError: If the FMU offers none, or fails.
        """
        if not self._description.capabilities.can_get_and_set_fmu_state:
            raise SimulationError(f"{self._description.model_name} cannot get and set its state")
        self._require(Phase.STEPPING, "save the FMU state")
        state = ctypes.c_void_p()
        get_state = self._function(self._state_function("Get"))
        self.check("saving the FMU state", get_state(self._component, ctypes.byref(state)))
        saved = SavedState(self, state)
        self._saved_states.add(saved)
        return saved

    def restore_state(self, state: SavedState) -> None:
        """Return to a state saved by this instance.

        Raises:
            SimulationError: If the FMU fails, or is past any call.
        """
        if self.phase is Phase.DEAD:
            raise SimulationError(f"{self._log.instance_name}: no restore after a fatal error")
        self._log.recent.clear()
        set_state = self._function(self._state_function("Set"))
        self.check("restoring the FMU state", set_state(self._component, state.pointer))
        self.phase = Phase.STEPPING

    def free_state(self, pointer: ctypes.c_void_p) -> None:
        """Free a state; only ``SavedState`` calls this."""
        if self.phase is not Phase.DEAD:
            free_state = self._function(self._state_function("Free"))
            self.judge(free_state(self._component, ctypes.byref(pointer)))

    def _state_function(self, verb: str) -> str:
        return f"{verb}FMUState"


class SavedState:
    """The owner of an FMU state: frees it once, while its instance still lives.

    Attributes:
        pointer: The FMU's own handle.
    """

    def __init__(self, instance: Instance, pointer: ctypes.c_void_p) -> None:
        self.pointer = pointer
        self.release = weakref.finalize(self, instance.free_state, pointer)


class FMI1Instance(Instance):
    """FMI 1.0 co-simulation, stand-alone: no FMU state, no way to tell Terminated from Discard."""

    slave_class = FMU1Slave
    dtypes: ClassVar[dict[str, Any]] = {
        "Real": np.float64,
        "Integer": np.int32,
        "Boolean": np.uint8,
    }

    _SLAVE_FUNCTIONS: ClassVar = {
        "Reset": "ResetSlave",
        "Terminate": "TerminateSlave",
        "FreeInstance": "FreeSlaveInstance",
    }
    _STATUS_FUNCTIONS: ClassVar = (
        "fmi1InitializeSlave",
        "fmi1DoStep",
        "fmi1CancelStep",
        "fmi1GetStatus",
        "fmi1GetRealStatus",
        "fmi1GetIntegerStatus",
        "fmi1GetBooleanStatus",
        "fmi1GetStringStatus",
        "fmi1GetRealOutputDerivatives",
        "fmi1SetRealInputDerivatives",
    )

    @classmethod
    def mend(cls, slave: Any) -> None:
        """FMPy takes the status of these for a string: any but OK would be dereferenced."""
        for name in cls._STATUS_FUNCTIONS:
            slave._functions[name].restype = ctypes.c_int

    def _instantiate(self, log: MessageLog) -> None:
        self._slave.instantiate(functions=fmi1_callbacks, loggingOn=log.wants_debug)

    def _function_name(self, name: str) -> str:
        name = self._SLAVE_FUNCTIONS.get(name, name)
        return f"{self._description.model_identifier}_fmi{name}"

    def _prepare_step(self) -> Callable[[float, float], int]:
        double = ctypes.c_double
        do_step = self._function("DoStep", ctypes.c_void_p, double, double, ctypes.c_char)
        component = self._component

        def step(time: float, step_size: float) -> int:
            status: int = do_step(component, time, step_size, _TRUE)
            return status if status == 0 else self.judge_step(status)

        return step

    def _prepare_initialization(self) -> Initialize:
        double = ctypes.c_double
        initialize = self._function(
            "InitializeSlave", ctypes.c_void_p, double, ctypes.c_char, double
        )

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            set_start_values()
            start, has_stop, stop = span.times
            defined = _TRUE if has_stop else _FALSE
            status = initialize(self._component, start, defined, stop)
            self.check("initialization", status)

        return run


class FMI2Instance(Instance):
    """FMI 2.0 co-simulation."""

    slave_class = FMU2Slave
    dtypes: ClassVar[dict[str, Any]] = {
        "Real": np.float64,
        "Integer": np.int32,
        "Boolean": np.int32,
    }

    _TERMINATED: ClassVar = 3
    """``fmi2Terminated`` of ``fmi2StatusKind``."""

    def _instantiate(self, log: MessageLog) -> None:
        self._slave.instantiate(callbacks=fmi2_callbacks, loggingOn=log.wants_debug)

    def _function_name(self, name: str) -> str:
        return f"fmi2{name}"

    def _state_function(self, verb: str) -> str:
        return f"{verb}FMUstate"

    def _prepare_step(self) -> Callable[[float, float], int]:
        double = ctypes.c_double
        do_step = self._function("DoStep", ctypes.c_void_p, double, double, ctypes.c_int)
        component, no_return = self._component, not self._may_return

        def step(time: float, step_size: float) -> int:
            status: int = do_step(component, time, step_size, no_return)
            if status == Status.DISCARD:
                status = self._judge_discard()
            return status if status == 0 else self.judge_step(status)

        return step

    def _judge_discard(self) -> int:
        """What a discarded step comes to; whoever cannot tell why has discarded it."""
        terminated = ctypes.c_int(0)
        get_status = self._function("GetBooleanStatus")
        status = get_status(self._component, self._TERMINATED, ctypes.byref(terminated))
        if status == Status.FATAL:
            return Status.FATAL
        asked_to_stop = status <= Status.WARNING and terminated.value != 0
        return Status.TERMINATED if asked_to_stop else Status.DISCARD

    def _prepare_initialization(self) -> Initialize:
        double, integer = ctypes.c_double, ctypes.c_int
        setup = self._function(
            "SetupExperiment", ctypes.c_void_p, integer, double, double, integer, double
        )
        enter = self._function("EnterInitializationMode")
        leave = self._function("ExitInitializationMode")
        component, check = self._component, self.check

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            check("setting up the experiment", setup(component, *span.tolerances, *span.times))
            set_start_values()
            check("entering initialization", enter(component))
            check("initialization", leave(component))

        return run


class FMI3Instance(Instance):
    """FMI 3.0 co-simulation, without event mode, early return and intermediate update."""

    slave_class = FMU3Slave
    dtypes: ClassVar[dict[str, Any]] = {
        "Float64": np.float64,
        "Float32": np.float32,
        "Int8": np.int8,
        "Int16": np.int16,
        "Int32": np.int32,
        "Int64": np.int64,
        "UInt8": np.uint8,
        "UInt16": np.uint16,
        "UInt32": np.uint32,
        "UInt64": np.uint64,
        "Boolean": np.uint8,
    }
    enumeration_type = "Int64"

    def _instantiate(self, log: MessageLog) -> None:
        resources = os.path.join(self._slave.unzipDirectory, "resources", "")
        self._slave.component = self._slave.fmi3InstantiateCoSimulation(
            self._slave.instanceName.encode(),
            self._slave.guid.encode(),
            resources.encode(),
            False,  # visible
            log.wants_debug,
            False,  # event mode used
            False,  # early return allowed
            None,
            0,
            log.environment,
            fmi3_log_message,
            fmi3IntermediateUpdateCallback(),
        )

    def _function_name(self, name: str) -> str:
        return f"fmi3{name}"

    def _trailing_arguments(self, count: int) -> tuple[Any, ...]:
        return (ctypes.c_size_t(count),)

    def _prepare_step(self) -> Callable[[float, float], int]:
        double, pointer = ctypes.c_double, ctypes.c_void_p
        do_step = self._function(
            "DoStep", pointer, double, double, ctypes.c_bool, pointer, pointer, pointer, pointer
        )
        flags = (ctypes.c_bool * 3)()  # event handling needed, terminate, early return
        last_successful_time = double()
        results = [ctypes.addressof(flags) + i for i in range(3)]
        results.append(ctypes.addressof(last_successful_time))
        component, self._step_results = self._component, (flags, last_successful_time)
        no_return = not self._may_return

        def step(time: float, step_size: float) -> int:
            flags[1] = flags[2] = False  # an FMU that has nothing to say may not write them
            status: int = do_step(component, time, step_size, no_return, *results)
            if status <= Status.WARNING and flags[1]:
                status = Status.TERMINATED
            elif status <= Status.WARNING and flags[2]:  # early return was not allowed
                status = Status.DISCARD
            return status if status == 0 else self.judge_step(status)

        return step

    def _prepare_initialization(self) -> Initialize:
        boolean, double = ctypes.c_bool, ctypes.c_double
        enter = self._function(
            "EnterInitializationMode", ctypes.c_void_p, boolean, double, double, boolean, double
        )
        leave = self._function("ExitInitializationMode")
        component, check = self._component, self.check

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            set_start_values()
            check("entering initialization", enter(component, *span.tolerances, *span.times))
            check("initialization", leave(component))

        return run


_INSTANCE_CLASSES: Final[dict[int, type[Instance]]] = {
    1: FMI1Instance,
    2: FMI2Instance,
    3: FMI3Instance,
}
