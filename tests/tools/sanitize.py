"""Run the stress of the native pool with sanitizers: errors of memory, of arithmetic, of threads.

    python tests/tools/sanitize.py [--seconds 30] [--systems 100] [--only address thread]

Builds the C extension with gcc's address and undefined-behaviour sanitizers, and with its thread
sanitizer, each into a copy of the package, and runs ``native_stress.py``, ``fuzz_systems.py`` and
``fuzz_forms.py`` on it. Needs gcc on Linux. Prints each finding; the exit status is 0 if there is
none.
"""

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

HERE = Path(__file__).resolve().parents[1]
TOP = HERE.parent
SUPPRESSIONS = HERE / "sanitize"


class Sanitizer(NamedTuple):
    """How to build with a sanitizer, and how to run.

    Attributes:
        flags: For the compiler.
        libraries: To be loaded before anything else, as Python was built without them.
        environment: Its options.
    """

    flags: str
    libraries: tuple[str, ...]
    environment: dict[str, str]


SANITIZERS = {
    # Python keeps memory to its end, and what it allocates with its own allocator is not seen.
    "address": Sanitizer(
        "address,undefined",
        ("libasan.so", "libubsan.so"),
        {
            "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1:handle_segv=0",
            "UBSAN_OPTIONS": "halt_on_error=1:print_stacktrace=1",
            "PYTHONMALLOC": "malloc",
        },
    ),
    # Signal handlers of Python do no more than note the signal. The thread of pythonfmu is its own.
    "thread": Sanitizer(
        "thread",
        ("libtsan.so",),
        {
            "TSAN_OPTIONS": f"exitcode=66:suppressions={SUPPRESSIONS / 'thread.txt'}:"
            "report_signal_unsafe=0:report_thread_leaks=0:history_size=4",
            "PYTHONMALLOC": "malloc",
        },
    ),
}


def build(sanitizer, folder):
    """Copy the package and compile the extension into the copy."""
    package = folder / "fmugym"
    shutil.copytree(TOP / "fmugym", package, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    shutil.copytree(TOP / "resources" / "fmus", package / "fmus")
    command = ["gcc", "-std=gnu11", "-O1", "-g", "-fno-omit-frame-pointer", "-shared", "-fPIC"]
    command += [f"-fsanitize={sanitizer.flags}", "-fno-sanitize-recover=undefined"]
    command += ["-ffp-contract=off", "-fvisibility=hidden", "-DPy_LIMITED_API=0x030B0000"]
    folders = TOP / "native", sysconfig.get_path("include"), np.get_include()
    command += [f"-I{folder}" for folder in folders]
    sources = (path for path in (TOP / "native").glob("**/*.c") if path.name != "main.c")
    command += map(str, sorted(sources))
    command += ["-o", str(package / "_native.abi3.so"), "-lm", "-lpthread", "-ldl"]
    subprocess.run(command, check=True)


def library(name):
    """The path of a library of gcc's."""
    command = ["gcc", f"-print-file-name={name}"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def run(sanitizer, folder, *command):
    """Run Python on the copy; returns the exit status."""
    environment = (
        os.environ
        | sanitizer.environment
        | {
            "PYTHONPATH": f"{folder}{os.pathsep}{HERE / 'tools'}",
            "LD_PRELOAD": " ".join(map(library, sanitizer.libraries)),
            "FMUGYM_PROBE": "off",
            "FMUGYM_CACHE_DIR": str(folder / "cache"),
            "OPENBLAS_NUM_THREADS": "1",
        }
    )
    return subprocess.run([sys.executable, *command], env=environment, cwd=folder).returncode


def runs(name, seconds, seeds, systems):
    """What is run: by name, the arguments of Python."""
    for seed in range(seeds):
        stress = str(HERE / "tools" / "native_stress.py"), str(seconds), str(seed)
        words = ["python"] if seed % 2 else []
        words += ["in-turn"] if name == "thread" else []
        yield f"seed {seed}", (*stress, *words)
    for what, count in (("systems", systems), ("forms", 10 * systems)):
        yield what, (str(HERE / "tools" / f"fuzz_{what}.py"), "--count", str(count))


def check(name, seconds, seeds, systems):
    """Run the stress with a sanitizer.

    Returns:
        Whether it found nothing.
    """
    sanitizer = SANITIZERS[name]
    clean = True
    with tempfile.TemporaryDirectory() as folder:
        build(sanitizer, Path(folder))
        for what, command in runs(name, seconds, seeds, systems):
            begin = time.monotonic()
            status = run(sanitizer, Path(folder), *command)
            took = time.monotonic() - begin
            verdict = "clean" if status == 0 else f"FAILED with exit status {status}"
            print(f"{name}, {what}: {verdict} after {took:.0f} s", flush=True)
            clean = clean and status == 0
    return clean


def main():
    parser = argparse.ArgumentParser(description="Stress the native pool with sanitizers.")
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--systems", type=int, default=100)
    parser.add_argument("--only", nargs="+", choices=SANITIZERS, default=list(SANITIZERS))
    arguments = parser.parse_args()
    given = arguments.seconds, arguments.seeds, arguments.systems
    results = [check(name, *given) for name in arguments.only]
    sys.exit(not all(results))


if __name__ == "__main__":
    main()
