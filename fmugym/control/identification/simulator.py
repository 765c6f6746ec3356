"""Simulation of all trajectories at once, each with several sets of values."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fmugym.checks import check_number
from fmugym.control.identification.trajectory import Trajectory, common_names
from fmugym.environment.env import FMUEnv
from fmugym.environment.fmu_variables import start_variable
from fmugym.environment.pool_opening import pool_options
from fmugym.errors import ConfigError
from fmugym.fmi.fmu import FMU
from fmugym.fmi.status import Status
from fmugym.fmi.variable import Variable, start_of
from fmugym.pool.opening import open_pool
from fmugym.pool.pool import FloatArray, MaskArray, PoolSpec

__all__ = ["FitSettings", "Simulator", "median_interval", "silent"]

logger = logging.getLogger(__name__)

WARNING = int(Status.WARNING)

_MOST_STEPS = 10_000_000
"""A trajectory that needs more steps has a wrong time step."""


def silent(count: float) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class FitSettings:
    """The common settings of a fit and its predictions; see ``fit_parameters``.

    ``plant`` is the environment of the FMU, if there is one; its communication steps, samplings
    and start time hold then. ``advance`` is told how many simulations were done since its last
    call.
    """

    fmu: FMU
    initial_states: Mapping[str, str | float]
    fixed: Mapping[str, float | str]
    scales: Mapping[str, float] = field(default_factory=dict)
    time_step: float | None = None
    drop_repeats: bool = False
    wash_in: float | None = None
    plant: FMUEnv | None = None
    advance: Callable[[float], None] = silent


class Simulator:
    """One pool with an instance for each trajectory and each set of values.

    Simulated time begins at 0 with each trajectory's first sample and advances in equal steps.
    Cubics interpolate the outputs at sampling instants between the steps.

    Args:
        experiment: The settings. The simulator opens the FMU again with the same arguments.
        trajectories: Trajectories with the same outputs and inputs.
        free: The variables whose values form a set: parameters, start values or inputs. The
            value of an input is added to the logged input.
        num_sets: Largest number of sets.

    Attributes:
        num_sets: As given.
        outputs: The names of the outputs, in the order of the results.
        failure: The reason of the last failed simulation.
    """

    def __init__(
        self,
        experiment: FitSettings,
        trajectories: Sequence[Trajectory],
        free: Sequence[Variable],
        num_sets: int,
    ) -> None:
        step, fixed, plant = experiment.time_step, experiment.fixed, experiment.plant
        if step is not None:
            step = check_number("time_step", step, positive=True)
        fmu = FMU.of(experiment.fmu)
        self.failure, self.num_sets = "", num_sets
        self.outputs, logged = common_names(trajectories)
        step = step or median_interval(trajectories)
        self._grids = [_Grid(trajectory, step) for trajectory in trajectories]
        self._advance = experiment.advance
        self._is_offset = np.array([one.causality == "input" for one in free], np.bool_)
        offsets = [one.name for one in free if one.causality == "input"]
        self._inputs = list(dict.fromkeys([*logged, *offsets]))
        self._offset_rows = [self._inputs.index(name) for name in offsets]
        self._logged = self._logged_inputs(trajectories)
        constants = [
            start_of(start_variable(fmu.description, name, value), value)
            for name, value in fixed.items()
        ]
        own = (one for one in free if one.causality != "input")
        self._variables = *own, *(variable for variable, _ in constants)
        self._constants = np.reshape([number for _, number in constants], (-1, 1))
        inputs, outputs = (tuple(map(fmu.variable, n)) for n in (self._inputs, self.outputs))
        _require_fit(inputs, outputs)
        spec = PoolSpec(inputs, outputs, step)
        count = num_sets * len(trajectories)
        if plant is None:
            self._pool = open_pool(fmu, spec, count, logger)
        else:
            spec = _as_in(plant.pool_spec, spec)
            self._pool = open_pool(fmu, spec, count, plant.logger, pool_options(plant))

    def close(self) -> None:
        """Free all instances."""
        self._pool.close()

    def simulate(self, values: FloatArray) -> list[FloatArray]:
        """Simulate every trajectory with every set of values.

        Args:
            values: Shape (names, sets, trajectories).

        Returns:
            The outputs of each trajectory at its sampling instants, shape (sets, n, outputs);
            NaN for a failed simulation.
        """
        names, num_sets, num_trajectories = values.shape
        record = self._run(values.reshape(names, num_sets * num_trajectories))
        self._advance(num_sets * num_trajectories)
        record = record.reshape(*record.shape[:2], num_sets, num_trajectories)
        return [grid.sample(record[..., w]) for w, grid in enumerate(self._grids)]

    def _note(self, failed: MaskArray) -> MaskArray:
        """Keep the reason of the first failure among the instances."""
        if failed.any():
            self.failure = self._pool.failure(int(failed.argmax()))
        return failed

    def _run(self, values: FloatArray) -> FloatArray:
        """Return the outputs at all steps, shape (steps + 1, outputs, columns of the values)."""
        size, count = self._pool.num_instances, values.shape[1]
        active = np.arange(size) < count
        starts, offsets = self._arrange(values, size)
        outputs, statuses = self._pool.reset(self._variables, starts, active)
        record = np.empty((len(self._logged) + 1, len(outputs), count))
        record[0] = outputs[:, :count]
        failed = self._note(active & (statuses > WARNING))
        ends = np.tile([grid.num_steps for grid in self._grids], size // len(self._grids))
        everywhere = np.tile(self._logged, (1, 1, size // len(self._grids))) + offsets
        for step, inputs in enumerate(everywhere):
            skip = ~active | failed | (ends <= step)
            outputs, statuses = self._pool.step(inputs, skip)
            record[step + 1] = outputs[:, :count]
            failed |= self._note(~skip & (statuses > WARNING))
        record[:, :, failed[:count]] = np.nan
        return record

    def _arrange(self, values: FloatArray, size: int) -> tuple[FloatArray, FloatArray]:
        """Split the values into start values and offsets of inputs, a column for each instance."""
        values = np.pad(values, ((0, 0), (0, size - values.shape[1])))
        offsets = np.zeros((len(self._inputs), size))
        offsets[self._offset_rows] = values[self._is_offset]
        return np.vstack([values[~self._is_offset], np.tile(self._constants, (1, size))]), offsets

    def _logged_inputs(self, trajectories: Sequence[Trajectory]) -> FloatArray:
        """Return the inputs at each step, shape (steps, inputs, trajectories)."""
        steps = max(grid.num_steps for grid in self._grids)
        logged = np.zeros((steps, len(self._inputs), len(trajectories)))
        for w, (trajectory, grid) in enumerate(zip(trajectories, self._grids, strict=True)):
            for name, signal in trajectory.inputs.items():
                logged[: grid.num_steps, self._inputs.index(name), w] = signal[grid.held]
        return logged


class _Grid:
    """The steps of one trajectory, and the interpolation at its sampling instants.

    Args:
        trajectory: A trajectory of n samples.
        step: Step size in seconds.

    Attributes:
        num_steps: Number of steps up to the last sample; at least three, for the cubics.
        held: The sample whose input holds during each step, shape (num_steps,).

    Raises:
        ConfigError: If there would be more than ten million steps.
    """

    def __init__(self, trajectory: Trajectory, step: float) -> None:
        duration = trajectory.time[-1] - trajectory.time[0]
        if not duration <= _MOST_STEPS * step:
            raise ConfigError(
                f"a time step of {step:g} s is too small for a trajectory of {duration:g} s"
            )
        position = (trajectory.time - trajectory.time[0]) / step
        whole = np.round(position)
        position = np.where(np.abs(position - whole) < 1e-6, whole, position)
        self.num_steps = max(3, int(np.ceil(position[-1])))
        self.held = np.searchsorted(position, np.arange(self.num_steps), side="right") - 1
        first = np.clip(np.floor(position).astype(int) - 1, 0, self.num_steps - 3)
        self._points = first[:, np.newaxis] + np.arange(4)
        self._weights = _lagrange_weights(position - first)

    def sample(self, record: FloatArray) -> FloatArray:
        """Interpolate the outputs at the sampling instants.

        Args:
            record: Outputs at each step, shape (steps + 1, k, sets).

        Returns:
            Outputs at the sampling instants, shape (sets, n, k).
        """
        sampled = np.einsum("np,npks->snk", self._weights, record[self._points])
        return np.ascontiguousarray(sampled)


def _lagrange_weights(x: FloatArray) -> FloatArray:
    """Return the weights of the values at 0, 1, 2, 3 in the cubic at x, shape (n, 4)."""
    points = np.arange(4.0)
    others = np.array([np.delete(points, place) for place in range(4)])
    factors = (x[:, np.newaxis, np.newaxis] - others) / (points[:, np.newaxis] - others)
    return np.asarray(factors.prod(axis=2))


def median_interval(trajectories: Sequence[Trajectory]) -> float:
    """Return the median sampling interval of the trajectories, in seconds.

    It is rounded to a nanosecond, so that rounded sampling instants give a round step size.
    """
    intervals = np.concatenate([np.diff(trajectory.time) for trajectory in trajectories])
    return round(float(np.median(intervals)), 9) or float(np.median(intervals))


def _as_in(given: PoolSpec, spec: PoolSpec) -> PoolSpec:
    """The inputs, outputs and steps of a spec; the rest as an environment has it."""
    known = {variable.name: variable for variable in given.outputs}
    return replace(
        given,
        inputs=spec.inputs,
        outputs=tuple(known.get(variable.name, variable) for variable in spec.outputs),
        time_step=spec.time_step,
        substeps=max(1, round(spec.time_step * given.substeps / given.time_step)),
        num_observed=0,
        warm_up_steps=0,
        records=False,
    )


def _require_fit(inputs: Sequence[Variable], outputs: Sequence[Variable]) -> None:
    for one in inputs:
        if one.causality != "input":
            raise ConfigError(f"{one.name!r} was logged as an input, but is no input of the FMU")
    for one in outputs:
        if not one.numeric:
            text = "cannot be compared with a measurement: it is not numeric"
            raise ConfigError(f"{one.name!r} {text}")
