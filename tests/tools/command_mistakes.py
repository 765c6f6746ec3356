"""Mistakes on the command line: the arguments, and what the line that the user sees must have.

``python tests/tools/command_mistakes.py`` prints all lines, for a person to read.
``tests/cli/test_commands.py`` requires them. Mistakes that every command may have are laws there.
"""

import contextlib
import functools
import io
import os
import shlex
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import mistakes
import tomlkit
from mistakes import LONGEST, misspelt

import fmugym
from fmugym.cli.command_line import run_command_line

__all__ = [
    "MISSING_LIBRARIES",
    "MISTAKES",
    "OF_ALGORITHMS",
    "make_folder",
    "misspelt",
    "refusal",
    "require_refusal",
]

Facts = tuple[str, ...]
"""What a line must have: the thing, what was given, what was expected, and what was meant."""

PID_OF_Q: Final = "pid of=q setpoint=1"
PID_OF_T: Final = "pid of=T setpoint=20..22"

TASK: Final = mistakes.TASK | {
    "controllers": {"still": f"{PID_OF_Q} kp=0.001"},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
}
RANGES: Final = TASK | {
    "controllers": {"still": 0, "wide": f"{PID_OF_Q} kp=0.1..1", "ahead": "mpc horizon=0.2s"}
}

MISTAKES: Final[Mapping[str, Facts]] = {
    # The program itself
    "": ("COMMAND", "required"),
    "--verson": ("--verson", "'--version'"),
    # info
    "info modle.fmu": ("modle.fmu", "'model.fmu'"),
    "info taks.toml": ("taks.toml", "'task.toml'"),
    "info task.tml": ("task.tml", "'task.toml'"),
    "info prices.csv": ("prices.csv", "FMU", "zip"),
    "info model.fmu extra": ("'extra'",),
    "info model.fmu -y": ("'-y'", "'-q'"),
    "info model.fmu --output more": ("--output", "--repair"),
    "info --repair task.toml": ("task.toml", "FMU"),
    "info --repair model.fmu": ("model.fmu", "source code"),
    # new
    "new task.toml": ("task.toml", "FMU"),
    "new model.fmu --output no/t.toml": ("no/t.toml", "'no'"),
    # Tasks, which most commands take
    "validate task": ("'task'", "'task.toml'"),
    "validate nothing": ("'nothing'",),
    "validate task.toml:Task": ("'task.toml'", "module"),
    "validate drive:": ("'drive:'",),
    "validate drvie:Drive": ("'drvie'", "'drive'"),
    "validate drive:Drvie": ("'Drvie'", "'Drive'"),
    "validate broken:Drive": ("'broken'", "NameError", "oops"),
    "validate math:pi": ("3.14", "module:Class"),
    "validate fmugym/CartPol-v0": ("fmugym/CartPol-v0", "'fmugym/CartPole-v0'"),
    "validate CartPole-v1": ("'CartPole-v1'", "no environment of fmugym"),
    "validate drive:Drive --master jacobi": ("'drive:Drive'", "its own master"),
    "simulate drive:Drive --scenario frost": ("'drive:Drive'", "no scenarios"),
    "simulate model.fmu": ("'model.fmu'", "fmugym new model.fmu"),
    "evaluate model.fmu": ("'model.fmu'", "fmugym new model.fmu"),
    f"tune model.fmu '{PID_OF_Q} kp=0.1..1'": ("'model.fmu'", "fmugym new model.fmu"),
    "train model.fmu --output agent": ("'model.fmu'", "fmugym new model.fmu"),
    # simulate
    "simulate task.toml --steps 0": ("--steps", "positive", "0"),
    "simulate task.toml --episodes 0": ("--episodes", "positive", "0"),
    "simulate task.toml --action 0.5": ("'0.5'", "0.01"),
    "simulate task.toml --action 0,0": ("'0,0'", "(1,)"),
    "simulate task.toml --action left": ("'left'", "random"),
    "simulate task.toml --action nan": ("'nan'",),
    "simulate task.toml --action 1": ("'1'", "0.01"),
    "simulate task.toml --controller 'pid setpoint=1'": ("'of'", "PID"),
    "simulate task.toml --controller 'pit of=q'": ("'pit'",),
    "simulate task.toml --controller 'pid of=qq setpoint=1 kp=1'": ("'qq'", "'q'"),
    "simulate task.toml --controller 'pid of=q setpont=1'": ("'setpont'", "'setpoint'"),
    "simulate ranges.toml --controller wide": ("kp=0.1..1 is a range",),
    "simulate task.toml --agent nowhere": ("'nowhere'", "fmugym train"),
    "simulate task.toml --scenario forst": ("'forst'",),
    "simulate task.toml --output no/run.csv": ("no/run.csv", "'no'"),
    "simulate task.toml --output run.xls": ("run.xls", ".csv"),
    "simulate task.toml --output a.csv --variables qq": ("'qq'", "'q'"),
    "simulate task.toml --output a.csv --every 0.03": ("0.03", "0.02"),
    "simulate task.toml --output a.csv --action 0 --action 0.01": ("a.csv", "2"),
    "simulate task.toml --timezone UTC": ("--timezone is for datasets",),
    "simulate task.toml --speed 2": ("--speed is for --plant",),
    "simulate task.toml --ahead 6h": ("--ahead is for --plant",),
    "simulate task.toml --output minari:a/b-v0 --output a.csv": ("alone", "2 outputs"),
    "simulate task.toml --plant --scenario frost": ("--scenario", "--steps"),
    "simulate fmugym/Pendulum-v0 --plant": ("'fmugym/Pendulum-v0'", "task file"),
    # evaluate
    "evaluate task.toml --plot a.pgn": ("'a.pgn'", ".png"),
    "evaluate task.toml --controller 'pid of=qq setpoint=1 kp=1'": ("'qq'", "'q'"),
    "evaluate task.toml --log log.csv --scenario frost": ("--log", "--scenario"),
    "evaluate fmugym/House-v0 --scenario frst": ("unknown scenario", "'frost'"),
    "evaluate fmugym/House-v0 --scenario spring --scenario frst": ("unknown scenario", "'frost'"),
    # bench
    "bench task.toml --envs 0": ("num_envs", "0"),
    "bench task.toml --seconds 0": ("--seconds", "positive", "0"),
    "bench task.toml --seconds inf": ("--seconds", "finite", "inf"),
    # tune
    f"tune task.toml '{PID_OF_Q} kp=1'": ("range", "kp=0.05..5"),
    "tune task.toml 'pid of=q kp=1..a'": ("'1..a'", "range"),
    f"tune fmugym/House-v0 '{PID_OF_T} kp=5..0.05'": ("5..0.05",),
    f"tune fmugym/House-v0 '{PID_OF_T}'": ("'kp'",),
    "tune fmugym/House-v0 'schedule 06:00=0..1'": ("hysteresis, pid",),
    "tune ranges.toml wide --candidates 7": ("candidates", "8", "7"),
    "tune ranges.toml wide --rounds 0": ("--rounds", "positive", "0"),
    "tune ranges.toml wide --output a.json": ("'a.json'", ".toml"),
    "tune ranges.toml wide --output a.toml --name 'a b'": ("'a b'", "'tuned'"),
    "tune ranges.toml wide --output missing/a.toml": ("missing/a.toml", "'missing'"),
    f"tune fmugym/House-v0 '{PID_OF_T} kp=1' --scenario frst": ("'frst'", "'frost'"),
    # train, which searches
    "train task.toml --output agent gamma=0.9": ("KEY=VALUE", "--algorithm"),
    **{
        f"train task.toml --output agent {option}": (option.split()[0], "--algorithm")
        for option in (
            *("--no-normalize", "--tune 3", "--tune-steps 3", "--record '*'", "--record-env 1"),
            *("--record-every 1", "--record-format csv", "--track wandb", "--residual still"),
        )
    },
    "train task.toml --output agent --algorithm PPO --minutes 2": ("--minutes", "--algorithm"),
    "train task.toml --output agent --algorithm PPO --rounds 2": ("--rounds", "--algorithm"),
    "train task.toml --output agent --minutes 0": ("--minutes", "positive", "0"),
    "train task.toml --output agent --rounds 0": ("--rounds", "positive", "0"),
    "train task.toml --output agent --envs 0": ("--envs", "positive", "0"),
    "train task.toml --output nowhere --rounds 1 --resume": ("nowhere", "no search to resume"),
    "train task.toml --output nowhere --rounds 1 --seed 1 --resume": ("--seed", "--resume"),
    # fit
    "fit task.toml --log log.csv": ("--parameter", "v_c"),
    "fit task.toml --log log.csv --plot a.pgn": ("'a.pgn'", ".png"),
    "fit task.toml --log log.csv --output a.tml": ("'a.tml'", ".toml"),
    "fit task.toml --log no.csv --parameter l": ("'no.csv'", "cannot be read"),
    "fit task.toml --log log.csv --parameter l=1": ("NAME=LOW..HIGH", "'l=1'"),
    "fit task.toml --log log.csv --parameter l --column q": ("COLUMN=VARIABLE", "'q'"),
    # export
    "export nowhere --task task.toml --output a.cc": ("'a.cc'", ".onnx"),
    "export x --task task.toml --output a.c --fmi 4.0": ("--fmi", "'4.0'"),
    "export --task task.toml --output a.c": ("AGENT", "--controller"),
    "export x --controller still --task task.toml --output a.c": ("AGENT", "--controller"),
    "export --controller still --output a.c": ("--task",),
    "export --controller wide --task ranges.toml --output a.c": ("kp=0.1..1",),
    "export task.toml --surrogate --output twin.c": ("'twin.c'", ".fmu"),
    "export --surrogate --output twin.fmu": ("--surrogate", "needs a task"),
    "export task.toml --surrogate --steps 0 --output twin.fmu": ("--steps", "positive", "0"),
    "export task.toml --surrogate --output twin.fmu --plot twin.doc": ("'twin.doc'", ".png"),
    "export task.toml --output twin.fmu --plot twin.png": ("--plot", "give --surrogate"),
    # serve
    "serve task.toml": ("'task.toml'", "[plant]", "--modbus or --opcua"),
    "serve fmugym/House-v0 --modbus": ("'fmugym/House-v0'", "task file"),
    "serve task.toml --modbus --action 0 --action 0.01": ("one can act", "action 0.01"),
}

_TRAIN: Final = "train task.toml --output agent --envs 2 --steps 64"
_SAC: Final = "--algorithm SAC learning_starts=10 batch_size=16 buffer_size=1000"
_PPO: Final = "--algorithm PPO n_steps=32 batch_size=32"

OF_ALGORITHMS: Final[Mapping[str, Facts]] = {
    f"{_TRAIN} --algorithm PPOO": ("'PPOO'", "'PPO'"),
    f"{_TRAIN} --algorithm PPO n_step=3": ("'n_step'", "'n_steps'"),
    f"{_TRAIN} --algorithm PPO learningrate=1e-3": ("'learningrate'", "'learning_rate'"),
    f"{_TRAIN} --algorithm PPO n_steps": ("'n_steps'",),
    f"{_TRAIN} --algorithm PPO --steps 0": ("--steps", "positive", "0"),
    f"{_TRAIN} --algorithm PPO n_steps=64": ("128 steps (n_steps=64 in 2 environments)",),
    f"{_TRAIN} --algorithm PPO --resume": ("agent", "no training to resume"),
    f"{_TRAIN} --residual stil {_SAC}": ("'stil'", "'still'"),
    f"{_TRAIN.replace('task', 'ranges')} --residual ahead {_SAC}": ("plans ahead",),
    f"{_TRAIN} --residual still --residual-scale 1.5 {_SAC}": ("at most 1, got 1.5",),
    f"{_TRAIN} --residual-scale 0.5 {_SAC}": ("--residual NAME",),
    f"{_TRAIN} --residual still --algorithm DQN": ("DQN cannot be made",),
    f"{_TRAIN} --record qq {_PPO}": ("'qq'",),
    f"{_TRAIN} --record q --record-env 3 {_PPO}": ("0 to 1", "3"),
    f"{_TRAIN} --record q --record-every 0.01 {_PPO}": ("0.02", "0.01"),
    f"{_TRAIN} --record q --record-format cvs {_PPO}": ("'cvs'", "'csv'"),
    f"{_TRAIN} --record-env 1 {_PPO}": ("--record '*'",),
}
"""Of trainings with Stable-Baselines3, by arguments of ``train``."""

MISSING_LIBRARIES: Final[Mapping[str, tuple[str, str]]] = {
    "simulate task.toml --output a.html": ("matplotlib", "plot"),
    "evaluate task.toml --plot a.png": ("matplotlib", "plot"),
    "fit task.toml --log log.csv --parameter l --plot a.svg": ("matplotlib", "plot"),
    "simulate task.toml --output minari:a/b-v0": ("fmugym.records.minari", "minari"),
    f"{_TRAIN} --algorithm PPO": ("fmugym.training.sb3", "sb3"),
    f"{_TRAIN} {_PPO} --tune 2": ("optuna", "tune"),
    f"{_TRAIN} {_PPO} --track mlflow": ("mlflow", "mlflow"),
    f"{_TRAIN} {_PPO} --track wandb": ("wandb", "wandb"),
}
"""By a command, the module that is missing, and the extra that brings it."""


def make_folder(folder: Path) -> None:
    """What users have beside them: FMUs and tasks, right and wrong."""
    mistakes.make_folder(folder)
    (folder / "task.toml").write_text(tomlkit.dumps(TASK))
    (folder / "ranges.toml").write_text(tomlkit.dumps(RANGES))
    (folder / "log.csv").write_text(log())
    (folder / "wrong.toml").write_text(tomlkit.dumps(TASK | {"reward": "-abs(p)"}))
    for ending in ("fmu", "toml"):
        (folder / f"folder.{ending}").mkdir()
        (folder / f"text.{ending}").write_text("no such thing")
    (folder / "wrong.fmu").write_bytes((folder / "model.fmu").read_bytes()[:-1000])


@functools.cache
def log() -> str:
    """An episode of the plant, whose arm has another length than that of the task."""
    task = fmugym.Task.from_dict(TASK | {"fmu": {"bundled": "Pendulum"}, "parameters": {"l": 0.12}})
    rows = ["time,tau,q,q_dot"]
    with contextlib.closing(fmugym.load(task, physical=True)) as env:
        env.action_space.seed(0)
        q, q_dot = env.reset(seed=0)[0]
        for step in range(50):
            action = env.action_space.sample()
            rows.append(f"{step * 0.02:.2f},{float(action[0])!r},{q},{q_dot}")
            q, q_dot = env.step(action)[0]
    return "\n".join([*rows, ""])


def refusal(*arguments: Any, code: int | None = None) -> str:
    """Run a command that must fail and print one line only; returns the line."""
    printed, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(error):
        try:
            found = run_command_line([*map(str, arguments)])
        except SystemExit as end:
            found = end.code
    line = error.getvalue()
    assert found in ({1, 2} if code is None else {code}), (arguments, found, line)
    assert not printed.getvalue(), arguments
    assert line.count("\n") == 1, line
    line = line.removesuffix("\n")
    assert line.startswith("fmugym"), line
    assert line.isprintable(), line
    assert len(line) <= LONGEST, line
    return line


def files_in(folder: Path) -> list[Path]:
    """All files, but for the classes that Python has compiled."""
    return sorted(path for path in folder.rglob("*") if "__pycache__" not in path.parts)


def require_refusal(line: str, facts: Facts, folder: Path) -> None:
    """Run a mistake: its facts are told, and the folder stays as it was."""
    before = files_in(folder)
    said = refusal(*shlex.split(line))
    missing = [fact for fact in facts if fact not in said]
    assert not missing, (said, missing)
    assert files_in(folder) == before


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        make_folder(Path(place))
        sys.path.append("")
        os.environ["COLUMNS"] = "200"
        for given in (*MISTAKES, *OF_ALGORITHMS):
            sys.stdout.write(f"fmugym {given}\n    {refusal(*shlex.split(given))}\n")
