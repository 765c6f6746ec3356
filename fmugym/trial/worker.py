"""The process in which an FMU is tried for the first time; see ``fmugym.trial.trial``.

It talks through files in a folder of its own, which no output of the FMU can disturb: it reads
``request``, and writes ``stage`` before each step and ``answer`` as far as it has one. What the FMU
says goes to standard error at once, since the next call may be the last.
"""

from __future__ import annotations

import ctypes
import faulthandler
import json
import logging
import os
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT
from fmugym.errors import FMUGymError, SimulationError
from fmugym.fmi.status import Status
from fmugym.pool.base import Pool, PoolSpec
from fmugym.pool.extension import has_native_pool
from fmugym.pool.local import local_pool
from fmugym.trial.shared_globals import default_spec, shares_globals, start_inputs
from fmugym.trial.trial import Candidate, Request

_NO_DIALOGUES: Final = 0x0003
"""``SEM_FAILCRITICALERRORS | SEM_NOGPFAULTERRORBOX``: a fault on Windows asks nobody."""

_LINE_BUFFERED: Final = 1
"""``_IOLBF`` of glibc, musl and macOS."""

Note = Callable[[str], None]
"""Tells what is about to be done."""


def main(folder: Path) -> None:
    """Try an FMU.

    Args:
        folder: Has the request; gets the stage and the answer.
    """
    request: Request = pickle.loads((folder / "request").read_bytes())
    _prepare(request.candidate.timeout or DEFAULT_PROBE_TIMEOUT)

    def note(stage: str) -> None:
        (folder / "stage").write_text(stage)

    def answer(**values: bool) -> None:
        (folder / "answer").write_text(json.dumps(values))

    complete = _try_alone(request.candidate, note)
    if request.spec is None or not complete:
        answer(complete=complete, shares_globals=False)
        return
    answer(complete=complete)
    answer(complete=complete, shares_globals=_try_two(request, note))


def _prepare(timeout: float) -> None:
    """Outlive neither the time-out nor, for long, a killed parent; leave no core dump."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    faulthandler.dump_traceback_later(timeout, exit=True, file=nowhere)
    if sys.platform == "win32":
        ctypes.windll.kernel32.SetErrorMode(_NO_DIALOGUES)
    else:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        _print_line_by_line()


def _print_line_by_line() -> None:
    """What C prints to a pipe would be held back until much came together, and lost at a crash."""
    library = ctypes.CDLL(None)
    name = "__stdoutp" if sys.platform == "darwin" else "stdout"
    stream = ctypes.c_void_p.in_dll(library, name)
    library.setvbuf(stream, None, _LINE_BUFFERED, ctypes.c_size_t(0))


def _try_alone(candidate: Candidate, note: Note) -> bool:
    """Try one instance; returns whether more of the FMU would be seen another time.

    In Python first: there messages come while the FMU runs. FMPy wants every function of the
    standard to be there, the native pool does not.
    """
    for native in (False, True) if has_native_pool() else (False,):
        try:
            _step_once(candidate, native, note)
            return True
        except FMUGymError:  # it is alive, and the caller will hear of it as well
            continue
    return False


def _step_once(candidate: Candidate, native: bool, note: Note) -> None:
    fmu = candidate.open()
    spec = default_spec(fmu)
    note("loading and instantiation")
    pool = local_pool(fmu, spec, 1, _Echo("fmu", logging.WARNING), native=native, threads=1)
    try:
        _reset_and_step(pool, spec, note)
    finally:
        note("closing")
        pool.close()


def _reset_and_step(pool: Pool, spec: PoolSpec, note: Note) -> None:
    note("initialization")
    _, statuses = pool.reset((), np.zeros((0, 1)))
    if statuses[0] <= Status.WARNING:  # otherwise it may need the values that the caller will set
        note("the first step")
        pool.step(start_inputs(spec, 1))


def _try_two(request: Request, note: Note) -> bool:
    note("the comparison with a second instance")
    try:
        return shares_globals(
            request.candidate.open(), request.spec, private_libraries=request.private_libraries
        )
    except SimulationError:  # it fails alone too, without the values that the caller will set
        return False


class _Echo(logging.Logger):
    """Writes every message down at once, also those that its level would drop."""

    def log(self, level: int, msg: object, *args: object, **_: Any) -> None:
        os.write(2, f"{str(msg) % args}\n".encode(errors="replace"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
