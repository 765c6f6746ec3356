"""The upper limit for all configurations: a C program that only steps the cart-pole FMU.

    python benchmarks/c_limit.py --num-envs 1024 --threads 1

It needs a C compiler: ``cc``, ``gcc`` or ``clang``, or the package ``ziglang``.
"""

from __future__ import annotations

import argparse
import atexit
import functools
import importlib.util
import math
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from measure import MissingError

import fmugym

__all__ = ["Rates", "build", "compile_c", "measure"]

SOURCE = Path(__file__).with_suffix(".c")
TIME_STEP = 0.02
REALS = {
    "m_cart": 1.0,
    "m_pole": 0.1,
    "pole_length": 1.0,
    "g": 9.8,
    "max_step": 1.0,
    "theta_0": math.pi / 2,
}
INTEGERS = {"pole_type": 2, "solver": 1}
"""Gymnasium's cart-pole: a uniform rod, explicit Euler."""


class Rates(NamedTuple):
    """Steps per second of all threads together; the time includes resets.

    Attributes:
        wall: Steps per second of wall-clock time.
        cpu: Steps per second of processor time.
    """

    wall: float
    cpu: float


def compile_c(source: Path, target: Path, *options: str) -> None:
    """Compile a C program or a library.

    Raises:
        MissingError: If there is no compiler, or the program does not compile on this system.
    """
    command = [*_compiler(), "-O2", "-Wall", "-Wextra", "-o", str(target), str(source), *options]
    try:
        subprocess.run(command, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise MissingError("not compiled here") from error


def _compiler() -> list[str]:
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return [name]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc"]
    raise MissingError("no C compiler")


@functools.cache
def build() -> tuple[Path, fmugym.FMU]:
    """Compile the program once. The FMU is kept, because its folder lives as long as it does.

    Raises:
        MissingError: See ``compile_c``.
    """
    folder = Path(tempfile.mkdtemp(prefix="c-limit-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    program = folder / "c_limit"
    compile_c(SOURCE, program, "-lm", "-ldl", "-lpthread")
    fmu = fmugym.FMU(fmugym.bundled_fmu("CartPole"))
    fmu.extract()
    return program, fmu


def measure(num_envs: int, threads: int = 1, seconds: float = 1.0) -> Rates:
    """Run the program.

    Args:
        num_envs: Number of instances of all threads together.
        threads: Number of threads; each steps its share of the instances without waiting.
        seconds: Length of the run.
    """
    program, fmu = build()
    names = ["f", "x", "x_dot", "phi", "phi_dot", "x_0", "x_dot_0", "phi_0", "phi_dot_0"]
    references = [str(fmu.variable(name).value_reference) for name in names]
    parameters = [f"r:{fmu.variable(n).value_reference}={v!r}" for n, v in REALS.items()]
    parameters += [f"i:{fmu.variable(n).value_reference}={v}" for n, v in INTEGERS.items()]
    command = [str(program), str(fmu.extract() / fmu.library), fmu.description.instantiation_token]
    command += [str(num_envs), str(threads), str(seconds), str(TIME_STEP), *references]
    result = subprocess.run([*command, *parameters], check=True, capture_output=True, text=True)
    return Rates(*map(float, result.stdout.split()))


def main() -> None:
    """Measure, and print both rates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1.0)
    arguments = parser.parse_args()
    rates = measure(arguments.num_envs, arguments.threads, arguments.seconds)
    print(f"{rates.wall / 1e6:.2f} M steps/s, {rates.cpu / 1e6:.2f} M steps/CPU-s")


if __name__ == "__main__":
    main()
