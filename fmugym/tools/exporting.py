"""The command that exports agents: export."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from fmugym.archive.variable import Variable
from fmugym.errors import ConfigError, shown
from fmugym.export import Agent, agent_of, write_c, write_fmu, write_onnx
from fmugym.export.building import PLATFORMS
from fmugym.export.fmus import FMI_VERSIONS
from fmugym.export.names import new_file
from fmugym.search.policy import Agent as FoundAgent
from fmugym.search.residual import Residual
from fmugym.tools.options import HELP_OF_TASK, Commands, add_command, add_json, say_result
from fmugym.tools.targets import maker_of
from fmugym.training.agents import read_agent

__all__ = ["add_export"]

_ENDINGS: Final = (".c", ".fmu", ".onnx")


def add_export(commands: Commands) -> None:
    """Add ``export``."""
    text = "write a trained agent as C, an FMU or ONNX, with everything around its network"
    command = add_command(commands, "export", _export, text)
    command.add_argument(
        "agent", type=Path, metavar="AGENT", help="a folder of train, or a zip file of a model"
    )
    command.add_argument("--task", required=True, metavar="TASK", help=HELP_OF_TASK)
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
        "--fmi", choices=FMI_VERSIONS, default="2.0", help="version of an FMU; default 2.0"
    )
    command.add_argument(
        "--platform",
        action="append",
        choices=[*PLATFORMS, "all"],
        help="that an FMU is built for; default this one",
    )
    add_json(command)


def _export(arguments: argparse.Namespace) -> None:
    output: Path = arguments.output
    if output.suffix not in _ENDINGS:
        raise ConfigError(
            f"expected a file that ends in {', '.join(_ENDINGS)}, got {shown(str(output))}"
        )
    new_file(output)
    model, normalization = read_agent(arguments.agent, arguments.algorithm)
    is_physical = isinstance(model, FoundAgent | Residual)
    with closing(maker_of(arguments.task)(physical=is_physical)) as env:
        options = {"all_inputs": arguments.all_inputs, "external": arguments.external}
        agent = agent_of(env, model, normalization, name=output.stem, **options)
    _show(agent, _written(agent, output, arguments), arguments)


def _written(agent: Agent, output: Path, arguments: argparse.Namespace) -> list[Path]:
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


def _show(agent: Agent, files: list[Path], arguments: argparse.Namespace) -> None:
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
