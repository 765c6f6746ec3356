"""The upper limit for all configurations: a C program that only steps an FMU.

    python benchmarks/c_limit.py --num-envs 1024 --threads 1

Called like this, it steps the cart-pole. It needs a C compiler: ``cc``, ``gcc`` or ``clang``, or
the package ``ziglang``.
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

__all__ = [
    "BLOCK",
    "Loop",
    "Rates",
    "build",
    "build_folder",
    "cart_pole",
    "compile_c",
    "measure",
    "repeat",
]

SOURCE = Path(__file__).with_suffix(".c")

BLOCK = 16
"""How many steps of all instances ``repeat`` measures at a time, as in ``c_limit.c``."""


class Loop(NamedTuple):
    """What the program does with an FMU of FMI 2.0; each dict is by variable name.

    Attributes:
        fmu: The FMU; its folder lives as long as the object.
        time_step: The communication step size in s.
        inputs: The magnitudes of the inputs; their sign is random.
        outputs: The largest absolute values of the outputs; a larger one leads to a reset.
        starts: The widths of the intervals around 0 from which start values are drawn.
        parameters: The fixed parameters; an int is for an Integer or an Enumeration.
    """

    fmu: fmugym.FMU
    time_step: float
    inputs: dict[str, float]
    outputs: dict[str, float]
    starts: dict[str, float]
    parameters: dict[str, float]

    def items(self) -> list[str]:
        """The variables as the program takes them."""
        named: dict[str, dict[str, float]] = {
            "u": self.inputs,
            "y": self.outputs,
            "s": self.starts,
            "r": {k: v for k, v in self.parameters.items() if isinstance(v, float)},
            "i": {k: v for k, v in self.parameters.items() if isinstance(v, int)},
        }
        return [
            f"{kind}:{self.fmu.variable(name).value_reference}={value!r}"
            for kind, values in named.items()
            for name, value in values.items()
        ]


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
def build_folder() -> Path:
    """A folder for what is compiled, which is deleted when Python ends."""
    folder = Path(tempfile.mkdtemp(prefix="fmugym-benchmarks-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@functools.cache
def build() -> Path:
    """Compile the program once.

    Raises:
        MissingError: See ``compile_c``.
    """
    program = build_folder() / "c_limit"
    compile_c(SOURCE, program, "-lm", "-ldl", "-lpthread")
    return program


@functools.cache
def cart_pole() -> Loop:
    """Gymnasium's cart-pole: a uniform rod, explicit Euler."""
    return Loop(
        fmugym.FMU(fmugym.bundled_fmu("CartPole")),
        time_step=0.02,
        inputs={"f": 10.0},
        outputs={"x": 2.4, "x_dot": math.inf, "phi": math.radians(12.0), "phi_dot": math.inf},
        starts={"x_0": 0.1, "x_dot_0": 0.1, "phi_0": 0.1, "phi_dot_0": 0.1},
        parameters={
            "m_cart": 1.0,
            "m_pole": 0.1,
            "pole_length": 1.0,
            "g": 9.8,
            "max_step": 1.0,
            "theta_0": math.pi / 2,
            "pole_type": 2,
            "solver": 1,
        },
    )


def measure(loop: Loop, num_envs: int, threads: int = 1, seconds: float = 1.0) -> Rates:
    """Run the program.

    Args:
        loop: What it steps.
        num_envs: Number of instances of all threads together.
        threads: Number of threads; each steps its share of the instances without waiting.
        seconds: Length of the run.

    Raises:
        MissingError: See ``compile_c``.
    """
    return Rates(*_run(loop, num_envs, threads, seconds))


def repeat(loop: Loop, num_envs: int, record: Path, seconds: float = 1.0) -> list[float]:
    """Let the program repeat recorded steps on one thread.

    Args:
        loop: Its starts and inputs name the variables whose values are in the record.
        num_envs: Number of instances.
        record: A file; ``c_limit.c`` describes it.
        seconds: Length of the run, at least one repetition.

    Returns:
        The least time in s of each ``BLOCK`` steps of all instances, without resets.
    """
    return _run(loop, num_envs, 1, seconds, f"@{record}")


def _run(loop: Loop, num_envs: int, threads: int, seconds: float, *arguments: str) -> list[float]:
    fmu = loop.fmu
    command = [str(build()), str(fmu.extract() / fmu.library), fmu.description.instantiation_token]
    command += [str(num_envs), str(threads), str(seconds), str(loop.time_step), *loop.items()]
    result = subprocess.run([*command, *arguments], check=True, capture_output=True, text=True)
    return [float(number) for number in result.stdout.split()]


def main() -> None:
    """Measure, and print both rates."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1.0)
    arguments = parser.parse_args()
    rates = measure(cart_pole(), arguments.num_envs, arguments.threads, arguments.seconds)
    print(f"{rates.wall / 1e6:.2f} M steps/s, {rates.cpu / 1e6:.2f} M steps/CPU-s")


if __name__ == "__main__":
    main()
