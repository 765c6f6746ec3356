"""A process of the speed gate: plays workloads with the package of one tree.

    PYTHONPATH=TREE python benchmarks/gate_player.py TREE

It answers requests, one line of JSON each: ``{"open": name}``, ``{"turn": repeats}`` and
``{"close": true}``. A workload that this tree cannot run is answered by ``{"missing": why}``.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from measure import Stopwatch


class Player:
    """The workload that is open."""

    def __init__(self, tree: Path) -> None:
        self._tree, self._stack = tree, ExitStack()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what a request asks for."""
        answers: dict[str, Callable[[Any], dict[str, Any]]] = {
            "open": self._open,
            "turn": self._turn,
            "close": self._close,
        }
        ((name, argument),) = request.items()
        try:
            return answers[name](argument)
        except Exception as reason:
            return {"missing": f"{type(reason).__name__}: {reason}"}

    def _open(self, name: str) -> dict[str, Any]:
        import fmugym

        if self._tree not in Path(fmugym.__file__ or "").resolve().parents:
            raise ImportError(f"{fmugym.__file__} does not belong to {self._tree}")
        from gate_rows import ROWS

        self._workload = ROWS[name](self._stack)
        self._workers = list(descendants(os.getpid()))
        return {}

    def _turn(self, repeats: int) -> dict[str, Any]:
        start, block = self._workload
        start()
        watch = Stopwatch(self._workers)
        watch.start()
        for _ in range(repeats):
            block()
        watch.stop()
        return {"cpu": watch.cpu}

    def _close(self, _: Any) -> dict[str, Any]:
        self._stack.close()
        gc.collect()  # there is no collection in turns
        return {}


def descendants(process: int) -> Iterator[int]:
    """The processes below one, such as workers and theirs."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text(errors="replace").rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        parents[int(path.parent.name)] = int(fields[1])
    return _below(process, parents)


def _below(process: int, parents: dict[int, int]) -> Iterator[int]:
    for child, parent in parents.items():
        if parent == process:
            yield child
            yield from _below(child, parents)


def main() -> None:
    """Answer until the requests end."""
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        os.dup2(2, 1)  # an FMU may print
        logging.basicConfig(level=logging.ERROR)
        player = Player(Path(sys.argv[1]).resolve())
        gc.disable()
        for line in sys.stdin:
            print(json.dumps(player.answer(json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main()
