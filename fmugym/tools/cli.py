"""The command line: from a first look at an FMU to episodes of a task.

::

    fmugym info model.fmu [--json] [--all] [--filter GLOB]
    fmugym new model.fmu [--output task.toml]
    fmugym validate task.toml|model.fmu|ID|module:Class [--json]
    fmugym simulate task.toml|ID|module:Class [--action random|NUMBERS] [--controller TEXT]
        [--scenario NAME] [--seed N] [--episodes N] [--steps N] [--output run.csv] [--json]
    fmugym train TASK --output FOLDER [--algorithm PPO] [--steps N] [--envs N] [--seed N]
        [--episodes N] [--no-normalize] [KEY=VALUE ...]
    fmugym evaluate TASK [--agent FOLDER ...] [--action NUMBERS ...] [--controller TEXT ...]
        [--scenario NAME] [--episodes N] [--seed N] [--steps N] [--json]
    fmugym demo [--seed N] [--output picture.png]
    fmugym skeleton model.fmu [--output my_env.py]
    fmugym stand-in model.fmu [--folder FOLDER]

``validate``, ``simulate``, ``train`` and ``evaluate`` execute the FMU, the others do not. Output is
printable ASCII. The exit code is 0; 1 if something cannot be used (one line on the error stream
says why) or ``validate`` finds an error; 2 if the arguments are wrong; 130 after Ctrl-C, which
keeps the lines of a table and the best agent until then.

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
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Final, TextIO

from fmugym.archive.fmu import FMU
from fmugym.checks import check_count, check_seed
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, FMUGymError
from fmugym.tools.demo import LinearController, Training, show, write_picture
from fmugym.tools.evaluation import evaluate, table
from fmugym.tools.overview import as_text, overview, plain
from fmugym.tools.proposal import Proposal
from fmugym.tools.simulation import Policy, action_of, policy_of, simulate
from fmugym.tools.skeleton import Skeleton
from fmugym.tools.stand_in import build_stand_in
from fmugym.tools.targets import maker_of, scenarios_of
from fmugym.tools.training import Plan, agent_policy, arguments_of, train
from fmugym.tools.validation import validate

__all__ = ["main"]

_INTERRUPTED: Final = 130
_TASK: Final = "a task file, a registered id or module:Class"
_CONTROLLER: Final = "a controller and its arguments: 'pid of=T setpoint=21 kp=0.5 ti=14400'"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: The arguments; by default those of the process.

    Returns:
        The exit code, 0, 1 or 130.

    Raises:
        SystemExit: With the code 2 if the arguments are wrong, 0 after ``--help``.
    """
    arguments = _parser().parse_args(argv)
    try:
        code: int = arguments.run(arguments) or 0
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return _INTERRUPTED
    except BrokenPipeError:  # the reader, for example ``head``, has ended
        _drop_output()
    except (FMUGymError, OSError) as error:
        print(f"fmugym: error: {plain(error)}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "fmugym", description="Look at a co-simulation FMU, make a task of it, and run that."
    )
    parser.add_argument("--version", action="version", version=version("fmugym-toolbox"))
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_info(commands)
    _add_new(commands)
    _add_validate(commands)
    _add_simulate(commands)
    _add_train(commands)
    _add_evaluate(commands)
    _add_demo(commands)
    _add_skeleton(commands)
    _add_stand_in(commands)
    return parser


def _add(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    run: Callable[[argparse.Namespace], int | None],
    text: str,
) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=text, description=f"{text.capitalize()}.")
    command.set_defaults(run=run)
    return command


def _add_info(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "say what an FMU is, where it runs, and which variables it has"
    info = _add(commands, "info", _info, text)
    info.add_argument("fmu", type=Path, metavar="FMU")
    info.add_argument("--json", action="store_true", help="print one JSON object")
    info.add_argument("--all", action="store_true", help="list local and other variables too")
    info.add_argument(
        "--filter",
        metavar="GLOB",
        help="list only variables with a matching name, of any causality; * is any text, "
        "? one character",
    )


def _add_new(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "write a task file for an FMU, to be filled in"
    command = _add(commands, "new", _new, text)
    command.add_argument("fmu", type=Path, metavar="FMU")
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new file, instead of standard output"
    )


def _add_validate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "run a few short episodes and say what is wrong with a task, and what to do about it"
    command = _add(commands, "validate", _validate, text)
    command.add_argument("task", metavar="TASK", help=f"{_TASK}, or an FMU")
    command.add_argument("--json", action="store_true", help="print one JSON object")


def _add_simulate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "play episodes with random or constant actions, or with a controller"
    command = _add(commands, "simulate", _simulate, text)
    command.add_argument("task", metavar="TASK", help=_TASK)
    command.add_argument(
        "--action", default="random", help="random (default), or the numbers of one action: 0.5,-1"
    )
    command.add_argument(
        "--controller", metavar="TEXT", help=f"instead of an action: {_CONTROLLER}"
    )
    command.add_argument("--scenario", help="a scenario of the task file")
    command.add_argument("--seed", type=int, default=0, help="of the first episode; default 0")
    command.add_argument("--episodes", type=int, default=1, help="default 1")
    command.add_argument("--steps", type=int, default=10_000, help="at most, in each episode")
    command.add_argument("--output", type=Path, metavar="FILE", help="a new CSV file of all steps")
    command.add_argument("--json", action="store_true", help="print one JSON object")


def _add_train(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "train an agent with Stable-Baselines3, and keep the best one"
    command = _add(commands, "train", _train, text)
    command.add_argument("task", metavar="TASK", help=_TASK)
    command.add_argument(
        "arguments", nargs="*", metavar="KEY=VALUE", help="arguments of the algorithm"
    )
    command.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="a new one")
    command.add_argument("--algorithm", default="PPO", help="PPO (default), A2C, SAC, TD3, DQN ...")
    command.add_argument("--steps", type=int, default=100_000, help="default 100000")
    command.add_argument("--envs", type=int, default=8, help="that step together; default 8")
    command.add_argument("--seed", type=int, default=0, help="default 0")
    command.add_argument("--episodes", type=int, default=5, help="of an evaluation; default 5")
    command.add_argument(
        "--no-normalize", action="store_true", help="without running normalization"
    )


def _add_evaluate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "let agents, controllers, random and constant actions play the same episodes"
    command = _add(commands, "evaluate", _evaluate, text)
    command.add_argument("task", metavar="TASK", help=_TASK)
    command.add_argument(
        "--agent", type=Path, action="append", default=[], metavar="FOLDER", help="of train"
    )
    command.add_argument("--action", action="append", default=[], help="a constant action")
    command.add_argument(
        "--controller", action="append", default=[], metavar="TEXT", help=_CONTROLLER
    )
    command.add_argument("--scenario", help="a scenario of the task file")
    command.add_argument("--episodes", type=int, default=10, help="default 10")
    command.add_argument("--seed", type=int, default=1_000_000, help="of the first episode")
    command.add_argument("--steps", type=int, default=10_000, help="at most, in each episode")
    command.add_argument("--json", action="store_true", help="print one JSON object")


def _add_demo(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "train a controller of the bundled cart-pole in seconds, and show it in a window"
    command = _add(commands, "demo", _demo, text)
    command.add_argument("--seed", type=int, default=0, help="default 0")
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new PNG file, instead of the window"
    )


def _add_skeleton(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "write a Python file with an environment for an FMU, to be filled in"
    command = _add(commands, "skeleton", _skeleton, text)
    command.add_argument("fmu", type=Path, metavar="FMU")
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new file, instead of standard output"
    )


def _add_stand_in(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "build a replacement for an old libgfortran that an FMU needs; takes a C compiler"
    command = _add(commands, "stand-in", _stand_in, text)
    command.add_argument("fmu", type=Path, metavar="FMU")
    command.add_argument(
        "--folder", type=Path, default=Path(), help="where to write it; by default this folder"
    )


def _info(arguments: argparse.Namespace) -> None:
    fmu = FMU(arguments.fmu)
    facts = overview(fmu, everything=arguments.all, pattern=arguments.filter)
    print(json.dumps(facts, indent=2, allow_nan=False) if arguments.json else as_text(facts))


def _new(arguments: argparse.Namespace) -> None:
    output: Path | None = arguments.output
    proposal = Proposal(FMU(arguments.fmu), None if output is None else output.parent)
    _write(proposal.text(), output)
    _print_notes(proposal.notes())


def _write(text: str, output: Path | None) -> None:
    if output is None:
        print(text, end="")
        return
    with output.open("x", encoding="ascii", newline="\n") as file:
        file.write(text)


def _print_notes(notes: Iterable[str]) -> None:
    for note in notes:
        print(f"fmugym: note: {plain(note)}", file=sys.stderr)


def _validate(arguments: argparse.Namespace) -> int:
    report = validate(maker_of(arguments.task))
    if arguments.json:
        print(json.dumps({"task": arguments.task, **report.as_dict()}, indent=2))
    else:
        print(report.as_text())
    return int(report.verdict == "error")


def _simulate(arguments: argparse.Namespace) -> None:
    check_seed(arguments.seed)
    check_count("--episodes", arguments.episodes)
    check_count("--steps", arguments.steps)
    with ExitStack() as stack:
        env = stack.enter_context(closing(maker_of(arguments.task, arguments.scenario)()))
        text = arguments.controller
        policy = action_of(env, arguments.action) if text is None else policy_of(env, text)
        output = arguments.output
        table = None if output is None else stack.enter_context(_new_table(output))
        summaries = []
        for seed in range(arguments.seed, arguments.seed + arguments.episodes):
            summaries.append(simulate(env, policy, seed, arguments.steps, table))
            if not arguments.json:
                print(plain(summaries[-1].as_text()))
    if arguments.json:
        episodes = [summary.as_dict() for summary in summaries]
        print(json.dumps({"schema": 1, "task": arguments.task, "episodes": episodes}, indent=2))


def _train(arguments: argparse.Namespace) -> None:
    check_seed(arguments.seed)
    for name in ("steps", "envs", "episodes"):
        check_count(f"--{name}", getattr(arguments, name))
    names = scenarios_of(arguments.task)
    held_out = {name: maker_of(arguments.task, name) for name in names}
    plan = Plan(
        maker_of(arguments.task),
        held_out or {"held-out seeds": maker_of(arguments.task)},
        arguments.output,
        arguments.algorithm,
        arguments.steps,
        arguments.envs,
        arguments.seed,
        arguments.episodes,
        normalize=not arguments.no_normalize,
        arguments=arguments_of(arguments.arguments),
    )
    print(table(train(plan, lambda line: print(line, file=sys.stderr))))


def _evaluate(arguments: argparse.Namespace) -> None:
    check_seed(arguments.seed)
    for name in ("steps", "episodes"):
        check_count(f"--{name}", getattr(arguments, name))
    policies: dict[str, Callable[[FMUEnv], Policy]] = {}
    for text in ("random", *arguments.action):
        policies[text if text == "random" else f"action {text}"] = partial(action_of, text=text)
    policies |= {text: partial(policy_of, text=text) for text in arguments.controller}
    policies |= {str(folder): agent_policy(folder) for folder in arguments.agent}
    make_env = maker_of(arguments.task, arguments.scenario)
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    scores = evaluate(make_env, policies, seeds, arguments.steps)
    if arguments.json:
        facts = {"schema": 1, "task": arguments.task, "scores": [one.as_dict() for one in scores]}
        print(json.dumps(facts, indent=2))
    else:
        print(table(scores))


def _demo(arguments: argparse.Namespace) -> int:
    check_seed(arguments.seed)
    training = Training(arguments.seed)
    untrained = training.controller
    solved = False
    for one in training.rounds():
        print(
            f"round {one.number}: {one.mean:.0f} steps in the mean, {one.best:.0f} at best; "
            f"controller {one.held_out:.0f} of 500"
        )
        solved = one.is_solved
    print(f"{training.steps} steps of the cart-pole FMU in {training.seconds:.2f} s")
    _show(untrained, training.controller, arguments)
    return int(not solved)


def _show(
    untrained: LinearController, trained: LinearController, arguments: argparse.Namespace
) -> None:
    seed = arguments.seed + 2_000_000
    if arguments.output is not None:
        write_picture([untrained, trained], seed, arguments.output)
        print(plain(f"{arguments.output}: an episode before the training, and one after it"))
        return
    try:
        print(f"before the training: {show(untrained, seed)} steps")
        print(f"after the training: {show(trained, seed)} steps")
    except ConfigError:
        print("There is no display for a window: --output demo.png writes a picture")


def _new_table(path: Path) -> TextIO:
    return path.open("x", encoding="utf-8", newline="")


def _skeleton(arguments: argparse.Namespace) -> None:
    skeleton = Skeleton(FMU(arguments.fmu))
    _write(skeleton.text(), arguments.output)
    _print_notes(skeleton.notes())


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
