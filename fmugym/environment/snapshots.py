"""Snapshots: episodes at one moment, as values.

They hold attributes of a class's own, too: those that ``FMUEnv`` does not have.
"""

from __future__ import annotations

import copy
import hashlib
import pickle
import re
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.expressions.quantities import KEPT
from fmugym.pool.states import Bundle, IndexArray, SaveMethod

__all__ = [
    "Columns",
    "Scope",
    "Snapshot",
    "SnapshotColumn",
    "changed",
    "checked_snapshot",
    "plain_attributes",
    "put_back",
    "require_scope",
    "same",
    "stacked",
    "taken",
]

_LARGEST: Final = 2**20
"""Arrays of more bytes are taken for data that hooks only read."""

_ATOMS: Final = (bool, int, float, complex, str, bytes, type(None), np.generic)


def plain_attributes(attributes: Mapping[str, Any], foreign: Collection[str]) -> dict[str, Any]:
    """Copy the attributes that hold plain data: numbers, texts, arrays, and lists of them.

    Args:
        attributes: The attributes of an environment.
        foreign: Those that ``FMUEnv`` keeps itself.
    """
    return {
        name: copy.deepcopy(value)
        for name, value in attributes.items()
        if name not in foreign and _is_plain(value)
    }


def put_back(env: Any, attributes: Mapping[str, Any]) -> None:
    """Give an environment the attributes that it had before, and no others."""
    now = vars(env)
    for name in now.keys() - attributes.keys():
        del now[name]
    now.update(attributes)


def changed(now: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes that are new or have another value than before."""
    return {n: v for n, v in now.items() if n not in before or not same(v, before[n])}


def same(one: Any, other: Any) -> bool:
    """Whether two plain values are equal; NaN equals NaN."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(
            one, other, equal_nan=one.dtype.kind in "fc"
        )
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple | deque):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other) or (one != one and other != other)


def _is_plain(value: Any, around: tuple[Any, ...] = ()) -> bool:
    """Whether a value, which is in others, is a number, text or array, or a container of them."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biufc" and value.nbytes <= _LARGEST
    if type(value) not in (list, tuple, deque, set, dict):
        return isinstance(value, _ATOMS)
    if any(value is one for one in around):
        return False
    parts = [*value, *value.values()] if type(value) is dict else value
    return all(_is_plain(one, (*around, value)) for one in parts)


_VERSION: Final = f"4 ({', '.join(one.attribute for one in KEPT)})"
"""Of pickles; it changes with their content, of which the quantities are a part."""

_HASH: Final = re.compile(r"\b([0-9a-f]{8})[0-9a-f]{8,}\b")

_WIDE: Final = {"b": np.int64, "i": np.int64, "u": np.uint64, "f": np.float64}
"""By kind, the type in which numbers are compared."""

SnapshotColumn = npt.NDArray[Any] | list[Any]
"""One value for each environment, which comes first."""

Columns = dict[str, Any]
"""Columns by name; those of the parameters and variables are dicts again."""

Scope = dict[str, str]
"""What an environment must have in common with those of a snapshot, as texts by name."""


class Snapshot:
    """The episodes of M environments at one moment; ``save_state`` returns one.

    A snapshot is a value. It can be compared, copied and pickled. It fits every environment with
    the same FMU and the same config, single or in a vector environment, in any process. It holds
    the state of the FMU, time, step count, action, previous values, drawn parameters, episode
    variables and random streams. Attributes that hooks have assigned are no part of it: then
    ``save_state`` refuses.

    ``snapshot[i]`` is the snapshot of environment i. A mask, a slice or a list of indices chooses
    several.

    Attributes:
        method: ``"state"`` if the FMU has serialized its state. ``"replay"`` if the inputs of the
            episode were kept: restoring such a snapshot plays the episode again. ``"copy"`` if they
            were kept, and the FMU has a copy of its state for the environment that has saved.
        step_count: Steps since the reset of each environment, shape (M,).
    """

    __slots__ = ("_bundle", "_columns", "_scope")

    def __init__(self, scope: Scope, columns: Columns, bundle: Bundle) -> None:
        self._scope, self._columns, self._bundle = scope, columns, bundle

    @property
    def method(self) -> SaveMethod:
        """Method by which the FMU's states were saved."""
        return self._bundle.method

    @property
    def step_count(self) -> npt.NDArray[np.int64]:
        """Steps since the reset of each environment, shape (M,)."""
        return np.array(self._columns["step_count"], np.int64)

    def __len__(self) -> int:
        return len(self._bundle)

    def __getitem__(self, which: Any) -> Snapshot:
        places = self._places(which)
        return Snapshot(self._scope, taken(self._columns, places), self._bundle.take(places))

    def _places(self, which: Any) -> IndexArray:
        try:
            places = np.atleast_1d(np.arange(len(self))[which])
        except Exception:  # numpy refuses it, or the caller's object fails
            places = np.empty((0, 0))
        if places.ndim > 1:
            raise ConfigError(f"{shown(which)} are no environments of a snapshot of {len(self)}")
        return places.astype(np.int64)

    def __iter__(self) -> Iterator[Snapshot]:
        return (self[index] for index in range(len(self)))

    @property
    def _content(self) -> tuple[Any, ...]:
        return self._scope, _content(self._columns), self._bundle.states

    def __eq__(self, other: object) -> bool:
        return self._content == other._content if isinstance(other, Snapshot) else NotImplemented

    def __hash__(self) -> int:
        return hash((tuple(self._scope.items()), self._bundle.states))

    def __repr__(self) -> str:
        return f"Snapshot({len(self)} environment(s), method={str(self.method)!r})"

    def __copy__(self) -> Snapshot:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Snapshot:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        content = pickle.dumps((self._scope, self._columns, self._bundle))
        return _unpickled, (_VERSION, content, hashlib.sha256(content).digest())

    # For the environments.

    def columns_for(self, scope: Scope) -> Columns:
        """The columns, for an environment with this scope.

        Raises:
            ConfigError: If the snapshot is of another FMU or of another config.
        """
        require_scope(self._scope, scope, "snapshot")
        return self._columns

    @property
    def bundle(self) -> Bundle:
        """The states of the FMU instances."""
        return self._bundle


def _unpickled(version: str, *parts: Any) -> Snapshot:
    if version != _VERSION:
        raise SimulationError(
            f"the snapshot was pickled in version {version} of the format, expected {_VERSION}"
        )
    content, digest = parts
    if hashlib.sha256(content).digest() != digest:
        raise SimulationError("the snapshot is damaged: its pickle has changed")
    scope, columns, bundle = pickle.loads(content)
    return Snapshot(scope, columns, bundle)


def checked_snapshot(snapshot: Any, length: int | None = None) -> Snapshot:
    """Return a snapshot.

    Args:
        snapshot: What a caller has given.
        length: The number of environments that it must have; None for any.

    Raises:
        ConfigError: If it is something else.
    """
    if not isinstance(snapshot, Snapshot):
        raise ConfigError(f"expected a snapshot from save_state, got {shown(snapshot)}")
    if length is not None and len(snapshot) != length:
        raise ConfigError(
            f"the snapshot is of {len(snapshot)} environments, expected {length}; snapshot[i] "
            "chooses one"
        )
    return snapshot


# Columns


def taken(columns: Columns, places: Sequence[int] | IndexArray) -> Columns:
    """Take some environments of the columns."""
    return {name: _taken(column, places) for name, column in columns.items()}


def _taken(column: Any, places: Any) -> Any:
    if isinstance(column, dict):
        return taken(column, places)
    if isinstance(column, list):
        return [column[place] for place in places]
    return None if column is None else column[places]


def stacked(parts: Sequence[Columns]) -> Columns:
    """Put columns of one environment each together."""
    return {name: _stacked([part.get(name) for part in parts]) for name in parts[0]}


def _stacked(parts: list[Any]) -> Any:
    if all(part is None for part in parts):
        return None
    if isinstance(parts[0], dict):
        names = dict.fromkeys(name for part in parts for name in part)
        return {name: [_first(part.get(name)) for part in parts] for name in names}
    if all(isinstance(part, np.ndarray) for part in parts):
        return np.concatenate(parts)
    return [value for part in parts for value in part]


def _first(column: Any) -> Any:
    return None if column is None else column[0]


def _content(column: Any) -> Any:
    """Content of a column, equal for equal columns, whatever the type of their numbers is."""
    if isinstance(column, dict):
        return {name: _content(part) for name, part in column.items()}
    if isinstance(column, np.ndarray) and column.dtype == object:
        column = column.tolist()
    if isinstance(column, list) and any(isinstance(one, dict) for one in column):
        return [_content(one) for one in column]
    try:
        array = np.asarray(column)
    except ValueError:  # arrays of different shapes
        array = np.empty(0, object)
    wide = _WIDE.get(array.dtype.kind)
    return pickle.dumps(column) if wide is None else (array.shape, array.astype(wide).tobytes())


# What must be the same


def require_scope(own: Scope, wanted: Scope, what: str) -> None:
    """Compare the scope of a snapshot or the like with that of an environment.

    Raises:
        ConfigError: If they differ; the text names the first difference, and of long values only
            the parts that differ.
    """
    if own == wanted:
        return
    for name in dict.fromkeys([*own, *wanted]):
        texts = own.get(name, "nothing"), wanted.get(name, "nothing")
        if texts[0] != texts[1]:
            here, there = map(_shown, _different_parts(*texts))
            raise ConfigError(
                f"the {what} is of environments with another {name}: {here}, expected {there}"
            )


def _different_parts(one: str, other: str) -> tuple[str, str]:
    """Of two lists of values, those that are not the same in both; of other texts the whole."""
    parts, others = one.strip("{}").split(", "), other.strip("{}").split(", ")
    only = [part for part in parts if part not in others]
    only_other = [part for part in others if part not in parts]
    if not only and not only_other:  # the order is another one
        return one, other
    return ", ".join(only) or "nothing more", ", ".join(only_other) or "nothing more"


def _shown(text: str) -> str:
    """A text of a scope on one line, with the first digits of each hash."""
    return shown(_HASH.sub(r"\1...", text))[1:-1]
