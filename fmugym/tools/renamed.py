"""Commands of earlier versions: their names work for one release, and warn."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from typing import Final

from fmugym.tools.options import MINARI, note

__all__ = ["renamed"]

_NAMES: Final = {
    "skeleton": ("new", "--class"),
    "record": ("simulate",),
    "stand-in": ("info", "--repair"),
    "compile": ("info", "--repair"),
    "dataset": (),
}


def renamed(given: Sequence[str]) -> Sequence[str]:
    """The arguments with the present name of the command; a note tells it."""
    if not given or given[0] not in _NAMES:
        return given
    old, *rest = given
    rest = ["--output" if one == "--folder" else one for one in rest]
    now = [*_NAMES[old], *(rest if old != "dataset" else _of_dataset(rest))]
    note(f"{old!r} is going away; it is now: fmugym {shlex.join(now)}", "warning")
    return now


def _of_dataset(rest: list[str]) -> list[str]:
    parser = argparse.ArgumentParser("fmugym dataset", add_help=False)
    parser.add_argument("name")
    parser.add_argument("--task")
    parser.add_argument("--output")
    known, more = parser.parse_known_args(rest)
    name = f"{MINARI}{known.name}"
    if known.task is None:
        return ["info", name, *(["--output", known.output] if known.output else []), *more]
    more = ["--log" if one == "--recording" else one for one in more]
    episodes = [] if "--episodes" in more else ["--episodes", "10"]
    return ["simulate", known.task, "--output", name, *episodes, *more]
