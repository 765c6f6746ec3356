"""A task as it is declared in a file or a dict: read, merged with the task it extends, written."""

from __future__ import annotations

import datetime
import os
import re
import sys
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.checks import Spellings, check_mapping, check_path, require_regular
from fmugym.environment.distributions import OWN_DISTRIBUTIONS
from fmugym.errors import ConfigError, missing_file, reason, shown, unknown_name
from fmugym.keys import Entries, Mistake, checked_entry, found_mistakes, with_paths
from fmugym.task.data_tables import is_column, with_tables
from fmugym.task.scenarios import listed_files, read_scenarios
from fmugym.task.task_entries import Entry, Source
from fmugym.task.task_keys import TASK, VERSION
from fmugym.task.task_writer import as_toml, revised, write_new

__all__ = ["Task"]

_NOT_INHERITED: Final = ("version", "extends")

_MOST_FILES: Final = 20
"""Files may extend each other in a chain of this length."""


_LARGEST: Final = 16 * 2**20

_DEEPEST: Final = 50
_TOO_DEEP: Final = f"tables and lists stand in each other {_DEEPEST} times at most"

_KEY: Final = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_TOO_LONG: Final = {
    rf"(?:^|[\[{{,])[ \t]*+{_KEY}(?:[ \t]*+\.[ \t]*+{_KEY}){{{_DEEPEST}}}": _TOO_DEEP,
    r"(?<![\w.])[+-]?(?:\d_?+){1000}": "a number has 1000 digits at most",
}
"""Patterns of texts that no task file needs, with the messages about them."""

_IN_A_KEY: Final = (
    "(?:Invalid statement|Invalid initial character for a key part|Expected '=' after a key|"
    "Expected ']' at the end of a table)"
)
"""Message of the TOML parser about a letter that only keys in quotes may have."""

_BARE_KEY: Final = r"""[^\s=.,\[\]{}"'\\#]+"""
_MOST_PARSED: Final = 10**7
"""Characters that may be parsed to find such keys, one after the other: seconds."""


@dataclass(frozen=True, repr=False)
class Task:
    """A declared task.

    Two tasks are equal if they declare the same. Paths count as absolute paths.

    Attributes:
        document: Declarations: dicts, lists, texts and numbers. Only a task that was made of a
            dict may hold other objects.
        sources: The files that it was read from, the file itself first, or the dict.
        is_physical: Whether it is in its physical form; no file says so. See ``physical``.
        outside: The task before one of its scenarios was chosen; None if none was.
    """

    document: Mapping[str, Any]
    sources: tuple[Source, ...] = field(compare=False)
    is_physical: bool = False
    outside: Task | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        if "class" in self.document:
            return f"Task({self.name!r}: {shown(self.document['class'])})"
        agent = self.document.get("agent", {})
        seen, done = (shown(agent.get(key)) for key in ("observations", "actions"))
        return f"Task({self.name!r}: {done} -> {seen})"

    @classmethod
    def of(cls, config: Any) -> Task:
        """Make a task of a file, a dict or a task.

        Raises:
            ConfigError: If it is none of these, or as ``read`` and ``from_dict``.
        """
        return cls.draft(config)._checked()

    @classmethod
    def draft(cls, config: Any) -> Task:
        """Make a task as ``of`` does, but leave mistakes in values to ``root`` or ``begun``.

        Raises:
            ConfigError: If a file is missing, no TOML, or has an unknown version.
        """
        if isinstance(config, Task):
            return config
        return cls._of_dict(config) if isinstance(config, Mapping) else cls._of_file(config)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Task:
        """Read a TOML file, and the files that it extends.

        Args:
            path: The file; a relative path is relative to the working directory.

        Raises:
            ConfigError: If a file is missing, no TOML, or has an unknown key or version.
        """
        return cls._of_file(path)._checked()

    @classmethod
    def _of_file(cls, path: str | os.PathLike[str]) -> Task:
        sources = [_read(check_path("the path of a task", path).absolute())]
        while "extends" in sources[-1].document:
            entry = _root(sources[-1]).child("extends")
            base = Path(os.path.realpath(entry.path()))  # which goes around in a circle of links
            if base in [source.path for source in sources] or len(sources) == _MOST_FILES:
                raise entry.error(f"{shown(str(base))} is extended in a circle")
            with entry.placing():
                sources.append(_read(base))
        return cls._merged(tuple(sources))

    @classmethod
    def from_dict(
        cls, document: Mapping[str, Any], folder: str | os.PathLike[str] | None = None
    ) -> Task:
        """Make a task of a dict with the keys of a file.

        Args:
            document: The dict. Distributions may also be objects such as ``Uniform(0, 1)``.
            folder: Base of relative paths; by default the working directory.

        Raises:
            ConfigError: For an unknown key, or as ``read`` for a file that it extends.
        """
        return cls._of_dict(document, folder)._checked()

    @classmethod
    def _of_dict(
        cls, document: Mapping[str, Any], folder: str | os.PathLike[str] | None = None
    ) -> Task:
        start = Path.cwd() if folder is None else check_path("folder", folder).absolute()
        _require_shallow(document)
        given = check_mapping("config", document)
        plain: dict[str, Any] = _plain({**given, "data": with_tables(given.get("data"))})
        source = Source(None, start, "", _with_paths(plain, start))
        _check(source)
        if "extends" not in plain:
            return cls._merged((source,))
        base = cls._of_file(_root(source).child("extends").path())
        return cls._merged((source, *base.sources))

    @classmethod
    def _merged(cls, sources: tuple[Source, ...]) -> Task:
        document: dict[str, Any] = {}
        for source in reversed(sources):
            own = {k: v for k, v in source.document.items() if k not in _NOT_INHERITED}
            document = _merge(document, own)
        return cls(document, sources)

    def _checked(self) -> Task:
        self.begun().mistakes.require_none()
        return self

    @property
    def root(self) -> Entry:
        """The table of all keys, whose values are checked, with the places in the files.

        Raises:
            TaskError: If values are wrong; it names all of them.
        """
        root = self.begun()
        root.mistakes.require_none()
        return root

    def begun(self) -> Entry:
        """Return the table of all keys, as far as their values are right, with the mistakes."""
        values, mistakes = self._found
        root = Entry(values, (), self.sources)
        for keys, text, is_unknown in mistakes:
            entry = replace(root, value=None, keys=keys)
            entry.note(entry.error(text), is_unknown)
        return root

    @cached_property
    def _found(self) -> tuple[Any, list[Mistake]]:
        return found_mistakes(TASK, self.document)

    def physical(self) -> Task:
        """Return the task as controllers play it: they read and write values in its units.

        Observations are not normalized. An action is a value from the lowest to the highest one,
        whatever ``rescale`` says. With ``delta``, the input follows it by so much in each step.
        With ``levels``, it becomes the nearest level, the lower one of two.
        """
        return replace(self, is_physical=True)

    def in_scenario(self, name: str) -> Task:
        """Return the task in one of its scenarios, with a given beginning and length.

        In a task with a start time and no clock, the FMU begins so early that the scenario follows
        the warm-up.

        Raises:
            ConfigError: If there is no such scenario.
        """
        root = self.begun()
        section, scenarios = root.child("scenarios"), read_scenarios(root)
        with section.placing():
            found = Spellings("scenario", scenarios).find(name)
        if found is None:
            root.mistakes.require_none()
            raise section.error(unknown_name("scenario", name, scenarios))
        scenario = scenarios[found]
        times: dict[str, Any] = {"clock": scenario.start, "episode_length": scenario.length}
        if "start_time" in self.document and "clock" not in self.document:
            times["start_time"] = scenario.start_after(
                root.child("warm_up").child("period").value or 0.0
            )
            del times["clock"]
        files = section.child(found).child("file").value
        times |= {"file": files} if files else {}
        outside = self.outside or self
        return replace(self, document={**self.document, **times}, outside=outside)

    @property
    def name(self) -> str:
        """File name with its suffix; ``"task"`` for a dict."""
        path = self.sources[0].path
        return "task" if path is None else path.name

    def with_paths(self, path_of: Callable[[str], str]) -> dict[str, Any]:
        """Return the declarations with other paths of files.

        Args:
            path_of: Takes the absolute path of the FMU or of a file of data, and returns the new
                one.
        """
        return dict(with_paths(TASK, self.document, path_of))

    def with_listed_files(self) -> Task:
        """Return the task with lists of files in the place of patterns that these fit now."""
        data = dict(self.document.get("data", {}))
        for name, entry in self.root.child("data").items().items():
            if "file" in entry.value:
                data[name] = {**data[name], "file": listed_files(entry)}
        return replace(self, document={**self.document, "data": data}) if data else self

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the task to a new TOML file. Reading the file gives an equal task.

        Paths are written relative to the new file. What the task extends is written out. If the
        task was read from a file, the comments of that file are kept.

        Args:
            path: The file, which must not exist.

        Raises:
            ConfigError: If the task holds an object that no TOML file can hold; the text names it.
            FileExistsError: If the file exists.
        """
        file = check_path("the path of a task", path).absolute()
        document = self.with_paths(partial(_relative_path, folder=file.parent))
        own = self.sources[0]
        if "version" not in document and (own.path is None or "version" in own.document):
            document = {"version": VERSION, **document}
        text = None if own.path is None else revised(own.text, document)
        if text is not None and file.parent != own.folder:
            text = re.sub(r"\A#:schema \./.*\n", "", text)  # the schema lies beside the other file
        if text is None:
            text = as_toml(document)
        write_new(file, text)


def _root(source: Source) -> Entry:
    return Entry(source.document, (), (source,))


def _read(path: Path) -> Source:
    try:
        require_regular(path)
        if path.stat().st_size > _LARGEST:
            raise ConfigError(
                f"{shown(str(path))} has more than {_LARGEST} bytes, the most of a task file: "
                "leave data in files of their own"
            )
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ConfigError(f"{shown(str(path))} is no TOML file: {_advice(path)}") from None
    except FileNotFoundError:
        raise missing_file("task file", path, "*.toml") from None
    except OSError as error:
        raise ConfigError(f"{shown(str(path))} cannot be read: {error.strerror}") from None
    document, text = _parsed(path, text)
    source = Source(path, path.parent, text, _with_paths(_plain(document), path.parent))
    _check(source)
    return source


def _parsed(path: Path, text: str) -> tuple[dict[str, Any], str]:
    """Parse TOML; the parser takes more than linear time for long keys and numbers.

    Returns:
        The document, and its text, in which keys such as ``µ`` stand in quotes.
    """
    for pattern, what in _TOO_LONG.items():
        match = re.search(pattern, text, re.MULTILINE)
        if match:
            line = 1 + text.count("\n", 0, match.end())
            raise ConfigError(f"{path.name}, line {line}: {what}")
    try:
        document, text = _loaded(text)
    except tomllib.TOMLDecodeError as error:
        hint = _hint_of(text, str(error))
        raise ConfigError(f"{path.name} is no TOML file: {reason(error)}{hint}") from None
    except (ValueError, RecursionError):
        raise ConfigError(f"{path.name}: {_TOO_DEEP}") from None
    _require_shallow(document, f"{path.name}: ")
    return document, text


def _loaded(text: str) -> tuple[dict[str, Any], str]:
    """Parse TOML in which keys without quotes may have the letters of any language."""
    for _ in range(_MOST_PARSED // (len(text) + 1)):
        try:
            return tomllib.loads(text), text
        except tomllib.TOMLDecodeError as error:
            quoted = _with_quoted_key(text, str(error))
            if quoted is None:
                raise
            text = quoted
    return tomllib.loads(text), text


def _with_quoted_key(text: str, error: str) -> str | None:
    """Put the key in quotes at whose letters the parser stumbles; None if it does at another."""
    place = re.search(rf"{_IN_A_KEY}.* \(at line (\d+), column (\d+)\)", error)
    if place is None:
        return None
    lines = text.replace("\r\n", "\n").split("\n")
    number, column = int(place[1]) - 1, int(place[2]) - 1
    for key in re.finditer(_BARE_KEY, lines[number]):
        start, end = key.span()
        if start <= column < end and not key[0].isascii():
            lines[number] = f'{lines[number][:start]}"{key[0]}"{lines[number][end:]}'
            return "\n".join(lines)
    return None


def _hint_of(text: str, error: str) -> str:
    """Guess the mistake at which the parser of TOML fails, usually missing quotation marks."""
    if re.search("Invalid value|Expected newline", error):
        return "; texts and expressions stand in quotes"
    line = re.search(r"at line (\d+)", error)
    lines = text.splitlines()
    key = lines[int(line[1]) - 1].partition("=")[0].strip() if line else ""
    if re.match("Cannot (overwrite|declare|mutate)", error):
        return f"; {key} is given there once more: remove one of both, or rename it"
    return ""


def _require_shallow(document: Any, place: str = "") -> None:
    """Refuse tables and lists in each other, too many for functions which call themselves.

    A dict of the caller may hold itself.
    """
    level = [document]
    for _ in range(_DEEPEST):
        inner = (one.values() if isinstance(one, Mapping) else one for one in level)
        parts = (part for parts in inner for part in parts)
        level = list({id(p): p for p in parts if isinstance(p, Mapping | list | tuple)}.values())
        if not level:
            return
    raise ConfigError(f"{place}{_TOO_DEEP}")


def _advice(path: Path) -> str:
    if path.suffix.lower() == ".fmu":
        return f"'fmugym new {path.name}' writes a task file for an FMU"
    return "it is not encoded in UTF-8"


def _check(source: Source) -> None:
    """Check the keys that are not merged: the version, and the extended task."""
    for name in _NOT_INHERITED:
        entry = _root(source).child(name)
        if entry.value is not None:
            with entry.placing():
                checked_entry(Entries(TASK.keys[name].kind), {name: entry.value})


def _merge(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Replace values of the same keys, and merge tables, but not the tables of one value."""
    merged = dict(base)
    for key, value in own.items():
        before = merged.get(key)
        merged[key] = value
        if isinstance(value, dict) and isinstance(before, dict):
            # A distribution or an FMU is one value.
            is_one_value = "distribution" in value or "bundled" in value
            merged[key] = value if is_one_value else _merge(before, value)
    return merged


def _plain(value: Any) -> Any:
    """The value in types that a file can hold, as far as that is possible."""
    if isinstance(value, Mapping):
        items = ((str(key), _plain(item)) for key, item in value.items())
        return {key: item for key, item in items if item is not None}
    if isinstance(value, OWN_DISTRIBUTIONS):
        return _plain(asdict(value))
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        return value.tolist()
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind == "M":
        return value.astype("M8[us]").tolist()
    if isinstance(value, np.ndarray) and value.dtype.kind == "O" and value.ndim == 1:
        return [_plain(item) for item in value]
    if is_column(value):
        missing = [*value.isna()]
        return [None if gone else _plain(one) for one, gone in zip(value, missing, strict=True)]
    if isinstance(value, datetime.datetime) and hasattr(value, "to_pydatetime"):
        return value.to_pydatetime(warn=False)
    if isinstance(value, type):
        return _named(value)
    return _text_of_path(value) if isinstance(value, os.PathLike) else value


def _text_of_path(path: os.PathLike[Any]) -> Any:
    """The text of a path; the path itself, which is refused later, if it has none."""
    with suppress(Exception):  # of the caller's class
        return os.fspath(path)
    return path


def _named(value: type) -> Any:
    """Name a class by ``"module:Class"`` if that leads to it; otherwise the class itself."""
    with suppress(KeyError, AttributeError):
        if getattr(sys.modules[value.__module__], value.__qualname__) is value:
            return f"{value.__module__}:{value.__qualname__}"
    return value


def _with_paths(document: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Make the paths in a document absolute."""

    def path_of(path: str) -> str:
        if "\0" in path:  # which the check of the key refuses
            return path
        return os.path.normpath(folder / Path(path).expanduser())

    return dict(with_paths(TASK, document, path_of))


def _relative_path(path: str, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return path
