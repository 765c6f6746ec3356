"""Compare the speed of this tree with that of another one, side by side in one run.

    git worktree add ../before 0ce11fa0
    python -m venv ../before/.venv && ../before/.venv/bin/pip install -e "../before[dev]"
    python benchmarks/gate.py ../before --limit 1.25 --limit '*/expressions/64=1.10'

Both trees play the same workloads (``gate_rows.py``) in processes of their own, which take turns. A
ratio is the least processor time of a turn in this tree by the least in the other one, workers
included: above 1, this tree is slower. First, this tree is measured against itself, which shows
how far to trust a ratio. The program fails if a ratio is beyond its limit also after it was
measured again, or if a workload cannot run in a tree. It needs Linux.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from fnmatch import fnmatchcase
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

from gate_rows import ROWS
from tables import Table, duration

THIS = Path(__file__).resolve().parents[1]
PASSES = 3
"""How often rows are measured, at different times of the run."""


class CannotRunError(Exception):
    """A workload cannot run in a tree."""


class Row(NamedTuple):
    """The comparison of a workload.

    Attributes:
        name: That of the workload.
        ours: Least processor time of a turn in this tree in s.
        theirs: That of the other tree.
        missing: Why there are no times; else empty.
    """

    name: str
    ours: float = math.nan
    theirs: float = math.nan
    missing: str = ""

    @property
    def ratio(self) -> float:
        """How many times the other tree's time this tree takes."""
        return self.ours / self.theirs

    def with_pass(self, row: Row) -> Row:
        """The least times of both."""
        if self.missing or row.missing:
            return self if self.missing else row
        return Row(self.name, min(self.ours, row.ours), min(self.theirs, row.theirs))


class Player:
    """A process that plays workloads with the package of one tree.

    Args:
        tree: The folder of the tree.
        python: Its interpreter.
    """

    def __init__(self, tree: Path, python: Path) -> None:
        self._tree = tree
        self._command = [python, Path(__file__).with_name("gate_player.py"), tree]
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(
            self._command,
            env=os.environ | {"PYTHONPATH": str(self._tree)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def open(self, name: str) -> None:
        """Make a workload ready.

        Raises:
            CannotRunError: If that fails.
        """
        self._ask(open=name)

    def turn(self, repeats: int) -> float:
        """Play it, and return the processor time in s.

        Raises:
            CannotRunError: If that fails.
        """
        return float(self._ask(turn=repeats)["cpu"])

    def close(self) -> None:
        """Close the workload."""
        self._ask(close=True)

    def end(self) -> None:
        """End the process."""
        self._process.communicate()

    def _ask(self, **request: Any) -> dict[str, Any]:
        assert self._process.stdin
        assert self._process.stdout
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            self._process.communicate()
            status = self._process.returncode
            self._start()
            raise CannotRunError(f"{self._tree}: the process ended with status {status}")
        answer: dict[str, Any] = json.loads(line)
        if "missing" in answer:
            raise CannotRunError(f"{self._tree}: {answer['missing']}")
        return answer


class Meter:
    """Measures workloads of two trees by turns.

    Args:
        ours: Plays them in this tree.
        theirs: Plays them in the other one.
        rounds: Turns of each.
        seconds: Processor time of a turn of this tree.
    """

    def __init__(self, ours: Player, theirs: Player, rounds: int, seconds: float) -> None:
        self._players = (ours, theirs)
        self._rounds, self._seconds = rounds, seconds

    def compare(self, name: str) -> Row:
        """Measure a workload."""
        try:
            with ExitStack() as stack:
                for player in self._players:
                    stack.callback(_close, player)
                    player.open(name)
                return Row(name, *self._least(self._repeats()))
        except CannotRunError as reason:
            return Row(name, missing=str(reason))

    def _repeats(self) -> int:
        """How often a turn repeats a workload: the same for both."""
        repeats = 1
        while self._players[0].turn(repeats) < self._seconds:
            repeats *= 2
        self._players[1].turn(repeats)
        return repeats

    def _least(self, repeats: int) -> tuple[float, float]:
        times: dict[Player, list[float]] = {player: [] for player in self._players}
        order = list(self._players)
        for _ in range(self._rounds):
            for player in order:
                times[player].append(player.turn(repeats))
            order.reverse()
        ours, theirs = (min(times[player]) / repeats for player in self._players)
        return ours, theirs


def _close(player: Player) -> None:
    with suppress(CannotRunError):  # it could not be opened, either
        player.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, print the ratios, and return the exit status."""
    options = _checked(_parser(), arguments)
    names = [name for name in ROWS if _matches(name, options.only)]
    with ExitStack() as stack:
        ours, ours_too = (_player(stack, THIS, Path(sys.executable)) for _ in range(2))
        theirs = _player(stack, options.tree, options.python or _python_of(options.tree))
        effort = (options.rounds, options.seconds)
        itself = _measured(Meter(ours, ours_too, *effort), names)
        print(f"{_trust(itself)}\n", flush=True)
        meter = Meter(ours, theirs, *effort)
        rows = _again(meter, _measured(meter, names), options.limit)
    print(f"{_table(rows, itself, options)}\n")
    failures = list(_failures(rows, options))
    print("\n".join(failures) or "no row is beyond its limit")
    return 1 if failures else 0


def _measured(meter: Meter, names: Sequence[str]) -> list[Row]:
    passes = [[meter.compare(name) for name in names] for _ in range(PASSES)]
    return [reduce(Row.with_pass, rows) for rows in zip(*passes, strict=True)]


def _again(meter: Meter, rows: list[Row], limits: Sequence[tuple[str, float]]) -> list[Row]:
    """Measure rows that are beyond their limits again."""
    for _ in range(PASSES):
        rows = [
            row.with_pass(meter.compare(row.name)) if row.ratio > _limit(row.name, limits) else row
            for row in rows
        ]
    return rows


def _player(stack: ExitStack, tree: Path, python: Path) -> Player:
    player = Player(tree, python)
    stack.callback(player.end)
    return player


def _python_of(tree: Path) -> Path:
    own = tree / ".venv" / "bin" / "python"
    return own if own.exists() else Path(sys.executable)


# The command line


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tree", type=Path, help="the folder of the other tree, with its extension")
    parser.add_argument("--python", type=Path, help="its interpreter, if not TREE/.venv/bin/python")
    for name, form, text in (
        ("--limit", "[PATTERN=]RATIO", "the largest ratio of rows; the last that matches holds"),
        ("--only", "PATTERN", "rows to measure"),
        ("--allow-missing", "PATTERN", "rows that a tree need not be able to run"),
    ):
        kind = _pair if name == "--limit" else str
        parser.add_argument(name, type=kind, action="append", default=[], metavar=form, help=text)
    parser.add_argument("--rounds", type=int, default=15, help="turns of each tree in a pass")
    parser.add_argument("--seconds", type=float, default=0.002, help="processor time of a turn")
    return parser


def _pair(text: str) -> tuple[str, float]:
    pattern, _, ratio = text.rpartition("=")
    return pattern or "*", float(ratio)


def _checked(
    parser: argparse.ArgumentParser, arguments: Sequence[str] | None
) -> argparse.Namespace:
    options = parser.parse_args(arguments)
    options.tree = options.tree.resolve()
    if not (options.tree / "fmugym").is_dir():
        parser.error(f"{options.tree} has no package fmugym")
    if options.rounds < 1:
        parser.error(f"--rounds must be at least 1, got {options.rounds}")
    for pattern in [*options.only, *options.allow_missing, *(name for name, _ in options.limit)]:
        if not any(_matches(name, [pattern]) for name in ROWS):
            parser.error(f"no row matches '{pattern}'; there are: {', '.join(ROWS)}")
    return options


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)


def _limit(name: str, limits: Sequence[tuple[str, float]]) -> float:
    fitting = [ratio for pattern, ratio in limits if fnmatchcase(name, pattern)]
    return fitting[-1] if fitting else math.inf


# The results


def _trust(rows: Sequence[Row]) -> str:
    """How far this tree is from itself."""
    distances = sorted((abs(math.log(row.ratio)), row.name) for row in rows if not row.missing)
    if not distances:
        return "No row can run in this tree."
    middle = statistics.median(distance for distance, _ in distances)
    most = distances[math.ceil(0.9 * len(distances)) - 1][0]
    worst, name = distances[-1]
    return (
        f"This tree against itself, {len(distances)} rows: half are within {_percent(middle)},\n"
        f"nine of ten within {_percent(most)}, all within {_percent(worst)} ({name}).\n"
        "A ratio says nothing if it is closer to 1 than nine of ten of these, or than that of its\n"
        "row in the column 'itself'."
    )


def _percent(distance: float) -> str:
    return f"{100 * math.expm1(distance):.1f} %"


def _table(rows: Sequence[Row], itself: Sequence[Row], options: argparse.Namespace) -> Table:
    table = Table(
        f"This tree, and {options.tree}: processor time of a call",
        ["row", "other", "this", "this / other", "itself", "limit"],
    )
    for row, own in zip(rows, itself, strict=True):
        limit = _limit(row.name, options.limit)
        shown = "" if math.isinf(limit) else f"{limit:.2f}"
        cells = [duration(row.theirs), duration(row.ours), f"{row.ratio:.2f}", f"{own.ratio:.2f}"]
        table.rows.append([row.name, *(["missing", *[""] * 3] if row.missing else cells), shown])
    return table


def _failures(rows: Sequence[Row], options: argparse.Namespace) -> Iterator[str]:
    for row in rows:
        limit = _limit(row.name, options.limit)
        if row.missing:
            allowed = options.allow_missing and _matches(row.name, options.allow_missing)
            if not allowed:
                yield f"{row.name} cannot run in {row.missing}"
        elif not row.ratio <= limit:
            yield f"{row.name} takes {row.ratio:.3f} times as long, at most {limit} are allowed"


if __name__ == "__main__":
    sys.exit(main())
