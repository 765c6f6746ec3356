"""Candidates of a rollout: their actions, and what they assume."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable, checked_value, unlisted
from fmugym.checks import (
    Spellings,
    by_own_names,
    check_count,
    check_mapping,
    check_number,
    check_seed,
)
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.pool.base import FloatArray
from fmugym.task.future import future_of
from fmugym.task.snapshot import Columns
from fmugym.vector.action_arrays import array_of, checked_actions, is_array_space

__all__ = ["Candidates", "keys_of", "offsets_of", "tables_of", "tunable_values"]


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
    """Draw the keys of the noise of later steps.

    Args:
        env: The prototype.
        seed: That of all candidates, which nobody's luck then tells apart; None if they go on with
            the random numbers of their snapshot.

    Raises:
        ConfigError: If it is no seed.
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
