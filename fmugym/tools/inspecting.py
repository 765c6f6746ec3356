"""The commands for an FMU or a task itself: info, new, skeleton, validate, stand-in, compile."""

from __future__ import annotations

import argparse
import json
import tomllib
from pathlib import Path

from fmugym.archive.fmu import FMU
from fmugym.errors import ConfigError
from fmugym.systems import FMUSystem
from fmugym.tools.compiling import compile_fmu
from fmugym.tools.options import (
    Commands,
    add_command,
    add_json,
    add_master,
    add_task,
    say,
    say_json,
    write_text,
)
from fmugym.tools.overview import as_text, overview, plain
from fmugym.tools.proposal import Proposal, preload_line
from fmugym.tools.skeleton import Skeleton
from fmugym.tools.stand_in import build_stand_in
from fmugym.tools.systems import as_text_of_system, find_model, open_model, overview_of_system
from fmugym.tools.targets import maker_of
from fmugym.tools.validation import validate

__all__ = ["add_compile", "add_info", "add_new", "add_skeleton", "add_stand_in", "add_validate"]


def add_info(commands: Commands) -> None:
    """Add ``info``."""
    text = "say what an FMU or a system is, where it runs, and which variables it has"
    command = add_command(commands, "info", _info, text)
    _add_fmu(command)
    add_master(command)
    add_json(command)
    command.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="draw the system of an SSP archive or a task file, for example system.svg",
    )
    command.add_argument("--all", action="store_true", help="list local and other variables too")
    command.add_argument(
        "--filter",
        metavar="GLOB",
        help="list only variables with a matching name, of any causality; * is any text, "
        "? one character",
    )


def _add_fmu(command: argparse.ArgumentParser) -> None:
    command.add_argument("fmu", type=Path, metavar="FMU")


def _info(arguments: argparse.Namespace) -> None:
    model = find_model(arguments.fmu, arguments.master)
    wanted = {"everything": arguments.all, "pattern": arguments.filter}
    if isinstance(model, FMUSystem):
        facts, as_lines = overview_of_system(model, **wanted), as_text_of_system
        if arguments.plot is not None:
            model.plot(arguments.plot)
    elif arguments.plot is None:
        facts, as_lines = overview(model, **wanted), as_text
    else:
        raise ConfigError("--plot is for systems; an FMU alone has no connections to draw")
    say(json.dumps(facts, indent=2, allow_nan=False) if arguments.json else as_lines(facts))


def add_new(commands: Commands) -> None:
    """Add ``new``."""
    text = "write a task file for an FMU, or a Python file with a class, to be filled in"
    command = add_command(commands, "new", _new, text)
    command.add_argument(
        "--class", action="store_true", dest="as_class", help="a class instead of a task file"
    )
    _add_output(command)


def _add_output(command: argparse.ArgumentParser) -> None:
    _add_fmu(command)
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new file, instead of standard output"
    )
    add_json(command)


def _new(arguments: argparse.Namespace) -> None:
    if arguments.as_class:
        _skeleton(arguments)
        return
    output: Path | None = arguments.output
    proposal = Proposal(open_model(arguments.fmu), None if output is None else output.parent)
    text, notes = proposal.text(), list(proposal.notes())
    if not arguments.json:
        write_text(text, output, notes)
        return
    if output is not None:
        write_text(text, output, [])
    say_json({"output": output, "task": tomllib.loads(text), "notes": notes})


def add_skeleton(commands: Commands) -> None:
    """Add ``skeleton``, another name of ``new --class``."""
    text = "write a Python file with an environment for an FMU, as new --class does"
    _add_output(add_command(commands, "skeleton", _skeleton, text))


def _skeleton(arguments: argparse.Namespace) -> None:
    skeleton = Skeleton(open_model(arguments.fmu))
    text, notes = skeleton.text(), list(skeleton.notes())
    if not arguments.json:
        write_text(text, arguments.output, notes)
        return
    if arguments.output is not None:
        write_text(text, arguments.output, [])
    say_json({"output": arguments.output, "program": text, "notes": notes})


def add_validate(commands: Commands) -> None:
    """Add ``validate``."""
    text = "run a few short episodes and say what is wrong with a task, and what to do about it"
    command = add_command(commands, "validate", _validate, text)
    add_task(command, ", or an FMU")
    add_json(command)


def _validate(arguments: argparse.Namespace) -> int:
    report = validate(maker_of(arguments.task, master=arguments.master, takes_fmu=True))
    if arguments.json:
        say_json({"task": arguments.task, **report.as_dict()})
    else:
        say(report.as_text())
    return int(report.verdict == "error")


def add_compile(commands: Commands) -> None:
    """Add ``compile``."""
    text = "compile the source code in an FMU for this machine, into a new FMU"
    command = add_command(commands, "compile", _compile, text)
    _add_fmu(command)
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="by default beside the FMU, with the platform"
    )
    add_json(command)


def _compile(arguments: argparse.Namespace) -> None:
    made = compile_fmu(arguments.fmu, arguments.output)
    if arguments.json:
        say_json({"output": made})
    else:
        say(plain(f"{made}: compiled for {FMU(made).platform}"))


def add_stand_in(commands: Commands) -> None:
    """Add ``stand-in``."""
    text = "build a replacement for an old libgfortran that an FMU needs; takes a C compiler"
    command = add_command(commands, "stand-in", _stand_in, text)
    _add_fmu(command)
    command.add_argument(
        "--folder", type=Path, default=Path(), help="where to write it; by default this folder"
    )
    add_json(command)


def _stand_in(arguments: argparse.Namespace) -> None:
    built = build_stand_in(FMU(arguments.fmu), arguments.folder)
    if arguments.json:
        libraries = [
            {"path": one.path, "functions": list(one.served), "without": list(one.lacking)}
            for one in built
        ]
        say_json({"preload": [one.path for one in built], "libraries": libraries})
        return
    for library in built:
        say(plain(f"{library.path}: {len(library.served)} functions"))
        for name in library.lacking:
            say(plain(f"  without {name}: an FMU that calls it ends its process"))
    line = preload_line([str(library.path) for library in built])
    say(f"Put it into the task file, below [config]: {line}")
    say(f'or into the config of a class: "preload": {line.removeprefix("preload = ")}')
