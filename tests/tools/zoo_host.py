"""A process in which cells of the zoo's table are visited: ``python zoo_host.py FOLDER [here]``.

It reads cells from standard input, a line of JSON each, and answers each with a line. Each is
visited by a fork, which may die or hang; or ``here``, where nothing is to happen to this process.
"""

import contextlib
import json
import os
import signal
import sys
import time
import traceback
from pathlib import Path

import zoo_tools

from fmugym.pool import native_pool  # noqa: F401 (so that the forks need not import it)
from fmugym.pool.processes.channel import describe_exit


def main(folder, *modes):
    answers = os.fdopen(os.dup(1), "w")
    output = os.open(folder / "output", os.O_CREAT | os.O_RDWR | os.O_APPEND)
    os.dup2(output, 1)
    visit = visit_and_write if "here" in modes else visit_in_fork
    for line in sys.stdin:
        size = os.fstat(output).st_size
        answer = visit(json.loads(line), folder / "answer")
        if os.fstat(output).st_size > size:
            answer[1].append("output")
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def visit_and_write(cell, path):
    """Visit a cell; the answer goes through a file, since pipes may be closed meanwhile."""
    try:
        answer = zoo_tools.visit(cell)
    except Exception:
        answer = [("broken", traceback.format_exc())], []
    path.write_text(json.dumps(answer))
    return json.loads(path.read_text())


def visit_in_fork(cell, path):
    path.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        os.setsid()
        visit_and_write(cell, path)
        os._exit(0)
    code = wait(child, cell["seconds"])
    with contextlib.suppress(ProcessLookupError):  # what the FMU has forked
        os.killpg(child, signal.SIGKILL)
    if code is None:
        return [("hangs", "")], []
    if path.exists():
        return json.loads(path.read_text())
    return [("dies", describe_exit(code))], []


def wait(child, seconds):
    """The exit status of a child; None if it had to be ended."""
    deadline = time.monotonic() + seconds
    while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0):
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(2e-3)
    return os.waitstatus_to_exitcode(ended[1])


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
