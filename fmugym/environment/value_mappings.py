"""The mappings through which hooks and infos read values by name."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from typing import Any, Final, Self

import numpy as np

from fmugym.checks import Spellings
from fmugym.errors import ConfigError, UnknownParameterError, shown, unknown_name
from fmugym.fmi.variable import Texts, texts_at

__all__ = [
    "EpisodeVariables",
    "LateDict",
    "NamedValues",
    "ParameterValues",
    "ShownParameters",
]


def array_places(names: Iterable[str]) -> dict[str, list[int]]:
    """The places of the elements of each array among names such as ``y[1]``, by its name."""
    places: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        if name.endswith("]"):
            places.setdefault(name.rpartition("[")[0], []).append(place)
    return places


def _stacked(values: Sequence[Any]) -> Any:
    """Make an array of the elements: numbers, or rows of numbers."""
    return np.array(values) if type(values[0]) is float else np.stack(values)


class NamedValues(Mapping[str, Any]):
    """A read-only mapping from names to values in a fixed order.

    Of arrays it has the elements by their names, as ``y[1]``. ``["y"]`` returns an array of those
    elements of ``y`` that it has, in their order; the elements are on the first axis.

    Args:
        kind: What the names refer to, for error texts.
        names: The names, in the order of the values.
        get_values: Returns the current values.

    Raises:
        ConfigError: If ``[]`` gets an unknown name; the text suggests the nearest one.
    """

    def __init__(
        self,
        kind: str,
        names: Sequence[str],
        get_values: Callable[[], Sequence[Any]],
    ) -> None:
        self._kind = kind
        self._index = {name: index for index, name in enumerate(names)}
        self._get_values = get_values
        self._found_arrays: dict[str, list[int]] | None = None

    def share_names(self, other: NamedValues) -> None:
        """Look the names up in the table of another mapping, if it has the same ones."""
        if list(self._index) == list(other._index):
            self._index = other._index

    @property
    def _arrays(self) -> dict[str, list[int]]:
        """The places of the elements of arrays, found when first asked for."""
        if self._found_arrays is None:
            self._found_arrays = array_places(self._index)
        return self._found_arrays

    def __getitem__(self, name: str) -> Any:
        try:
            index = self._index[name]
        except Exception:  # a KeyError, or an object that cannot be a key
            return self._array(name)
        return self._get_values()[index]

    def _array(self, name: Any) -> Any:
        places = self._arrays.get(str.__str__(name)) if isinstance(name, str) else None
        spelt = None if places is not None else self._spelt(name)
        if spelt is not None:
            return self[spelt]
        if places is None:
            raise unknown_name(self._kind, name, self._index) from None
        values = self._get_values()
        return _stacked([values[place] for place in places])

    def _spelt(self, name: Any) -> str | None:
        """The name of other letters that look the same; None if there is none."""
        plain = str.__str__(name) if isinstance(name, str) else None
        return Spellings(self._kind, {**self._index, **self._arrays}).find(plain)

    def __contains__(self, name: object) -> bool:
        if not isinstance(name, str):
            return False
        plain = str.__str__(name)
        return plain in self._index or plain in self._arrays or self._spelt(plain) is not None

    def get(self, name: str, default: Any = None) -> Any:
        """Return the value of a name, or the default if the name is unknown."""
        if name not in self:
            return default
        return self[str.__str__(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._index)

    def __len__(self) -> int:
        return len(self._index)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({dict(self)})"

    def over(self, get_values: Callable[[], Sequence[Any]]) -> Self:
        """The same names, in the same order, with other values."""
        other = copy(self)
        other._get_values = get_values
        return other


class ParameterValues(dict[str, Any]):
    """Parameters by name, with the elements of arrays as ``A[1,2]``.

    ``["A"]`` returns a new array of those elements of ``A`` that it has, as ``NamedValues`` does.
    """

    def __missing__(self, name: Any) -> Any:
        arrays = array_places(self)
        places = arrays.get(name) if isinstance(name, str) else None
        spelt = (
            None if places is not None else Spellings("parameter", {**self, **arrays}).find(name)
        )
        if spelt is not None:
            return self[spelt]
        if places is None:
            raise UnknownParameterError(str(unknown_name("parameter", name, self)))
        values = list(self.values())
        return _stacked([values[place] for place in places])

    def copy(self) -> ParameterValues:
        """A copy of the same kind."""
        return ParameterValues(self)


class ShownParameters(Mapping[str, Any]):
    """The parameters of N environments as hooks read them: Strings as arrays of texts.

    Args:
        rows: A row of shape (N,) for each parameter; of a String it has the places of the texts.
        texts: By name, the texts of the Strings.
    """

    def __init__(self, rows: ParameterValues, texts: Mapping[str, Texts]) -> None:
        self._rows, self._texts = rows, texts

    def __getitem__(self, name: str) -> Any:
        row = self._rows[name]
        return texts_at(self._texts[name], row) if name in self._texts else row

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


class EpisodeVariables(dict[str, Any]):
    """The episode variables: a dict that accepts only the names in the config.

    Args:
        names: The names; their values are None until the first reset.
    """

    def __init__(self, names: Mapping[str, Any]) -> None:
        super().__init__(dict.fromkeys(names))

    def __missing__(self, name: str) -> Any:
        return super().__getitem__(self._spelt(name))

    def _spelt(self, name: Any) -> str:
        """The own name that is meant, also by other letters that look the same."""
        return Spellings("episode variable", self.keys()).require(name)

    def __setitem__(self, name: str, value: Any) -> None:
        is_own = isinstance(name, str) and name in self
        super().__setitem__(name if is_own else self._spelt(name), value)

    def update(self, *args: Any, **kwargs: Any) -> None:
        """Write several variables, as in a dict. If a name is unknown, nothing is written."""
        try:
            new = dict(*args, **kwargs)
        except Exception:  # not a dict, or a dict whose methods fail
            raise ConfigError(f"{shown(args)} are no values by name") from None
        super().update({self._spelt(name): value for name, value in new.items()})

    def __ior__(self, other: Any) -> EpisodeVariables:  # type: ignore[misc, override]  # dict overloads it
        self.update(other)
        return self

    def setdefault(self, name: str, default: Any = None) -> Any:
        """Read a variable. The default is never used, because all variables exist."""
        return self[name]

    def _keep(self, *_: Any) -> Any:
        raise ConfigError("episode variables are those of the config; none can be removed")

    __delitem__ = pop = popitem = clear = _keep

    def __reduce__(self) -> tuple[type[dict[str, Any]], tuple[dict[str, Any]]]:
        """Make copies plain dicts."""
        return dict, (dict(self),)


class LateDict(dict[str, Any]):
    """A dict for values that are rarely read; it is filled when first read or written.

    Every method of ``dict`` fills it first. C functions that read a dict without calling its
    methods would find ``UNFILLED``; no function of the standard library does that.

    It is made of a dict whose only key is ``UNFILLED``, because ``json`` believes an empty one at
    once. The value is a tuple: a function that returns the items, and its arguments.
    """

    __slots__ = ()

    def _filled(self) -> dict[str, Any]:
        pending = dict.pop(self, UNFILLED, None)
        if pending is not None:
            fill, *arguments = pending
            dict.update(self, fill(*arguments))
        return self

    __hash__ = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Make copies plain dicts."""
        return dict, (dict(self.items()),)


UNFILLED: Final = "fmugym: not filled yet"
"""The only key of a ``LateDict`` that nobody has read yet."""

_NOT_OF_THE_ITEMS: Final = {
    *("__class_getitem__", "__getattribute__", "__hash__", "__init__", "__new__", "fromkeys"),
    "__reduce__",
}
"""The methods of ``dict`` that do not depend on its items, or that ``LateDict`` has itself."""


def _filling(method: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a method of ``dict`` so that it first fills every ``LateDict`` among its arguments."""

    @functools.wraps(method)
    def call(*values: Any, **items: Any) -> Any:
        for value in values:
            if isinstance(value, LateDict):
                value._filled()
        return method(*values, **items)

    return call


for _name, _method in vars(dict).items():
    if callable(_method) and _name not in _NOT_OF_THE_ITEMS:
        setattr(LateDict, _name, _filling(_method))
