"""Command ``export``: agents as C, FMUs and ONNX."""

from __future__ import annotations

import argparse
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

from fmugym.cli.options import (
    HELP_OF_TASK,
    Commands,
    add_command,
    add_json,
    check_counts,
    say_result,
    tell,
)
from fmugym.cli.task_arguments import maker_of
from fmugym.control import controller_of
from fmugym.control.controller_table import acting_text
from fmugym.control.surrogate.surrogate_fit import plot_prediction, predicted
from fmugym.deployment.export import ExportedAgent, agent_of, write_c, write_fmu, write_onnx
from fmugym.deployment.export.agent_fmu import EXPORT_VERSIONS, PLATFORMS
from fmugym.deployment.export.exported_agent import agent_of_surrogate, check_name
from fmugym.deployment.export.identifiers import new_file
from fmugym.errors import ConfigError, shown
from fmugym.files import replaced
from fmugym.fmi.variable import Variable
from fmugym.records.output_files import require_picture
from fmugym.records.players import given_controller
from fmugym.training.agents import read_agent
from fmugym.training.residual import Residual
from fmugym.training.search.excitation import fitted_surrogate
from fmugym.training.search.policy import ResidualAgent

__all__ = ["add_export"]

_ENDINGS: Final = (".c", ".fmu", ".onnx")
_STEPS: Final = 2000
"""Steps of an FMU to which a surrogate is fitted."""

_UNSEEN: Final = 4
"""Episodes in which the picture of a surrogate compares it with the FMU."""


def add_export(commands: Commands) -> None:
    """Add ``export``."""
    text = "write an agent or a controller as C, an FMU or ONNX, with everything around it"
    command = add_command(commands, "export", _export, text)
    command.add_argument(
        "agent",
        type=Path,
        nargs="?",
        metavar="AGENT",
        help="a folder of train, or a zip file of a model; a task with --surrogate",
    )
    command.add_argument(
        "--controller",
        metavar="TEXT",
        help="instead of an agent, a controller as for simulate, or its name in the task file",
    )
    command.add_argument("--task", metavar="TASK", help=HELP_OF_TASK)
    command.add_argument(
        "--surrogate",
        action="store_true",
        help="write a fast FMU that does what the FMU of a task does in simulations",
    )
    command.add_argument(
        "--steps", type=int, default=_STEPS, help=f"of the FMU, for --surrogate; default {_STEPS}"
    )
    command.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="with --surrogate, a picture of what it predicts beside the FMU",
    )
    command.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help="a new file: agent.c, agent.fmu or agent.onnx",
    )
    command.add_argument(
        "--algorithm", default="PPO", help="of a zip file: PPO (default), A2C, SAC, TD3, DQN ..."
    )
    command.add_argument(
        "--all-inputs",
        action="store_true",
        help="also write inputs that no action changes, such as weather from data",
    )
    command.add_argument(
        "--external",
        action="append",
        default=[],
        metavar="NAME",
        help="data of the task that the agent is given, instead of having them in tables",
    )
    command.add_argument(
        "--fmi", choices=EXPORT_VERSIONS, default="2.0", help="version of an FMU; default 2.0"
    )
    command.add_argument(
        "--platform",
        action="append",
        choices=[*PLATFORMS, "all"],
        help="that an FMU is built for; default this one",
    )
    add_json(command)


def _export(arguments: argparse.Namespace) -> None:
    check_counts(arguments, "steps")
    output: Path = arguments.output
    if output.suffix not in _ENDINGS:
        raise ConfigError(
            f"expected a file that ends in {', '.join(_ENDINGS)}, got {shown(str(output))}"
        )
    new_file(output)
    if arguments.plot is not None:
        if not arguments.surrogate:
            raise ConfigError("--plot shows a surrogate: give --surrogate")
        require_picture(arguments.plot)
    if arguments.surrogate:
        agent = _surrogate(arguments)
        _show(agent, _written(agent, output, arguments), arguments)
        return
    if (arguments.agent is None) == (arguments.controller is None):
        raise ConfigError("give either AGENT or --controller")
    if arguments.task is None:
        raise ConfigError("--task is missing: the task of the agent or the controller")
    model, normalization = None, None
    if arguments.agent is not None:
        model, normalization = read_agent(arguments.agent, arguments.algorithm)
    is_physical = model is None or isinstance(model, ResidualAgent | Residual)
    with closing(maker_of(arguments.task)(physical=is_physical)) as env:
        options = {"all_inputs": arguments.all_inputs, "external": arguments.external}
        if model is None:
            text = acting_text(given_controller(env, arguments.controller))
            controller_of(text)  # raises for ranges
            model = ResidualAgent("controller", text)
        agent = agent_of(env, model, normalization, name=output.stem, **options)
    _show(agent, _written(agent, output, arguments), arguments)


def _surrogate(arguments: argparse.Namespace) -> ExportedAgent:
    """Fit a surrogate to simulations of the FMU of a task."""
    if arguments.output.suffix != ".fmu":
        name = shown(arguments.output.name)
        raise ConfigError(f"a surrogate is an FMU: expected a file that ends in .fmu, got {name}")
    if arguments.agent is None:
        raise ConfigError("--surrogate needs a task: fmugym export task.toml --surrogate ...")
    make_env = partial(maker_of(str(arguments.agent)), physical=True)
    check_name(arguments.output.stem)
    with closing(make_env()) as env:
        units = env.fmu.description.units
    found, unseen = fitted_surrogate(
        make_env, arguments.steps, unseen=0 if arguments.plot is None else _UNSEEN
    )
    if arguments.plot is not None:
        with replaced(arguments.plot) as part:
            plot_prediction(predicted(found, unseen), found).savefig(part)
    tell(
        f"surrogate of {arguments.steps} steps: {found.terms.form}; errors of "
        f"simulations are {100 * found.error:.2g} % of the variation of outputs"
    )
    return agent_of_surrogate(found, arguments.output.stem, units)


def _written(agent: ExportedAgent, output: Path, arguments: argparse.Namespace) -> list[Path]:
    """Write an agent in the format that the file's ending tells."""
    if output.suffix == ".c":
        return write_c(agent, output.parent)
    if output.suffix == ".onnx":
        return [write_onnx(agent, output)]
    platforms = arguments.platform
    if platforms is not None and "all" in platforms:
        is_new = arguments.fmi != "2.0"
        platforms = [name for name, one in PLATFORMS.items() if is_new or one.folder]
    return [write_fmu(agent, output, fmi_version=arguments.fmi, platforms=platforms)]


def _show(agent: ExportedAgent, files: list[Path], arguments: argparse.Namespace) -> None:
    logic = agent.logic
    parts = {
        "measurements": [_facts(one) for one in logic.measurements],
        "actions": [_facts(one) for one in logic.inputs],
        "parameters": [{"name": one.name, "start": one.start} for one in logic.parameters],
    }
    facts = {"files": files, "name": agent.name, "sample_time": logic.time_step, **parts}
    lines = [f"{', '.join(map(str, files))}: a sample every {logic.time_step:g} s"]
    for title, rows in parts.items():
        for row in rows:
            more = f" = {row['start']:g}" if "start" in row else f" {row['unit'] or ''}".rstrip()
            lines.append(f"  {title.removesuffix('s')} {row['name']}{more}")
    say_result(arguments, facts, "\n".join(lines))


def _facts(variable: Variable) -> dict[str, Any]:
    return {"name": variable.name, "unit": variable.unit}
