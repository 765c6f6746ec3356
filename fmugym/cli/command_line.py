"""Command line of fmugym: its parser, its standard streams, and the run of a command.

::

    fmugym info model.fmu|system.ssp|task.toml [--all] [--filter GLOB]
    fmugym info --repair model.fmu [--output PATH]
    fmugym info minari:NAME [--output FOLDER]
    fmugym new model.fmu [--class] [--output task.toml]
    fmugym validate TASK|model.fmu
    fmugym simulate TASK [WHO ...] [--scenario NAME] [EPISODES] [--output FILE ...]
        [--variables GLOB ...] [--every SECONDS]
    fmugym simulate TASK --output minari:NAME [WHO | --log plant.csv ...] [EPISODES]
    fmugym train TASK --output FOLDER [--algorithm PPO] [--steps N] [--envs N] [--seed N]
        [--episodes N] [--no-normalize] [--resume] [--tune N] [--track mlflow|wandb]
        [--record GLOB ...] [--record-env N ...] [--record-every SECONDS] [--record-format csv]
        [KEY=VALUE ...]
    fmugym evaluate TASK [WHO ...] [--scenario NAME ...] [EPISODES] [--plot scores.png]
    fmugym tune TASK CONTROLLER [--scenario NAME] [--rounds N] [--candidates N] [EPISODES]
        [--output tuned.toml] [--name NAME]
    fmugym fit TASK --log plant.csv ... --parameter NAME[=LOW..HIGH] ... [--start NAME[=OUTPUT] ...]
        [--column COLUMN=VARIABLE ...] [--wash-in TIME] [--candidates N] [--output fitted.toml]
        [--plot fit.png]
    fmugym export AGENT|--controller TEXT --task TASK --output agent.c|agent.fmu|agent.onnx
        [--algorithm PPO] [--all-inputs] [--external NAME ...] [--fmi 2.0|3.0] [--platform NAME ...]
    fmugym simulate TASK --plant [ADDRESS] [WHO] [--ahead TIME] [--speed X] [--output FILE ...]
    fmugym serve TASK [WHO] [--port N] [--speed X] [--steps N] [--seed N]
    fmugym bench TASK|model.fmu [--envs N ...] [--seconds S]

TASK is a task file, a registered id or ``module:Class``. WHO is ``--action random|NUMBERS``,
``--controller TEXT`` or ``--agent FOLDER``. EPISODES are ``--episodes N``, ``--seed N`` and
``--steps N``. All commands take ``--json``, ``-q`` and ``-v``; those that write files ``--force``.

``info`` and ``new --class`` execute nothing of the FMU, the others do. Output is printable text;
letters that the console lacks are escaped. The exit code is 0; 1 if something cannot be used (the
error stream says why), ``validate`` finds an error, ``simulate`` meets a reward that is no finite
number, or ``evaluate`` or ``simulate`` leave one out; 2 if the arguments are wrong; 130 after
Ctrl-C, which keeps what was written until then. SIGTERM and SIGHUP do as Ctrl-C does; the exit code
is then 143 or 129.

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
- ``in_wine``: whether its library is one for Windows, which runs in Wine here
- ``obstacles``: texts, what keeps the FMU from being loaded and what to do about it
- ``missing_libraries``: the shared libraries that it needs and this machine lacks (Linux), each
  with ``name`` and a ``print_note``
- ``missing_tool``: the tool that must be installed as well; null if none is known to be missing
- ``trial``: what the first meeting on this machine has shown: ``deterministic``, the
  ``noisy_outputs``, the grades of ``resets`` by method, the ``reset_method``, the
  ``component_resets`` of a system by the names of its components, what ``several_instances``
  need, ``isolate``, whether it ``cannot_be_read_before_a_step``, how many ``instances_at_once``
  and ``initializations`` it used, its ``findings``, and the ``execution`` of pools by default and
  why, a sentence each; null before
- ``capabilities``: flags by name, those of ``fmugym.fmi.description.Capabilities``
- ``default_experiment``: ``start_time``, ``stop_time``, ``step_size`` in s, and ``tolerance``
- ``fixed_internal_step_size``: in s
- ``findings``: texts, what breaks rules in the archive and in the model description
- ``variable_counts``: number of all variables by causality
- ``variables``: those that were asked for, in the order of the XML, each with ``name``,
  ``causality``, ``variability``, ``initial``, ``type``, ``shape``, ``unit``, ``min``, ``max``,
  ``nominal``, ``start`` (in the variable's type; a text for arrays and for what is malformed or not
  finite), ``items`` (each with ``name`` and ``value``), ``description``, ``settable_at_start`` and
  ``settable_in_step``
- ``system``: for systems only: ``components``, ``connections``, ``connectors``, ``master``,
  ``order`` (groups of components, each with ``is_loop``) and ``loops`` (lists of connections)

FMUs and their libraries must not write to the standard streams; what they print goes elsewhere.
"""

from __future__ import annotations

import argparse
import ctypes
import io
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, Final, NoReturn

import argcomplete

from fmugym.cli.episode_commands import add_bench, add_evaluate, add_simulate
from fmugym.cli.export_command import add_export
from fmugym.cli.fit_command import add_fit
from fmugym.cli.inspection_commands import add_info, add_new, add_validate
from fmugym.cli.options import add_common, free_outputs, print_note, speaking
from fmugym.cli.plant_commands import add_serve
from fmugym.cli.signals import exit_code
from fmugym.cli.training_commands import add_train, add_tune
from fmugym.errors import FMUGymError, unknown_name

__all__ = [
    "drop_output",
    "escape_what_consoles_lack",
    "keep_output_from_fmus",
    "named",
    "run_command_line",
]


def keep_output_from_fmus(*, shown: bool) -> BinaryIO | None:
    """Keep the standard streams for Python's output; all other output goes elsewhere.

    FMUs print what they like. A table, or the JSON that another program reads, must not have it
    between its lines. The C library writes what it still has when the process ends, so this is not
    undone.

    Args:
        shown: Whether it goes to the standard error instead of a file.

    Returns:
        The file, which has no name, so that nothing is left of it after any end of the process.
    """
    with suppress(OSError, AttributeError, io.UnsupportedOperation):
        if (sys.stdout.fileno(), sys.stderr.fileno()) != (1, 2):
            return None
        sys.stdout = _apart(sys.stdout)
        if shown:
            os.dup2(2, 1)
            return None
        sys.stderr = _apart(sys.stderr)
        file = tempfile.TemporaryFile()  # noqa: SIM115, it lives as long as the process
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        return file
    return None


def _apart(stream: Any) -> Any:
    """The same stream on a descriptor of its own."""
    stream.flush()
    return open(
        os.dup(stream.fileno()),
        "w",
        encoding=stream.encoding,
        errors=stream.errors,
        buffering=1 if stream.line_buffering or stream.write_through else -1,
    )


def named(printed: BinaryIO) -> Path | None:
    """Give a name to the file with the output of FMUs; None if there is no output."""
    with suppress(OSError, AttributeError, TypeError):  # Windows has no such library
        ctypes.CDLL(None).fflush(None)
    if not printed.seek(0, os.SEEK_END):
        return None
    printed.seek(0)
    with tempfile.NamedTemporaryFile(prefix="fmugym-printed-", suffix=".txt", delete=False) as file:
        shutil.copyfileobj(printed, file)
    return Path(file.name)


def escape_what_consoles_lack() -> None:
    """Names and descriptions of an FMU may have letters that an old console cannot show."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def drop_output() -> None:
    """Discard buffered output, about which the interpreter would complain at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


_COMMANDS: Final = (
    *(add_info, add_new, add_validate, add_simulate, add_train, add_evaluate, add_tune),
    *(add_fit, add_export, add_serve, add_bench),
)


def run_command_line(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: The arguments; by default those of the process.

    Returns:
        The exit code, 0, 1 or, after Ctrl-C, 130.

    Raises:
        SystemExit: With the code 2 if the arguments are wrong, 0 after ``--help``.
    """
    escape_what_consoles_lack()
    arguments = _parsed(argv)
    printed = None if argv is not None else keep_output_from_fmus(shown=arguments.verbose)
    with speaking(arguments):
        try:
            return _code_of(arguments)
        finally:
            if printed is not None and (file := named(printed)):
                print_note(f"what FMUs and their libraries printed is in {file}; -v shows it")


def _code_of(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    try:
        with free_outputs(arguments):
            code: int = arguments.run(arguments) or 0
        sys.stdout.flush()
        return code
    except KeyboardInterrupt as error:
        return exit_code(error)
    except BrokenPipeError:  # the reader, for example ``head``, has ended
        drop_output()
    except (FMUGymError, OSError) as error:
        for line in _told(error).splitlines():  # a task may have several mistakes
            print_note(line, "error")
        return 1 if (end := _end_before(error)) is None else exit_code(end)
    return 0


def _end_before(error: BaseException) -> KeyboardInterrupt | None:
    """The interruption after which a clean-up has failed."""
    origin: BaseException | None = error
    while origin is not None and not isinstance(origin, KeyboardInterrupt):
        origin = origin.__context__
    return origin


def _told(error: Exception) -> str:
    """Describe an error; errors of the system come without their numbers."""
    if not isinstance(error, OSError):
        return str(error)
    if error.filename is None:
        return error.strerror or str(error)
    if isinstance(error, FileExistsError):
        return f"{error.filename} exists; name a new file"
    return f"{error.filename}: {error.strerror}"


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line with the nearest name."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.register("type", int, _reader(int, "an integer"))
        self.register("type", float, _reader(float, "a number"))

    def error(self, message: str) -> NoReturn:
        """End the program."""
        hint = "" if message.endswith("?") else f"; '{self.prog} --help' tells more"
        self.exit(2, f"{self.prog}: error: {message}{hint}\n")

    def refuse(self, text: str) -> NoReturn:
        """End the program for an argument that is not known."""
        if not text.startswith("-"):
            self.error(f"unexpected argument {text!r}")
        self.error(str(unknown_name("option", text.partition("=")[0], self.options)))

    @property
    def options(self) -> list[str]:
        """The names of the options; argparse has no public list of them."""
        return list(self._option_string_actions)


def _reader(kind: type[int] | type[float], what: str) -> Callable[[str], float]:
    def read(text: str) -> float:
        try:
            return kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"expected {what}, got {text!r}") from None

    return read


def _parsed(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse arguments; those of ``train`` may stand anywhere, which argparse does not know."""
    parser, commands = _parser()
    argcomplete.autocomplete(parser)
    given = sys.argv[1:] if argv is None else argv
    if given and not given[0].startswith("-") and given[0] not in commands:
        parser.error(str(unknown_name("command", given[0], commands)))
    if given and given[0].startswith("-") and given[0] not in parser.options:
        parser.refuse(given[0])
    arguments, rest = parser.parse_known_args(given)
    for text in rest:
        if text.startswith("-") or not hasattr(arguments, "arguments"):
            commands[arguments.command].refuse(text)
    if rest:
        arguments.arguments = [*arguments.arguments, *rest]
    return arguments


def _parser() -> tuple[_Parser, dict[str, _Parser]]:
    """Make the parser; returns it with the parsers of the commands."""
    parser = _Parser("fmugym", description="Look at an FMU, make a task of it, and run that.")
    parser.add_argument("--version", action="version", version=version("fmugym-toolbox"))
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    for add in _COMMANDS:
        add(commands)
    for command in commands.choices.values():
        add_common(command)
    return parser, commands.choices
