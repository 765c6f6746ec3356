"""An FMU that harms its process (``faulty.c``), and an environment over it."""

import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path

import building
import model_tools
import pytest
from zoo_tools import CALLS, ZooEnv

FAULTS = (
    *("none", "crash", "abort", "exit", "hang", "close", "pause", "leak", "scribble"),
    *("traced", "traced by child", "traced and stop", "traced and crash"),
)

VARIABLES = (
    ("u", "input", 'start="0"'),
    ("y", "output", ""),
    *((name, "parameter", 'start="0"') for name in ("fault", "stage", "at")),
)


INTERRUPTIBLE = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
"""
"""The begin of a program that obeys Ctrl-C although its parent ignores it, as in the background."""


def run_python(*command, environment=(), timeout=100, check=False, **options):
    """Run Python in a process of its own; the options are those of ``subprocess.run``."""
    path = os.pathsep.join(filter(None, [building.PATH, os.environ.get("PYTHONPATH")]))
    own = {"PYTHONPATH": path, "MALLOC_PERTURB_": "85", **dict(environment)}
    return subprocess.run(
        [sys.executable, *map(str, command)],
        env=os.environ | own,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=check,
        **options,
    )


def faulty_fmu(folder, token="{faulty-0}", capabilities=""):
    """Write the FMU; the token ``{faulty-F}`` lets it fail in its instantiation."""
    flags = 'canHandleVariableCommunicationStepSize="true" '
    flags += f"{model_tools.STATES[2]} {capabilities}"
    path = Path(folder) / "Faulty.fmu"
    return model_tools.model_fmu(path, "faulty", 2, token, VARIABLES, flags=flags, name="Faulty")


def start_values(fault="none", stage="step", at=2):
    """The parameters that ask for a fault in a call, of ``zoo_tools.CALLS``."""
    return {"fault": FAULTS.index(fault), "stage": CALLS.index(stage), "at": at}


class FaultyEnv(ZooEnv):
    """Integrates its action until the FMU does what its parameters say."""

    def __init__(self, path, fault="none", stage="step", at=2, **config):
        own = {"model_parameters": start_values(fault, stage, at), "isolation": "process"}
        super().__init__(path, **own | config)


def _processes(is_meant):
    """The numbers of the processes that live and of which something holds, by their folders."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            with contextlib.suppress(OSError):  # it has ended, or is another user's
                found += [int(process.name)] if is_meant(process) else []
    return found


def processes_with(folder):
    """The numbers of the processes, other than this one, that have a file of a folder mapped."""
    own = str(os.getpid())
    return _processes(lambda one: one.name != own and str(folder) in (one / "maps").read_text())


def processes_of_session(leader):
    """The numbers of the processes that live, or wait for their parent, in a session."""
    return _processes(
        lambda one: int((one / "stat").read_text().rpartition(")")[2].split()[3]) == leader
    )


def processes_told_of(folder):
    """The numbers of the processes that live and whose environment variables name a folder."""
    return _processes(lambda one: os.fsencode(folder) in (one / "environ").read_bytes())


@contextlib.contextmanager
def no_descriptors_left(left=0):
    """Let this process open no files, sockets or pipes, or only a few."""
    import resource  # not on Windows

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(256, hard), hard))
    taken = []
    try:
        with contextlib.suppress(OSError):
            while True:
                taken.append(os.open(os.devnull, os.O_RDONLY))
        for _ in range(left):
            os.close(taken.pop())
        yield
    finally:
        for descriptor in taken:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


posix_only = pytest.mark.skipif(os.name != "posix", reason="needs signals and forks")


linux_only = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@pytest.fixture(name="faulty", scope="module")
def fixture_faulty(tmp_path_factory):
    """The FMU of ``faulty.c``."""
    return faulty_fmu(tmp_path_factory.mktemp("faulty"))


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(condition, seconds=20.0):
    """Wait for what is bound to happen soon."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
