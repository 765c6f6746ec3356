"""Check of hooks: equality of their results on arrays and one by one.

``if abs(x) > 2.4`` raises on arrays, but ``np.any`` and ``norm`` without an axis silently give one
answer for all environments, and a transposed observation has the right shape if there are as many
environments as elements. So each hook is called both ways on the states of episodes, for several
numbers of environments.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
from gymnasium import spaces

from fmugym.environment.actions import flat_inputs
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import Episode, standing_in
from fmugym.environment.hook_results import as_flag, as_info, as_reward
from fmugym.environment.hooks import ORDER, Hooks
from fmugym.environment.snapshots import changed, plain_attributes, put_back
from fmugym.environment.value_mappings import EpisodeVariables, ParameterValues
from fmugym.environment.vector import array_results
from fmugym.environment.vector.infos import mapped
from fmugym.environment.vector.quantity_arrays import EpisodeColumn, batched
from fmugym.errors import FMUGymError, shown
from fmugym.expressions.quantities import KEPT
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray

__all__ = ["CURE", "find_difference", "own_hooks"]

CURE: Final = (
    "Write hooks element-wise: & and | for 'and' and 'or', numpy.where for 'if', no reduction over "
    "all values"
)
"""The advice that follows a difference."""

_STEPS, _EPISODES = 200, 8
"""The length of an episode, and how many there are at most."""

_MOST_ROWS, _ROWS_AT_LIMITS = 480, 24
"""Of all episodes, and how many of these are taken to limits."""

_MOST_BATCHES: Final = 24
"""Of one number of environments."""

_FACTORS: Final = (-0.3, 10.0, 300.0, 1e5, -1e5)
"""Of outputs, beside limits: other magnitudes than those that episodes reach."""

_READ_ONLY: Final = tuple(one.attribute for one in KEPT)

_WRITING: Final = ("_get_inputs", "_update")
"""The hooks that may write episode variables."""

_AT_STARTS: Final = ("_get_observation", "_get_info")
"""The hooks whose results count where an episode has just started."""

_TOLERANCE: Final = 1e-6
"""numpy's results on arrays may differ from those on scalars in the last bit of a float32."""

_Kind = Literal["step", "start", "failed", "limit"]


@dataclass(frozen=True)
class _Row:
    """Row of a check: the quantities of one environment, of a kind.

    Attributes:
        kind: ``"step"``; ``"start"`` if an episode has just begun; ``"failed"`` if the FMU has not
            done the step, so that nothing counts that hooks return; ``"limit"``, where they may
            fail, too.
        episode: What ``_is_done`` and the hooks after it read.
        before: The episode variables before ``_update``.
        done: What ``_is_done`` has returned.
    """

    kind: _Kind
    episode: Episode
    before: dict[str, Any]
    done: bool


def find_difference(env: FMUEnv) -> str | None:
    """Find a hook that gives something else on arrays than one environment at a time.

    Args:
        env: An environment that makes arrays, with a pool of its own; it plays episodes.

    Returns:
        The hook and what is wrong with it, or None.
    """
    hooks = own_hooks(env)
    if not hooks:
        return None
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rng = np.random.default_rng(0)
        rows = list(_rows(env, rng))
        _spread_variables(rows)
        limits = list(_at_limits(env, [one for one in rows if one.kind == "step"], rng))
        for name in hooks:
            try:
                for count in _counts(env):
                    for batch in (*_batches(rows, count), *_batches(limits, count)):
                        _Comparison(env, name, batch).require_same()
            except _DifferenceError as difference:
                return f"{name} {difference}"
    return None


def own_hooks(env: FMUEnv) -> list[str]:
    """The hooks of a step that classes override."""
    return [name for name in ORDER if _is_own(env, name)]


def _is_own(env: FMUEnv, name: str) -> bool:
    """Whether a hook is neither a default nor an expression."""
    if name == "_reward_policy" and env._own_hooks.goal_reward:
        return True
    return name not in vars(env) and getattr(type(env), name) is not getattr(Hooks, name)


# The states


def _rows(env: FMUEnv, rng: np.random.Generator) -> Iterator[_Row]:
    """Play episodes with actions inside of their range and at its ends."""
    if env._instance.pool.is_real:
        yield from _drawn_rows(env, rng)  # nothing real must move
        return
    rows: list[_Row] = []
    for number in range(_EPISODES):
        rows += _episode(env, rng, at_ends=number % 2 == 1)
        if len(rows) > _MOST_ROWS:
            break
    yield from rows


def _episode(env: FMUEnv, rng: np.random.Generator, *, at_ends: bool) -> list[_Row]:
    env.reset(seed=int(rng.integers(2**31)))
    rows, variables = [_row_of(env, "start", dict(env.variables))], dict(env.variables)
    for _ in range(_STEPS):
        action = _sample_of(env.action_space, rng)
        try:
            *_, terminated, truncated, info = env.step(_at_end(env.action_space, action, at_ends))
        except FMUGymError:
            break  # a fault, or an action that makes no input
        if "fault" in info:
            break
        rows.append(_row_of(env, "step", variables))
        variables = dict(env.variables)
        if terminated or truncated:
            break
    return rows


def _at_end(space: Any, action: Any, at_ends: bool) -> Any:
    """The nearest end of the range of an action."""
    if not at_ends or not isinstance(space, spaces.Box) or not space.is_bounded():
        return action
    nearer = np.asarray(action, np.float64) * 2 > np.asarray(space.high, np.float64) + space.low
    return np.where(nearer, space.high, space.low).astype(space.dtype)


def _row_of(env: FMUEnv, kind: _Kind, before: Mapping[str, Any]) -> _Row:
    now = env._episode.copy()
    parameters = MappingProxyType(ParameterValues(now.parameters))
    variables = _variables(now.variables)
    kept = now.replaced(parameters=parameters, variables=variables)
    for one in KEPT:
        if one.shape == "action":
            setattr(kept, one.attribute, np.array(getattr(now, one.attribute)))
    return _Row(kind, kept, dict(before), bool(now.done))


def _variables(values: Mapping[str, Any]) -> EpisodeVariables:
    variables = EpisodeVariables(values)
    variables.update({name: np.copy(one) if np.ndim(one) else one for name, one in values.items()})
    return variables


def _spread_variables(rows: Sequence[_Row]) -> None:
    """Give each variable the shape that it has in later steps everywhere."""
    for name in rows[0].episode.variables:
        held = [part for row in rows for part in (row.episode.variables, row.before)]
        shape = np.broadcast_shapes(*(np.shape(part[name]) for part in held))
        for part in held if shape else ():
            part[name] = np.array(np.broadcast_to(part[name], shape))


def _drawn_rows(env: FMUEnv, rng: np.random.Generator) -> Iterator[_Row]:
    """States around zero, of episodes that nobody has played."""
    for index in range(_STEPS // 4):
        episode, now = env.episode_start.draw(rng), env._episode.copy()
        variables = _variables(now.variables | episode.variables)
        drawn = {
            one.attribute: np.array(_sample_of(env.action_space, rng))
            if one.shape == "action"
            else tuple(rng.normal(size=len(getattr(now, one.attribute))).tolist())
            for one in KEPT
            if one.shape != "number"
        }
        kept = now.replaced(
            **drawn,
            step_count=index,
            parameters=MappingProxyType(ParameterValues(episode.parameters)),
            variables=variables,
        )
        yield _Row("step", kept, dict(variables), bool(rng.integers(2)))


def _at_limits(env: FMUEnv, rows: Sequence[_Row], rng: np.random.Generator) -> Iterator[_Row]:
    """Rows whose outputs are at the ends of their ranges, or of another magnitude."""
    variables = env.interface.outputs + env.interface.monitors
    lows, highs = (np.array(one, np.float64) for one in zip(*map(_ends_of, variables), strict=True))
    for row in rows[:: 1 + len(rows) // _ROWS_AT_LIMITS]:
        values = np.array(row.episode.outputs)
        places = [np.where(np.isfinite(ends), ends, values) for ends in (lows, highs)]
        places += [values * factor * rng.uniform(0.5, 1.5, len(values)) for factor in _FACTORS]
        for place in places:
            before = place[: env.interface.output_count] * rng.uniform(0.9, 1.0)
            moved = row.episode.replaced(
                outputs=tuple(place.tolist()), previous_state=tuple(before.tolist())
            )
            yield _Row("limit", moved, row.before, bool(rng.integers(2)))


def _ends_of(variable: Variable) -> tuple[float, float]:
    return variable.minimum, variable.maximum


def _sample_of(space: spaces.Space[Any], rng: np.random.Generator) -> Any:
    """Sample without touching the space's own generator."""
    own, space._np_random = space._np_random, rng
    try:
        return space.sample()
    finally:
        space._np_random = own


# Batches of them


def _counts(env: FMUEnv) -> tuple[int, ...]:
    """Numbers of environments: one that no length of the task equals, one that does, and 1."""
    arrays = spaces.flatten_space(env.observation_space).shape or (1,)
    lengths = {*arrays, *np.shape(env._conversions.no_action), env.interface.output_count}
    lengths |= {len(env.interface.start_inputs), len(env._episode.outputs)}
    for part in _boxes(env.observation_space):
        lengths |= set(part.shape)
    for value in env.variables.values():
        lengths |= set(np.shape(value))
    other = next(n for n in range(23, 10_000) if n not in lengths)
    width = next((part.shape[-1] for part in _boxes(env.observation_space) if part.shape), 1)
    return (other, width, 1) if 1 < width <= _MOST_ROWS else (other, 1)


def _boxes(space: spaces.Space[Any]) -> Iterator[Any]:
    """The parts of a space that are arrays."""
    if isinstance(space, spaces.Dict):
        for part in space.values():
            yield from _boxes(part)
    elif space.shape is not None:
        yield space


def _batches(rows: Sequence[_Row], count: int) -> Iterator[list[_Row]]:
    """Divide rows of all kinds into batches of so many, of which there are not too many."""
    mixed = np.random.default_rng(1).permutation(len(rows)).tolist()
    starts = range(0, len(mixed), max(count, 1 + len(mixed) // _MOST_BATCHES))
    for start in starts:
        chosen = [rows[i] for i in (mixed[start:] + mixed)[:count]]
        while len(chosen) < count:
            chosen += chosen[: count - len(chosen)]
        if count > 4 and chosen[1].kind == "step":
            chosen[1] = replace(chosen[1], kind="failed")
        yield chosen


def _batch_of(env: FMUEnv, rows: Sequence[_Row], name: str) -> Episode:
    """Quantities of some environments in arrays, as a hook reads them."""
    batch = batched(env, len(rows))
    states = [_moment(env, row, name) for row in rows]
    for index, one in enumerate(states):
        for quantity in _READ_ONLY:
            getattr(batch, quantity)[..., index] = getattr(one, quantity)
    for variable in batch.variables:
        values = np.array([one.variables[variable] for one in states])
        batch.variables[variable] = np.moveaxis(values, 0, -1).copy()
    names = states[0].parameters
    batch.parameters = MappingProxyType(
        ParameterValues((n, _array_of([one.parameters[n] for one in states])) for n in names)
    )
    return batch


def _array_of(values: list[Any]) -> Any:
    return np.array(values, object if isinstance(values[0], str) else None)


def _moment(env: FMUEnv, row: _Row, name: str) -> Episode:
    """Quantities of one environment, as a hook reads them: the first hooks know fewer."""
    now = row.episode
    if name not in _WRITING:
        return now.replaced(done=row.done and name != "_is_done")
    variables = _variables(row.before)
    if name == "_update":
        return now.replaced(variables=variables, done=False)
    values = (*now.previous_state, *now.outputs[env.interface.output_count :])
    return now.replaced(variables=variables, outputs=values, done=False)


# The comparison


class _DifferenceError(Exception):
    """Error of a hook, in words."""


class _FailureError(Exception):
    """Exception of a hook, in words."""


@dataclass
class _Comparison:
    """Compares a hook on arrays with the same hook one environment at a time.

    Attributes:
        env: Whose hook is called.
        name: The hook.
        rows: What it reads.
    """

    env: FMUEnv
    name: str
    rows: Sequence[_Row]

    def require_same(self) -> None:
        """Raise a ``_DifferenceError`` if the results differ, or the hook changes something."""
        batch = _batch_of(self.env, self.rows, self.name)
        alone = self._alone(batch)
        failing = [i for i, row in enumerate(self.rows) if row.kind == "limit" and i not in alone]
        if failing:  # as they do on arrays, rightly
            kept = [row for i, row in enumerate(self.rows) if i not in failing]
            if kept:
                replace(self, rows=(kept * len(self.rows))[: len(self.rows)]).require_same()
            return
        first, second = self._together(batch), self._together(batch)
        for index, row in enumerate(self.rows):
            if self._counts(row):
                self._compare(row, alone[index], *(_part(one, index) for one in (first, second)))

    @property
    def _where(self) -> str:
        count = len(self.rows)
        return f"on the arrays of {count} environment{'s' if count > 1 else ''}"

    def _alone(self, batch: Episode) -> dict[int, Any]:
        """The results one environment at a time, as far as there are any."""
        found: dict[int, Any] = {}
        for index, row in enumerate(self.rows):
            try:
                found[index] = self._called(EpisodeColumn(batch, index).copy(), self._of_one)
            except _FailureError as failure:
                if row.kind != "limit" and self._counts(row):
                    raise _DifferenceError(f"fails for one environment: {failure}") from None
        return found

    def _together(self, batch: Episode) -> Any:
        try:
            return self._called(batch.mapped(lambda values: np.array(values)), self._of_many)
        except _FailureError as failure:
            raise _DifferenceError(f"fails {self._where}: {failure}") from None

    def _compare(self, row: _Row, alone: Any, first: Any, second: Any) -> None:
        if not _same(first, second):
            raise _DifferenceError(f"gives other values {self._where} when it is called again")
        if not _same(alone, first):
            raise _DifferenceError(
                f"gives {shown(first)} {self._where} {_WHICH[row.kind]}, where it gives "
                f"{shown(alone)} for that environment alone"
            )

    def _counts(self, row: _Row) -> bool:
        """Whether the result of a row is ever used."""
        if row.kind == "start":
            return self.name in _AT_STARTS
        return row.kind != "failed"

    def _called(self, episode: Episode, of: Callable[[Any], Any]) -> Any:
        """Call the hook; return its result, unless it has changed other values than it may.

        Raises:
            _DifferenceError: If it has changed something else.
            _FailureError: If the hook fails, or returns what cannot be used.
        """
        env = self.env
        before, attributes = _values_in(episode, self.name), dict(vars(env))
        plain = plain_attributes(attributes, env._own_names)
        try:
            with standing_in(env, episode):
                value = of(getattr(env, self.name)())
                after = _values_in(env._episode.copy(), self.name)
            _require_unchanged(before, after)
            _require_attributes(env, attributes, plain)
            return value
        except _DifferenceError:
            raise
        except FMUGymError as error:
            raise _FailureError(str(error)) from error
        except Exception as error:  # hooks may raise anything
            raise _FailureError(f"{type(error).__name__}: {error}") from error
        finally:
            put_back(env, attributes)

    # The results

    def _of_one(self, value: Any) -> Any:
        """The result in one environment."""
        match self.name:
            case "_get_inputs":
                return flat_inputs(value, self.env.interface.inputs, shown)
            case "_update":
                return {name: np.asarray(one) for name, one in self.env.variables.items()}
            case "_is_done" | "_is_truncated":
                return as_flag(self.name, value)
            case "_reward_policy":
                return as_reward(value)
            case "_get_info":
                return as_info(value)
        return mapped(np.asarray, value)

    def _of_many(self, value: Any) -> Any:
        """The results in all environments, which come first in arrays."""
        env, count = self.env, len(self.rows)
        match self.name:
            case "_get_inputs":
                inputs = np.empty((len(env.interface.start_inputs), count))
                array_results.write_inputs(value, inputs)
                return inputs.T
            case "_update":
                return {
                    name: np.moveaxis(array_results.variable(name, one, count), -1, 0)
                    for name, one in env.variables.items()
                }
            case "_is_done" | "_is_truncated":
                return array_results.flags(self.name, value, count)
            case "_reward_policy":
                return array_results.rewards(value, count)
            case "_get_info":
                return array_results.info_arrays(value, np.ones(count, np.bool_))
        return array_results.observations(value, env.observation_space, count)


_WHICH: Final[Mapping[str, str]] = {
    "step": "for one of them",
    "start": "for one whose episode has just begun",
    "limit": "for one whose outputs are at a limit, or far from those of episodes",
}


def _require_unchanged(before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
    """Raise a ``_DifferenceError`` if a hook has changed a quantity that it reads."""
    for name, value in before.items():
        if name == "variables" and not _same(value, after[name]):
            raise _DifferenceError(
                "changes self.variables, which only _get_inputs and _update may do"
            )
        if not _same(value, after[name]):
            told = "state and self.out" if name == "outputs" else name
            raise _DifferenceError(f"changes the arrays in self.{told} in place")


def _require_attributes(env: FMUEnv, before: Mapping[str, Any], plain: Mapping[str, Any]) -> None:
    """Raise a ``_DifferenceError`` if a hook has kept something in an attribute."""
    now = vars(env)
    new = [name for name, value in now.items() if name not in before or before[name] is not value]
    new += changed(plain_attributes(now, env._own_names), plain)
    for name in new:
        if name not in env._own_names:
            raise _DifferenceError(f"changes self.{name}, which belongs in 'episode_variables'")


def _values_in(episode: Episode, hook: str) -> dict[str, Any]:
    """Copies of quantities that a hook must not change."""
    kept: dict[str, Any] = {name: np.copy(getattr(episode, name)) for name in _READ_ONLY}
    if hook not in _WRITING:
        kept["variables"] = {name: np.copy(one) for name, one in episode.variables.items()}
    return kept


def _part(results: Any, index: int) -> Any:
    """The results of one environment; the masks of infos are left out."""
    if isinstance(results, Mapping):
        return {
            name: _part(one, index)
            for name, one in results.items()
            if not (name.startswith("_") and name[1:] in results)
        }
    return results[index]


def _same(expected: Any, found: Any) -> bool:
    """Whether two results are equal, as far as rounding allows; NaNs are equal."""
    try:
        if isinstance(expected, Mapping):
            return expected.keys() == found.keys() and all(
                _same(expected[name], found[name]) for name in expected
            )
        return _equal(np.asarray(expected), np.asarray(found))
    except Exception:  # the results are the user's, and may be anything
        return False


def _equal(expected: FloatArray, found: FloatArray) -> bool:
    if expected.shape != found.shape and expected.size != found.size:
        return False
    if expected.dtype.kind not in "biufc" or found.dtype.kind not in "biufc":
        return bool(np.array_equal(expected, found))
    first, second = expected.ravel(), found.ravel()
    finite = np.abs(first[np.isfinite(first)])
    slack = _TOLERANCE * float(finite.max(initial=1e-3))
    return bool(np.allclose(second, first, rtol=_TOLERANCE, atol=slack, equal_nan=True))
