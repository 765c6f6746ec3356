"""Rollouts of many candidates for the next actions: their actions, assumptions and costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.checks import (
    Spellings,
    by_own_names,
    check_count,
    check_mapping,
    check_number,
    check_seed,
)
from fmugym.environment.actions import array_of, checked_actions, is_array_space
from fmugym.environment.env import FMUEnv
from fmugym.environment.forecasts import future_of
from fmugym.environment.snapshots import Columns, Snapshot, checked_snapshot
from fmugym.environment.vector.episodes import Episodes
from fmugym.environment.vector.infos import copy_rows, mapped
from fmugym.environment.vector.tasks import StepResult, VectorTask
from fmugym.errors import ConfigError, SimulationError
from fmugym.fmi.variable import Variable, checked_value, unlisted
from fmugym.pool.pool import FloatArray, MaskArray
from fmugym.pool.states import IndexArray

__all__ = [
    "Candidates",
    "Rollout",
    "costs_in",
    "joined_rollouts",
    "keys_of",
    "offsets_of",
    "returning_to",
    "roll_out",
    "start_of_rollout",
    "tables_of",
    "tunable_values",
]


class Candidates:
    """Candidates: given actions, or a policy.

    Args:
        count: n.
        horizon: The number of steps.
        num_envs: N.
        given: The actions, shape (n, horizon, ...), or the policy.

    Attributes:
        rounds: Which candidates the environments play one after the other, arrays of shape (N,).
            Environments that are left over play the last candidate, too.
    """

    parameters: Mapping[str, FloatArray] = MappingProxyType({})
    """What the tunable parameters of each candidate are, arrays of shape (n,) by name."""

    variables: Mapping[str, float] = MappingProxyType({})
    """What episode variables of all candidates are at the beginning, by name."""

    tables: Mapping[str, FloatArray] = MappingProxyType({})
    """What candidates look up in the place of data, by name."""

    offsets: FloatArray | None = None
    """What is added to the outputs of all candidates, shape (k,)."""

    def __init__(self, count: int, horizon: int, num_envs: int, given: Any) -> None:
        self.count, self.horizon, self._given = count, horizon, given
        firsts = range(0, count, num_envs)
        self.rounds = [np.minimum(np.arange(i, i + num_envs), count - 1) for i in firsts]

    @classmethod
    def of(cls, space: Any, num_envs: int, actions: Any, horizon: Any) -> Candidates:
        """Check the actions of a caller.

        Raises:
            ConfigError: If there are no candidates, the shape does not fit, or an action is not
                possible.
        """
        if callable(actions):
            steps = check_count("the horizon, which a policy needs,", horizon)
            return cls(num_envs, steps, num_envs, actions)
        array = _checked_array(space, actions)
        if horizon not in (None, array.shape[1]):
            raise ConfigError(f"the actions have {array.shape[1]} steps, but horizon = {horizon}")
        return cls(len(array), array.shape[1], num_envs, array)

    def seen_in(self, columns: Columns) -> Columns:
        """Columns of the start of candidates: outputs with their offsets."""
        if self.offsets is None:
            return columns
        shifted = {}
        for name in ("outputs", "previous_state"):
            rows = np.asarray(columns[name], np.float64)
            shifted[name] = rows + self.offsets[: rows.shape[1]]
        return {**columns, **shifted}

    def actions(self, places: npt.NDArray[np.int64]) -> npt.NDArray[Any] | None:
        """The actions of a round, shape (horizon, N, ...); None for a policy."""
        if callable(self._given):
            return None
        array: npt.NDArray[Any] = self._given
        if len(places) != self.count:
            array = array[places]
        return np.ascontiguousarray(np.swapaxes(array, 0, 1))

    def act(self, actions: npt.NDArray[Any] | None) -> Callable[[int, Any], Any]:
        """The function that chooses the actions of a step."""
        policy = self._given
        if actions is None:
            return lambda step, observations: policy(observations)
        return lambda step, observations: actions[step]


def tunable_values(env: FMUEnv, parameters: Any, count: int) -> dict[str, npt.NDArray[np.float64]]:
    """Check the parameters of candidates.

    Args:
        env: Its FMU has the parameters.
        parameters: By name an array of shape (n,), of an array of shape (n, ...), or one number for
            all; None for none.
        count: n.

    Returns:
        Arrays of shape (n,) by name.

    Raises:
        ConfigError: If a parameter is unknown or cannot be set between two steps, or its values do
            not fit.
    """
    given = {} if parameters is None else check_mapping("'parameters'", parameters)
    found: dict[Variable, npt.NDArray[np.float64]] = {}
    for name, values in given.items():
        variables = env.fmu.description.scalars(name)
        for variable, own in zip(variables, _spread(name, values, variables, count), strict=True):
            _require_tunable(variable)
            found[variable] = np.array([checked_value(variable, value) for value in own])
    missing = unlisted(list(found))
    if missing:
        raise ConfigError(
            f"there are no values of {missing[0].name!r}: FMI sets arrays as a whole, so the "
            "candidates need values of all elements"
        )
    return {variable.name: values for variable, values in found.items()}


def tables_of(env: FMUEnv, data: Any) -> dict[str, FloatArray]:
    """Check data that candidates assume.

    Args:
        env: Its task has the data.
        data: Times and values by name; None for none.

    Raises:
        ConfigError: If there is no such data, or the rows make no function of time.
    """
    given = {} if data is None else check_mapping("'data'", data)
    future = future_of(env)
    lookups = {} if future is None else future.lookups
    given = by_own_names("'data'", given, Spellings("data that hooks read", lookups).require)
    return {name: lookups[name].table_of(name, rows) for name, rows in given.items()}


def offsets_of(env: FMUEnv, offsets: Any) -> FloatArray | None:
    """Check offsets of outputs.

    Args:
        env: The FMU's outputs are its own.
        offsets: Numbers by the names of outputs and monitored variables, in the FMU's units; None
            for none.

    Returns:
        Numbers of shape (k,); None for none.

    Raises:
        ConfigError: If an output is unknown, or an offset no finite number.
    """
    given = {} if offsets is None else check_mapping("'offsets'", offsets)
    names = list(env.out)
    given = by_own_names("'offsets'", given, Spellings("output in offsets", names).require)
    for name, value in given.items():
        check_number(f"the offset of {name!r}", value)
    return np.array([given.get(name, 0.0) for name in names]) if given else None


def keys_of(env: FMUEnv, seed: Any) -> dict[str, float]:
    """Draw the noise keys that the candidates of a rollout share.

    Args:
        env: The prototype.
        seed: Seed of the noise. All candidates get the same noise, so that luck does not rank them.
            With None, they go on with the noise of their snapshot.

    Raises:
        ConfigError: If the seed is none.
    """
    first, future = check_seed(seed), future_of(env)
    if first is None or future is None:
        return {}
    stream = np.random.default_rng(first)
    return {name: env.config.variable_starts[name].sample(stream) for name in future.keys}


def _require_tunable(variable: Variable) -> None:
    if (variable.causality, variable.variability) != ("parameter", "tunable"):
        raise ConfigError(
            f"{variable.name!r} is a {variable.variability} {variable.causality}: an FMU lets only "
            "tunable parameters be set between two steps. Let the candidates begin with "
            "episodes of their own, whose resets have drawn it"
        )


def _spread(name: str, values: Any, variables: Sequence[Variable], count: int) -> list[Any]:
    """The values of each scalar that a name stands for, count of each."""
    if np.ndim(values) == 0:
        return [[values] * count] * len(variables)
    if len(values) != count:
        raise ConfigError(f"there are {len(values)} values of {name!r}, expected {count}")
    if len(variables) == 1:
        return [np.reshape(values, -1).tolist() if np.ndim(values) > 1 else values]
    array = np.asarray(values)
    if array.size != count * len(variables):
        raise ConfigError(
            f"the values of {name!r} have the shape {array.shape}, expected ({count}, ...) with "
            f"{len(variables)} elements"
        )
    return list(array.reshape(count, -1).T)


def _checked_array(space: Any, actions: Any) -> npt.NDArray[Any]:
    """The actions as an array of shape (n, horizon, ...) and of the type of the space."""
    if not is_array_space(space):
        raise ConfigError(f"the actions of {space} make no array; give rollout a policy instead")
    array = actions if type(actions) is np.ndarray else array_of(actions)
    if array.ndim < 2 or array.shape[2:] != space.shape or not array.size:
        raise ConfigError(
            f"the actions have shape {array.shape}, expected (n, horizon"
            f"{''.join(f', {length}' for length in space.shape)}) with at least one of each"
        )
    count = array.shape[0] * array.shape[1]
    try:
        checked = checked_actions(space, count, array.reshape(count, *space.shape))
    except ConfigError as error:
        raise _in_words_of_candidates(error, space, array) from None
    with np.errstate(over="ignore"):  # the action becomes infinite, and so does an input
        return checked.astype(space.dtype, copy=False).reshape(array.shape)


def _in_words_of_candidates(error: ConfigError, space: Any, array: npt.NDArray[Any]) -> ConfigError:
    for index, candidate in enumerate(array):
        try:
            checked_actions(space, len(candidate), candidate)
        except ConfigError as own:
            return ConfigError(f"candidate {index}: {own}".replace("environment", "step"))
    return error


class _Steps(NamedTuple):
    observations: Any
    rewards: FloatArray
    terminated: MaskArray
    truncated: MaskArray
    lengths: npt.NDArray[np.int64]


class Rollout(_Steps):
    """Results of n candidates in up to ``horizon`` steps.

    It is a tuple of the first five attributes.

    After the end of a candidate's episode its last observation is repeated, its rewards are 0, and
    the flags are False.

    Attributes:
        observations: After each step, shape (n, horizon, ...), or a dict or tuple of such arrays.
        rewards: Shape (n, horizon), float64.
        terminated: Whether the step has ended the episode, shape (n, horizon).
        truncated: Whether the step has cut it short, shape (n, horizon).
        lengths: The steps that each candidate has done, shape (n,).
        costs: The numbers that infos tell as ``"costs"``, by name, each of shape (n, horizon); 0
            after the end.
        has_failed: Whether a fault has ended the episode, shape (n,).
    """

    costs: Mapping[str, FloatArray] = MappingProxyType({})
    has_failed: MaskArray

    @classmethod
    def of(
        cls,
        observations: Any,
        rewards: FloatArray,
        terminated: MaskArray,
        truncated: MaskArray,
        costs: Mapping[str, FloatArray],
        has_failed: MaskArray,
    ) -> Rollout:
        """Make it of arrays with steps on the first axis."""
        ends = terminated | truncated
        horizon = len(rewards)
        first = ends.argmax(axis=0) + 1 if horizon else np.zeros(rewards.shape[1], np.int64)
        lengths = np.where(ends.any(axis=0), first, horizon)
        turned = mapped(lambda array: np.swapaxes(array, 0, 1), observations)
        found = cls(turned, rewards.T, terminated.T, truncated.T, lengths)
        if costs:
            runs = np.arange(horizon)[:, np.newaxis] < lengths
            found.costs = {name: np.where(runs, paid, 0.0).T for name, paid in costs.items()}
        found.has_failed = has_failed
        return found


def costs_in(infos: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, FloatArray]:
    """The costs that infos of environments tell, by name.

    Args:
        infos: Those of a step.
        shape: That of the rewards. What a class tells as ``"costs"`` in another shape, or as no
            numbers, is its own affair.
    """
    told = infos.get("costs")
    return {
        name: paid
        for name, paid in (told.items() if isinstance(told, dict) else ())
        if not str(name).startswith("_")  # which says whose costs are told
        and isinstance(paid, np.ndarray)
        and paid.shape == shape
        and paid.dtype.kind in "biuf"
    }


def joined_rollouts(parts: Sequence[Rollout], count: int) -> Rollout:
    """Put rollouts together, and keep the first candidates."""
    if len(parts) == 1 and len(parts[0].rewards) == count:
        return parts[0]
    joined = Rollout._make(
        mapped(lambda *arrays: np.concatenate(arrays)[:count], *part)
        for part in zip(*parts, strict=True)
    )
    joined.costs = {
        name: np.concatenate([one.costs.get(name, 0.0 * one.rewards) for one in parts])[:count]
        for name in dict.fromkeys(name for one in parts for name in one.costs)
    }
    joined.has_failed = np.concatenate([one.has_failed for one in parts])[:count]
    return joined


def start_of_rollout(
    episodes: Episodes, snapshot: Snapshot | None, present: Snapshot | None, count: int
) -> Snapshot:
    """Start of candidates: the snapshot that was given, or else the present episodes.

    Raises:
        ConfigError: If the snapshot does not fit, or not so many candidates.
        SimulationError: If there is none, or an episode in it has ended.
    """
    if snapshot is None and present is None:
        raise SimulationError("rollout without a snapshot was called before the first reset")
    start = checked_snapshot(present if snapshot is None else snapshot)
    if len(start) not in ((count,) if snapshot is None else (1, count)):
        raise ConfigError(
            f"there are {count} candidates, but {len(start)} episodes where they may begin"
        )
    columns = episodes.columns_of(start)
    episodes.require_fit(columns)
    if np.any(columns["ended"]):
        raise SimulationError("an episode where candidates begin has ended: reset it first")
    return start


@contextmanager
def returning_to(episodes: Episodes, present: Snapshot | None) -> Iterator[None]:
    """Return to the present episodes afterwards, or to none."""
    try:
        yield
    finally:
        episodes.is_ready = False
        if present is not None:
            episodes.go_on_from(present, episodes.everywhere)
            episodes.let_step()


def roll_out(task: VectorTask, start: Snapshot, candidates: Candidates) -> Rollout:
    """Let the environments play all candidates, as many at a time as there are environments.

    Args:
        task: That of the environments.
        start: Where the candidates begin, see ``start_of_rollout``.
        candidates: The candidates.
    """
    with task.assuming(candidates.tables, candidates.offsets):
        parts = [_play(task, start, places, candidates) for places in candidates.rounds]
    return joined_rollouts(parts, candidates.count)


def _play(task: VectorTask, start: Snapshot, places: IndexArray, candidates: Candidates) -> Rollout:
    """Let each environment play the candidate at its place, until all of these have ended."""
    actions, episodes = candidates.actions(places), task.episodes
    _begin(episodes, start, places, candidates)
    observations = None if actions is not None else task.observe(episodes.everywhere)
    act = candidates.act(actions)
    arrays = _Arrays(candidates.horizon, len(places))
    for step in range(candidates.horizon):
        resting = episodes.ended.copy() if episodes.any_ended else None
        if resting is not None and resting.all():
            arrays.repeat_last(step)
            break
        chosen = act(step, observations)
        if resting is None:
            result = task.step(chosen)
        else:
            result = _without(task.step_around(chosen, resting), observations, resting)
        arrays.keep(step, result, resting)
        observations = result[0]
    return arrays.rollout()


def _begin(episodes: Episodes, start: Snapshot, places: IndexArray, candidates: Candidates) -> None:
    """Bring all environments to the places where candidates begin."""
    sources = places if len(start) > 1 else np.zeros_like(places)
    episodes.restore(start.bundle, sources, episodes.everywhere)
    columns = candidates.seen_in(episodes.columns_of(start))
    episodes.place(columns, sources, episodes.everywhere)
    values = {name: column[places] for name, column in candidates.parameters.items()}
    if values:
        variables = tuple(map(episodes.prototype.fmu.variable, values))
        episodes.pool.write(variables, np.stack(list(values.values())))
    episodes.show(candidates.variables, values)


class _Arrays:
    """Results of a rollout, in arrays with the steps on the first axis.

    Args:
        horizon: The number of steps.
        count: N.
    """

    def __init__(self, horizon: int, count: int) -> None:
        self._horizon = horizon
        self._observations: Any = None
        self._rewards = np.zeros((horizon, count))
        self._terminated, self._truncated = np.zeros((2, horizon, count), np.bool_)
        self._costs: dict[str, FloatArray] = {}
        self._has_failed = np.zeros(count, np.bool_)

    def keep(self, step: int, result: StepResult, resting: MaskArray | None) -> None:
        """Keep the result of a step."""
        observed, rewards, terminated, truncated, infos = result
        if step == 0:
            self._observations = mapped(self._room_for, observed)
        if type(observed) is np.ndarray:  # no tree to search through
            self._observations[step] = observed
        else:
            mapped(partial(_put, step), self._observations, observed)
        self._rewards[step] = rewards
        self._terminated[step] = terminated
        self._truncated[step] = truncated
        if infos:
            self._keep_infos(step, infos, resting)

    def _keep_infos(self, step: int, infos: Mapping[str, Any], resting: MaskArray | None) -> None:
        for name, paid in costs_in(infos, self._has_failed.shape).items():
            if name not in self._costs:
                self._costs[name] = np.zeros_like(self._rewards)
            self._costs[name][step] = paid
        if "_fault" in infos:
            self._has_failed |= infos["_fault"] if resting is None else infos["_fault"] & ~resting

    def _room_for(self, part: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.empty((self._horizon, *part.shape), part.dtype)

    def repeat_last(self, step: int) -> None:
        """Let nothing happen from a step on."""
        mapped(lambda rows: _put(slice(step, None), rows, rows[step - 1]), self._observations)

    def rollout(self) -> Rollout:
        """The rollout of these steps."""
        judged = self._rewards, self._terminated, self._truncated
        return Rollout.of(self._observations, *judged, self._costs, self._has_failed)


def _put(step: int | slice, rows: npt.NDArray[Any], part: npt.NDArray[Any]) -> None:
    rows[step] = part


def _without(result: StepResult, before: Any, over: MaskArray) -> StepResult:
    """Leave out the environments whose candidates have ended earlier."""
    observations, rewards, terminated, truncated, _ = result
    copy_rows(before, observations, over)
    rewards[over] = 0.0
    terminated[over] = truncated[over] = False
    return result
