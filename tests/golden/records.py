"""Records of golden cases: short, and precise enough to tell the first row that differs.

A record has the number of rows, the first of them as numbers for readers, two hexadecimal digits of
a hash for each quantity of each row, and a hash of all. Results are exact on x86-64 Linux;
elsewhere compilers and libraries of mathematics round in other ways, so that only the first rows
are compared, with a tolerance.
"""

import hashlib
import json
import math
import platform
import sys
from pathlib import Path

HERE = Path(__file__).parent
TASKS, POOLS, CHANGES = (HERE / f"{name}.json" for name in ("tasks", "results", "changes"))
IS_EXACT = sys.platform == "linux" and platform.machine() == "x86_64"
FIRST = 2
"""Rows that stand in a record as numbers."""

LONGEST = 3
"""Elements of a list that stand there."""

TOLERANCE = 1e-5
"""On other machines; some observations are float32."""


def hash_of(value, digits):
    """Digits of a hash of numbers in lists and dicts."""
    text = json.dumps(value, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:digits]


def record_of(rows):
    """The record of a case."""
    return {
        "rows": len(rows),
        "first": [shortened(row) for row in rows[:FIRST]],
        "each": " ".join(map(digits_of, rows)),
        "all": hash_of(rows, 16),
    }


def digits_of(row):
    """Two digits for each quantity, in the order of their names."""
    return "".join(hash_of(row[name], 2) for name in sorted(row))


def shortened(value):
    """The same with the first elements of lists only."""
    if isinstance(value, dict):
        return {name: shortened(one) for name, one in value.items()}
    if isinstance(value, list):
        rest = ["..."] * (len(value) > LONGEST)
        return [shortened(one) for one in value[:LONGEST]] + rest
    return value


def difference(record, rows):
    """In words, where rows differ from their record first; None if they do not."""
    if not IS_EXACT:
        return rough_difference(record, rows)
    if record["all"] == hash_of(rows, 16):
        return None
    for number, (row, digits) in enumerate(zip(rows, record["each"].split(), strict=False)):
        if digits_of(row) != digits:
            return in_words(number, row, digits, record["first"][number : number + 1])
    return f"there were {record['rows']} rows, and are {len(rows)}"


def rough_difference(record, rows):
    """In words, how the first rows differ by more than the tolerance; None if they do not."""
    found = [shortened(row) for row in rows[:FIRST]]
    if len(rows) == record["rows"] and are_close(found, record["first"]):
        return None
    return f"{record['rows']} rows, the first {record['first']}, are {len(rows)}: {found}"


def in_words(number, row, digits, before):
    """A row that differs: its quantities now and, where the record has them, before."""
    names = sorted(row)
    if len(digits) == 2 * len(names):
        names = [n for i, n in enumerate(names) if hash_of(row[n], 2) != digits[2 * i : 2 * i + 2]]
    scene = f" of {row['scene']!r}" if "scene" in row else ""
    now = ", ".join(f"{name} {shortened(row[name])}" for name in names)
    was = "".join(f"; it was {', '.join(f'{n} {one.get(n)}' for n in names)}" for one in before)
    return f"row {number}{scene} differs in {' and '.join(names)}: it is {now}{was}"


def are_close(one, other):
    """Whether numbers in lists and dicts are equal but for rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(are_close(one[k], other[k]) for k in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(are_close, one, other))
    if isinstance(one, float) and isinstance(other, float):
        both_nan = math.isnan(one) and math.isnan(other)
        return both_nan or math.isclose(one, other, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
    return one == other


def read(path):
    """The results in a file, by case."""
    return json.loads(path.read_text(encoding="utf-8"))


def write(path, results):
    """Write results, one case a line."""
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(one)}" for name, one in results.items())
    path.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def all_results():
    """What each case has given, of tasks and of pools: a short hash by name."""
    tasks = {name: record["all"] for name, record in read(TASKS).items()}
    pools = {name: hash_of(result, 16) for name, result in read(POOLS).items()}
    assert not tasks.keys() & pools.keys()
    return tasks | pools
