"""The two small mappings through which hooks read values by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from fmugym.errors import ConfigError, unknown_name

__all__ = ["EpisodeVariables", "LateDict", "NamedValues"]


class NamedValues:
    """A read-only view by name of values that are kept in a fixed order.

    Args:
        kind: What the names name, for error texts.
        names: The names, in the order of the values.
        get_values: Returns the present values.
    """

    def __init__(
        self, kind: str, names: Sequence[str], get_values: Callable[[], Sequence[Any]]
    ) -> None:
        self._kind = kind
        self._index = {name: index for index, name in enumerate(names)}
        self._get_values = get_values

    def __getitem__(self, name: str) -> Any:
        index = self._index.get(name)
        if index is None:
            raise unknown_name(self._kind, name, self._index)
        return self._get_values()[index]

    def __iter__(self) -> Iterator[str]:
        return iter(self._index)

    def __len__(self) -> int:
        return len(self._index)

    def keys(self) -> Iterator[str]:
        """The names, so that ``dict(env.out)`` works."""
        return iter(self._index)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({dict(self)})"


class EpisodeVariables(dict[str, Any]):
    """The episode variables: a dict whose set of names is that of the config.

    Args:
        names: The names; their values are None until the first reset.
    """

    def __init__(self, names: Mapping[str, Any]) -> None:
        super().__init__(dict.fromkeys(names))

    def __missing__(self, name: str) -> Any:
        raise unknown_name("episode variable", name, self)

    def __setitem__(self, name: str, value: Any) -> None:
        if name not in self:
            raise unknown_name("episode variable", name, self)
        super().__setitem__(name, value)

    def update(self, *args: Any, **kwargs: Any) -> None:
        """Write several; as in a dict."""
        for name, value in dict(*args, **kwargs).items():
            self[name] = value

    def __ior__(self, other: Any) -> EpisodeVariables:  # type: ignore[misc, override]
        self.update(other)
        return self

    def setdefault(self, name: str, default: Any = None) -> Any:
        """Read one: all are there from the start."""
        return self[name]

    def _keep(self, *_: Any) -> Any:
        raise ConfigError("episode variables are those of the config: none can be removed")

    __delitem__ = pop = popitem = clear = _keep

    def __reduce__(self) -> tuple[type[dict[str, Any]], tuple[dict[str, Any]]]:
        """A copy is a dict like any other."""
        return dict, (dict(self),)


class LateDict(dict[str, Any]):
    """A dict that is filled when it is first looked at, for what is rarely looked at.

    Args:
        fill: Returns the items.
        arguments: What to call it with.
    """

    __slots__ = ("_fill",)

    _fill: tuple[Callable[..., Mapping[str, Any]], tuple[Any, ...]] | None

    @classmethod
    def of(cls, fill: Callable[..., Mapping[str, Any]], *arguments: Any) -> LateDict:
        """Make one in a third of the time that a constructor in Python takes."""
        late: LateDict = dict.__new__(cls)
        late._fill = fill, arguments
        return late

    def _filled(self) -> dict[str, Any]:
        if self._fill is not None:
            (fill, arguments), self._fill = self._fill, None
            super().update(fill(*arguments))
        return self

    def __getitem__(self, key: str) -> Any:
        return dict.__getitem__(self._filled(), key)

    def __setitem__(self, key: str, value: Any) -> None:
        dict.__setitem__(self._filled(), key, value)

    def __delitem__(self, key: str) -> None:
        dict.__delitem__(self._filled(), key)

    def __contains__(self, key: object) -> bool:
        return dict.__contains__(self._filled(), key)

    def __iter__(self) -> Iterator[str]:
        return dict.__iter__(self._filled())

    def __len__(self) -> int:
        return dict.__len__(self._filled())

    def __eq__(self, other: object) -> bool:
        return dict.__eq__(self._filled(), other)

    __hash__ = None

    def __repr__(self) -> str:
        return dict.__repr__(self._filled())

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self.items()),)

    def keys(self) -> Any:
        """See ``dict``."""
        return dict.keys(self._filled())

    def values(self) -> Any:
        """See ``dict``."""
        return dict.values(self._filled())

    def items(self) -> Any:
        """See ``dict``."""
        return dict.items(self._filled())

    def get(self, key: str, default: Any = None) -> Any:
        """See ``dict``."""
        return dict.get(self._filled(), key, default)

    def copy(self) -> dict[str, Any]:
        """See ``dict``; the copy is a plain one."""
        return dict(self.items())
