"""What makes the episode of a single environment, as columns of a snapshot."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from fmugym.archive.texts import numbers_of
from fmugym.errors import ConfigError, SimulationError
from fmugym.pool import Pool
from fmugym.task.construction import Constructed
from fmugym.task.generators import row_of, state_of
from fmugym.task.plain import changed, plain_attributes
from fmugym.task.snapshot import Columns

__all__ = ["columns_of", "learn", "native_value", "place_columns", "require_saving"]


def require_saving(pool: Pool) -> None:
    """Refuse to restore anything in a real system, whose episode goes on.

    Raises:
        SimulationError: If the pool has no states.
    """
    if pool.save_method is None:
        what = "a real system" if pool.is_real else "an FMU that FMPy steps"
        raise SimulationError(f"{what} has no states that could be restored")


def columns_of(env: Constructed) -> Columns:
    """Copy what makes the episode, except for the FMU's state.

    Returns:
        Columns of one environment.
    """
    attributes = plain_attributes(vars(env), env._own_names)
    streams, seeds = _stream_of(env)
    return {
        "values": np.array([env._readings.values]),
        "previous_state": np.array([env.previous_state]),
        "inputs": np.array([env.inputs], np.float64),
        "action": [copy.deepcopy(env.action)],
        "previous_action": [copy.deepcopy(env.previous_action)],
        "step_count": np.array([env.step_count]),
        "done": np.array([env.done]),
        "after_end": np.array([env.after_end]),
        "ended": np.array([env._ended]),
        "parameters": {name: [value] for name, value in env.parameters.items()},
        "texts": {name: [env.out[name]] for name in env.out.strings},
        "variables": {name: [copy.deepcopy(v)] for name, v in env.variables.items()},
        "streams": streams,
        "seeds": seeds,
        "pictured": [(env._last_reward, env._return)],
        "attributes": [changed(attributes, env._as_constructed)],
    }


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
    learn(columns.get("texts", {}))
    read = env._readings
    read.values = tuple(np.asarray(columns["values"][place], np.float64).tolist())
    read.state = read.values[: env._output_count]
    read.previous_state = tuple(np.asarray(columns["previous_state"][place], np.float64).tolist())
    read.inputs = tuple(np.asarray(columns["inputs"][place], np.float64).tolist())
    read.action = native_value(columns["action"], place)
    read.previous_action = native_value(columns["previous_action"], place)
    read.step_count = int(columns["step_count"][place])
    read.done = bool(columns["done"][place])
    read.after_end = bool(columns["after_end"][place])
    parameters = {name: native_value(c, place) for name, c in columns["parameters"].items()}
    read.parameters = MappingProxyType({n: v for n, v in parameters.items() if v is not None})
    read.variables.update(
        {name: native_value(column, place) for name, column in columns["variables"].items()}
    )
    pictured, attributes = columns["pictured"], columns["attributes"]
    env._last_reward, env._return = (None, 0.0) if pictured is None else pictured[place]
    vars(env).update({} if attributes is None else copy.deepcopy(attributes[place]))
    _place_stream(env, columns, place)
    env._was_reset, env._ended = True, bool(columns["ended"][place])


def learn(texts: Mapping[str, Any]) -> None:
    """Let this process know the texts of Strings that another one has met."""
    for column in texts.values():
        numbers_of(column)


def native_value(column: Any, place: int) -> Any:
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
    bits = getattr(np.random, state["bit_generator"], None)
    if bits is None:
        raise ConfigError(f"the snapshot has a generator {state['bit_generator']!r}")
    generator = np.random.Generator(bits())
    generator.bit_generator.state = state
    seed = columns["seeds"][place]
    env._np_random, env._np_random_seed = generator, -1 if seed is None else seed
