"""Write the golden results: what the pool in Python gave for all cases before it went.

    git worktree add BEFORE 179b934
    python tests/golden/make.py RESULTS

RESULTS is the file to write. The package that Python imports makes them, so run this with the
environment of that revision, and with its tests beside it (PYTHONPATH=BEFORE/tests).
"""

import json
import sys
import tempfile
from pathlib import Path

import cases


def written(values):
    """Numbers as texts that lose nothing."""
    return [float(value).hex() for value in values.ravel()]


def main():
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, case in cases.cases().items():
            values = case(Path(folder), native=False)
            results[name] = {"shape": values.shape, "values": written(values)}
    Path(sys.argv[1]).write_text(json.dumps(results, indent=0), encoding="utf-8")


if __name__ == "__main__":
    main()
