"""Results of ``validate``: checks, costs, and recommended settings of a task, with reasons.

Among them is the length of episodes, compared with the response times of outputs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.cli.accuracy import TOLERANCE, OutputTrajectory, Replay, error_of, substeps_of
from fmugym.cli.class_skeleton import rounded_down
from fmugym.control.linearization import linearize
from fmugym.errors import FMUGymError, plain
from fmugym.fmi.fmu import FMU
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray
from fmugym.pool.pool_spec import FIXED_STEP_SOLVERS
from fmugym.pool.trial.verdict import known_verdict

__all__ = ["Advice", "CheckResult", "ValidationReport", "advise", "advise_episodes", "lines_of"]


@dataclass(frozen=True)
class CheckResult:
    """The result of a check.

    Attributes:
        verdict: ``"ok"``, ``"warning"`` or ``"error"``.
        check: Name of the check.
        text: Description of the result.
        cure: Advice; empty for none.
    """

    verdict: str
    check: str
    text: str
    cure: str = ""


@dataclass(frozen=True)
class Advice:
    """A line for a task file.

    Attributes:
        table: The table it stands in; ``""`` for the top of the file.
        key, value: Recommended setting.
        why: Measurement behind the advice.
    """

    table: str
    key: str
    value: Any
    why: str

    @property
    def line(self) -> str:
        """The line, in TOML."""
        return f"{self.key} = {json.dumps(self.value)}"


@dataclass(frozen=True)
class ValidationReport:
    """The results of all checks.

    Attributes:
        findings: The results in the order of the checks.
        costs: Seconds of real time by name: ``step``, ``reset`` and ``restore`` of one environment.
            None for a restore that the FMU does not allow.
        hooks: Calls of hooks in a vector environment: ``expressions``, ``arrays`` or
            ``one by one``.
        execution: Sentences on how the FMU runs, and why.
        reset_method: How episodes begin.
        recommended: Settings that suit the task, by name.
        advices: Lines for the task file, of these settings.
    """

    findings: tuple[CheckResult, ...]
    costs: Mapping[str, float | None]
    hooks: str
    execution: tuple[str, ...]
    reset_method: str
    recommended: Mapping[str, Any]
    advices: tuple[Advice, ...] = ()

    @property
    def verdict(self) -> str:
        """The worst verdict."""
        found = {finding.verdict for finding in self.findings}
        return next(one for one in ("error", "warning", "ok") if one in found or one == "ok")

    def as_dict(self) -> dict[str, Any]:
        """The report in types that JSON has."""
        facts = {"verdict": self.verdict, **asdict(self)}
        lines = zip(facts.pop("advices"), self.advices, strict=True)
        return facts | {"lines": [one | {"line": advice.line} for one, advice in lines]}

    def as_text(self) -> str:
        """The report in lines of printable ASCII."""
        lines = []
        for one in self.findings:
            lines.append(f"{one.verdict:8} {one.check}: {plain(one.text)}")
            if one.cure:
                lines.append(f"{'':8} cure: {plain(one.cure)}")
        step, reset, restore = (_duration(self.costs[n]) for n in ("step", "reset", "restore"))
        lines.append(f"a step takes {step}, a reset {reset}, to restore a state {restore}")
        lines += map(plain, self.execution)
        lines.append(f"hooks in a vector environment: {self.hooks}")
        if "envs" in self.recommended:
            lines.append(f"recommended for a training: --envs {self.recommended['envs']}")
        if self.advices:
            lines += ["recommended for the task file:", *lines_of(self.advices)]
        return "\n".join(lines)


def lines_of(advices: Iterable[Advice]) -> list[str]:
    """The lines of a task file, with the reasons as comments: printable ASCII."""
    ordered = sorted(advices, key=lambda one: one.table)
    width = max((len(one.line) for one in ordered), default=0)
    lines = []
    for table, group in groupby(ordered, key=lambda one: one.table):
        lines += [f"[{table}]"] if table else []
        lines += [f"{one.line.ljust(width)}  # {plain(one.why)}" for one in group]
    return lines


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "is not possible"
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} us"


_ComplexArray = npt.NDArray[np.complex128]

_STEPS_OF_AN_OSCILLATION: Final = 10
_STEPS_OF_A_TIME_CONSTANT: Final = 5
"""Time steps in the time constant of the fastest unstable process; if there is none, and none that
oscillates, in that of the slowest one."""

_MUCH: Final = 1.5
"""A time step that is too long by less than this factor is left alone."""

_FASTER: Final = 2.0
_NOTICED: Final = 50e-6
"""Settings that are only faster are recommended from this factor, and this real time in s, on."""

_LOST: Final = 100.0
"""Outputs that are off by so many times their variation are worth nothing."""

_SOLVERS: Final = ("dormand_prince", "rosenbrock")
_TOLERANCES: Final = (1e-3, 1e-4, 1e-5, 1e-6)
_FINEST: Final = 1e-9
_EXACT: Final = 0.1 * TOLERANCE
"""The error that is recommended of solvers, whose tolerances cost little."""


def advise(replay: Replay) -> Iterator[Advice | CheckResult]:
    """Find settings of the time step, of substeps and of the solver.

    Args:
        replay: An episode; its environment should be closed, since some FMUs allow one instance
            only.
    """
    if not len(replay.inputs):
        return
    time_step = _time_step(replay)
    if time_step is not None:
        yield time_step
    if replay.fmu.description.interface == "model_exchange":
        yield from _of_solvers(replay)
    else:
        yield from _of_substeps(replay)


def _of_substeps(replay: Replay) -> Iterator[Advice | CheckResult]:
    found, own = substeps_of(replay), replay.spec.substeps
    if found is None:
        return
    if found.needed is None:
        yield CheckResult(
            "warning",
            "accuracy",
            f"with {found.finest} substeps the outputs still differ by {found.least:.2g} of their "
            "variation from those with half as many",
            "the FMU may be chaotic, or switch often: compare episodes with shorter time steps",
        )
    elif found.error > TOLERANCE:
        cost = _cost(found.seconds[found.needed], found.seconds.get(own))
        yield Advice("", "substeps", found.needed, f"with {own}, {_off(found.error)}{cost}")
    elif _is_slow(found.seconds[own], found.seconds[found.needed]) and own > found.needed:
        factor = found.seconds[own] / found.seconds[found.needed]
        yield Advice(
            "", "substeps", found.needed, f"as exact as {own}, and {factor:.2g} times as fast"
        )


def _is_slow(seconds: float, possible: float) -> bool:
    return seconds > _FASTER * possible and seconds > possible + _NOTICED


def _share(error: float) -> str:
    return f"{100 * error:.2g} %" if error < 1 else f"{error:.2g} times"


def _off(error: float) -> str:
    """An error in words."""
    if error > _LOST:
        return "outputs fail or grow without bounds"
    return f"outputs are off by {_share(error)} of their variation"


def _cost(seconds: float, before: float | None) -> str:
    """Describe the cost of a change; "" if it is not known."""
    return "" if before is None else f"; a step takes {seconds / before:.2g} times as long"


def _of_solvers(replay: Replay) -> Iterator[Advice | CheckResult]:
    """Compare the solvers of model exchange, each with some tolerances."""
    own = replay.run()
    finest = [replay.run(solver=name, tolerance=_FINEST, max_step=None) for name in _SOLVERS]
    known = [one for one in finest if one is not None and one.is_whole]
    least = error_of(known[0], known[1]) if len(known) == len(_SOLVERS) else 0.0
    if least > TOLERANCE:
        yield CheckResult(
            "warning",
            "accuracy",
            f"the most exact solvers differ by {_share(least)} of the outputs' variation",
            "the FMU may be chaotic, or switch often: give max_step under [config]",
        )
        return
    if not known:
        return
    reference = known[-1]
    tried = dict(_each_solver(replay, reference))
    if not tried:
        return
    best = min(tried, key=lambda one: tried[one].seconds)
    error = error_of(own, reference)
    is_slow = own is not None and _is_slow(own.seconds, tried[best].seconds)
    if error > TOLERANCE or is_slow:
        yield from _solver(replay, best, _why(own, error, tried[best]))


def _each_solver(
    replay: Replay, reference: OutputTrajectory
) -> Iterator[tuple[tuple[str, float], OutputTrajectory]]:
    """Exact settings of the least cost, by solver and tolerance."""
    for name in _SOLVERS:
        for tolerance in _TOLERANCES:
            course = replay.run(solver=name, tolerance=tolerance, max_step=None)
            if course is not None and course.is_whole and error_of(course, reference) <= _EXACT:
                yield (name, tolerance), course
                break


def _why(own: OutputTrajectory | None, error: float, best: OutputTrajectory) -> str:
    if own is None or math.isinf(error):
        return "the solver of this task fails"
    cost = _cost(best.seconds, own.seconds)
    return f"{_off(error)}{cost}" if error > TOLERANCE else cost.removeprefix("; ")


def _solver(replay: Replay, best: tuple[str, float], why: str) -> Iterator[Advice]:
    name, tolerance = best
    if name != replay.spec.solver:
        yield Advice("config", "solver", name, why)
    if tolerance != replay.spec.tolerance or replay.spec.solver in FIXED_STEP_SOLVERS:
        yield Advice("config", "tolerance", tolerance, f"the error is below {_share(_EXACT)}")


def _time_step(replay: Replay) -> Advice | None:
    """Recommend a time step from the eigenvalues at the start of the FMU."""
    eigenvalues = _eigenvalues(replay)
    if eigenvalues is None or not len(eigenvalues):
        return None
    longest, what = min(_longest(eigenvalues))
    if replay.spec.time_step <= _MUCH * longest:
        return None
    step = rounded_down(longest)
    return Advice("", "time_step", step, f"{what}, where the FMU starts")


def _eigenvalues(replay: Replay) -> _ComplexArray | None:
    """Eigenvalues of the linear model at the start; None if the FMU gives none."""
    names = [variable.name for variable in replay.variables]
    starts = dict(zip(names, replay.starts[:, 0].tolist(), strict=True))
    verdict = known_verdict(replay.fmu)
    if verdict is not None and verdict.isolate:  # it is linearized in this process
        return None
    own = FMU.of(replay.fmu)
    try:
        return np.linalg.eigvals(linearize(own, at=starts).A).astype(np.complex128)
    except (FMUGymError, np.linalg.LinAlgError):
        return None
    finally:
        own.close()


def _longest(eigenvalues: _ComplexArray) -> Iterator[tuple[float, str]]:
    """Limits of the time step, and the reason for each."""
    rates, waves = np.abs(eigenvalues.real), np.abs(eigenvalues.imag)
    swings = waves[waves > rates]
    if len(swings):
        period = 2 * math.pi / float(swings.max())
        yield period / _STEPS_OF_AN_OSCILLATION, f"it oscillates with a period of {period:.3g} s"
    grows = eigenvalues.real[eigenvalues.real > 1e-9]
    if len(grows):
        constant = 1 / float(grows.max())
        text = f"it is unstable with a time constant of {constant:.3g} s"
        yield constant / _STEPS_OF_A_TIME_CONSTANT, text
    decays = rates[(eigenvalues.real < -1e-9) & (waves <= rates)]
    if len(decays) and not len(swings) and not len(grows):
        constant = 1 / float(decays.min())
        text = f"its slowest time constant is {constant:.3g} s"
        yield constant / _STEPS_OF_A_TIME_CONSTANT, text
    yield math.inf, ""


_STEPS: Final = 200
_STEPS_OF_AN_EPISODE: Final = 25
"""Number of steps of an episode in the first response; later ones are longer."""

_FACTORS: Final = tuple(8**power for power in range(7))
_MOST_SUBSTEPS: Final = 64
"""The FMU's own steps stay as long as they are, up to this factor."""

_SLOW: Final = 2e-3
"""After a response with longer steps in seconds of real time, there are no others."""

_RISEN: Final = 1 - math.exp(-1)
_SETTLED: Final = 0.02
"""The part of a response by which it changes in its second half, at most, if it has settled."""

_TIME_CONSTANTS: Final = 3
"""An episode should take so many of them."""

_MANY: Final = 2000
"""Steps of an episode for which longer ones are recommended."""

_LONG: Final = 800
"""Least number of steps of those, as actions may follow faster responses."""


def advise_episodes(replay: Replay, steps: int) -> Iterator[Advice]:
    """Recommend longer episodes for slow outputs.

    Args:
        replay: An episode.
        steps: How many steps one takes.
    """
    constants = _time_constants(replay, steps)
    seconds, name = max(((constants[one], one.name) for one in constants), default=(0.0, ""))
    time_step = replay.spec.time_step
    if seconds <= steps * time_step:
        return
    why = f"{name} follows with a time constant of {seconds:.3g} s: an episode ends before"
    needed = _TIME_CONSTANTS * seconds
    if needed > _MANY * time_step:
        time_step = rounded_down(needed / _LONG)
        yield Advice("", "time_step", time_step, why)
    value = float(f"{math.ceil(needed / time_step) * time_step:.12g}")
    yield Advice("", "episode_length", value, why)


def _time_constants(replay: Replay, steps: int) -> dict[Variable, float]:
    """Time constants of real outputs under constant inputs, in s; 0 without a change.

    The time at which one comes near the value where it rests counts: what swings has it soon.
    Outputs that do not settle, such as positions and levels, have none.
    """
    outputs = [one for one in replay.spec.outputs if one.kind == "real"]
    held = replace(replay, inputs=np.repeat(replay.inputs[:1], _STEPS, axis=0))
    found: dict[Variable, float] = {}
    courses: list[tuple[float, FloatArray]] = []  # the changes, and the step that they have
    for factor in (max(1, round(steps / _STEPS_OF_AN_EPISODE)) * one for one in _FACTORS):
        time_step = factor * replay.spec.time_step
        substeps = min(factor, _MOST_SUBSTEPS) * replay.spec.substeps
        course = held.run(time_step=time_step, substeps=substeps, stop_time=None)
        if course is None or not course.is_whole or not np.isfinite(course.outputs).all():
            break
        courses.append((time_step, np.abs(course.outputs - course.outputs[0]).T))
        for index, output in enumerate(outputs):
            away = courses[-1][1][index]
            if np.ptp(away[_STEPS // 2 :]) <= _SETTLED * away[-1]:
                risen = ((step, rows[index] >= _RISEN * away[-1]) for step, rows in courses)
                first = next(step * int(np.argmax(has)) for step, has in risen if has.any())
                found.setdefault(output, first)
        if len(found) == len(outputs) or course.seconds > _SLOW:
            break
    return found
