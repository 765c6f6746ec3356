"""Tools of the tests of the examples."""

import os
import subprocess
import sys

from fmu_tools import HERE

EXAMPLES = HERE.parent / "examples"


def run_example(name, *arguments, folder=None, warnings="error", **environment):
    """Run an example as a reader would; returns what it prints, and nothing may be complained of.

    Args:
        name: Of the file.
        arguments: Of its command line.
        folder: The working directory.
        warnings: Python's option ``-W``.
        environment: More variables.
    """
    command = [sys.executable, "-X", "utf8", "-W", warnings, EXAMPLES / name, *map(str, arguments)]
    variables = {**os.environ, "MPLBACKEND": "Agg", **environment}
    output = {"capture_output": True, "text": True, "encoding": "utf-8"}
    done = subprocess.run(command, cwd=folder, env=variables, timeout=300, **output)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout
