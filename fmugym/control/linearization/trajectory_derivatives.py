"""Derivatives along a trajectory, by central differences over rollouts.

Those by the states of an FMU come from episodes that start beside the trajectory.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import check_number
from fmugym.environment.snapshots import Columns, Snapshot, checked_snapshot, stacked, taken
from fmugym.environment.vector.rollouts import returning_to
from fmugym.environment.vector.vector_env import FMUVectorEnv, require_open
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.variable import checked_value
from fmugym.pool.pool import FloatArray, MaskArray
from fmugym.pool.pool_spec import START_TIME
from fmugym.pool.states import Bundle, IndexArray

__all__ = [
    "Derivatives",
    "Matrices",
    "checked_trajectory",
    "derivatives",
    "differences",
    "differentiate_by_starts",
    "float_box",
    "moved_alone",
    "moved_both_ways",
    "precise_step",
    "require_vector",
]


class Derivatives(NamedTuple):
    """Derivatives of a trajectory by its actions.

    The derivative by an action of a later step is 0.

    Attributes:
        observations: Observations of the nominal actions, shape (horizon, outputs).
        rewards: Rewards of the nominal actions, shape (horizon,).
        by_actions: Derivatives of the observations, shape (horizon, outputs, horizon, actions):
            element [t, i, s, j] is that of observation i after step t by action j of step s.
        of_rewards: Derivatives of the rewards, shape (horizon, horizon, actions).
    """

    observations: npt.NDArray[Any]
    rewards: FloatArray
    by_actions: FloatArray
    of_rewards: FloatArray

    @property
    def of_return(self) -> FloatArray:
        """The gradient of the sum of the rewards, shape (horizon, actions)."""
        gradient: FloatArray = self.of_rewards.sum(axis=0)
        return gradient


def derivatives(
    envs: FMUVectorEnv, snapshot: Snapshot, actions: Any, *, step: float | None = None
) -> Derivatives:
    """Differentiate a trajectory by its actions, in one rollout on all threads.

    Each element of each action is moved up and down, and not beyond the bounds of its space. That
    makes 2 horizon actions + 1 candidates of one rollout. Observations of float32 have seven
    digits, so that their derivatives have about four; those of float64 have about ten.

    Args:
        envs: Environments whose observations and actions are boxes of floats, of any shape.
        snapshot: Snapshot of one environment, where the trajectory begins.
        actions: The nominal actions, shape (horizon, ...).
        step: How far actions are moved, as a fraction of the width of the space, or absolute where
            it has no bounds; by default the cube root of the precision of the observations.

    Raises:
        ConfigError: If a space is another one, or the arguments do not fit.
        SimulationError: If an episode ends before the last step, where nothing can be
            differentiated.
    """
    require_vector(envs, "derivatives")
    space = float_box(envs.single_action_space, "action")
    seen = float_box(envs.single_observation_space, "observation")
    checked_snapshot(snapshot, length=1)
    nominal = checked_trajectory(space, actions)
    delta = precise_step(seen) if step is None else check_number("step", step, positive=True)
    candidates, widths = moved_alone(space, nominal, delta)
    found = envs.rollout(snapshot, candidates)
    if found.lengths.min() < len(nominal):
        raise SimulationError(
            f"an episode ends after {found.lengths.min()} of {len(nominal)} steps: derivatives "
            "exist for trajectories without an end only"
        )
    outputs = np.asarray(found.observations, np.float64).reshape(len(candidates), len(nominal), -1)
    by_actions, of_rewards = differences(outputs, widths), differences(found.rewards, widths)
    shape = len(nominal), nominal[0].size
    return Derivatives(
        found.observations[0].reshape(len(nominal), -1),
        found.rewards[0].copy(),
        np.moveaxis(by_actions.reshape(*shape, *outputs.shape[1:]), (0, 1), (2, 3)),
        np.moveaxis(of_rewards.reshape(*shape, len(nominal)), 2, 0),
    )


def precise_step(space: spaces.Box) -> float:
    """The step with the least error of a central difference, for numbers of this precision."""
    dtype: Any = space.dtype
    return float(np.cbrt(float(np.finfo(dtype).eps)))


def float_box(space: Any, what: str) -> spaces.Box:
    """Return a space in which something can be differentiated.

    Raises:
        ConfigError: If it is no box of floats.
    """
    if not isinstance(space, spaces.Box) or space.dtype.kind != "f":
        raise ConfigError(f"derivatives need {what}s in a Box of floats, not in {space}")
    return space


def checked_trajectory(space: spaces.Box, actions: Any) -> npt.NDArray[Any]:
    """Return nominal actions as an array of shape (horizon, ...) and of the type of the space.

    Raises:
        ConfigError: If they do not fit, or are not in the space.
    """
    try:
        nominal = np.array(actions, space.dtype)
    except (TypeError, ValueError):
        nominal = np.empty(0)
    if nominal.shape[1:] != space.shape or nominal.ndim != len(space.shape) + 1 or not nominal.size:
        raise ConfigError(
            f"expected actions of shape (horizon, ...) for {space}, got {shown(actions)}"
        )
    outside = ~((space.low <= nominal) & (nominal <= space.high))
    for step, *place in np.argwhere(outside)[:1].tolist():
        value = nominal[(step, *place)]
        raise ConfigError(f"the action of step {step} is not in {space}: it has {value}")
    return nominal


def require_vector(envs: Any, name: str) -> None:
    """Require an open vector environment.

    Raises:
        ConfigError: If it is something else.
        SimulationError: If it is closed, or a step is under way.
    """
    if not isinstance(envs, FMUVectorEnv):
        raise ConfigError(f"{name} needs an FMUVectorEnv, got {shown(envs)}")
    require_open(envs, name)


def moved_alone(
    space: spaces.Box, nominal: npt.NDArray[Any], step: float
) -> tuple[npt.NDArray[Any], FloatArray]:
    """Nominal actions, two candidates for each element, and the distances of these."""
    *moved, widths = moved_both_ways(space, nominal, step)
    candidates = np.repeat(nominal[None], 2 * nominal.size + 1, axis=0)
    flat = candidates.reshape(len(candidates), -1)
    elements = np.arange(nominal.size)
    for first, values in zip((1, 2), moved, strict=True):
        flat[first + 2 * elements, elements] = values.reshape(-1)
    return candidates, widths.reshape(-1)


def moved_both_ways(
    space: spaces.Box, nominal: npt.NDArray[Any], step: float
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], FloatArray]:
    """Move each element of actions up and down, and not beyond the bounds of the space.

    Args:
        space: Space of one action.
        nominal: Shape (horizon, ...).
        step: How far, as a fraction of the width of the space.

    Returns:
        All moved up, all moved down, and how far these are apart, each of the shape of ``nominal``.
    """
    high, low = (np.broadcast_to(limit, nominal.shape) for limit in (space.high, space.low))
    with np.errstate(over="ignore", invalid="ignore"):
        width = np.subtract(high, low, dtype=np.float64)
    width[~np.isfinite(width)] = 1.0
    up, down = (
        np.clip(nominal + sign * step * width, low, high).astype(nominal.dtype)
        for sign in (1.0, -1.0)
    )
    return up, down, np.subtract(up, down, dtype=np.float64)


def differences(values: npt.NDArray[Any], widths: FloatArray) -> FloatArray:
    """Differences of each pair of candidates, divided by their distances.

    Args:
        values: Results of the candidates of ``moved_alone``, in their order.
        widths: How far they are apart.
    """
    pairs = values[1:].reshape(len(widths), 2, *values.shape[1:])
    apart = widths.reshape(-1, *[1] * (values.ndim - 1))
    quotients: FloatArray = (pairs[:, 0] - pairs[:, 1]) / apart
    return quotients


_AGREEMENT: Final = 1e-3
"""Tolerated difference of a step after a start at the state before it, as a part of scales."""

_LEAST: Final = 1e-3
"""The least magnitude of a state, as a fraction of its nominal value: states at rest have rounding
errors instead of zeros, which are no measure of how far to move them."""

_FIRST: Final = np.zeros(1, np.int64)


class Matrices(NamedTuple):
    """The arrays of a ``LinearTrajectory``."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    x: FloatArray
    y: FloatArray


class _Trials(NamedTuple):
    """Single steps, M of them.

    Attributes:
        at: Which step of the trajectory each is, shape (M,).
        starts: Whether the FMU starts at given states instead of going on, shape (M,).
        states: These states, shape (M, n_x).
        actions: Shape (M, ...).
    """

    at: IndexArray
    starts: MaskArray
    states: FloatArray
    actions: npt.NDArray[Any]

    def take(self, places: IndexArray) -> _Trials:
        """Some of them."""
        parts: Iterator[Any] = (part[places] for part in self)
        return _Trials(*parts)


def differentiate_by_starts(
    envs: FMUVectorEnv,
    start: Snapshot,
    nominal: npt.NDArray[Any],
    states: Mapping[str, str],
    steps: tuple[float, float],
) -> Matrices:
    """Differentiate each step of a trajectory by the states before it and by its action.

    Args:
        envs: The environments; they return to their present episodes.
        start: Start of one environment, where the trajectory begins.
        nominal: The actions, shape (horizon, ...).
        states: The start variable of each state.
        steps: How far states and actions are moved, as fractions.

    Returns:
        The matrices, the states and the outputs.

    Raises:
        SimulationError: See ``linearize_along``.
    """
    episodes = envs.episodes
    with returning_to(episodes, envs.save_state() if episodes.is_ready else None):
        return _Perturbation(envs, states, start).differentiate(nominal, steps)


class _Perturbation:
    """Plays a trajectory, and single steps beside it."""

    def __init__(self, envs: FMUVectorEnv, states: Mapping[str, str], start: Snapshot) -> None:
        env = envs.prototype
        self._task, self._pool, self._episodes = envs.task, envs.pool, envs.episodes
        self._spec = env.pool_spec
        self._space = float_box(envs.single_action_space, "action")
        self._x = tuple(map(env.fmu.variable, states))
        self._count_of_y = env.interface.output_count
        self._start = start
        self._times: FloatArray = np.empty(0)
        self._everywhere = np.arange(envs.num_envs)
        given = {
            name: column[0]
            for name, column in self._episodes.columns_of(start)["parameters"].items()
            if column[0] is not None and name not in {*states.values(), START_TIME.name}
        }
        fixed = [env.interface.parameter(name, value) for name, value in given.items()]
        pairs = zip(fixed, given.values(), strict=True)
        self._fixed = np.array([checked_value(variable, value) for variable, value in pairs])
        self._variables = (*fixed, *map(env.fmu.variable, states.values()), START_TIME)
        self._starts = tuple(states.values())

    def differentiate(self, nominal: npt.NDArray[Any], steps: tuple[float, float]) -> Matrices:
        """See ``differentiate_by_starts``."""
        x, y = self._follow(nominal)
        scales = self._scales(x)
        trials, widths = self._trials(nominal, x[:-1], scales * steps[0], steps[1])
        before, after = self._play_at_any_time(trials, x, scales)
        n = len(self._x)
        slopes = _slopes(before[:, 1:], after[:, 1:], widths)
        (a, b), (c, d) = (
            (rows[:, :, :n], rows[:, :, n:]) for rows in (slopes[:, :n], slopes[:, n:])
        )
        return Matrices(a, b, c, d, x, y)

    def _play_at_any_time(
        self, trials: _Trials, x: FloatArray, scales: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Start the FMU at the time of each step, or at the time of the trajectory.

        The first is right for all FMUs that can start at any time. Others may not depend on it.
        """
        try:
            return self._play_all(trials, x, scales)
        except SimulationError as reason:
            self._times = np.full_like(self._times, self._times[0])
            try:
                return self._play_all(trials, x, scales)
            except SimulationError:
                raise reason from None

    def _play_all(
        self, trials: _Trials, x: FloatArray, scales: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The states before each trial, and the states and outputs after it, by step."""
        rounds = [self._play(trials.take(p)) for p in self._rounds(len(trials.at))]
        before, after = (
            np.concatenate(part)[: len(trials.at)].reshape(len(x) - 1, -1, part[0].shape[1])
            for part in zip(*rounds, strict=True)
        )
        self._require_agreement(x, after[:, 0, : len(self._x)], scales)
        return before, after

    def _follow(self, nominal: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Play the trajectory, and keep each moment of it; returns x and y."""
        count = len(self._everywhere)
        self._episodes.go_on_from(self._start, np.zeros(count, np.int64))
        x, y = [self._pool.read(self._x)[:, 0]], []
        bundles, columns = [], []
        for index, action in enumerate(nominal):
            bundles.append(self._pool.save_instances(_FIRST))
            columns.append(self._episodes.columns(_FIRST))
            _, _, terminated, truncated, _ = self._task.step(np.repeat(action[None], count, axis=0))
            self._require_fine(f"step {index + 1}", _FIRST)
            if (terminated | truncated)[0] and index + 1 < len(nominal):
                raise SimulationError(
                    f"the episode ends after {index + 1} of {len(nominal)} steps: no step follows "
                    "that could be linearized"
                )
            x.append(self._pool.read(self._x)[:, 0])
            y.append(self._pool.outputs[: self._count_of_y, 0].copy())
        self._bundle: Bundle = Bundle.of_all(bundles)
        self._columns: Columns = stacked(columns)
        spec = self._spec
        heads = self._bundle.heads
        self._times = np.array([spec.communication_point(h.steps, h.start_time) for h in heads])
        return np.array(x), np.array(y)

    def _scales(self, x: FloatArray) -> FloatArray:
        """The magnitude of each state."""
        nominals = np.array([abs(v.nominal or 1.0) for v in self._x])
        scales: FloatArray = np.maximum(np.abs(x).max(axis=0), _LEAST * nominals)
        return scales

    def _trials(
        self, nominal: npt.NDArray[Any], x: FloatArray, deltas: FloatArray, step: float
    ) -> tuple[_Trials, FloatArray]:
        """For each step: a start at its states, at moved states, and moved actions.

        Returns:
            The trials, and how far each pair of actions is apart, shape (horizon, n_u).
        """
        (horizon, n), size = x.shape, nominal[0].size
        each = 1 + 2 * n + 2 * size
        states = np.repeat(x[:, None], each, axis=1)
        actions = np.repeat(nominal.reshape(horizon, 1, size), each, axis=1)
        *moved, widths = (
            array.reshape(horizon, size) for array in moved_both_ways(self._space, nominal, step)
        )
        i, j = np.arange(n), np.arange(size)
        for way, sign in enumerate((1.0, -1.0)):
            states[:, 1 + 2 * i + way, i] += sign * deltas
            actions[:, 1 + 2 * n + 2 * j + way, j] = moved[way]
        starts = np.tile(np.arange(each) < 1 + 2 * n, horizon)
        trials = _Trials(
            np.repeat(np.arange(horizon), each),
            starts,
            states.reshape(-1, n),
            actions.reshape(-1, *nominal.shape[1:]),
        )
        return trials, widths

    def _rounds(self, count: int) -> list[IndexArray]:
        """Rounds of trials, which the environments play one after the other."""
        num_envs = len(self._everywhere)
        firsts = range(0, count, num_envs)
        return [np.minimum(np.arange(i, i + num_envs), count - 1) for i in firsts]

    def _play(self, trials: _Trials) -> tuple[FloatArray, FloatArray]:
        """Do one step of each; returns the states before, and the states and outputs after."""
        starting, going = np.flatnonzero(trials.starts), np.flatnonzero(~trials.starts)
        if len(going):
            self._episodes.restore(self._bundle, trials.at[going], going)
        columns = taken(self._columns, trials.at)
        if len(starting):
            self._start_at(trials)
            self._require_fine("a start", starting)
            for index in starting.tolist():
                columns["outputs"][index] = self._pool.outputs[:, index].copy()
        before = self._pool.read(self._x).T
        self._require_states(before[starting], trials.states[starting])
        self._episodes.place(columns, self._everywhere, self._everywhere)
        self._task.step(trials.actions)
        self._require_fine("a step", self._everywhere)
        outputs = self._pool.outputs[: self._count_of_y]
        return before, np.concatenate([self._pool.read(self._x), outputs]).T

    def _start_at(self, trials: _Trials) -> None:
        fixed = np.repeat(self._fixed[:, None], len(self._everywhere), axis=1)
        times = self._times[trials.at][None]
        values = np.ascontiguousarray(np.concatenate([fixed, trials.states.T, times]))
        self._pool.reset(self._variables, values, trials.starts)

    # Checks

    def _require_fine(self, what: str, indices: IndexArray) -> None:
        for index in indices[self._pool.statuses[indices] > WARNING_CODE].tolist():
            raise SimulationError(f"{what} fails: {self._pool.failure(index)}")

    def _require_states(self, found: FloatArray, wanted: FloatArray) -> None:
        """Find start variables that do not set their states."""
        scales = self._scales(wanted) if len(wanted) else np.ones(len(self._x))
        for index in np.flatnonzero(np.any(np.abs(found - wanted) > _AGREEMENT * scales, axis=0)):
            state, start = self._x[index].name, self._starts[index]
            row = int(np.abs(found - wanted)[:, index].argmax())
            raise SimulationError(
                f"{start!r} does not set the state {state!r}: with {wanted[row, index]:g} it is "
                f"{found[row, index]:g}"
            )

    def _require_agreement(self, x: FloatArray, after: FloatArray, scales: FloatArray) -> None:
        """Compare the trajectory with steps after a start at its states."""
        bad = np.abs(after - x[1:]) > _AGREEMENT * scales
        for step, index in np.argwhere(bad)[:1].tolist():
            raise SimulationError(
                f"the states {', '.join(v.name for v in self._x)} do not determine what follows: "
                f"{self._x[index].name} is {x[step + 1, index]:g} after step {step + 1}, but "
                f"{after[step, index]:g} after a start at the states before that step"
            )


def _slopes(before: FloatArray, after: FloatArray, widths: FloatArray) -> FloatArray:
    """Differences of pairs of trials, divided by their distances.

    Args:
        before: The states before the step, shape (horizon, 2 (n_x + n_u), n_x); the first n_x pairs
            have moved states.
        after: Next states, shape (horizon, 2 (n_x + n_u), k).
        widths: How far pairs of actions are apart, shape (horizon, n_u).

    Returns:
        Shape (horizon, k, n_x + n_u).
    """
    horizon, _, n = before.shape
    moved = before[:, : 2 * n].reshape(horizon, n, 2, n)
    ends = np.einsum("kipi->kpi", moved)  # of each pair, the state that was moved
    apart = np.concatenate([ends[:, 0] - ends[:, 1], widths], axis=1)
    pairs = after.reshape(horizon, -1, 2, after.shape[2])
    return np.swapaxes((pairs[:, :, 0] - pairs[:, :, 1]) / apart[:, :, None], 1, 2)
