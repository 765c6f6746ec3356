"""Saved episode of a single environment, as columns of a snapshot."""

from __future__ import annotations

import copy
import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from fmugym.environment.construction import Constructed
from fmugym.environment.snapshots import Columns, Scope, SnapshotColumn, changed, plain_attributes
from fmugym.errors import ConfigError, SimulationError
from fmugym.expressions.quantities import KEPT, EpisodeQuantity
from fmugym.pool import Pool
from fmugym.pool.c_extension import needs_engine

__all__ = [
    "READ",
    "columns_of",
    "generator_of",
    "note_attributes",
    "place_columns",
    "read_columns",
    "require_quantities",
    "require_saving",
    "row_of",
    "scope_of",
    "state_of",
]

_WORD: Final = 2**64

_OPERATION: Final = {"on_fault", "fault_retries", "fault_reward", "isolation", "foreign"}
"""Config keys on which no state depends."""

READ: Final = tuple(one.attribute for one in KEPT)
"""The quantities but for mappings."""


def require_saving(pool: Pool) -> None:
    """Refuse to restore anything in a real system, whose episode goes on.

    Raises:
        SimulationError: If the pool has no states.
    """
    if pool.save_method is None:
        if pool.is_real:
            raise SimulationError("a real system has no states that could be restored")
        raise SimulationError(needs_engine("a saved state"))


def columns_of(env: Constructed) -> Columns:
    """Copy the quantities and the random stream of the episode, without the FMU's state.

    Returns:
        Columns of one environment.

    Raises:
        ConfigError: If it has assigned to attributes of its own.
    """
    require_quantities(env)
    streams, seeds = _stream_of(env)
    return read_columns(env, lambda value: [copy.deepcopy(value)]) | {
        "ended": np.array([env._ended]),
        "streams": streams,
        "seeds": seeds,
        "pictured": [env._pictured],
    }


def require_quantities(env: Constructed) -> None:
    """Refuse to save an episode of which attributes of the class hold a part.

    Raises:
        ConfigError: If such an attribute has changed since hooks are called.
    """
    own = plain_attributes(vars(env), env._own_names)
    for name in changed(own, env._as_constructed):
        raise ConfigError(
            f"the attribute {name!r} of {type(env).__name__} has changed since the first reset, "
            "and no snapshot holds it: keep it under 'episode_variables', which _update may write"
        )


def note_attributes(env: Constructed) -> None:
    """Take the attributes of the class for those that it was made with."""
    env._as_constructed = plain_attributes(vars(env), env._own_names)


def read_columns(env: Constructed, column: Callable[[Any], SnapshotColumn]) -> Columns:
    """Copy the quantities of one episode or of several.

    Args:
        env: The environment, or the prototype of several.
        column: Copies a value, or those of several environments.
    """
    columns: Columns = {name: column(getattr(env._episode, name)) for name in READ}
    groups = {"parameters": env.parameters, "variables": env.variables}
    for kind, values in groups.items():
        columns[kind] = {name: column(value) for name, value in values.items()}
    return columns


def _stream_of(env: Constructed) -> tuple[Any, list[Any]]:
    """The random stream and its seed; None if there is none yet."""
    generator = env._np_random
    if generator is None:
        return [None], [None]
    state = generator.bit_generator.state
    seed = None if env._np_random_seed == -1 else env._np_random_seed
    if state["bit_generator"] != "PCG64":
        return [copy.deepcopy(state)], [seed]
    return np.array([row_of(state)], np.uint64), [seed]


def place_columns(env: Constructed, columns: Columns, place: int) -> None:
    """Let an environment go on from the columns, except for the FMU's state."""
    read = env._episode
    for one in KEPT:
        setattr(read, one.attribute, _kept_value(one, columns[one.attribute], place))
    read.state = read.outputs[: read.width]
    parameters = {name: _native_value(c, place) for name, c in columns["parameters"].items()}
    read.parameters = MappingProxyType({n: v for n, v in parameters.items() if v is not None})
    read.variables.update(
        {name: _native_value(column, place) for name, column in columns["variables"].items()}
    )
    pictured = columns["pictured"]
    env._pictured = (None, 0.0) if pictured is None else pictured[place]
    _place_stream(env, columns, place)
    env._was_reset, env._ended = True, bool(columns["ended"][place])


def _kept_value(quantity: EpisodeQuantity, column: Any, place: int) -> Any:
    """One value of the column of a quantity, as the hooks of a single environment read it."""
    if quantity.shape == "action":
        return _native_value(column, place)
    numbers = np.asarray(column[place], quantity.dtype).tolist()
    return tuple(numbers) if isinstance(numbers, list) else numbers


def _native_value(column: Any, place: int) -> Any:
    """One value of a column as the hooks of a single environment read it."""
    value = column[place]
    if isinstance(column, list):
        return copy.deepcopy(value)
    if column.dtype == object:
        return value
    if isinstance(value, np.ndarray):
        return value.copy()
    return value.item() if value.dtype.kind == "f" else value


def _place_stream(env: Constructed, columns: Columns, place: int) -> None:
    stream = columns["streams"][place]
    if stream is None:
        env._np_random, env._np_random_seed = None, None
        return
    state = stream if isinstance(stream, dict) else state_of([int(word) for word in stream])
    seed = columns["seeds"][place]
    env._np_random, env._np_random_seed = generator_of(state), -1 if seed is None else seed


def generator_of(state: Any) -> np.random.Generator:
    """A generator in a state, as its bit generator has told it.

    Raises:
        ConfigError: If numpy has no such bit generator.
    """
    bits = getattr(np.random, state["bit_generator"], None)
    if bits is None:
        raise ConfigError(f"there is no random generator {state['bit_generator']!r}")
    generator = np.random.Generator(bits())
    generator.bit_generator.state = state
    return generator


def row_of(state: Any) -> list[int]:
    """The state of a ``numpy.random.PCG64`` as six integers of 64 bits.

    They are state and increment (the higher half first), whether a half of a number is left over,
    and that half.
    """
    inner = state["state"]
    numbers = [*divmod(inner["state"], _WORD), *divmod(inner["inc"], _WORD)]
    return [*numbers, state["has_uint32"], state["uinteger"]]


def state_of(row: list[int]) -> dict[str, Any]:
    """The state of a ``numpy.random.PCG64`` from such a row."""
    high, low, increment_high, increment_low, has_half, half = row
    numbers = {"state": high * _WORD + low, "inc": increment_high * _WORD + increment_low}
    return {"bit_generator": "PCG64", "state": numbers, "has_uint32": has_half, "uinteger": half}


def scope_of(env: Constructed) -> Scope:
    """Scope of the snapshots of an environment."""
    if env._scope is None:
        env._scope = _find_scope(env)
    return env._scope


def _find_scope(env: Constructed) -> Scope:
    config, fmu = env.config, env.fmu.description
    scope = {
        "FMU": f"{fmu.model_name} of FMI {fmu.fmi_version} (SHA-256 {env.fmu.content})",
        "action space": str(env.action_space),
    }
    names = [f.name for f in fields(config) if f.name not in _OPERATION]
    return scope | {f"config key {name!r}": _text(getattr(config, name)) for name in names}


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key!r}: {_text(part)}' for key, part in value.items())}}}"
    if isinstance(value, np.ndarray) and value.dtype == np.object_:
        return f"array of shape {value.shape}: {', '.join(map(_text, value.flat))}"
    if isinstance(value, np.ndarray):
        digest = hashlib.sha256(value.tobytes()).hexdigest()[:16]
        return f"array of {value.dtype}, shape {value.shape}, content {digest}"
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))
