"""Write the golden results: what the pool in Python gave for all cases before it went.

    git worktree add BEFORE 179b934
    PYTHONPATH=BEFORE:BEFORE/tests:tests:tests/tools:benchmarks python -P -m golden.make RESULTS

RESULTS is the file to write. The package that Python imports makes them, so run this with the
environment of that revision; its own tests come first.
"""

import json
import sys
import tempfile
from pathlib import Path

from golden.cases import cases


def written(values):
    """Numbers as a text that loses nothing."""
    return " ".join(float(value).hex() for value in values.ravel())


def main():
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, case in cases().items():
            values = case(Path(folder), native=False)
            results[name] = {"shape": values.shape, "values": written(values)}
    Path(sys.argv[1]).write_text(json.dumps(results, indent=0), encoding="utf-8")


if __name__ == "__main__":
    main()
