"""Fit of a task's FMU to logs of the plant, and the parameter rows that a task draws from it.

::

    log = fmugym.records.plant_log.PlantLog.read("plant.csv")
    fit = fmugym.records.log_fit.fit_logs(partial(fmugym.load, "house.toml"), [log], {"UA": (100,
    1000)}) fmugym.records.log_fit.write_rows(fit, "house-fit.npz")

The fit is that of ``fmugym.control.identification``, with the task's inputs, samplings, units and
names. A task file whose key ``fitted`` names the rows draws one of them in each episode.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np

from fmugym.control.identification import FitResult, Trajectory
from fmugym.control.identification.least_squares import start_between
from fmugym.control.identification.output_error import fit_of
from fmugym.control.identification.simulator import FitSettings, median_interval, silent
from fmugym.environment.env import inner_env
from fmugym.environment.fmu_variables import start_variable
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.fmi.units import conversion_of
from fmugym.fmi.variable import Variable, values_by_name
from fmugym.pool.pool_spec import is_start_time
from fmugym.records.plant_log import LogColumns, PlantLog, declared_as

__all__ = ["fit_logs", "write_rows"]

_AROUND: Final = 3.0
"""Without a range, a parameter lies between its value divided and multiplied by this."""

_WASH_IN: Final = 0.1
"""Of the shortest log, the part that is not counted if nobody says another."""

_ROWS: Final = 1000
"""Number of written rows."""

_OFF: Final = 1e-3
"""Tolerated deviation of a row of means from a step, as a part of it."""


def fit_logs(
    make_env: Callable[[], gymnasium.Env[Any, Any]],
    logs: Sequence[PlantLog],
    parameters: Mapping[str, tuple[float, float] | None],
    *,
    starts: Mapping[str, str | None] | None = None,
    wash_in: float | None = None,
    columns: Mapping[str, str] | None = None,
    candidates: int = 32,
    advance: Callable[[float], None] = silent,
) -> FitResult:
    """Fit parameters of a task's FMU to logs of the plant.

    A log needs a column for each input that the task writes. Each output of the task that has a
    column is compared. The simulation of a log begins with its first row, at the task's start time,
    and makes a step from row to row, of as many communication steps of the task as fit best. Delays
    and errors of sensors are not simulated.

    Args:
        make_env: Makes the environment of the task.
        logs: The logs; each of their episodes is simulated by itself.
        parameters: The names of the task or of the FMU, with the lowest and the highest value in
            the task's unit; None for a third of the present value to three times that.
        starts: Start values of the FMU that are fitted to each episode apart, with the name of the
            output that measures them, or None.
        wash_in: The seconds of each episode that are simulated but not counted. By default a tenth
            of the shortest episode, or 0 if start values are fitted.
        columns: The names of the FMU by the names of columns that differ.
        candidates: How many points within the ranges are tried first; see ``fit_parameters``.
        advance: Is told how many simulations of a log were done since its last call.

    Returns:
        Values and all else by the names and in the units of the FMU.

    Raises:
        ConfigError: If a log, a name, a unit or a range does not fit the task.
        SimulationError: If the FMU fails with the start values or near a tried point.
    """
    with closing(make_env()) as env:
        plant = _Plant(env, dict(columns or {}))
        trajectories = [one for log in logs for one in plant.trajectories(log)]
        if not trajectories:
            raise ConfigError("there is no log to fit to")
        plant.require_steps(trajectories)
        wanted = dict(plant.wanted(name, ends) for name, ends in parameters.items())
        states = dict(plant.start(name, output) for name, output in (starts or {}).items())
        if wash_in is None:
            shortest = min(float(np.ptp(one.time)) for one in trajectories)
            wash_in = 0.0 if states else _WASH_IN * shortest
        experiment = FitSettings(
            plant.env.fmu,
            initial_states=states,
            fixed={n: v for n, v in plant.given.items() if n not in wanted | states},
            wash_in=wash_in,
            plant=plant.env,
            advance=advance,
        )
        return fit_of(experiment, wanted, trajectories, candidates)


def write_rows(fit: FitResult, path: str | os.PathLike[str]) -> None:
    """Write 1000 rows of values that fit the logs together, for ``fitted`` of task files.

    Args:
        fit: The fit.
        path: The new file, with the ending ``.npz``.

    Raises:
        FileExistsError: If the file exists.
    """
    rows = fit.rows(_ROWS)
    with Path(path).open("xb") as file:
        np.savez(file, names=np.array([*fit.values]), rows=rows)


class _Plant:
    """Task of a fit: names, units and given values."""

    def __init__(self, env: Any, columns: dict[str, str]) -> None:
        self.env, self._columns = inner_env(env), columns
        draws = self.env.episode_start
        typical = np.median(draws.draw_starts(np.random.default_rng(0), 101), axis=1).tolist()
        given = values_by_name(draws.model_variables, typical)
        self.given: dict[str, Any] = {
            v.name: given[v.name] for v in draws.model_variables if not is_start_time(v)
        }

    def trajectories(self, log: PlantLog) -> Iterator[Trajectory]:
        """Episodes of a log in the units of the FMU, divided at missing measurements."""
        spec, columns = self.env.pool_spec, LogColumns(self.env, log, self._columns)
        for variable in spec.inputs:
            columns.require(variable)
        measured = [variable for variable in spec.outputs if columns.has(variable)]
        if not measured:
            first = next((v.name for v in spec.outputs), "")
            raise unknown_name("column of the log", first, log.columns)
        needed = columns.of(*spec.inputs, *measured)
        parts = [part for part in log.parts(needed) if len(part.times) > 1]
        if not parts:
            raise ConfigError(
                f"the log has no two rows of an episode, one after the other, in which "
                f"{', '.join(needed)} were all measured"
            )
        for part in parts:
            yield Trajectory(
                part.times,
                {v.name: columns.values(v, part) for v in measured},
                {v.name: columns.held(v, part) for v in spec.inputs},
            )

    def require_steps(self, trajectories: Sequence[Trajectory]) -> None:
        """Refuse rows that are not a step apart, if a measured value is the mean of a step."""
        spec, step = self.env.pool_spec, median_interval(trajectories)
        whole = [v for v in spec.outputs if v.sampling != "last"]
        sampled = [f"{v.sampling} of {v.name}" for v in whole if v.name in trajectories[0].outputs]
        for one in trajectories if sampled else ():
            steps = np.diff(one.time) / step
            off = np.abs(steps - np.round(steps)) > _OFF
            if off.any() or np.round(np.median(steps)) != 1:
                raise ConfigError(
                    f"the log at {one.time[np.argmax(off)]:g} s: the {sampled[0]} needs rows that "
                    f"are {step:g} s apart, in all logs, or multiples of that where rows are left "
                    "out"
                )

    def wanted(
        self, name: str, ends: tuple[float, float] | None
    ) -> tuple[str, tuple[float, float, float]]:
        """A parameter with its value and its range, in the unit of the FMU."""
        variable, unit = self._start(name)
        value = float(self.given.get(variable.name, variable.start_number))
        units = self.env.fmu.description.units
        if ends is None:
            low, high = sorted((value / _AROUND, value * _AROUND))
        else:
            conversion = conversion_of(variable, unit, units)
            low, high = sorted(map(conversion.inverse, ends))
        low, high = max(low, variable.minimum), min(high, variable.maximum)
        if not low < high:
            raise ConfigError(
                f"{name!r} needs a range such as {name}=1..10, got {shown(ends)}; its value is "
                f"{value:g}, the FMU allows {variable.minimum:g} to {variable.maximum:g}"
            )
        return variable.name, (start_between(value, low, high), low, high)

    def start(self, name: str, output: str | None) -> tuple[str, str | float]:
        """A start value that is fitted, and the output or number that it begins with."""
        variable, _ = self._start(name)
        if output is None:
            return variable.name, float(self.given.get(variable.name, variable.start_number))
        return variable.name, declared_as(self.env, output)[0]

    def _start(self, name: str) -> tuple[Variable, str | None]:
        """The variable of a name of the task or the FMU, and the unit that the task gives it."""
        found, unit = declared_as(self.env, name)
        variable = start_variable(self.env.fmu.description, found, 0.0)
        if variable.causality == "input":
            raise ConfigError(f"{name!r} cannot be fitted: it is an input, which the log gives")
        return variable, unit
