"""The command line: a first look at an FMU, and the first lines of an environment for it.

::

    fmugym info model.fmu [--json] [--all] [--filter GLOB]
    fmugym skeleton model.fmu [--output my_env.py]
    fmugym stand-in model.fmu [--folder FOLDER]

None of them executes anything of the FMU. Output is printable ASCII. The exit code is 0, 1 if the
FMU or a file cannot be used (one line on the error stream says why), or 2 if the arguments are
wrong.

``info --json`` prints one object. New versions may add keys; ``schema`` is raised when a key goes
or changes its meaning. What the FMU does not give is null, or ``""`` for a text.

- ``schema``: 1
- ``path``: absolute path of the FMU
- ``fmi_version``, ``model_name``, ``model_identifier``, ``instantiation_token``, ``description``,
  ``generation_tool``: texts of the XML
- ``interfaces``: of ``co-simulation``, ``model exchange``, ``scheduled execution``
- ``platforms``: the folders under ``binaries/``
- ``platform``, ``library``: the folder and the file that this machine needs
- ``runs_here``: whether nothing is known that would keep the FMU from being loaded
- ``obstacles``: texts, what keeps the FMU from being loaded and what to do about it
- ``missing_libraries``: the shared libraries that it needs and this machine lacks (Linux), each
  with ``name``, the packages ``debian`` and ``conda`` that have it, and a ``note``
- ``missing_tool``: the tool that must be installed as well; null if none is known to be missing
- ``trial``: what the first meeting on this machine has shown: ``deterministic``, the grades of
  ``resets`` by method, the ``reset_method``, what ``several_instances`` need, ``isolate``,
  the grade of an ``initial_state`` in another process, how many ``instances_at_once`` it used, and
  the ``deaths`` of workers; null before
- ``capabilities``: flags by name, those of ``fmugym.archive.description.Capabilities``
- ``default_experiment``: ``start_time``, ``stop_time``, ``step_size`` in s, and ``tolerance``
- ``fixed_internal_step_size``: in s
- ``findings``: texts, what breaks rules in the archive and in the model description
- ``variable_counts``: number of all variables by causality
- ``variables``: those that were asked for, in the order of the XML, each with ``name``,
  ``causality``, ``variability``, ``initial``, ``type``, ``shape``, ``unit``, ``min``, ``max``,
  ``nominal``, ``start`` (in the variable's type; a text for arrays and for what is malformed or not
  finite), ``items`` (each with ``name`` and ``value``), ``description``, ``settable_at_start`` and
  ``settable_in_step``
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from fmugym.archive.fmu import FMU
from fmugym.errors import FMUGymError
from fmugym.tools.overview import as_text, overview, plain
from fmugym.tools.skeleton import Skeleton
from fmugym.tools.stand_in import build_stand_in

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: The arguments; by default those of the process.

    Returns:
        The exit code, 0 or 1.

    Raises:
        SystemExit: With the code 2 if the arguments are wrong, 0 after ``--help``.
    """
    arguments = _parser().parse_args(argv)
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, for example ``head``, has ended
        _drop_output()
    except (FMUGymError, OSError) as error:
        print(f"fmugym: error: {plain(error)}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "fmugym", description="Look at a co-simulation FMU and make an environment of it."
    )
    parser.add_argument("--version", action="version", version=version("fmugym-toolbox"))
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_info(commands)
    _add_skeleton(commands)
    _add_stand_in(commands)
    return parser


def _add_info(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "say what an FMU is, where it runs, and which variables it has"
    info = commands.add_parser("info", help=text, description=text.capitalize() + ".")
    info.set_defaults(run=_info)
    info.add_argument("fmu", type=Path, metavar="FMU")
    info.add_argument("--json", action="store_true", help="print one JSON object")
    info.add_argument("--all", action="store_true", help="list local and other variables too")
    info.add_argument(
        "--filter",
        metavar="GLOB",
        help="list only variables with a matching name, of any causality; * is any text, "
        "? one character",
    )


def _add_skeleton(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "write a Python file with an environment for an FMU, to be filled in"
    command = commands.add_parser("skeleton", help=text, description=text.capitalize() + ".")
    command.set_defaults(run=_skeleton)
    command.add_argument("fmu", type=Path, metavar="FMU")
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new file, instead of standard output"
    )


def _add_stand_in(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "build a replacement for an old libgfortran that an FMU needs; takes a C compiler"
    command = commands.add_parser("stand-in", help=text, description=text.capitalize() + ".")
    command.set_defaults(run=_stand_in)
    command.add_argument("fmu", type=Path, metavar="FMU")
    command.add_argument(
        "--folder", type=Path, default=Path(), help="where to write it; by default this folder"
    )


def _info(arguments: argparse.Namespace) -> None:
    fmu = FMU(arguments.fmu)
    facts = overview(fmu, everything=arguments.all, pattern=arguments.filter)
    print(json.dumps(facts, indent=2, allow_nan=False) if arguments.json else as_text(facts))


def _skeleton(arguments: argparse.Namespace) -> None:
    skeleton = Skeleton(FMU(arguments.fmu))
    if arguments.output is None:
        print(skeleton.text(), end="")
    else:
        with arguments.output.open("x", encoding="ascii", newline="\n") as file:
            file.write(skeleton.text())
    for note in skeleton.notes():
        print(f"fmugym: note: {plain(note)}", file=sys.stderr)


def _stand_in(arguments: argparse.Namespace) -> None:
    built = build_stand_in(FMU(arguments.fmu), arguments.folder)
    for library in built:
        print(plain(f"{library.path}: {len(library.served)} functions"))
        for name in library.lacking:
            print(plain(f"  without {name}: an FMU that calls it ends its process"))
    paths = ", ".join(repr(str(library.path)) for library in built)
    print(plain(f'Put it into the config: "preload": [{paths}]'))


def _drop_output() -> None:
    """Discard what is still buffered, which the interpreter would complain about at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
