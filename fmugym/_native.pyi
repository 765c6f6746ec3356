"""Pools of FMU instances in C; ``fmugym.pool.native_pool`` is the way to use them.

Arrays are those of numpy: float64 for values, bool for masks, float32 for observations, int8 for
statuses. Masks and the values of a reset may have any strides.
"""

from collections.abc import Callable
from typing import Any, Final, NewType, final

import numpy.typing as npt

Array = npt.NDArray[Any]

MOST_REGISTERS: Final[int]
"""The most registers of a program."""

OPERATIONS: Final[tuple[str, ...]]
"""The operations of programs, in the order of their numbers."""

DISTRIBUTIONS: Final[tuple[str, ...]]
"""The kinds of distributions, in the order of their numbers."""

Program = tuple[bytes, tuple[Array, ...]]
"""The form of a program, and its rows: ``Program.with_rows`` of ``fmugym.expressions.program``."""

def evaluate(
    program: Program,
    count: int,
    /,
) -> bool:
    """Run a program on count environments outside of a step.

    Args:
        program: The program.
        count: The number of environments.

    Returns:
        Whether an index was outside of its table.
    """

def statistics() -> dict[str, int]:
    """What helper threads have done in this process.

    Returns:
        ``jobs`` in which helpers could take part, ``wakes`` of helpers that slept, ``early_wakes``
        before any item of the job was done, and ``chunks`` that these jobs were divided into.
    """

def initializations() -> int:
    """How many initializations the pools of this process have begun."""

def serve(channel: int, memory: int, /) -> None:
    """Be a worker until the other end of the channel is closed; see ``native/worker``.

    Args:
        channel: The descriptor of a socket; on Windows its handle.
        memory: The descriptor of the shared memory; not used on Windows.
    """

def end_with(parent: int, /) -> bool:
    """Let the system end this process with its parent; returns whether the parent still lives.

    Args:
        parent: The parent's process number.
    """

def stop_tracing(process: int, stopped_by: int, /) -> None:
    """Let a process go on that this one traces, and that a signal has stopped.

    Args:
        process: Its number, or that of a thread of it.
        stopped_by: The number of the signal, which it gets now.
    """

Access = NewType("Access", object)
"""A list of variables of one FMI version; nothing but pools can read it."""

def access(form: bytes, /) -> Access:
    """Take over a list of variables.

    Args:
        form: See ``fmugym.pool.pool_form.form_of_listing``.

    Raises:
        ValueError: If the form is damaged.
    """

Draws = tuple[bytes, int, int]
"""The draws of an episode: their form, see ``fmugym.pool.pool_form.form_of_draws``, and the
addresses of numpy's ``random_standard_normal`` and of ``exp`` behind ``math.exp``, or 0."""

def draw(draws: Draws, streams: Array, values: Array, /) -> None:
    """Draw an episode from each of M streams.

    Args:
        draws: The draws.
        streams: They change, uint64, shape (M, 6).
        values: Filled, float64, shape (draws, M).

    Raises:
        ValueError: If a kind is unknown or does not have the numbers that it needs.
    """

def draw_from(draws: Draws, bits: object, start_values: Array, values: Array, /) -> None:
    """Draw an episode by a bit generator of numpy.

    Args:
        draws: The draws.
        bits: The ``capsule`` of the generator; the caller holds its ``lock``.
        start_values: Gets those that are drawn, float64, shape (P,).
        values: Filled, float64, shape (draws,).

    Raises:
        ValueError: As for ``draw``.
    """

@final
class Pool:
    """N instances of one FMU.

    Any method may be called from any thread at any time; calls take turns.
    Afterwards the messages of the FMU go to ``callback``. What that raises comes out of the method,
    whose work is done by then. The next call reports the other messages.

    Args:
        form: See ``fmugym.pool.pool_form.form_of_pool``.
        arrays: The pool's own: inputs, outputs, statuses, observations, and the counts of
            ``fmugym.pool.health``, int64.
        callback: Receives the number of an instance, the status, the category and the text of each
            message.

    Raises:
        ValueError: If the form is damaged.
        OSError: If the FMU cannot be loaded or instantiated.
        SimulationError: From all methods but ``close``, if the pool is closed.
        RuntimeError: If an FMU calls the pool that it is in.
    """

    def __new__(
        cls,
        form: bytes,
        arrays: tuple[Array, Array, Array, Array, Array],
        callback: Callable[[int, int, str, str], object],
        /,
    ) -> Pool: ...
    def step(self, skip: Array | None, /) -> int:
        """Step all but those in the mask with the pool's inputs, and write all observations.

        Returns:
            How many have a status worse than a warning.
        """

    def reset(self, start: Access, values: Array, mask: Array | None, /) -> int:
        """Start those in the mask anew; the rest is as for ``step``, without observations."""

    def prepare_play(
        self,
        form: bytes,
        rows: tuple[Array, ...],
        start: Access,
        start_values: Array,
        current: Array,
        previous: Array,
        draws: Draws,
        streams: Array,
        ended: Array,
        kept: Array,
        results: tuple[bool, tuple[Array, ...]],
        /,
    ) -> None:
        """Take over what surrounds the steps of a vector environment; see ``NativePool``."""

    def play(self, actions: Array | int, at_ends: bool, /) -> tuple[Any, ...]:
        """Do a step, with all that was taken over; see ``Play.step`` of ``fmugym.pool.pool``.

        Raises:
            TypeError: If the actions have another type or shape than was prepared.
            ValueError: If one of them is out of range or NaN.
            IndexError: If a hook looks up an index outside of its table; the FMUs have stepped.
        """

    def check_actions(self, actions: Array | int, /) -> None:
        """Check actions as ``play`` does, and raise the same errors; nothing else is done."""

    def play_before(self, actions: Array | int, /) -> None:
        """Do what comes before the FMUs' part of ``play``, where the caller steps them.

        The errors are those of ``play``. Where they run in other processes, the pool was made
        without paths of libraries.
        """

    def play_after(self) -> tuple[Any, ...]:
        """Do what comes after the FMUs' part of ``play``.

        The outputs and statuses are those that the pool's arrays have. The results and errors are
        those of ``play``.
        """

    def start(self, mask: Array, /) -> tuple[Any, ...] | None:
        """Start episodes; see ``Play.start`` of ``fmugym.pool.pool``."""

    def count_steps(self) -> None:
        """Add the steps so far to the counts."""

    def ask(self, request: int, content: bytes, /) -> tuple[int, bytes]:
        """Ask for something else; see ``fmugym.pool.engine``.

        Args:
            request: What for.
            content: The content of the request.

        Returns:
            The code and the content of the answer.

        Raises:
            ValueError: If there is no such request.
        """

    def close(self) -> None:
        """Free all instances; more than one call is fine."""
