"""Rewrite golden results of named cases, on purpose.

    python tests/golden/make.py --only NAME [NAME ...] --why TEXT
    python tests/golden/make.py --show NAME ROW

TEXT is a sentence of ``CHANGELOG.md`` that says why results change; a test looks for it there. The
names are those of ``task_cases.py`` and ``cases.py``; a ``*`` stands for any text. A case that has
no result yet needs no sentence. ``--show`` prints a row in full, to compare it with that of another
revision.

The results of pools in ``results.json`` are those of a second implementation, which there was once
(revision 179b934). Those of tasks in ``tasks.json`` were made at revision 0ce11fa0.
"""

import argparse
import contextlib
import fnmatch
import json
import logging
import os
import sys
import tempfile
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path[:0] = map(str, (TESTS, TESTS / "tools", TESTS.parent / "benchmarks", TESTS.parent))
os.environ |= {"FMUGYM_PROBE": "off", "SDL_VIDEODRIVER": "dummy"}  # as in the tests


def main():
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[])
    parser.add_argument("--why", metavar="TEXT")
    parser.add_argument("--show", nargs=2, metavar=("NAME", "ROW"))
    given = parser.parse_args()
    logging.disable()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FMUGYM_CACHE_DIR"] = str(Path(folder, "cache"))
        if given.show:
            name, number = given.show
            sys.stdout.write(json.dumps(played(name, Path(folder))[int(number)], indent=1) + "\n")
        rewrite(given.only, given.why, Path(folder))


def rewrite(patterns, why, folder):
    """Play cases, and write their results and the reason for a change."""
    from golden import cases, records, task_cases

    for path, known in (
        (records.TASKS, task_cases.cases()),
        (records.POOLS, cases.cases()),
    ):
        results = records.read(path) if path.exists() else {}
        before = dict(results)
        for name in known:
            if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns):
                results[name] = result_of(name, folder)
        changed = [name for name in results if results[name] != before.get(name)]
        note(changed, before, why)
        if changed:
            records.write(path, {name: results[name] for name in known if name in results})


def note(changed, before, why):
    """Keep which results have changed, what they were, and why."""
    from golden import records

    changes = records.read(records.CHANGES)
    for name in changed:
        sys.stdout.write(f"{name}\n")
        if name not in before:
            changes[name] = {"was": None, "why": "new"}
        elif why is None:
            sys.exit(f"{name} differs from its result: say why, as CHANGELOG.md does (--why)")
        else:
            was = before[name].get("all") or records.hash_of(before[name], 16)
            changes[name] = {"was": was} | changes.get(name, {}) | {"why": why}
    records.write(records.CHANGES, changes)


def played(name, folder):
    """The rows of a task's case."""
    from golden import task_cases

    with contextlib.redirect_stdout(sys.stderr):
        return list(task_cases.cases()[name](folder))


def result_of(name, folder):
    """What a results file has of a case."""
    from golden import cases, records

    if name not in cases.cases():
        return records.record_of(played(name, folder))
    values = cases.cases()[name](folder)
    numbers = " ".join(float(value).hex() for value in values.ravel())
    return {"shape": list(values.shape), "values": numbers}


if __name__ == "__main__":
    main()
