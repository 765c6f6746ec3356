"""The limit of all configurations: a C program that does nothing but step the cart-pole FMU.

    python benchmarks/c_limit.py --num-envs 1024 --threads 1

A C compiler is needed: ``cc`` or ``gcc``, or else the package ``ziglang``.
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
    """Steps per second of all threads together, resets included in the time.

    Attributes:
        wall: By the wall clock.
        cpu: Per second of processor time.
    """

    wall: float
    cpu: float


def compile_c(source: Path, target: Path, *options: str) -> None:
    """Compile a C program, or a library.

    Raises:
        MissingError: Without a compiler, or if it refuses the program, as that of another system.
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
    """Compile the program once; the FMU is kept, as its folder goes with it.

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
        num_envs: Number of instances, of all threads together.
        threads: Each steps its part of the instances, and none waits for another.
        seconds: For how long.
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
    """Print both rates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1.0)
    arguments = parser.parse_args()
    rates = measure(arguments.num_envs, arguments.threads, arguments.seconds)
    print(f"{rates.wall / 1e6:.2f} M steps/s, {rates.cpu / 1e6:.2f} M steps/CPU-s")


if __name__ == "__main__":
    main()
