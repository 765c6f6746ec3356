"""One place in a Python pool: an instance with its buffers, replaced if a reset cannot help."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.errors import FMUGymError, SimulationError, printable
from fmugym.fmi.access import Access
from fmugym.fmi.instance import SavedState
from fmugym.fmi.library import Library
from fmugym.fmi.status import Phase, Status
from fmugym.pool.base import FloatArray, PoolSpec, names_of
from fmugym.pool.bundle import Record
from fmugym.pool.health import Column, HealthArray
from fmugym.pool.retries import step_with_retries
from fmugym.pool.samples import Samples
from fmugym.pool.spec import REUSING, ResetMethod, is_start_time

__all__ = ["Slot", "Snapshot"]


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A saved state of one instance.

    Attributes:
        life: The only life of an instance that can restore the state.
        state: The FMU state.
        count: The number of communication steps before the state.
        start_time: The first communication point of its episode.
    """

    life: object
    state: SavedState
    count: int
    start_time: float


_STEPPING = Phase.STEPPING
_WARNING = int(Status.WARNING)


def _all_finite(values: list[float]) -> bool:
    total = sum(values)
    return total - total == 0.0 or all(map(math.isfinite, values))


def _is_fine(status: int) -> bool:
    return 0 <= status <= _WARNING


def _has_failed(status: int) -> bool:
    return bool(status) and not _is_fine(status) and status != Status.TERMINATED


class Slot:
    """One place in the pool. Its instance is replaced if a reset cannot help.

    Args:
        library: The FMU's library.
        spec: What to do at each reset and step.
        input_row: The inputs of the instance, shape (k_in,).
        output_row: Its outputs, shape (k,).
        counts: Its counts, shape (HEALTH_COUNTS,).

    Attributes:
        failure: Why the last status was worse than a warning.
        start_time: The first communication point of its episode.
        is_due: Whether the next reset replaces the instance.
        keeps_record: Whether the inputs of its episodes are kept.
    """

    def __init__(
        self,
        library: Library,
        spec: PoolSpec,
        input_row: FloatArray,
        output_row: FloatArray,
        counts: HealthArray,
    ) -> None:
        self.failure = ""
        self.is_due = self.keeps_record = False
        self._played: tuple[Record, list[bytes]] | None = None
        self._unexplained = False
        self._counts = counts
        self._count = self._counted = 0
        self._library = library
        self._spec = spec
        self.start_time = spec.start_time
        self._input_row, self._output_row = input_row, output_row
        self._step_size = spec.communication_step_size
        self._restores = library.can_save_state and spec.reset_method == ResetMethod.RESTORE
        self._first_outputs = b""
        self._integrals = [i for i, name in enumerate(spec.samplings) if name == "integral"]
        self._build()

    def _build(self, *, hear_all: bool = False) -> None:
        self._instance = self._library.instantiate(hear_all=hear_all)
        self._inputs = Access(self._instance, self._spec.inputs, self._input_row)
        self._outputs = Access(self._instance, self._spec.outputs, self._output_row)
        self._start_variables: tuple[Variable, ...] = ()
        self._own_starts: list[int] = []
        self._start = Access(self._instance, ())
        self._start_key: tuple[tuple[Variable, ...], bytes] | None = None
        self._saved: SavedState | None = None
        self._good_outputs = self._output_row.tolist()

    def begin_by(self, method: ResetMethod) -> None:
        """Let later episodes begin in another way, without saved states."""
        self._spec = self._spec.beginning_by(method)
        self._restores, self._saved = False, None

    def reset(self, variables: tuple[Variable, ...], values: FloatArray) -> int:
        """Start a new episode by the spec's reset method.

        ``RESTORE`` keeps the state after initialization once the same start values come a second
        time after an episode with steps, and restores it from then on. Other start values need a
        reset and an initialization.
        """
        key = (variables, values.tobytes())
        stepped = self._count > self._spec.warm_up_steps * self._spec.substeps
        self.count_steps()
        self._counts[Column.RESETS] += 1
        self._counts[Column.RETRIED] = 0
        self._played = None
        if self.keeps_record:
            self._played = Record.of(variables, np.array(values), np.zeros((0, 0))), []
        self.start_time = self._start_time_in(variables, values)
        try:
            self._make_anew_if_due()
            self._instance.begin_episode()
            if not self._restored(key):
                self._initialize(variables, values)
                if not self._kept_state(key, stepped):
                    self._initialize(variables, values)
        except FMUGymError as error:
            return self._failed(str(error))
        self._begin_counting_at(self._spec.warm_up_steps * self._spec.substeps)
        status = self._read_outputs(Status.OK)
        self._first_outputs = self._output_row.tobytes()
        return status

    def _start_time_in(self, variables: tuple[Variable, ...], values: FloatArray) -> float:
        for variable, value in zip(variables, values, strict=True):
            if is_start_time(variable):
                return float(value)
        return self._spec.start_time

    def count_steps(self) -> None:
        """Add the steps so far to the counts."""
        self._counts[Column.STEPS] += self._count - self._counted
        self._counted = self._count

    def _begin_counting_at(self, count: int) -> None:
        self._count = self._counted = count

    def _make_anew_if_due(self) -> None:
        """Replace an instance that has leaked memory, or that no reset can make like new."""
        is_due, self.is_due = self.is_due, False
        unexplained, self._unexplained = self._unexplained, False
        if self._instance.phase in (Phase.DEAD, Phase.INSTANTIATED):
            return
        if is_due:
            self._counts[Column.RECYCLINGS] += 1
            self._replace()
        elif unexplained and not self._has_snapshots and self._instance.can_say_more:
            self._rebuild(hear_all=True)
        elif self._spec.whole_reset_method not in REUSING or self._instance.hears_more_than_wanted:
            self._rebuild()

    @property
    def _has_snapshots(self) -> bool:
        return self._instance.number_of_states > (self._saved is not None)

    def _restored(self, key: tuple[tuple[Variable, ...], bytes]) -> bool:
        if self._saved is None or key != self._start_key or self._instance.phase is Phase.DEAD:
            return False
        try:
            self._instance.restore_state(self._saved)
            got = self._get_between_steps(is_start=True)
        except SimulationError:  # a reset and an initialization may still work
            got = Status.ERROR
        if not _is_fine(got) or self._output_row.tobytes() != self._first_outputs:
            self._saved, self._restores = None, False  # whatever the trial showed
        return self._saved is not None

    def knows_start(self, variables: tuple[Variable, ...], values: FloatArray) -> bool:
        """See ``AttendedPool.knows_start``."""
        alive = self._saved is not None and self._instance.phase is not Phase.DEAD
        return alive and self._start_key == (variables, values.tobytes())

    def _kept_state(self, key: tuple[tuple[Variable, ...], bytes], stepped: bool) -> bool:
        """Keep the state if a later reset can use it; returns whether the instance can step."""
        again = stepped and key == self._start_key
        self._start_key, self._saved = key, None
        if again and self._restores:
            try:
                self._saved = self._instance.save_state()
            except SimulationError:  # episodes can begin without it, whatever the trial showed
                self._restores = False
        return self._instance.phase is _STEPPING

    def _initialize(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        """Initialize; if that fails without a word, repeat it and let the FMU log everything."""
        try:
            self._initialize_once(variables, values)
        except SimulationError:
            dead = self._instance.phase is Phase.DEAD
            if dead or self._has_snapshots or not self._instance.can_say_more:
                raise
            self._rebuild(hear_all=True)
            self._initialize_once(variables, values)

    def _initialize_once(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        self._return_to_instantiated()
        if variables is not self._start_variables:
            self._own_starts = [i for i, v in enumerate(variables) if not is_start_time(v)]
            self._start = Access(self._instance, [variables[i] for i in self._own_starts])
            self._start_variables = variables
        self._start.values[:] = values[self._own_starts]
        spec = self._spec
        self._instance.initialize(
            self.start_time, spec.stop_time, spec.tolerance, self._set_start_values
        )
        self._warm_up()

    def _return_to_instantiated(self) -> None:
        """Reset the instance, or replace it if it refuses or must not be reset."""
        if self._instance.phase is Phase.INSTANTIATED:
            return
        try:
            self._instance.reset()
        except SimulationError:
            self._replace()

    def _replace(self) -> None:
        self._counts[Column.REPLACEMENTS] += 1
        self._rebuild()

    def _rebuild(self, *, hear_all: bool = False) -> None:
        self._library.discard(self._instance)
        self._build(hear_all=hear_all)

    def _set_start_values(self) -> None:
        self._instance.check("setting the start values", self._start.set())
        self._start.set_texts()

    def _warm_up(self) -> None:
        self._begin_counting_at(0)
        for _ in range(self._spec.warm_up_steps):
            status = self._advance()
            self._begin_counting_at(self._count)
            if not _is_fine(status):
                raise SimulationError(f"the warm-up failed: {self.failure}")

    def step(self) -> int:
        """Set the inputs, step, and get the outputs; return the status."""
        if self._instance.phase is not _STEPPING:
            return self._failed("the instance needs a reset before it can be stepped")
        inputs = self._input_row.tolist()
        if not _all_finite(inputs):
            return self._not_finite("inputs", self._spec.inputs, inputs)
        if self._played is not None:
            self._played[1].append(self._input_row.tobytes())
        if self._spec.fault_retries:
            self._counts[Column.RETRIED] = 0
        status = self._inputs.set()
        if status and not _is_fine(status):
            return self._failed_call("setting the inputs", status)
        result = self._advance_sampled() if self._spec.samplings else self._advance_and_read()
        if result > _WARNING and result != Status.NOT_FINITE:  # this may have been the last step
            self._instance.forbid_steps()
        return result

    def _advance_and_read(self) -> int:
        status = self._advance()
        if _has_failed(status):
            return status
        got = self._outputs.get()
        return self._take_outputs(status, got)

    def _advance_sampled(self) -> int:
        """Read the outputs after each substep, and let the row hold what is asked for of them."""
        samples, status = Samples(self._spec.samplings, self._step_size), 0
        for _ in range(self._spec.substeps):
            status = self._step_once()
            got = 0 if _has_failed(status) else self._outputs.get()
            if _has_failed(status) or _has_failed(got):
                self._output_row[:] = self._good_outputs
                return self._take_outputs(status, got) if _has_failed(got) else status
            samples.add(self._output_row.tolist())
            if status == Status.TERMINATED:
                break
        self._output_row[:] = samples.conclude()
        return self._take_outputs(status, 0)

    def _advance(self) -> int:
        status = 0
        for _ in range(self._spec.substeps):
            status = self._step_once()
            if status and not _is_fine(status):
                break
        return status

    def _step_once(self) -> int:
        spec = self._spec
        time = spec.communication_point(self._count, self.start_time)
        if spec.fault_retries:
            status = step_with_retries(
                self._instance, time, self._step_size, spec.fault_retries, self._counts
            )
        else:
            status = self._instance.step(time, self._step_size)
        self._count += 1
        if status and not _is_fine(status):
            self._note_failure(f"the step at t = {time:g} s", status)
        return status

    def _get_between_steps(self, *, is_start: bool) -> int:
        """Get the outputs into the row, where integrals over a step are 0."""
        got: int = Status.OK
        if is_start and self._spec.blind_start:
            self._output_row[:] = self._spec.start_outputs
        else:
            got = self._outputs.get()
        self._output_row[self._integrals] = 0.0
        return got

    def _read_outputs(self, status: int) -> int:
        """Read the outputs between steps."""
        return self._take_outputs(status, self._get_between_steps(is_start=self._count == 0))

    def _take_outputs(self, status: int, got: int) -> int:
        """Take the outputs in the row; if any is not finite, keep the last good ones.

        Args:
            status: What to return if all is well.
            got: The status of reading them.
        """
        if got and not _is_fine(got):
            return self._failed_call("reading the outputs", got)
        values = self._output_row.tolist()
        if not _all_finite(values):
            self._output_row[:] = self._good_outputs
            return self._not_finite("outputs", self._spec.outputs, values)
        self._good_outputs = values
        return status

    def _not_finite(self, what: str, variables: Sequence[Variable], values: list[float]) -> int:
        pairs = zip(variables, values, strict=True)
        bad = (f"{v.name} = {value}" for v, value in pairs if not math.isfinite(value))
        self.failure = f"the {what} are not finite: {printable(', '.join(bad))}"
        return Status.NOT_FINITE

    def _failed_call(self, doing: str, status: int) -> int:
        status = self._instance.judge(status)
        self._note_failure(doing, status)
        self._output_row[:] = self._good_outputs
        return status

    def _note_failure(self, doing: str, status: int) -> None:
        self.failure = self._instance.describe_failure(doing, status)
        self._unexplained = status != Status.TERMINATED and self._instance.is_silent

    def _failed(self, reason: str) -> int:
        self.failure = reason
        return Status.FATAL if self._instance.phase is Phase.DEAD else Status.ERROR

    def save(self) -> Snapshot:
        """Copy the FMU state and the time."""
        state = self._instance.save_state()
        return Snapshot(self._instance.life, state, self._count, self.start_time)

    def require_own(self, snapshot: Snapshot) -> None:
        """Refuse a state of another instance, because FMUs accept it silently."""
        if snapshot.life is not self._instance.life:
            raise SimulationError("the snapshot is of another instance than this one")

    def restore(self, snapshot: Snapshot) -> int:
        """Return to a state and its time."""
        self.count_steps()
        self._played = None
        try:
            self._instance.restore_state(snapshot.state)
        except SimulationError as error:
            return self._failed(str(error))
        self.start_time = snapshot.start_time
        self._begin_counting_at(snapshot.count)
        return self._read_outputs(Status.OK)

    def write(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        """Set variables between two steps.

        Raises:
            SimulationError: If the FMU refuses.
        """
        if self._instance.phase is not _STEPPING:
            raise SimulationError("the instance needs a reset before anything can be set")
        self._played = None
        access = Access(self._instance, variables, np.array(values))
        self._instance.check("setting variables", access.set())

    def differentiate(
        self, unknowns: tuple[Variable, ...], knowns: tuple[Variable, ...]
    ) -> FloatArray:
        """See ``Pool.differentiate``; shape (k, m).

        Raises:
            SimulationError: If the FMU refuses.
        """
        self._instance.check("setting the inputs", self._inputs.set())
        return self._instance.jacobian(unknowns, knowns)

    @property
    def count(self) -> int:
        """The number of communication steps in this episode."""
        return self._count

    def serialize(self) -> bytes:
        """Serialize the FMU state; ``b""`` if the instance cannot be stepped any more.

        Raises:
            SimulationError: If the FMU fails.
        """
        if self._instance.phase is not _STEPPING:
            return b""
        state = self._instance.save_state()
        try:
            return self._instance.serialize(state)
        finally:
            state.release()

    def deserialize(self, data: bytes, count: int, start_time: float, outputs: FloatArray) -> int:
        """Return to a serialized state.

        Args:
            data: The state.
            count: Its number of communication steps.
            start_time: The first communication point of its episode.
            outputs: Its outputs.
        """
        self.count_steps()
        self._played = None
        self._output_row[:] = outputs
        self._good_outputs = outputs.tolist()
        if not data:
            self._instance.forbid_steps()
            return Status.OK
        try:
            if self._instance.phase is Phase.DEAD:
                self._replace()
            state = self._instance.deserialize(data)
            self._instance.restore_state(state)
            state.release()
        except SimulationError as error:
            return self._failed(str(error))
        self.start_time = start_time
        self._begin_counting_at(count)
        return Status.OK

    def replace_record(self, record: Record) -> None:
        """Let the episode count as the one of a record."""
        self._played = record, [row.tobytes() for row in record.inputs]

    @property
    def record(self) -> Record | None:
        """The episode until now; None if it is not known as a whole."""
        if self._played is None:
            return None
        record, rows = self._played
        inputs = np.frombuffer(b"".join(rows)).reshape(len(rows), len(self._spec.inputs))
        return replace(record, inputs=inputs)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """Read any variables now."""
        if not self._instance.can_read:
            raise SimulationError("the instance needs a reset before anything can be read")
        access = Access(self._instance, variables)
        self._instance.check(f"reading {names_of(variables)}", access.get())
        return access.values
