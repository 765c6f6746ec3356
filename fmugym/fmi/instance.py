"""One instance of an FMU, whatever its FMI version and interface.

Calls in the step loop go through ctypes with prepared arguments, because FMPy's wrappers build new
arrays for every call.
"""

from __future__ import annotations

import copy
import ctypes
import logging
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import ModelDescription
from fmugym.archive.variable import Variable
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.derivatives import DerivativeCall
from fmugym.fmi.log import Hearing, MessageLog
from fmugym.fmi.solver import Solving
from fmugym.fmi.span import Initialize, Span
from fmugym.fmi.status import Phase, Status, sane
from fmugym.signals import ordinary

__all__ = ["Instance", "SavedState"]


class Instance(ABC):
    """One instance of an FMU; made by ``Library.instantiate``.

    Attributes:
        phase: Decides which calls are legal.
        step: Does one communication step. It takes the current communication point and the step
            size in seconds, both finite, and returns a ``Status``. It never raises, because a
            failed step ends only one episode.
    """

    slave_class: ClassVar[Any]
    dtypes: ClassVar[dict[str, Any]]
    """numpy's type for each C type of this FMI version."""
    initializations: ClassVar = 0
    """How many initializations all instances of this process have begun."""
    enumeration_type: ClassVar = "Integer"
    """The C type of enumerations in this FMI version."""
    _deserialize: ClassVar = "Deserialize"

    exchange: Callable[[], None] | None = None
    """Called in Initialization Mode, to exchange values with other FMUs. FMI 1.0 has none."""

    def __init__(
        self,
        description: ModelDescription,
        slave: Any,
        target: logging.Logger,
        hearing: Hearing,
        hear_all: bool = False,
        solving: Solving | None = None,
    ) -> None:
        self._solving = solving
        self.phase = Phase.DEAD
        self._description = description
        self._slave = copy.copy(slave)  # shares the library and its functions
        self._log = MessageLog(description.model_identifier, target)
        self._slave.instanceName = self._log.instance_name
        self._hearing, self.hears_all = hearing, hear_all or self._log.wants_debug
        self._instantiate_checked()
        self._ask_for_errors()
        self._saved_states: weakref.WeakSet[SavedState] = weakref.WeakSet()
        self._may_return = False  # to an earlier state; FMI tells the FMU whether this may happen
        self.step = self._prepare_step()
        self._initialize = self._prepare_initialization()
        self._reset_function = self._find_reset()

    def _instantiate_checked(self) -> None:
        failure = self._try_to_instantiate()
        if not self._slave.component and self.can_say_more:
            self.hears_all = True
            failure = self._try_to_instantiate()
        if not self._slave.component:
            said = self._log.said()
            self._log.close()
            raise FMULoadError(
                f"{self._description.model_name} refused to be instantiated{failure}{said}"
            )
        self._component = ctypes.c_void_p(self._slave.component)
        self.phase = Phase.INSTANTIATED

    def _try_to_instantiate(self) -> str:
        try:
            self._instantiate(self._log, self.hears_all)
        except ordinary(Exception) as error:
            return f" ({error})"
        return ""

    @property
    def life(self) -> object:
        """Changes when the states that were saved before cannot be restored any more."""
        return self

    # What the FMU is asked to log.

    @property
    def can_say_more(self) -> bool:
        """Whether a new instance may log everything, because a call failed without a message."""
        return not self.hears_all and not self._log.recent and self._hearing.may_hear_all()

    @property
    def is_silent(self) -> bool:
        """Whether the FMU has logged nothing in this episode."""
        return not self._log.recent

    @property
    def hears_more_than_wanted(self) -> bool:
        """Whether the FMU logs everything although the logger drops most of it."""
        return self.hears_all and not self._log.wants_debug

    def _ask_for_errors(self) -> None:
        """Ask the FMU to say why calls fail. If it cannot bear the question, make it anew."""
        categories = self._description.error_categories
        if self.hears_all or not categories or self._hearing.deaf:
            return
        status = self._choose_messages(categories)
        if status > Status.WARNING:
            self._hearing.deaf = True
            if status != Status.FATAL:
                self._free_component()
            self._instantiate_checked()

    def begin_episode(self) -> None:
        """Forget the messages of the episode before; they would not explain a failure."""
        if self.phase is Phase.INSTANTIATED or not self._log.recent:
            return
        self._log.recent.clear()
        if self._log.is_too_long and not self._hearing.deaf and self.phase is Phase.STEPPING:
            self._hearing.deaf = True
            self.judge(self._choose_messages(()))

    # The parts that differ between the versions.

    @classmethod
    def mend(cls, slave: Any) -> None:
        """Correct FMPy's mistakes for this version; most versions need no correction."""
        return

    @abstractmethod
    def _instantiate(self, log: MessageLog, logging: bool) -> None: ...

    def _choose_messages(self, categories: Sequence[str]) -> int:
        """Ask for messages of these categories, for none if there are none; return the status."""
        texts = (ctypes.c_char_p * len(categories))(*(c.encode() for c in categories))
        set_logging = self._function("SetDebugLogging")
        status: int = set_logging(
            self._component, bool(categories), ctypes.c_size_t(len(categories)), texts
        )
        return sane(status)

    @abstractmethod
    def _function_name(self, name: str) -> str: ...

    @abstractmethod
    def _prepare_step(self) -> Callable[[float, float], int]: ...

    @abstractmethod
    def _prepare_initialization(self) -> Initialize: ...

    def _find_reset(self) -> Callable[[Any], int]:
        function: Callable[[Any], int] = self._function("Reset")
        return function

    # The parts that the versions share.

    def _function(self, name: str, *argtypes: Any, restype: Any = ctypes.c_int) -> Any:
        """Look up a separate function object, so that FMPy's prototype stays unchanged."""
        function = self._slave.dll[self._function_name(name)]
        function.restype = restype
        if argtypes:
            function.argtypes = argtypes
        return function

    def c_type(self, variable: Variable) -> str:
        """The C type of a variable, by its name in the standard."""
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
            *self._trailing_arguments(len(buffer)),
        )
        return self._function(f"Get{c_type}"), self._function(f"Set{c_type}"), arguments

    def _trailing_arguments(self, count: int) -> tuple[Any, ...]:
        return ()

    def _complain(self, text: str) -> None:
        """Log what the solver says like a message of the FMU."""
        self._log.receive(Status.ERROR, "solver", text)

    @contextmanager
    def muted(self) -> Iterator[None]:
        """Drop the FMU's messages inside this context."""
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

    def get_string(self, variable: Variable) -> tuple[int, str]:
        """Get the status and the text of a String variable."""
        reference = ctypes.c_uint32(variable.value_reference)
        text = ctypes.c_char_p()
        status = self._function("GetString")(
            self._component,
            ctypes.byref(reference),
            ctypes.c_size_t(1),
            ctypes.byref(text),
            *self._trailing_arguments(1),
        )
        return sane(status), (text.value or b"").decode(errors="replace")

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
            tolerance: For the FMU's solver, or None to leave it to the FMU.
            set_start_values: Sets the start values; called when FMI allows it.

        Raises:
            SimulationError: If the FMU fails.
        """
        self._require(Phase.INSTANTIATED, "initialize")
        Instance.initializations += 1
        try:
            self._configure()
            self._initialize(Span(start_time, stop_time, tolerance), set_start_values)
        except BaseException:  # initialization is incomplete: only a reset is legal now
            if self.phase is Phase.INSTANTIATED:
                self.phase = Phase.FAILED
            raise
        self.phase = Phase.STEPPING

    def _configure(self) -> None:
        """Set structural parameters, by which arrays get their sizes."""
        if not self._description.structure:
            return
        enter, leave = map(self._function, ("EnterConfigurationMode", "ExitConfigurationMode"))
        self.check("entering the configuration mode", enter(self._component))
        for variable, value in self._description.structure:
            reference = np.array([variable.value_reference], np.uint32)
            number = np.array([value], self.dtypes[variable.type])
            _, set_, arguments = Instance.prepare_access(self, variable.type, reference, number)
            self.check(f"setting {variable.name!r}", set_(*arguments))
        self.check("leaving the configuration mode", leave(self._component))

    def reset(self) -> None:
        """Return to the state just after instantiation, start values included.

        Raises:
            SimulationError: If the FMU fails, or had a fatal error before.
        """
        if self.phase is Phase.DEAD:
            raise SimulationError(
                f"{self._log.instance_name}: no reset is legal after a fatal error"
            )
        self.check("reset", self._reset_function(self._component))
        self.phase = Phase.INSTANTIATED

    def exchange_values(self) -> None:
        """Exchange values with other FMUs in Initialization Mode."""
        if self.exchange is not None:
            self.exchange()

    def free(self) -> None:
        """Terminate and free the instance. It may be called more than once."""
        if not self._slave.component:
            return
        for state in self._saved_states:
            state.release()
        if self.can_read:
            self.judge(self._function("Terminate")(self._component))
        fatal, self.phase = self.phase is Phase.DEAD, Phase.DEAD
        if not fatal:  # after Fatal, the standard forbids even this, so memory leaks
            self._free_component()
        self._slave.component = None
        self._log.close()

    def _free_component(self) -> None:
        self._function("FreeInstance", restype=None)(self._component)

    def check(self, doing: str, status: int) -> None:
        """Raise for a status worse than a warning.

        Raises:
            SimulationError: The text has the call that failed and the FMU's last messages.
        """
        if status > Status.WARNING or status < 0:
            raise SimulationError(self.describe_failure(doing, self.judge(status)))

    def describe_failure(self, doing: str, status: int) -> str:
        """Say which call failed, with the FMU's last messages."""
        label = Status(status).name.capitalize()
        return f"{self._log.instance_name}: {doing} returned {label}{self._log.said()}"

    def judge(self, status: int) -> int:
        """Note which calls are legal after a status; return it as a ``Status``."""
        status = sane(status)
        if status == Status.FATAL:
            self.phase = Phase.DEAD
        elif status == Status.ERROR:
            self.phase = Phase.FAILED
        return status

    def judge_step(self, status: int) -> int:
        """Do what ``judge`` does, and forbid more steps after a step that was not done."""
        if status != Status.TERMINATED:
            status = self.judge(status)
        if status > Status.WARNING:
            self.forbid_steps()
        return status

    def forbid_steps(self) -> None:
        """Forbid steps until a reset."""
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

    # Directional or adjoint derivatives, where the FMU offers them (FMI 2.0 and 3.0).

    def jacobian(
        self, unknowns: Sequence[Variable], knowns: Sequence[Variable]
    ) -> npt.NDArray[np.float64]:
        """Differentiate variables by others at the current communication point.

        Args:
            unknowns: The variables to differentiate: outputs or derivatives, real scalars and
                elements of arrays.
            knowns: The variables to differentiate by: continuous inputs or states, of the same
                kinds.

        Returns:
            The partial derivatives, shape (len(unknowns), len(knowns)), in the variables' units.

        Raises:
            SimulationError: If the FMU provides no derivatives, or fails.
        """
        capabilities = self._description.capabilities
        if not capabilities.provides_derivatives:
            raise SimulationError(f"{self._description.model_name} provides no derivatives")
        self._require(Phase.STEPPING, "differentiate")
        result = np.zeros((len(unknowns), len(knowns)))
        if capabilities.provides_directional_derivatives:
            for column, known in zip(result.T, knowns, strict=True):
                call = DerivativeCall.directional(unknowns, known, self._trailing_arguments)
                column[:] = self._derivatives(call)
        else:
            for row, unknown in zip(result, unknowns, strict=True):
                call = DerivativeCall.adjoint(unknown, knowns, self._trailing_arguments)
                row[:] = self._derivatives(call)
        return result

    def _derivatives(self, call: DerivativeCall) -> npt.NDArray[np.float64]:
        status = self._function(call.name)(self._component, *call.arguments)
        self.check(call.doing, status)
        return call.result

    # FMU state, where the FMU offers it (FMI 2.0 and 3.0).

    def save_state(self) -> SavedState:
        """Copy the FMU state.

        Raises:
            SimulationError: If the FMU cannot save its state, or fails.
        """
        if not self._description.capabilities.can_get_and_set_fmu_state:
            raise SimulationError(f"{self._description.model_name} cannot get and set its state")
        self._require(Phase.STEPPING, "save the FMU state")
        state = ctypes.c_void_p()
        get_state = self._function(self._state_function("Get"))
        self.check("saving the FMU state", get_state(self._component, ctypes.byref(state)))
        self._note_return()
        saved = SavedState(self, state)
        self._saved_states.add(saved)
        return saved

    @property
    def number_of_states(self) -> int:
        """How many saved states are in use."""
        return len(self._saved_states)

    def serialize(self, state: SavedState) -> bytes:
        """Turn a state of this instance into bytes.

        Raises:
            SimulationError: If the FMU fails.
        """
        name, size = self._state_function(""), ctypes.c_size_t(0)
        get_size = self._function(f"Serialized{name}Size")
        self.check("sizing a state", get_size(self._component, state.pointer, ctypes.byref(size)))
        data = ctypes.create_string_buffer(size.value)
        serialize = self._function(f"Serialize{name}")
        self.check("serializing a state", serialize(self._component, state.pointer, data, size))
        return data.raw

    def deserialize(self, data: bytes) -> SavedState:
        """Make a state of bytes that an instance of the same FMU has serialized.

        Raises:
            SimulationError: If the FMU fails.
        """
        pointer = ctypes.c_void_p()
        deserialize = self._function(self._state_function(self._deserialize))
        size = ctypes.c_size_t(len(data))
        status = deserialize(self._component, data, size, ctypes.byref(pointer))
        self.check("deserializing a state", status)
        self._note_return()
        saved = SavedState(self, pointer)
        self._saved_states.add(saved)
        return saved

    def _note_return(self) -> None:
        """From now on the FMU may be returned to an earlier state, and is told so in each step."""
        if not self._may_return:
            self._may_return = True
            self.step = self._prepare_step()

    def restore_state(self, state: SavedState) -> None:
        """Return to a state saved by this instance.

        Raises:
            SimulationError: If the FMU fails, or had a fatal error before.
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
    """The owner of an FMU state; it frees the state once, while the instance lives.

    Attributes:
        pointer: The FMU's handle.
        memory: What a solver adds to the state.
    """

    memory: Any = None

    def __init__(self, instance: Instance, pointer: ctypes.c_void_p) -> None:
        self.pointer = pointer
        self.release = weakref.finalize(self, instance.free_state, pointer)
