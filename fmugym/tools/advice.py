"""Recommended settings of a task, with reasons."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.fmu import FMU
from fmugym.errors import FMUGymError
from fmugym.linearization import linearize
from fmugym.pool.spec import FIXED_STEP_SOLVERS
from fmugym.tools.accuracy import TOLERANCE, OutputTrajectory, Replay, error_of, substeps_of
from fmugym.tools.findings import Advice, CheckResult
from fmugym.tools.skeleton import rounded_down
from fmugym.trial.known import known_verdict

__all__ = ["advise"]

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
