"""Linear models along a trajectory, from the state and the action to the next state."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import check_number, check_option
from fmugym.control.linearization.trajectory_derivatives import (
    Matrices,
    checked_trajectory,
    differences,
    differentiate_by_starts,
    float_box,
    moved_alone,
    moved_both_ways,
    precise_step,
    require_vector,
)
from fmugym.environment.actions import written_inputs
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import standing_in
from fmugym.environment.fmu_variables import start_variable
from fmugym.environment.snapshots import Snapshot, checked_snapshot
from fmugym.environment.vector.rollouts import start_of_rollout
from fmugym.environment.vector.vector_env import FMUVectorEnv
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray

__all__ = ["LinearTrajectory", "linearize_along"]

logger = logging.getLogger(__name__)

_BESIDE: Final = 1e-3
"""Distance of the actions that check derivatives, as a part of the width of their space."""

_ROUNDING: Final = 1e-9
"""Changes of states that are smaller fractions of these show rounding errors."""

_DOUBTFUL: Final = 0.1
"""The error of predictions from which on derivatives are doubtful."""

_METHODS: Final = ("directional", "differences")

States = Mapping[str, str]
"""The start variable of each state."""


class LinearTrajectory(NamedTuple):
    """Models x[k + 1] = A[k] x[k] + B[k] u[k], y[k] = C[k] x[k] + D[k] u[k] of small deviations.

    x[k] are the states before step k, u[k] is the action of step k, and y[k] are the outputs after
    it, which are what ``step`` observes by default. All are deviations from the trajectory.

    Attributes:
        A: Shape (horizon, n_x, n_x).
        B: Shape (horizon, n_x, n_u).
        C: Shape (horizon, n_y, n_x).
        D: Shape (horizon, n_y, n_u).
        x: The states of the trajectory, the last ones included, shape (horizon + 1, n_x).
        y: Its outputs, shape (horizon, n_y).
        states: The names of the states.
        outputs: The names of the outputs.
        method: ``"directional"`` or ``"differences"``.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    x: FloatArray
    y: FloatArray
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    method: str


def linearize_along(
    envs: FMUVectorEnv,
    snapshot: Snapshot,
    actions: Any,
    *,
    states: Mapping[str, str] | Sequence[str] | None = None,
    method: str | None = None,
    step: float | None = None,
) -> LinearTrajectory:
    """Linearize each step of a trajectory, for LQR and iterative LQR along it.

    There are two methods. The states are always variables of the FMU. What the environment itself
    remembers (delays, episode variables) is no state: its effect on later steps is not in the
    matrices.

    - ``"directional"``: the FMU differentiates its equations (``GetDirectionalDerivative`` of
      FMI 2.0 and 3.0) before and after each step. The matrices of the step are the exponential of
      the mean of both, with constant inputs (exponential midpoint rule; M. Hochbruck, C. Lubich,
      SIAM J. Numer. Anal. 41(3), 2003). The error of a step is of order 3 in its size; errors of
      the FMU's own solver are not in it. The states are all continuous states that the FMU
      declares, and need not be settable. A second trajectory close by checks the matrices; if they
      are far off, a warning is logged.
    - ``"differences"``: central differences, all states, actions and steps together, on all
      threads. Each state is moved by its start value: episodes that start at the states of the
      trajectory, each at the time of its step, do one step. So the start values of ``states`` must
      determine all of the FMU's state; what an unmoved start leads to is compared with the
      trajectory. The result is that of the FMU's solver with its step size.

    Args:
        envs: The environments; their actions are in a box of floats. They return to their present
            episodes afterwards.
        snapshot: Snapshot of one environment, where the trajectory begins.
        actions: The nominal actions, shape (horizon, ...).
        states: Names of states; or the name of the start variable of each, such as
            ``{"q": "q_0"}``, where that is another one. The name of an array stands for its
            elements. By default those that the FMU declares.
        method: By default ``"directional"`` where the FMU offers it for these states, otherwise
            ``"differences"``.
        step: For differences: how far a state is moved, as a fraction of its largest magnitude in
            the trajectory (at least a thousandth of its nominal value), and an action, as a
            fraction of the width of its space. By default the cube root of the precision of the
            numbers. An FMU whose solver has a tolerance needs more: about the square root of it.

    Raises:
        ConfigError: If the arguments do not fit, or the FMU does not offer the method.
        SimulationError: If a step fails, if the episode ends before the last step, or if the states
            do not determine what follows.
    """
    require_vector(envs, "linearize_along")
    env = envs.prototype
    space = float_box(envs.single_action_space, "action")
    nominal = checked_trajectory(space, actions)
    start = start_of_rollout(envs.episodes, checked_snapshot(snapshot, length=1), None, 1)
    chosen = _states(env, states)
    if method is not None:
        check_option("method", method, _METHODS)
    obstacle = _obstacle(env, chosen)
    if method == "directional" and obstacle:
        raise ConfigError(f"there are no directional derivatives of {_name(env)}: {obstacle}")
    if method != "differences" and not obstacle:
        method, found = "directional", _by_directional_derivatives(envs, start, nominal, chosen)
    else:
        method, fraction = "differences", _fractions(step, space)
        _require_starts(env, chosen, obstacle)
        found = differentiate_by_starts(envs, start, nominal, chosen, fraction)
    outputs = tuple(variable.name for variable in _outputs(env))
    return LinearTrajectory(**found._asdict(), states=tuple(chosen), outputs=outputs, method=method)


def _fractions(step: float | None, space: spaces.Box) -> tuple[float, float]:
    """Fractions by which states and actions are moved."""
    if step is not None:
        check_number("step", step, positive=True)
        return step, step
    return float(np.cbrt(np.finfo(np.float64).eps)), precise_step(space)


# The states


def _name(env: FMUEnv) -> str:
    description = env.fmu.description
    return f"{description.model_name} (FMI {description.fmi_version})"


def _outputs(env: FMUEnv) -> tuple[Variable, ...]:
    return env.pool_spec.outputs[: env.interface.output_count]


def _states(env: FMUEnv, given: Any) -> dict[str, str]:
    """The start variable of each state."""
    description = env.fmu.description
    if given is None:
        given = tuple(description.state_derivatives)
    if isinstance(given, str) or not isinstance(given, Mapping | Sequence) or not given:
        raise ConfigError(
            f"expected names of states of {_name(env)}, or a dict with their start variables, got "
            f"{shown(given)}"
        )
    pairs = given.items() if isinstance(given, Mapping) else ((name, name) for name in given)
    found: dict[str, str] = {}
    for name, start in pairs:
        states, starts = description.scalars(name), description.scalars(start)
        if len(states) != len(starts):
            raise ConfigError(
                f"{start!r} has {len(starts)} elements, expected {len(states)} as {name!r}"
            )
        for variable, own in zip(states, starts, strict=True):
            if variable.kind != "real":
                raise ConfigError(f"{variable.name!r} cannot be a state: it is no Real")
            found[variable.name] = own.name
    return found


def _obstacle(env: FMUEnv, states: States) -> str:
    """Why the FMU offers no directional derivatives for a trajectory; empty if it does."""
    description, spec = env.fmu.description, env.pool_spec
    if not description.capabilities.provides_derivatives:
        return "the FMU does not offer any"
    declared = set(description.state_derivatives)
    if set(states) != declared:
        return f"the FMU declares the states {', '.join(sorted(declared)) or 'none'}"
    if set(spec.samplings) - {"last"}:
        return "outputs are sampled within a step"
    for variable in (*spec.inputs, *_outputs(env)):
        if variable.kind != "real" or variable.shape:
            return f"{variable.name!r} is no scalar Real"
    return ""


def _require_starts(env: FMUEnv, states: States, obstacle: str) -> None:
    """Refuse states that cannot be set."""
    description = env.fmu.description
    for name, start in states.items():
        if not description.variable(start).settable_at_start:
            hint = f"; directional derivatives need none, but {obstacle}" if obstacle else ""
            raise ConfigError(
                f"{start!r} cannot be set before initialization; states={{{name!r}: ...}} takes "
                f"the name of the start variable of the state{hint}"
            )
        start_variable(description, start, 0.0)


# Directional derivatives


def _by_directional_derivatives(
    envs: FMUVectorEnv, start: Snapshot, nominal: npt.NDArray[Any], states: States
) -> Matrices:
    """Play the trajectory with an instance of its own, and ask that for derivatives."""
    env = envs.maker.make()
    try:
        env.restore_state(start)
        follower = _Follower(env, states)
        found = follower.follow(nominal)
        env.restore_state(start)
        error = follower.error_beside(nominal, found)
        if error > _DOUBTFUL:
            logger.warning(
                "%s: its directional derivatives predict the effect of small changes with an error "
                "of %.0f %%. They are wrong, or the steps are too long for them; compare with "
                "method='differences'",
                *(_name(env), 100 * error),
            )
        return found
    finally:
        env.close()


class _Follower:
    """Plays the trajectory with one instance, and asks it for derivatives.

    Args:
        env: A single environment at the beginning of the trajectory.
        states: The states.
    """

    def __init__(self, env: FMUEnv, states: States) -> None:
        description = env.fmu.description
        self._env, self._pool = env, env.pool
        self._x = tuple(map(description.variable, states))
        slopes = description.state_derivatives
        self._x_dot = tuple(description.variable(slopes[name]) for name in states)
        self._u, self._y = env.pool_spec.inputs, _outputs(env)

    def follow(self, nominal: npt.NDArray[Any]) -> Matrices:
        """Play the nominal actions."""
        n, rows, x, y = len(self._x), [], [self._read()], []
        for index, action in enumerate(nominal):
            _require_no_feedback(self._env, action)
            by_action = _inputs_by_action(self._env, action)
            before = self._differentiate(self._x_dot)
            self._step(index, action, len(nominal))
            after = self._differentiate((*self._x_dot, *self._y))
            rows.append((0.5 * (before + after[:n]), after[n:], by_action))
            x.append(self._read())
            y.append(self._pool.outputs[: len(self._y), 0].copy())
        slopes, outputs, by_actions = map(np.array, zip(*rows, strict=True))
        a, b = discrete(slopes, self._env.pool_spec.time_step)
        by_x, by_u = outputs[:, :, :n], outputs[:, :, n:]
        d = (by_x @ b + by_u) @ by_actions
        return Matrices(a, b @ by_actions, by_x @ a, d, np.array(x), np.array(y))

    def error_beside(self, nominal: npt.NDArray[Any], found: Matrices) -> float:
        """Play other actions, and compare the change of each step with the linear prediction.

        Returns:
            The mean error of a state, as a fraction of its largest change; that of the worst state.
        """
        space = float_box(self._env.action_space, "action")
        actions, down, _ = moved_both_ways(space, nominal, _BESIDE)
        actions[1::2] = down[1::2]
        x = [self._read()]
        for action in actions:
            *_, terminated, truncated, _ = self._env.step(action)
            x.append(self._read())
            if terminated or truncated:
                break
        moves = np.subtract(actions, nominal, dtype=np.float64).reshape(len(nominal), -1)
        return _error_of(found, np.array(x), moves)

    def _read(self) -> FloatArray:
        return self._pool.read(self._x)[:, 0]

    def _differentiate(self, unknowns: tuple[Variable, ...]) -> FloatArray:
        return self._pool.differentiate(unknowns, (*self._x, *self._u))[:, :, 0]

    def _step(self, index: int, action: Any, horizon: int) -> None:
        _, _, *ends, info = self._env.step(action)
        if "fault" in info or (any(ends) and index + 1 < horizon):
            why = info.get("fault", "the episode ends there")
            raise SimulationError(f"step {index + 1} of {horizon} has no successor: {why}")


def _error_of(found: Matrices, x: FloatArray, moves: FloatArray) -> float:
    """The error of predicted changes of each step, as ``_Follower.error_beside`` returns it.

    Args:
        found: The matrices and the nominal states.
        x: The states beside them, shape (steps + 1, n_x).
        moves: How far the actions were moved, shape (horizon, n_u).
    """
    steps, off = len(x) - 1, x - found.x[: len(x)]
    predicted = np.einsum("kij,kj->ki", found.A[:steps], off[:-1])
    predicted += np.einsum("kij,kj->ki", found.B[:steps], moves[:steps])
    wrong = np.abs(off[1:] - predicted).mean(axis=0)
    largest = np.abs(off[1:]).max(axis=0)
    has_moved = largest > _ROUNDING * np.abs(x).max(axis=0)
    return float(np.max(wrong[has_moved] / largest[has_moved], initial=0.0))


def _require_no_feedback(env: FMUEnv, action: npt.NDArray[Any]) -> None:
    """Refuse inputs that depend on outputs: the FMU's derivatives do not know of that.

    Raises:
        ConfigError: If the inputs change with the outputs.
    """
    wanted = written_inputs(env, action)
    others = tuple(value + 0.01 * (abs(value) or 1.0) for value in env.episode.outputs)
    with standing_in(env, env.episode.replaced(outputs=others)):
        found = written_inputs(env, action)
    if found != wanted:
        raise ConfigError(
            "_get_inputs depends on the outputs, which directional derivatives of the FMU do not "
            "show; use method='differences'"
        )


def _inputs_by_action(env: FMUEnv, action: npt.NDArray[Any]) -> FloatArray:
    """Differentiate the FMU's inputs by an action; the action's inputs stay in the pool.

    Returns:
        Shape (inputs, actions).
    """
    space = float_box(env.action_space, "action")
    actions, widths = moved_alone(space, action[None], precise_step(space))
    # The inputs of the action itself are the last that are written.
    inputs = [written_inputs(env, one[0]) for one in actions[::-1]]
    return differences(np.array(inputs[::-1]), widths).T


def discrete(slopes: FloatArray, time_step: float) -> tuple[FloatArray, FloatArray]:
    """Models x_dot = J_x x + J_u u over one step with constant inputs.

    By one matrix exponential for both (C. Van Loan, IEEE Trans. Automatic Control 23(3), 1978).

    Args:
        slopes: J_x and J_u of each model side by side, shape (models, n, n + m).
        time_step: In s.

    Returns:
        Shapes (models, n, n) and (models, n, m).
    """
    count, n, width = slopes.shape
    square = np.zeros((count, width, width))
    square[:, :n] = slopes * time_step
    found = _exponential(square)
    return found[:, :n, :n], found[:, :n, n:]


def _exponential(matrices: FloatArray) -> FloatArray:
    """The exponentials of matrices by their series, scaled to a norm of 1/2 and squared again."""
    norm = max(np.abs(matrices).sum(axis=2).max(initial=0.0), 0.5)
    halvings = int(np.ceil(np.log2(norm))) + 1
    scaled = matrices / 2.0**halvings
    total = term = np.broadcast_to(np.eye(matrices.shape[1]), matrices.shape)
    for order in range(1, 18):  # the next term is below 1e-21
        term = term @ scaled / order
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total
