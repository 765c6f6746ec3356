"""The trial of an unknown FMU, in worker processes that it may crash.

An FMU is native code: a fault in it ends the process that loads it, and what it promises need not
hold. So worker processes try it before this process touches it, step by step:

1. Fresh instances: each of two episodes is played by a fresh instance in a fresh process. All that
   follows is compared with these, bit by bit.
2. Freeing: an instance is freed before its initialization, and another one before its first step.
3. Resets: one instance plays episode after episode, with each method from the fastest one on.
4. Other instances: up to four play beside each other, stepped in turn.
5. Shared data: a lone instance steps, and the data of its libraries are looked at.
6. Threads: two instances are initialized and stepped at the same moment.
7. Saved states, when they are first asked for: an episode goes on from one.

Steps 4 to 6 are for several instances. The longest episode is as long as those of the task, or as
there is time for. Each step has a process and a copy of the FMU's files of its own, and its
finding is a sentence of the verdict. Success is cached by the file's content. Failures are not
cached: a missing licence may return.

A process protects from accidents but not from malice: a worker has all the rights of its user.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from typing import Final, TypeVar

from fmugym.errors import FMULoadError, LicenceError, SimulationError
from fmugym.fmi.fmu import FMU
from fmugym.pool.instance_limit import claim_instances
from fmugym.pool.licences import speaks_of_licence
from fmugym.pool.pool_spec import REUSING, PoolSpec, ResetMethod
from fmugym.pool.processes.supervisor import WorkerError
from fmugym.pool.states import SaveMethod
from fmugym.pool.trial import trial_steps
from fmugym.pool.trial.component_resets import find_component_resets, offers_of
from fmugym.pool.trial.reference import AMPLITUDES, Reference
from fmugym.pool.trial.trial_episodes import Inputs, Run, Starts, Stretch, play
from fmugym.pool.trial.trial_steps import Halfway, PairResult
from fmugym.pool.trial.trial_workers import CLOSING, STEP, DeathError, Workers
from fmugym.pool.trial.verdict import (
    MOST_INSTANCES,
    Finding,
    Grade,
    Neighbours,
    Verdict,
    content_key,
    known_resuming,
    note_resuming,
    recall,
    remember,
    verdict_key,
    with_harm,
)

__all__ = ["compare", "examine", "saving_method"]

logger = logging.getLogger(__name__)

R = TypeVar("R")

_MOST_UNREADABLE: Final = 5
"""The most outputs that a verdict names because they cannot be read."""

_UNSTEPPED: Final = {
    "freeing an instance before its initialization": False,
    "freeing an instance before its first step": True,
}
"""The parts of the trial that free an instance early, and whether it is initialized."""

_METHODS: Final = {
    ResetMethod.RESTORE: "state restores",
    ResetMethod.RESET: "resets",
    ResetMethod.INSTANCE: "new instances",
    ResetMethod.LIBRARY: "libraries loaded anew",
}
"""The reset methods, for messages."""


def examine(
    fmu: FMU,
    spec: PoolSpec,
    starts: Starts | None = None,
    *,
    num_instances: int = 1,
    length: int | None = None,
    must_survive: bool = True,
) -> Verdict:
    """Try an FMU in worker processes, and find the right treatment.

    Args:
        fmu: The FMU; this does not extract it.
        spec: What to do at each reset and step.
        starts: The start values of two episodes; by default those of the FMU.
        num_instances: How many instances are wanted; a trial makes four of them at most.
        length: The most steps of an episode; None if nothing limits them.
        must_survive: Whether it is an error if a lone instance ends the process. If not, the
            verdict asks for isolation.

    Returns:
        The verdict, from the cache if no more was asked before.

    Raises:
        FMULoadError: If a process does not survive a single instance, and ``must_survive``. The
            text has the reason and the last lines.
        LicenceError: If an instance got no licence.
    """
    key = verdict_key(fmu, spec, starts)
    known = Verdict.from_text(recall(key))
    if known is not None and known.covers(length, num_instances):
        return with_harm(known, fmu)
    of_one = known if known is not None and known.covers(length, 1) else Verdict()
    trial = _Trial(fmu, spec, starts or Starts(), length)
    count = min(num_instances, MOST_INSTANCES)
    with closing(claim_instances(fmu, spec, count, "a trial")), _naming(trial.workers):
        verdict = trial.of_one(of_one, must_survive=must_survive)
        if count > 1 and verdict.complete:
            verdict = trial.of_several(verdict, count)
    verdict = trial.concluded(verdict)
    _log(fmu, verdict)
    verdict = with_harm(verdict, fmu)
    if verdict.complete:
        remember(content_key(fmu), verdict.to_text())
        remember(key, verdict.to_text())
    return verdict


def compare(
    fmu: FMU,
    spec: PoolSpec,
    starts: Starts | None = None,
    *,
    num_instances: int = 2,
    length: int | None = None,
) -> Verdict:
    """Find out whether instances disturb each other in turn, and no more.

    Args:
        fmu: An FMU that is exempt from trials.
        spec: What to do at each reset and step.
        starts: The start values of two episodes; by default those of the FMU.
        num_instances: As for ``examine``.
        length: As for ``examine``.

    Raises:
        LicenceError: If an instance got no licence.
    """
    key = f"{verdict_key(fmu, spec, starts)}-in-turn"
    known = Verdict.from_text(recall(key))
    if known is not None and known.covers(length, num_instances):
        return known
    trial = _Trial(fmu, spec, starts or Starts(), length)
    count = min(num_instances, MOST_INSTANCES)
    with closing(claim_instances(fmu, spec, count, "a trial")), _naming(trial.workers):
        found = trial.in_turn(count)
    remember(key, found.to_text())
    return found


def saving_method(
    fmu: FMU, spec: PoolSpec, starts: Starts | None, length: int | None
) -> SaveMethod:
    """Find out whether restored states lead to the same outputs, bit by bit.

    Args:
        fmu: The FMU.
        spec: What to do at each reset and step.
        starts: The start values of two episodes.
        length: As for ``examine``.

    Returns:
        ``STATE`` if they do so also in another process; ``COPY`` if only in the same one.
    """
    known = known_resuming(fmu, spec, starts, length)
    if known is not None:
        return known
    trial = _Trial(fmu, spec, starts or Starts(), length)
    try:
        with closing(claim_instances(fmu, spec, 1, "a trial of saved states")):
            method, found = trial.of_saved_states()
    except LicenceError as error:
        logger.warning("snapshots keep the inputs of the episode for now: %s", error)
        return SaveMethod.REPLAY
    if found.grade is not Grade.FAILS:  # a failure may have passing causes
        note_resuming(fmu, spec, starts, length, method)
    if not found.is_kept:
        logger.warning(
            "%s: %s%s; snapshots keep the inputs of the episode, and restoring one%s plays the "
            "episode again",
            fmu.path.name,
            found.text,
            " in another process" if method is SaveMethod.COPY else "",
            " in another environment" if method is SaveMethod.COPY else "",
        )
    return method


class _Trial:
    """The steps of a trial.

    Args:
        fmu: The FMU.
        spec: What to do at each reset and step.
        starts: The start values of two episodes.
        length: The most steps of an episode; None if nothing limits them.

    Attributes:
        workers: The processes in which the FMU is tried.
        told: The findings so far, a sentence each.
    """

    def __init__(self, fmu: FMU, spec: PoolSpec, starts: Starts, length: int | None) -> None:
        self.workers, self.told = Workers(fmu), list[str]()
        self._fmu, self._spec, self._starts, self._length = fmu, spec, starts, length
        self._reference = Reference(self.workers, spec, starts, length)

    def of_one(self, known: Verdict, *, must_survive: bool) -> Verdict:
        """Find unknown facts with a lone instance."""
        workers, name = self.workers, self._fmu.path.name
        workers.checks_heap &= not known.isolate
        try:
            self._play_with_fresh_instances()
            if known.complete:
                return known
            self._free()
            return self._resets() if self._reference.possible else self._nothing_to_play()
        except DeathError as death:
            if not must_survive:
                workers.note(death, alone=True)
                return Verdict(neighbours=Neighbours.PROCESSES)
            text = (
                f"{name} cannot be used: in {death.call} {death}. That was a trial in a process of "
                "its own; probe_timeout=None turns it off"
            )
            raise LicenceError(text) if speaks_of_licence(text) else FMULoadError(text) from None
        except WorkerError as error:
            logger.warning("%s could not be tried before: %s", name, error)
            return Verdict()
        except LicenceError:
            raise
        except FMULoadError:  # the process is alive, and the caller will get the error too
            return Verdict()

    # 1. Fresh instances

    def _play_with_fresh_instances(self) -> None:
        """Let them play, with checked heaps at first; note whether that does harm.

        Raises:
            DeathError: If a process does not even survive one step.
        """
        workers = self.workers
        try:
            self._reference.find()
        except DeathError as death:
            only_checked = workers.checks_heap and death.shows_memory_error
            if death.call not in (STEP, CLOSING) and not only_checked:
                raise
            workers.note(death, alone=True)
            if only_checked:  # it might live on without the checks
                workers.checks_heap = False
                self._play_with_fresh_instances()
            elif death.call == CLOSING:
                self._reference.step_once()

    def _nothing_to_play(self) -> Verdict:
        """The verdict on an FMU that returns errors."""
        unreadable = tuple(self._unreadable())
        return Verdict(
            complete=True,
            blind_start=self._reference.spec.blind_start,
            unreadable=unreadable,
            findings=("a fresh instance returns errors, so that no episodes were compared",),
        )

    def _unreadable(self) -> Iterator[str]:
        """Find the first outputs that cannot be read after an initialization."""
        reference, left = self._reference, _MOST_UNREADABLE
        if not reference.fails_in_reading:
            return
        spec, begin = replace(reference.spec, outputs=()), [Stretch((0,), 0)]
        with self.workers.pool("the search for outputs that cannot be read", spec) as pool:
            play(pool, reference.starts, reference.inputs, begin)
            for variable in reference.spec.outputs:
                try:
                    pool.read((variable,))
                except SimulationError:
                    yield variable.name
                    left -= 1
                    if not left:
                        return
                    play(pool, reference.starts, reference.inputs, begin)

    # 2. Freeing

    def _free(self) -> None:
        """Free an instance before its initialization, and one before its first step."""
        for stage, begins in _UNSTEPPED.items():
            try:
                with self._reference.open(stage) as pool:
                    if begins:
                        self._reference.play(pool, 0, 0)
            except DeathError as death:
                self.workers.note(death, alone=True)

    # 3. Resets

    def _resets(self) -> Verdict:
        """Grade the reset methods, fastest first, until one is exact to the last bit."""
        reference = self._reference
        able = self._fmu.description.capabilities.can_get_and_set_fmu_state
        methods = [ResetMethod.RESTORE] if able else []
        methods += [ResetMethod.RESET, ResetMethod.INSTANCE]
        methods += [ResetMethod.LIBRARY] if self.workers.can_copy_libraries else []
        grades: dict[ResetMethod, Grade] = {}
        for method in methods:
            found = self._begins_anew(method)
            grades[method] = found.grade
            sentence = f"episodes that begin by {method} {{}} the outputs of a fresh instance"
            self._tell(sentence, found)
            if found.is_kept:
                break
        verdict = Verdict(
            complete=True,
            resets=grades,
            noisy=reference.noisy,
            blind_start=reference.spec.blind_start,
        )
        return replace(verdict, components=self._components(verdict))

    def _begins_anew(
        self, method: ResetMethod, components: tuple[ResetMethod, ...] = ()
    ) -> Finding:
        """Play several episodes with one instance, and compare each with a fresh one.

        Args:
            method: How the episodes begin.
            components: How each component of a system begins them; empty for ``method``.
        """
        reference, stage = self._reference, f"the comparison of {_METHODS[method]}"
        if components:
            stage = f"the comparison of resets by component ({', '.join(components)})"

        def grade() -> Finding:
            with reference.open(stage, method, components) as pool:
                runs, restored = trial_steps.play_again_and_again(pool, reference)
            gives_up = bool(self._fmu.description.components) and not restored
            if gives_up and method is ResetMethod.RESTORE:
                return Finding(Grade.WRONG, "a restored state has other outputs")
            return reference.worst(runs)

        return self.workers.attempt(grade, failed=partial(Finding, Grade.FAILS))

    def _components(self, verdict: Verdict) -> tuple[ResetMethod, ...]:
        """Find a method for each component of a system that does not begin anew by restores."""
        base, parts = verdict.reset_method, self._fmu.description.components
        tried = verdict.resets.get(base) is Grade.BITWISE and base is not ResetMethod.RESTORE
        if not tried or not parts:
            return ()
        offers = [offers_of(part, reloads=self.workers.can_copy_libraries) for part in parts]
        return find_component_resets(
            offers, base, lambda found: self._begins_anew(base, found).is_kept
        )

    # 4. to 6. Other instances, shared data, threads

    def of_several(self, verdict: Verdict, count: int) -> Verdict:
        """Find the cheapest way to keep instances from disturbing each other.

        Args:
            verdict: That on a lone instance.
            count: How many instances to try.

        Raises:
            LicenceError: If an instance gets no licence.
        """
        return replace(verdict, neighbours=self._neighbours(verdict, count))

    def _neighbours(self, verdict: Verdict, count: int) -> Neighbours:
        if verdict.reset_method is ResetMethod.PROCESS:
            return Neighbours.PROCESSES
        if not self._reference.possible:
            return Neighbours.INDEPENDENT
        beside = partial(self._agree_beside, verdict, count)
        threads = partial(self._agree_in_threads, verdict)
        has_copies, otherwise = self.workers.can_copy_libraries, Neighbours.PROCESSES
        if verdict.reset_method is not ResetMethod.LIBRARY and beside():
            otherwise = Neighbours.ONE_THREAD
            writes, seconds = self.workers.attempt(
                partial(self._watch, verdict), failed=lambda _: (False, math.inf)
            )
            threads = partial(threads, seconds)
            if not writes and threads():
                return Neighbours.INDEPENDENT
            if not writes and threads(one_initialization=True):
                return Neighbours.ONE_INITIALIZATION
            if writes and has_copies:
                shared = self.workers.attempt(self._copies_share_data, failed=lambda _: True)
                has_copies = not shared
        has_copies = has_copies and beside(private_libraries=True)
        if has_copies and threads(private_libraries=True):
            return Neighbours.LIBRARIES
        return otherwise

    def _agree_beside(
        self, verdict: Verdict, count: int, *, private_libraries: bool = False
    ) -> bool:
        """Whether instances agree in turn, also while others are freed, as after a fault.

        Args:
            verdict: That on a lone instance.
            count: How many instances there are.
            private_libraries: Whether each instance has a copy of the library.
        """
        agree = partial(self._agree_in_turn, count=count, private_libraries=private_libraries)
        keeps = verdict.reset_method in REUSING
        return agree(verdict.reset_method, verdict.components) and (
            not keeps or agree(ResetMethod.INSTANCE)
        )

    def in_turn(self, count: int) -> Verdict:
        """Find out only whether instances disturb each other in turn."""
        beside = partial(self._agree_in_turn, ResetMethod.INSTANCE, count=count)

        def neighbours() -> Neighbours:
            self._reference.find()
            if not self._reference.possible or beside():
                return Neighbours.INDEPENDENT
            copies = self.workers.can_copy_libraries and beside(private_libraries=True)
            return Neighbours.LIBRARIES if copies else Neighbours.PROCESSES

        found = self.workers.attempt(neighbours, failed=lambda _: Neighbours.INDEPENDENT)
        return self.concluded(Verdict(neighbours=found))

    def _agree_in_turn(
        self,
        method: ResetMethod,
        components: tuple[ResetMethod, ...] = (),
        *,
        count: int,
        private_libraries: bool = False,
    ) -> bool:
        """Whether instances that are stepped in turn give what each gives alone.

        Args:
            method: How episodes begin.
            components: How each component of a system begins them.
            count: How many instances there are.
            private_libraries: Whether each instance has a copy of the library.
        """
        reference = self._reference
        those = "copies of the library" if private_libraries else "instances"
        open_pool = partial(
            reference.open,
            f"the comparison of {count} {those} in turn",
            method,
            components,
            private_libraries=private_libraries,
        )

        def together() -> list[list[Run]]:
            with open_pool(count) as pool:
                return trial_steps.play_beside(pool, reference)

        def alone(index: int) -> list[Run]:
            with open_pool() as pool:
                return trial_steps.play_alone(pool, reference, index, count)

        def played(attempt: Callable[[], list[R]]) -> list[R]:
            return self.workers.attempt(attempt, failed=lambda _: [])

        found = Finding(Grade.BITWISE, "")
        beside = played(together)
        for index, runs in enumerate(beside or [[]]):
            if runs and all(map(reference.is_as_fresh, runs)):
                continue
            found = reference.compare(runs, played(partial(alone, index)))
            if not found.is_kept:
                break
        how = f"stepped in turn with {_METHODS[method]},"
        self._tell(f"{count} {those}, {how} {{}} what each gives alone", found)
        return found.is_kept

    def _watch(self, verdict: Verdict) -> tuple[bool, float]:
        """Whether steps write to data of a library, and how many seconds a step takes."""
        stage = "the search for data that steps share"
        given = verdict.steady(self._reference.spec)
        spec = trial_steps.spec_to_watch(given, self._reference.step_seconds)
        try:
            with self.workers.pool(stage, spec) as pool:
                (one,) = trial_steps.watch_data(pool, self._reference.starts)
        except DeathError as death:
            self.workers.note(death, alone=True)
            return False, math.inf
        if one.written:
            self.told.append("a step writes to data that all instances of a library share")
        return bool(one.written), one.seconds * given.substeps / spec.substeps

    def _copies_share_data(self) -> bool:
        """Whether steps of copies of the library write to the same data.

        They may belong to a library that both need, or to a class of C++.
        """
        reference, stage = self._reference, "the search for data that copies of the library share"
        with reference.open(stage, num_instances=2, private_libraries=True) as pool:
            one, other = trial_steps.watch_data(pool, reference.starts)
        shared = bool(one.written & other.written)
        if shared:
            self.told.append("copies of the library share these data, too")
        return shared

    def _agree_in_threads(
        self,
        verdict: Verdict,
        seconds: float = math.inf,
        *,
        one_initialization: bool = False,
        private_libraries: bool = False,
    ) -> bool:
        """Whether two instances in two threads give the same as in one.

        Args:
            verdict: That on a lone instance.
            seconds: How many a step takes, if known.
            one_initialization: Whether instances are made, initialized and freed in turn, so that
                only steps run at the same time as other calls.
            private_libraries: Whether each instance has a copy of the library.
        """
        if self._fmu.in_wine:
            return True  # one thread steps all instances
        reference = self._reference
        given = replace(verdict.steady(reference.spec), one_initialization=one_initialization)
        seconds = min(seconds, reference.step_seconds)
        reloads = verdict.reset_method is ResetMethod.LIBRARY
        first = ResetMethod.LIBRARY if reloads else ResetMethod.INSTANCE
        for method in dict.fromkeys((first, verdict.reset_method)):
            spec = trial_steps.spec_for_threads(given, seconds, method)
            found = self._compared_in_threads(spec, private_libraries or reloads)
            if found is not None:
                break
        else:  # not even one thread can play so
            return True
        those = "copies of the library" if private_libraries else "instances"
        how = ", initialized in turn," if one_initialization else ""
        self._tell(f"two {those} in two threads{how} {{}} the same as in one", found)
        return found.is_kept

    def _compared_in_threads(self, spec: PoolSpec, private_libraries: bool) -> Finding | None:
        """Compare two threads with one; returns None if one cannot play several episodes."""
        reference, stage = self._reference, "the comparison of instances in two threads"
        open_pool = partial(self.workers.pool, stage, spec, 2, private_libraries=private_libraries)

        def alone() -> list[PairResult]:
            with open_pool() as pool:
                return trial_steps.play_rounds(pool, reference)

        def compare() -> Finding:
            with open_pool(threads=2) as pool:
                same = trial_steps.is_repeated(pool, reference, expected)
            if same or not all(
                map(PairResult.allows, expected, alone())
            ):  # or they never repeat it
                return Finding(Grade.BITWISE, "")
            return Finding(Grade.WRONG, "some outputs differ")

        expected = self.workers.attempt(alone, failed=lambda _: [])
        if not expected or not all(run.played for one in expected for run in one.runs):
            return None
        return self.workers.attempt(compare, failed=partial(Finding, Grade.FAILS))

    # 7. Saved states

    def of_saved_states(self) -> tuple[SaveMethod, Finding]:
        """Method of saving states, and the finding of the last attempt.

        One process plays an episode, saves its state, plays on, restores the state and plays on
        again. A second process restores the same bytes in an instance that has never been
        initialized. They may hold addresses of the first process, so the second one may crash.
        """
        stage = "the comparison of saved states"
        spec = self._spec.beginning_by(ResetMethod.RESTORE)
        open_pool = partial(self.workers.pool, stage, spec)
        made: list[Halfway] = []

        def here() -> Finding:
            for amplitude in AMPLITUDES:
                with open_pool() as pool:
                    halfway = Halfway.of(pool, self._starts, Inputs(spec, amplitude), self._length)
                    if halfway is not None:
                        made.append(halfway)
                        return halfway.goes_on(pool)
            return Finding(Grade.FAILS, "no episode lasts long enough to go on from its middle")

        def elsewhere() -> Finding:
            with open_pool() as pool:  # its instance was never initialized
                return made[0].goes_on(pool)

        grade = partial(self.workers.attempt, failed=_cannot_be_restored)
        found = grade(here)
        if not found.is_kept:
            return SaveMethod.REPLAY, found
        if made[0].state.method is not SaveMethod.STATE:  # copies stay in their process
            return SaveMethod.COPY, found
        found = grade(elsewhere)
        return SaveMethod.STATE if found.is_kept else SaveMethod.COPY, found

    # What is told

    def _tell(self, sentence: str, found: Finding) -> None:
        """Keep a sentence whose place for a verb is filled by the finding."""
        verb = "give" if found.is_kept else "do not give"
        self.told.append(sentence.format(verb) + (f": {found.text}" if found.text else ""))

    def concluded(self, verdict: Verdict) -> Verdict:
        """The verdict with all that the trial has used, and a sentence for each finding."""
        workers, tried = self.workers, self._reference.tried_length
        return replace(
            verdict,
            length=tried,
            unlimited=tried is None or self._length is None,
            harm=verdict.harm or workers.harm,
            instances=max(verdict.instances, workers.instances),
            initializations=verdict.initializations + workers.initializations,
        ).finding(*self.told, workers.harm)


def _cannot_be_restored(reason: str) -> Finding:
    return Finding(Grade.FAILS, f"a saved state cannot be restored: {reason}")


def _log(fmu: FMU, verdict: Verdict) -> None:
    name = fmu.path.name
    for finding in verdict.findings:
        logger.info("%s: %s", name, finding)
    logger.info(
        "%s was tried with %d instance(s) at once at most, and %d initialization(s) in all",
        *(name, verdict.instances, verdict.initializations),
    )


@contextmanager
def _naming(workers: Workers) -> Iterator[None]:
    """Name the FMU and the licences of the trial if an instance gets none."""
    try:
        yield
    except LicenceError as error:
        raise LicenceError(
            f"{workers.fmu.path.name} got no licence in its trial, which used "
            f"{workers.instances} instance(s) at once: {error}"
        ) from None
