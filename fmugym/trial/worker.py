"""The process in which an FMU is tried for the first time; see ``fmugym.trial.trial``.

It communicates through files in a private folder, so that output of the FMU cannot interfere. It
reads ``request``, writes ``stage`` before each step, and adds to ``answer`` as results come in. The
FMU's messages go to ``echo`` at once, because the next call may be the last.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import functools
import json
import logging
import math
import mmap
import os
import pickle
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym import _native
from fmugym.archive.fmu import DEFAULT_PROBE_TIMEOUT, FMU
from fmugym.archive.variable import Variable
from fmugym.errors import FMUGymError, FMULoadError, LicenceError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import Pool
from fmugym.pool.patience import require_licence
from fmugym.pool.process.output import print_line_by_line
from fmugym.pool.process.shared_memory import ECHO_SIZE
from fmugym.pool.process.supervisor import Supervisor
from fmugym.pool.progress import INITIALIZATION, listen
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.attempt import ECHO, Request, Stage, patience
from fmugym.trial.inputs import start_inputs
from fmugym.trial.neighbours import default_spec, disturb_in_threads, disturb_in_turn
from fmugym.trial.pools import trial_pool
from fmugym.trial.rehearsal import Rehearsal, Starts
from fmugym.trial.resuming import Halfway, make_halfway, try_halfway
from fmugym.trial.rungs import find_rungs, offers_of
from fmugym.trial.shared_data import Steps, watch_steps
from fmugym.trial.verdict import FRUGAL, Grade, Neighbours, Verdict

_NO_DIALOGUES: Final = 0x0003
"""``SEM_FAILCRITICALERRORS | SEM_NOGPFAULTERRORBOX``: faults on Windows open no dialog."""


_MOST_UNREADABLE: Final = 5
"""The most outputs that a verdict names because they cannot be read."""

_SILENT: Final = logging.Logger("fmugym.trial", logging.CRITICAL + 1)
"""Takes messages that the echo has already."""

_GRACE: Final = 1.0
"""Seconds that the parent has to end this process before it ends itself."""


class Notes:
    """Notes that the parent can read at any time, even after the process has died.

    Args:
        folder: The folder for the files.
        timeout: Seconds that a call may take.
    """

    def __init__(self, folder: Path, timeout: float) -> None:
        self._folder, self._timeout = folder, timeout
        self._answer: dict[str, Any] = {}

    def stage(self, stage: str) -> None:
        """Write down what comes next, and how many initializations there were so far."""
        self.answer(initializations=_initializations())
        (self._folder / "stage").write_text(stage)

    def call(self, call: str) -> None:
        """Write down which call of the FMU comes next."""
        (self._folder / "call").write_text(call)
        _end_after(patience(call, self._timeout))

    def found(self, name: str) -> bool:
        """Whether the answer so far has a value that is true."""
        return bool(self._answer.get(name))

    def keep(self, sample: Halfway) -> None:
        """Leave a sample for another process."""
        (self._folder / "sample").write_bytes(pickle.dumps(sample))

    def answer(self, **values: Any) -> None:
        """Add to the answer; the file is replaced atomically."""
        self._answer |= values
        path = self._folder / "answer.new"
        path.write_text(json.dumps(self._answer))
        path.replace(self._folder / "answer")


def main(folder: Path) -> None:
    """Try an FMU.

    Args:
        folder: The folder that has the request and gets the stage and the answer.
    """
    request: Request = pickle.loads((folder / "request").read_bytes())
    _prepare()
    notes = Notes(folder, request.candidate.timeout or DEFAULT_PROBE_TIMEOUT)
    notes.call(INITIALIZATION)
    listen(notes.call)
    notes.answer(instances=1)
    _echo_to(folder / ECHO)
    try:
        _try(request, notes)
    except LicenceError as error:
        notes.answer(refused=str(error))
    notes.answer(finished=True, initializations=_initializations())


def _echo_to(path: Path) -> None:
    with path.open("wb+") as file:
        file.truncate(ECHO_SIZE)
        _native.echo_to(np.frombuffer(mmap.mmap(file.fileno(), ECHO_SIZE), np.uint8))


def _try(request: Request, notes: Notes) -> None:
    if request.resume is not None:
        _try_resuming(request, notes)
        return
    if request.known is not None:
        notes.answer(complete=True, frugal=FRUGAL in request.known.reasons)
        _try_several(request, notes, request.known)
        return
    complete = _try_alone(request, notes)
    notes.answer(complete=complete)
    if complete and request.spec is not None:
        verdict = _try_resets(request, notes)
        if request.several:
            _try_several(request, notes, verdict)


def _initializations() -> int:
    """How many initializations this process has begun."""
    return Supervisor.initializations + _native.initializations()


def _end_after(seconds: float) -> None:
    """End this process then, even if the parent was killed, unless this is called again before."""
    faulthandler.dump_traceback_later(seconds + _GRACE, exit=True, file=_nowhere())


@functools.cache
def _nowhere() -> int:
    return os.open(os.devnull, os.O_WRONLY)


def _prepare() -> None:
    """Leave no dialog and no core dump, and lose no output."""
    if sys.platform == "win32":
        ctypes.windll.kernel32.SetErrorMode(_NO_DIALOGUES)
    else:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        print_line_by_line()


def _try_alone(request: Request, notes: Notes) -> bool:
    """Try one instance; return whether another trial might show more of the FMU."""
    try:
        _step_once(request, notes)
    except LicenceError:
        raise
    except FMUGymError:  # the process is alive, and the caller will get the error too
        return False
    return True


def _step_once(request: Request, notes: Notes) -> None:
    fmu = request.candidate.open()
    spec = default_spec(fmu)
    notes.stage("loading and instantiation")
    pool = trial_pool(fmu, spec, 1, _SILENT)
    try:
        _reset_and_step(pool, spec, notes)
    finally:
        notes.stage("closing")
        pool.close()


def _reset_and_step(pool: Pool, spec: PoolSpec, notes: Notes) -> None:
    notes.stage("initialization")
    _, statuses = pool.reset((), np.zeros((0, 1)))
    require_licence(pool)
    if statuses[0] <= WARNING_CODE:  # otherwise it may need the caller's values
        notes.stage("the first step")
        pool.step(start_inputs(spec)[:, None])


def _try_resets(request: Request, notes: Notes) -> Verdict:
    """Grade the reset methods, fastest first, until one is exact to the last bit.

    Returns:
        The verdict on the resets of a lone instance.
    """
    notes.stage(Stage.REFERENCE)
    if Stage.REFERENCE in request.skip:
        return Verdict()
    rehearsal = _rehearsal(request, notes)
    if not rehearsal.possible:
        return Verdict()
    notes.answer(frugal=rehearsal.is_frugal)
    grades: dict[ResetMethod, Grade] = {}
    for method in _methods(request):
        stage = Stage.of(method)
        notes.stage(stage)
        skipped = stage in request.skip
        grades[method] = Grade.FAILS if skipped else rehearsal.grade(method)
        notes.answer(resets=grades, noisy=rehearsal.noisy)
        if grades[method] == Grade.BITWISE:
            break
    components = _try_components(request, rehearsal, grades, notes)
    blind = notes.found("blind_start")
    return Verdict(resets=grades, components=components, noisy=rehearsal.noisy, blind_start=blind)


def _try_components(
    request: Request, rehearsal: Rehearsal, grades: dict[ResetMethod, Grade], notes: Notes
) -> tuple[ResetMethod, ...]:
    """Find a method for each component of a system that does not begin anew by restores."""
    base = Verdict(resets=grades).reset_method
    description = request.candidate.open().description
    tried = grades.get(base) == Grade.BITWISE and base is not ResetMethod.RESTORE
    if not tried or rehearsal.is_frugal or not description.components:
        return ()

    def grade(components: tuple[ResetMethod, ...]) -> Grade:
        stage = f"the rehearsal of resets by component ({', '.join(components)})"
        notes.stage(stage)
        return Grade.FAILS if stage in request.skip else rehearsal.grade(base, components)

    reloads = _can_copy_libraries(request.candidate.open())
    offers = [offers_of(part, reloads=reloads) for part in description.components]
    found = find_rungs(offers, base, grade)
    notes.answer(components=found)
    return found


def _rehearsal(request: Request, notes: Notes) -> Rehearsal:
    """Find the reference; if the FMU cannot be read before its first step, without doing so."""
    starts = request.starts or Starts()
    rehearsal = Rehearsal(request.candidate, request.spec, starts)
    if rehearsal.possible or "reading the outputs" not in rehearsal.reason:
        return rehearsal
    blind = Rehearsal(request.candidate, replace(request.spec, blind_start=True), starts)
    if not blind.possible:
        notes.answer(unreadable=[v.name for v in _unreadable(request, request.spec.outputs)])
        return rehearsal
    notes.answer(blind_start=True)
    return blind


def _unreadable(request: Request, outputs: tuple[Variable, ...]) -> tuple[Variable, ...]:
    """Find the outputs that cannot be read after an initialization, by halves."""
    if not outputs or _can_read(request, outputs):
        return ()
    if len(outputs) == 1:
        return outputs
    middle = len(outputs) // 2
    halves = outputs[:middle], outputs[middle:]
    found = tuple(v for half in halves for v in _unreadable(request, half))
    return found[:_MOST_UNREADABLE]


def _can_read(request: Request, outputs: tuple[Variable, ...]) -> bool:
    spec = replace(request.spec, outputs=outputs, samplings=(), num_observed=0)
    starts = request.starts or Starts()
    pool = trial_pool(request.candidate.open(), spec, 1, logging.getLogger(__name__))
    try:
        _, statuses = pool.reset(starts.variables, starts.column(0))
        return bool(statuses[0] <= WARNING_CODE)
    finally:
        pool.close()


def _try_resuming(request: Request, notes: Notes) -> None:
    """Try a state in the middle of an episode: make one, or go on from that of another process."""
    notes.stage(Stage.HALFWAY)
    found = make_halfway(request) if request.resume is True else try_halfway(request)
    if isinstance(found, Halfway):
        notes.keep(found)
    else:
        notes.answer(resuming=found)


def _methods(request: Request) -> list[ResetMethod]:
    """The methods to try in this process; only the native pool can load libraries anew."""
    fmu = request.candidate.open()
    able = fmu.description.capabilities.can_get_and_set_fmu_state
    methods = [ResetMethod.RESTORE] if able else []
    methods += [ResetMethod.RESET, ResetMethod.INSTANCE]
    return [*methods, ResetMethod.LIBRARY] if _can_copy_libraries(fmu) else methods


def _can_copy_libraries(fmu: FMU) -> bool:
    return not fmu.in_wine


def _try_several(request: Request, notes: Notes, alone: Verdict) -> None:
    """Find out what several instances need.

    Args:
        request: What the parent wants to know.
        notes: Get the answer.
        alone: The verdict on a lone instance.
    """
    spec = replace(
        _without(request.spec, alone.noisy),
        reset_method=alone.reset_method,
        component_resets=alone.components,
        blind_start=alone.blind_start,
    )
    request = replace(request, spec=spec)
    notes.answer(instances=2)
    notes.answer(neighbours=_need_of_several(request, notes))


def _without(spec: PoolSpec, noisy: tuple[str, ...]) -> PoolSpec:
    """Leave out the outputs that tell nothing about other instances, unless all are such."""
    kept = [i for i, variable in enumerate(spec.outputs) if variable.name not in noisy]
    if not kept:
        return spec
    samplings = tuple(spec.samplings[i] for i in kept) if spec.samplings else ()
    return replace(spec, outputs=tuple(spec.outputs[i] for i in kept), samplings=samplings)


def _need_of_several(request: Request, notes: Notes) -> Neighbours:
    """Find the cheapest way to keep instances from disturbing each other."""
    copies = _can_copy_libraries(request.candidate.open())
    if request.alone or _disturbed(request, notes, private_libraries=False):
        copies = copies and not _disturbed(request, notes, private_libraries=True)
        return Neighbours.LIBRARIES if copies else Neighbours.PROCESSES
    steps = _watch_steps(request, notes)
    race = partial(_disturbed_in_threads, request, notes, steps.seconds)
    if steps.need is Neighbours.INDEPENDENT:
        if not race(Stage.THREADS):
            return Neighbours.INDEPENDENT
        return Neighbours.ONE_THREAD if race(Stage.TURNS) else Neighbours.ONE_INITIALIZATION
    copies = copies and steps.need is Neighbours.LIBRARIES
    if copies and not (
        _disturbed(request, notes, private_libraries=True) or race(Stage.THREADS_OF_COPIES)
    ):
        return Neighbours.LIBRARIES
    return Neighbours.ONE_THREAD


def _watch_steps(request: Request, notes: Notes) -> Steps:
    notes.stage(Stage.SHARED_DATA)
    if Stage.SHARED_DATA not in request.skip:
        with contextlib.suppress(FMULoadError):
            return watch_steps(
                request.candidate, _without_reloading(request.spec), request.starts or Starts()
            )
    return Steps(Neighbours.INDEPENDENT, math.inf)


def _disturbed_in_threads(
    request: Request, notes: Notes, step_seconds: float, stage: Stage
) -> bool:
    notes.stage(stage)
    if stage in request.skip:
        return True
    try:
        return disturb_in_threads(
            request.candidate,
            request.spec,
            request.starts,
            step_seconds=step_seconds,
            one_initialization=stage is Stage.TURNS,
            private_libraries=stage is Stage.THREADS_OF_COPIES,
            frugal=notes.found("frugal"),
        )
    except LicenceError:
        raise
    except FMUGymError:  # it fails without the caller's values
        return False


def _disturbed(request: Request, notes: Notes, *, private_libraries: bool) -> bool:
    stage = Stage.COPIES if private_libraries else Stage.SECOND
    notes.stage(stage)
    if stage in request.skip:
        return True
    reloads = private_libraries and request.spec.reloads
    spec = request.spec if reloads else _without_reloading(request.spec)
    try:
        return disturb_in_turn(
            request.candidate, spec, request.starts, private_libraries=private_libraries
        )
    except LicenceError:
        raise
    except FMUGymError:  # a lone instance fails too: it needs the caller's values
        return False


def _without_reloading(spec: PoolSpec) -> PoolSpec:
    """Instances that share a library, or this process, can only be made anew themselves."""
    reloads = spec.reloads or spec.reset_method is ResetMethod.PROCESS
    return spec.beginning_by(ResetMethod.INSTANCE) if reloads else spec


if __name__ == "__main__":
    main(Path(sys.argv[1]))
