"""The two small mappings through which hooks read values by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from fmugym.errors import ConfigError, unknown_name

__all__ = ["EpisodeVariables", "NamedValues"]


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
