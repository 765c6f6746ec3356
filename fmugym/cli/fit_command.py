"""Command ``fit``: parameters of an FMU from logs of a plant."""

from __future__ import annotations

import argparse
import math
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from fmugym.checks import duration
from fmugym.cli.minari_datasets import add_timezone, read_log, renaming
from fmugym.cli.options import (
    Commands,
    add_command,
    add_json,
    add_task,
    check_counts,
    print_note,
    require_toml,
    say_result,
    write_extension,
)
from fmugym.cli.overview import finite_or_none
from fmugym.cli.task_arguments import maker_of
from fmugym.control.identification import FitResult, plot_comparison
from fmugym.control.identification.output_error import Shift, shift_of_clocks
from fmugym.errors import ConfigError, shown
from fmugym.files import replaced
from fmugym.records.evaluation import aligned
from fmugym.records.log_fit import fit_logs, write_rows
from fmugym.records.output_files import require_picture
from fmugym.records.progress_bars import progress_bar

__all__ = ["add_fit"]

_RELATED: Final = 0.95
"""Correlations of parameters above this are worth a line."""

_SAME: Final = 1e-3
"""Starts whose costs differ by less, as a part of them, have come to the same optimum."""


def add_fit(commands: Commands) -> None:
    """Add ``fit``."""
    command = add_command(commands, "fit", _fit, "find parameters of an FMU in logs of a plant")
    add_task(command)
    command.add_argument(
        "--log", action="append", required=True, metavar="FILE", help="a .csv file; more than once"
    )
    command.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="COLUMN=VARIABLE",
        help="a column of the log whose name is not that of the variable; more than once",
    )
    add_timezone(command)
    command.add_argument(
        "--parameter",
        action="append",
        default=[],
        metavar="NAME[=LOW..HIGH]",
        help="what to fit, by default between a third of its value and three times that; "
        "more than once",
    )
    command.add_argument(
        "--start",
        action="append",
        default=[],
        metavar="NAME[=OUTPUT]",
        help="a start value to fit in each episode apart, and the output that measures it; "
        "more than once",
    )
    command.add_argument(
        "--wash-in",
        metavar="TIME",
        help="what is simulated but not counted at the beginning of each episode, as '12h'; "
        "default a tenth of the shortest one, or none with --start",
    )
    command.add_argument(
        "--candidates", type=int, default=32, help="points that are tried first; default 32"
    )
    command.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help="a new task file that draws from what was found, with a file .npz beside it",
    )
    command.add_argument("--plot", type=Path, metavar="FILE", help="a picture of log and FMU")
    add_json(command)


def _fit(arguments: argparse.Namespace) -> None:
    check_counts(arguments, "candidates")
    make_env, output = maker_of(arguments.task, None, arguments.master), arguments.output
    if output is not None:
        require_toml(output)
    if arguments.plot is not None:
        require_picture(arguments.plot)
    if not arguments.parameter:
        raise ConfigError(f"name what to fit with --parameter: {_possible(make_env)}")
    wash_in = arguments.wash_in
    with progress_bar(None, "fit", "simulations") as advance:
        fit = fit_logs(
            make_env,
            [read_log(path, arguments) for path in arguments.log],
            dict(map(_range, arguments.parameter)),
            starts=dict(map(_start, arguments.start)),
            wash_in=None if wash_in is None else duration("--wash-in", wash_in),
            columns=dict(map(renaming, arguments.column)),
            candidates=arguments.candidates,
            advance=advance,
        )
    if output is not None:
        rows = output.with_suffix(".npz")
        write_rows(fit, rows)
        write_extension(output, arguments.task, {"fitted": rows.name})
    if arguments.plot is not None:
        with replaced(arguments.plot) as part:
            plot_comparison(fit.comparison).savefig(part)
    _show(fit, arguments)


def _possible(make_env: Any) -> str:
    with closing(make_env()) as env:
        variables = env.unwrapped.fmu.description.variables.values()
    return ", ".join(
        v.name
        for v in variables
        if v.kind == "real" and v.settable_at_start and v.causality != "input"
    )


def _range(text: str) -> tuple[str, tuple[float, float] | None]:
    name, separator, ends = text.partition("=")
    if not separator:
        return name, None
    try:
        low, high = map(float, ends.split(".."))
    except ValueError:
        raise ConfigError(f"expected NAME=LOW..HIGH, got {shown(text)}") from None
    return name, (low, high)


def _start(text: str) -> tuple[str, str | None]:
    name, _, output = text.partition("=")
    return name, output or None


def _show(fit: FitResult, arguments: argparse.Namespace) -> None:
    is_noise = all(one.is_noise for one in fit.correlations.values())
    shift = None if is_noise else shift_of_clocks(fit, fit.comparison.trajectories)
    facts = _facts(fit) | {"shift": None if shift is None else shift._asdict()}
    say_result(arguments, facts, "\n".join(_table(fit)))
    for one in ([] if shift is None else [_told(shift)]) + _warnings(fit, shift is not None):
        print_note(one)


def _told(shift: Shift) -> str:
    when = "later" if shift.seconds > 0 else "earlier"
    return (
        f"the outputs are logged {abs(shift.seconds):.3g} s {when} than the inputs: without that, "
        f"residuals are {shift.improvement:.2g} times smaller. Their clocks differ, or something "
        "delays the signals: change the times of one of them, and fit again"
    )


def _facts(fit: FitResult) -> dict[str, Any]:
    errors, intervals = fit.standard_errors, fit.confidence_intervals()
    return {
        "parameters": {
            name: {
                "value": value,
                "standard_error": finite_or_none(errors[name]),
                "interval": [*map(finite_or_none, intervals[name])],
            }
            for name, value in fit.values.items()
        },
        "correlations": fit.correlation_matrix.tolist(),
        "outputs": {
            name: {
                "rms": fit.rms(name),
                "explained": fit.comparison.explained(name),
                "autocorrelation": one.first,
                "is_noise": one.is_noise,
            }
            for name, one in fit.correlations.items()
        },
        "start_values": fit.comparison.initial_values,
        "untold": fit.untold(),
        "costs": fit.costs,
        "converged": fit.converged,
    }


def _table(fit: FitResult) -> list[str]:
    """The lines about parameters and outputs."""
    variables = fit.experiment.fmu.description
    rows = [("parameter", "value", "standard error", "95 % interval", "unit")]
    for name, (low, high) in fit.confidence_intervals().items():
        numbers = f"{fit.values[name]:.5g}", f"{fit.standard_errors[name]:.2g}"
        rows.append(
            (name, *numbers, f"{low:.5g} .. {high:.5g}", variables.variable(name).unit or "")
        )
    outputs = [("output", "rms", "explained", "autocorrelation", "unit")]
    for name, one in fit.correlations.items():
        numbers = f"{fit.rms(name):.3g}", f"{fit.comparison.explained(name):.2%}"
        outputs.append((name, *numbers, f"{one.first:.2f}", variables.variable(name).unit or ""))
    return [*aligned(rows), "", *aligned(outputs)]


def _warnings(fit: FitResult, has_shift: bool) -> list[str]:
    """Warnings for a reader of the table."""
    found = []
    for name, one in fit.correlations.items():
        if not one.is_noise and not has_shift:
            found.append(
                f"the residuals of {name} are no noise (autocorrelation {one.first:.2f}): the "
                "structure of the model is not that of the plant. Standard errors allow for the "
                "correlation, but not for what it does to the values"
            )
    for direction in fit.untold():
        parts = " and ".join(direction)
        found.append(
            f"the log does not tell {parts} apart: only what they do together"
            if len(direction) > 1
            else f"the log does not tell {parts}"
        )
    names, matrix = [*fit.values], fit.correlation_matrix
    for k, name in enumerate(names):
        related = [names[j] for j in range(k) if abs(matrix[k, j]) > _RELATED]
        if related:
            found.append(f"{name} is correlated with {', '.join(related)}: draw them together")
    for name, (low, high) in fit.bounds.items():
        if min(fit.values[name] - low, high - fit.values[name]) < _SAME * (high - low):
            found.append(f"{name} is at an end of its range; a wider one may fit better")
    same = sum(math.isclose(one, fit.costs[0], rel_tol=_SAME, abs_tol=1e-9) for one in fit.costs)
    if same < len(fit.costs):
        found.append(f"{same} of {len(fit.costs)} starts came to this optimum, others to worse")
    if not fit.converged:
        found.append(f"the fit has not converged: {fit.message}")
    return found
