"""Lists of data files, one of which is drawn for each episode."""

from __future__ import annotations

import glob
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from fmugym.declared.entries import Entry
from fmugym.errors import ConfigError, missing_file, shown, unknown_name

__all__ = ["FileLists", "chosen_files", "file_lists", "files_of", "listed_files", "variable_of"]

_SHARED: Final = "file number"
"""The episode variable with the place of the file in all lists that share it."""

FileLists = Mapping[str, Sequence[Sequence[str]]]
"""By episode variable, the files that belong to each of its values."""


def listed_files(entry: Entry) -> list[str]:
    """Paths of the files of a series; files that fit a pattern come in the order of their names.

    Raises:
        ConfigError: If there is none, or one comes twice.
    """
    file = entry.child("file")
    given = file.value if isinstance(file.value, list) else [file.value]
    paths = [path for one in given if one is not None for path in _fitting(file, one)]
    if not paths:
        raise file.error("expected at least one file")
    twice = next((path for path in paths if paths.count(path) > 1), None)
    if twice is not None:
        raise file.error(f"{shown(twice)} is listed twice")
    return paths


def _is_pattern(path: str) -> bool:
    return glob.has_magic(path) and not os.path.exists(path)


def _fitting(entry: Entry, path: str) -> list[str]:
    if not _is_pattern(path):
        return [path]
    found = sorted(filter(os.path.isfile, glob.glob(path, recursive=True)))
    if not found:
        raise entry.error(missing_file("file", Path(path), f"*{Path(path).suffix}"))
    return found


def files_of(entry: Entry) -> list[Entry]:
    """The same declaration of a series with each of its files alone; itself if it has none.

    Raises:
        ConfigError: As ``listed_files``.
    """
    if "file" not in entry.value:
        return [entry]
    return [replace(entry, value={**entry.value, "file": one}) for one in listed_files(entry)]


def variable_of(entry: Entry) -> str:
    """The episode variable with the number of a series' file."""
    return f"{_SHARED} of {entry.name}" if entry.value["draw"] == "own" else _SHARED


def file_lists(root: Entry) -> FileLists:
    """Lists of files of a task, and the distributions that draw one for each episode.

    Raises:
        ConfigError: If lists that share their number differ in their lengths.
    """
    lists: dict[str, dict[str, list[str]]] = {}
    for name, entry in root.child("data").items().items():
        given = entry.value.get("file") or []
        if len(given) > 1 or any(map(_is_pattern, filter(None, given))):
            _add(lists.setdefault(variable_of(entry), {}), name, entry)
    rows = {variable: [*zip(*own.values(), strict=True)] for variable, own in lists.items()}
    return {variable: own for variable, own in rows.items() if len(own) > 1}


def _add(lists: dict[str, list[str]], name: str, entry: Entry) -> None:
    paths = listed_files(entry)
    for other, known in lists.items():
        if len(known) != len(paths):
            raise entry.child("file").error(
                f"{name!r} has {len(paths)} files, but {other!r} has {len(known)}, and an episode "
                "takes files of one place in their lists. Let one draw by itself: "
                'draw = "own"'
            )
    lists[name] = paths


def chosen_files(entry: Entry, lists: FileLists) -> dict[str, int]:
    """The numbers of files that are chosen by their names.

    Args:
        entry: The names; each is the end of a path.
        lists: Has the files.

    Returns:
        The numbers by episode variable.

    Raises:
        ConfigError: If no file, or more than one of a list, has a name.
    """
    chosen: dict[str, int] = {}
    for one in entry.elements():
        with one.placing():
            for variable, number in _numbers_of(one.value, lists).items():
                if chosen.setdefault(variable, number) != number:
                    raise ConfigError(f"{shown(one.value)} is of another place in its list")
    return chosen


def _numbers_of(name: str, lists: FileLists) -> dict[str, int]:
    numbers: dict[str, int] = {}
    for variable, rows in lists.items():
        found = [i for i, row in enumerate(rows) if any(_ends_with(path, name) for path in row)]
        if len(found) > 1:
            raise ConfigError(
                f"{shown(name)} is the name of {len(found)} files of a list: say more of its path"
            )
        if found:
            numbers[variable] = found[0]
    if not numbers:
        known = {Path(path).name for rows in lists.values() for row in rows for path in row}
        raise unknown_name("file of a list", name, sorted(known))
    return numbers


def _ends_with(path: str, name: str) -> bool:
    parts = Path(name).parts
    return Path(path).parts[-len(parts) :] == parts
