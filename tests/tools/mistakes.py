"""A few hundred mistakes of users: each message says what, expected, actual and the nearest name.

``python tests/tools/mistakes.py`` prints all messages, for a person to read. Most mistakes are
made of the tables of the package, so that new keys and arguments are covered as they come.
``command_mistakes.py`` has those on the command line.
"""

import contextlib
import copy
import functools
import inspect
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit
from gymnasium import spaces

import fmugym
from fmugym.environment.config import EnvConfig
from fmugym.errors import shown
from fmugym.task import task_keys as task_format

LONGEST = 500
"""Characters of a message: a user reads it in a terminal."""


class Mistake(NamedTuple):
    """A mistake.

    Attributes:
        label: What a person may call it.
        make: Makes it, and returns the message; in a folder with ``model.fmu`` and ``task.toml``.
        facts: What the message must have: the thing, what was given, what was expected, and what
            was meant. Texts, or patterns of them.
    """

    label: str
    make: Callable[[], str]
    facts: tuple[str | re.Pattern[str], ...]


def flaws_of(mistake: Mistake) -> list[str]:
    """What a message lacks; the message first, if there is something."""
    text = mistake.make()
    missing = [fact for fact in map(_pattern, mistake.facts) if not fact.search(text)]
    flaws = [f"lacks {fact.pattern}" for fact in missing]
    if len(text) > LONGEST:
        flaws.append(f"has {len(text)} characters")
    if not text.isprintable() or "Traceback" in text:
        flaws.append("is more than a line")
    return [f"{mistake.label}: {text}", *flaws] if flaws else []


def _pattern(fact: str | re.Pattern[str]) -> re.Pattern[str]:
    return re.compile(re.escape(fact)) if isinstance(fact, str) else fact


WANTED = re.compile(r"must be|expected|known are|reads version")
"""How messages begin to say what would have been right."""


def misspelt(name: str) -> str:
    """A slip of the finger, whose nearest name is the name itself."""
    return name + name[-1]


# Task files

TASK = {
    "fmu": "model.fmu",
    "time_step": 0.02,
    "episode_length": "1s",
    "reward": "-abs(q - 1)",
    "variables": {"tau": {"min": -0.01, "max": 0.01}, "q": {"min": -20, "max": 20}},
    "agent": {"actions": ["tau"], "observations": ["q"]},
}


def merged(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    result = copy.deepcopy(base)
    for key, value in change.items():
        if value is None:
            result.pop(key, None)
        elif isinstance(value, dict) and isinstance(result.get(key), dict):
            result[key] = merged(result[key], value)
        else:
            result[key] = value
    return result


def in_the_file(change: dict[str, Any]) -> str:
    """Load a task file that must be refused; returns the message."""
    Path("wrong.toml").write_text(tomlkit.dumps(merged(TASK, change)))
    try:
        env = fmugym.load("wrong.toml")
        env.reset(seed=0)
    except fmugym.FMUGymError as error:
        return str(error)
    raise AssertionError(f"nobody complains of {change}")


def task(change: dict[str, Any], *facts: str) -> Mistake:
    return Mistake(str(change), lambda: in_the_file(change), ("wrong.toml", *facts))


def nested(keys: str, value: Any) -> dict[str, Any]:
    """A value under keys with dots between them."""
    for key in reversed(keys.split(".")):
        value = {key: value}
    return value


SECTIONS = task_format.TASK.keys
TABLES = {
    "": SECTIONS,
    "agent": SECTIONS["agent"].kind.keys,
    "variables.q": SECTIONS["variables"].kind.kind.keys,
    "config": task_format.CONFIG_OF_TASK.keys,
    "data.d": SECTIONS["data"].kind.kind.keys,
    "setpoints.s": SECTIONS["setpoints"].kind.kind.keys,
    "kpis.k": SECTIONS["kpis"].kind.kind.keys,
    "clock": task_format.SEASON.keys,
    "scenarios.s": SECTIONS["scenarios"].kind.kind.keys,
    "memory.m": SECTIONS["memory"].kind.kind.keys,
    "expressions.e": SECTIONS["expressions"].kind.kind.keys,
    "reward.r": ("expr", "weight"),
    "variables.q.drop_out": ("probability", "value"),
    "fmu": ("bundled", "fmi_version"),
}
"""The keys of each table."""


def of_keys() -> Iterator[Mistake]:
    """Every key of every table misspelt, and given in a wrong type."""
    for table, keys in TABLES.items():
        for key in dict.fromkeys(keys):
            wrong = misspelt(key)
            change = nested(f"{table}.{wrong}".lstrip("."), 1)
            yield task(change, f"'{wrong}'", f"did you mean '{key}'", wrong)
    for key in SECTIONS.keys() - {"class", "arguments", "extends", "system"}:
        wrong = 3.5 if key in _TEXTS_OR_TABLES else [[]]
        yield task({key: wrong}, key, shown(wrong[0] if key in _LISTS else wrong), WANTED)
    for key in task_format.CONFIG_OF_TASK.elsewhere:
        yield task(nested(f"config.{key}", 1), f"'{key}' is no key of [config]")
    for key in (field.name for field in fields(EnvConfig) if field.name not in TABLES[""]):
        place = re.compile(r"\[\w+\]|'reward'|the FMU")
        yield task({key: 1}, f"'{key}' is no key: ", place)
    for key in ("controller", "cache"):
        wrong = misspelt(key)
        yield task({"warm_up": {"period": "1s", wrong: "x"}}, wrong, f"'{key}'")


_TEXTS_OR_TABLES = {
    *("version", "description", "fmu", "scenarios", "variables", "parameters", "data"),
    *("setpoints", "controllers", "inputs", "memory", "expressions", "agent", "costs", "kpis"),
    *("terminated", "truncated", "config"),
}
"""Keys that are no numbers."""

_LISTS = ("start_time", "clock", "file")
"""Keys that may be lists, so that their elements are wrong."""

PLACES_OF_NAMES = (
    "agent.actions",
    "agent.observations",
    "agent.history.of",
    "agent.forecast.of",
    "reward",
    "terminated",
    "truncated",
    "costs.c",
    "expressions.e",
    "kpis.k.mean",
    "memory.m.update",
    "setpoints.s.of",
    "variables.x.name",
)
"""Where a task names a variable."""

_BESIDE = {
    "agent.history.of": {"agent": {"history": {"length": "1s"}}},
    "agent.forecast.of": {"agent": {"forecast": {"horizon": "1s", "step": "1s"}}},
    "memory.m.update": {"memory": {"m": {"start": 0}}},
    "setpoints.s.of": {"setpoints": {"s": {"value": 1}}},
    "expressions.e": {"reward": "e"},
}


def of_names() -> Iterator[Mistake]:
    """A misspelt variable in all places where a name may stand."""
    for place in PLACES_OF_NAMES:
        wrong: Any = "theta_dott"
        change = nested(place, [wrong] if place.startswith("agent") else wrong)
        if place in {"terminated", "truncated"}:
            change = nested(place, f"{wrong} > 1")
        yield task(merged(_BESIDE.get(place, {}), change), f"'{wrong}'", "'theta_dot'")
    for name in ("m", "q_0", "solver", "b"):
        wrong = misspelt(name)
        yield task(nested(f"parameters.{wrong}", 1), wrong, f"'{name}'")


FILES: tuple[tuple[dict[str, Any], tuple[str, ...]], ...] = (
    ({"reward": None}, ("reward",)),
    ({"reward": {}}, ("reward",)),
    ({"agent": None}, ("'agent'",)),
    ({"fmu": None}, ("'fmu'",)),
    ({"agent": {"actions": None}}, ("'actions'", "missing", "line 14")),
    ({"agent": {"actions": []}}, ("actions", "at least one")),
    ({"agent": {"actions": ["q"]}}, ("'q'", "output")),
    ({"agent": {"actions": [3]}}, ("actions", "3", "text")),
    ({"agent": {"observations": ["q", "q"]}}, ("'q'", "twice")),
    ({"agent": {"rescale": "yes"}}, ("rescale", "'yes'", "True or False")),
    ({"agent": {"forecast": {"of": ["q"], "horizon": "1s"}}}, ("'q'", "forecast")),
    ({"episode_length": "-1s"}, ("episode_length", "'-1s'", "negative", "line 3")),
    ({"episode_length": "1 hour"}, ("episode_length", "'1 hour'", "'1h 30min'")),
    ({"episode_length": "0.03s"}, ("0.03", "0.02")),
    ({"episode_length": 0}, ("0.02", "0 s")),
    ({"time_step": "20 mss"}, ("'20 mss'", "ms")),
    ({"time_step": -1}, ("time_step", "-1")),
    ({"time_step": 0}, ("time_step", "0", "positive")),
    ({"substeps": 2.5}, ("substeps", "2.5", "line 5")),
    ({"substeps": 0}, ("substeps", "0", "positive integer")),
    ({"warm_up": "x"}, ("warm_up", "'x'", "'15min'")),
    ({"version": 7}, ("version", "7", "1")),
    ({"extends": "basee.toml"}, ("'basee.toml'", "'base.toml'")),
    ({"fmu": "task.toml"}, ("task.toml", "FMU")),
    ({"fmu": "modle.fmu"}, ("'modle.fmu'", "'model.fmu'")),
    ({"fmu": {"bundled": "Pendulun"}}, ("'Pendulun'", "'Pendulum'")),
    ({"fmu": {"bundled": "Pendulum", "fmi_version": "4.0"}}, ("'4.0'", "'3.0'")),
    ({"variables": {"tau": {"min": "a"}}}, ("tau.min", "'a'")),
    ({"variables": {"tau": {"unit": "xyz"}}}, ("'xyz'", "W/(m2.K)")),
    ({"variables": {"tau": {"unit": 3}}}, ("unit", "3", "text")),
    ({"variables": {"tau": {"levels": []}}}, ("levels", "[]")),
    ({"variables": {"tau": {"levels": 3}}}, ("levels", "3", "list")),
    ({"variables": {"tau": {"delta": -1}}}, ("delta", "-1", "positive")),
    ({"variables": {"q": {"saturation": [1, 0]}}}, ("[1, 0]", "lowest")),
    ({"variables": {"q": {"delay": "0.03s"}}}, ("delay", "0.03", "0.02")),
    ({"variables": {"q": {"drop_out": 2}}}, ("2", "between 0 and 1")),
    ({"variables": {"q": {"rate": -1}}}, ("rate", "-1", "positive")),
    ({"variables": {"tau": {"min_on": "1 hour"}}}, ("min_on", "'1 hour'", "'15min'")),
    ({"parameters": {"m": "a"}}, ("parameters.m", "'a'")),
    ({"parameters": {"m": [1]}}, ("m must be a number", "[1]")),
    ({"parameters": {"q": 1}}, ("'q'", "continuous output")),
    ({"parameters": {"body": "rodd"}}, ("'rodd'", "'uniform_rod'")),
    ({"parameters": {"m": {"distribution": "unifrom"}}}, ("'unifrom'", "'uniform'")),
    ({"parameters": {"m": {"distribution": "uniform", "low": 0}}}, ("'high'",)),
    (
        {"parameters": {"m": {"distribution": "uniform", "low": 1, "high": 0}}},
        ("low=1.0", "high=0.0"),
    ),
    ({"parameters": {"m": {"low": 0, "high": 1}}}, ("'distribution'", "0.0")),
    ({"parameters": {"m": {"distribution": "choice", "values": []}}}, ("[]", "at least one")),
    ({"reward": {"a": {"weight": 1}}}, ("reward.a", "'expr'")),
    ({"terminated": "q"}, ("'q'", "condition", "x > 1")),
    ({"terminated": "q = 1"}, ("'q = 1'", "==")),
    ({"terminated": "not"}, ("'not'", "ends too early")),
    ({"config": {"isolation": "proces"}}, ("'proces'", "'process'")),
    ({"foreign": {"call_timeout": -1}}, ("call_timeout", "-1", "positive")),
    ({"foreign": {"preload": 3}}, ("preload", "3", "list of names")),
    ({"config": {"stop_time": "a"}}, ("stop_time", "'a'", "number")),
    ({"data": {"d": {"file": "prices.csv", "column": "prise"}}}, ("'prise'", "'price'")),
    ({"data": {"d": {"values": [1, 2]}}}, ("'step'", "'times'")),
    ({"data": {"d": {"values": [1, 2], "times": [1]}}}, ("1 times", "2 values")),
    (
        {"data": {"d": {"values": [1, 2], "step": "1s", "interpolation": "linaer"}}},
        ("'linaer'", "'linear'"),
    ),
    ({"setpoints": {"s": {"schedule": {"25:00": 1}}}}, ("'25:00'", "'06:00'")),
    ({"setpoints": {"s": "a"}}, ("setpoints.s", "'a'")),
    ({"clock": {"from": "01-01"}}, ("clock", "'to'")),
    ({"clock": "02-30"}, ("'02-30'", "'01-15'")),
    ({"expressions": {"e": "e + 1"}}, ("'e'", "itself")),
    ({"expressions": {"q": "1"}}, ("'q'", "twice")),
    ({"expressions": {"time": "1"}}, ("'time'",)),
    ({"inputs": {"tau": "q"}}, ("'tau'", "action")),
    ({"arguments": {"a": 1}}, ("'arguments'", "'class'")),
)


# Expressions


EXPRESSIONS: dict[str, tuple[str, ...]] = {
    "": ("''", "empty"),
    "(q - 1": ("'(q - 1'", "never closed", "column 1"),
    "q - 1)": ("'q - 1)'", "unmatched", "column 6"),
    "q == 1 ? 2": ("'q == 1 ? 2'", "column 8"),
    "q tau": ("'q tau'", "column"),
    "q ^ 2": ("'q ^ 2'", "**", "power"),
    "q // tau": ("operator in 'q // tau'",),
    "q & tau": ("operator in 'q & tau'", "and"),
    "~q": ("~", "write 'not'"),
    "q is tau": ("Is is not allowed",),
    "Q": ("'Q'", "'q'"),
    "q.x": ("unknown name 'q.x'", "'q'"),
    "q[0]": ("unknown name 'q[0]'",),
    "__import__": ("unknown name '__import__'",),
    "q + qq": ("'qq'", "column 5 of"),
    "  q + qq": ("'qq'", "column 7 of"),
    "abs(q) * qq": ("'qq'", "column 10 of"),
    "\u00e4 + q": ("'\u00e4'", "column 1 of"),
    "abs(q, 1)": ("abs", "1", "2"),
    "exec(q)": ("unknown function 'exec'",),
    "sin": ("unknown name 'sin'",),
    "sin(x=q)": ("sin", "by place"),
    "min(*q)": ("min", "by place"),
    "q.b(1)": ("functions by their names",),
    "previous(time)": ("'time'", "no value before the step"),
    "previous(q + tau)": ("previous takes one name",),
    "q and tau": ("condition", "'x > 1'"),
    "tau if q else 1": ("condition", "'x > 1'"),
    "not q": ("condition", "'x > 1'"),
    "'a'": ("'a'", "number"),
    "1j": ("1j", "no number"),
    "1e999": ("inf", "no number"),
    "1 / 0": ("'1 / 0'", "no finite number", "inf"),
    "[q]": ("list is not allowed",),
    "lambda: 1": ("lambda",),
    "(x := q)": ("namedexpr is not allowed",),
    "f'{q}'": ("joinedstr is not allowed",),
    "await q": ("await",),
    "q\n+ tau": ("no expression",),
    "\0": ("no expression",),
    "(" * 300 + "q" + ")" * 300: ("no expression",),
    "-" * 60 + "q": ("too long", "nested 40 times"),
    "+".join(["q"] * 300): ("too long", "500 parts"),
    "q" * 3000: ("2000", "3000"),
}
"""What is no expression, or cannot be computed."""


class Expressed(fmugym.FMUEnv):
    """A class whose config has all that hooks might tell."""

    def __init__(self, **keys: Any) -> None:
        config = {"model_input_names": "tau", "model_output_names": ["q"], "time_step": 0.02}
        config |= {"terminated": False, "model_parameters": {"q_0": 0.0}} | keys
        super().__init__(Path("model.fmu").absolute(), config)

    def _get_action_space(self) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (1,))


OF_CLASSES: tuple[tuple[dict[str, Any], tuple[str, ...]], ...] = (
    ({"terminated": "qq > 1"}, ("config key 'terminated'", "'qq'", "did you mean 'q'")),
    ({"terminated": "q"}, ("config key 'terminated'", "expected a condition", "got 'q'")),
    ({"terminated": "done"}, ("'done' is known in 'reward'",)),
    ({"terminated": "q >"}, ("'terminated': 'q >' is no expression",)),
    ({"reward": "action[7]"}, ("unknown name 'action[7]'", "'action")),
    ({"reward": "1", "positive_reward": 2.0}, ("'reward' and 'positive_reward' contradict",)),
    ({"reward": {"near": {"expr": "q", "wight": 2}}}, ("'wight'", "did you mean 'weight'")),
    ({"inputs": {"g": "1"}}, ("unknown input in 'inputs' 'g'", "'tau'")),
    ({"inputs": {"tau": "previous(q)"}}, ("'q'", "no value before the step")),
    ({"memory": {"n": {"start": 0, "update": "n + o"}}}, ("config key 'memory'", "name 'o'")),
    ({"memory": {"n": {"start": 0}}}, ("'update' is missing",)),
    (
        {"memory": {"n": {"start": 0, "update": "1"}}, "episode_variables": {"n": 1}},
        ("'n' is in",),
    ),
    ({"memory": {"q_0": {"start": 0, "update": "1"}}}, ("'q_0' is both",)),
    ({"memory": {"pi": {"start": 0, "update": "1"}}}, ("'pi' has a name with a meaning",)),
    ({"episode_variables": {"time": 0}}, ("'time' has a name with a meaning",)),
    ({"costs": {"much": "sqr(q)"}}, ("unknown function 'sqr'", "did you mean 'sqrt'")),
    ({"observations": ["q", "y"]}, ("config key 'observations'", "unknown name 'y'")),
    ({"info": {"cost": "1"}}, ("'cost' has a meaning of its own",)),
    ({"reward": "y", "truncated": "z > 1"}, ("'y'", "'z'")),
)
"""Keys of the config of a class; all of its mistakes are told at once."""


def of_expressions() -> Iterator[Mistake]:
    """Mistakes in the expressions of task files and of classes."""
    for text, facts in EXPRESSIONS.items():
        yield task({"reward": text}, *facts)
    for keys, facts in OF_CLASSES:
        yield python(str(keys), lambda keys=keys: Expressed(**keys), *facts)


# Classes


class Small(fmugym.FMUEnv):
    """An environment of the FMU in the working directory."""

    def __init__(self, **changes: Any) -> None:
        options = {key: changes.pop(key) for key in list(changes) if key in _OPTIONS}
        config = {"model_input_names": "tau", "model_output_names": ["q"], "time_step": 0.02}
        super().__init__(Path("model.fmu").absolute(), config | changes, **options)

    def _is_done(self) -> bool:
        return False


_ARGUMENTS = ("log_level", "render_mode", "backend", "isolation")
_OPTIONS = {*_ARGUMENTS, *map(misspelt, _ARGUMENTS)}


def in_python(use: Callable[[], Any]) -> str:
    """Do what must be refused; returns the message."""
    try:
        use()
    except fmugym.FMUGymError as error:
        return str(error)
    raise AssertionError("nobody complains")


def python(label: str, use: Callable[[], Any], *facts: str) -> Mistake:
    return Mistake(label, lambda: in_python(use), facts)


def made(*facts: str, **changes: Any) -> Mistake:
    """A class with another config or other arguments."""
    return python(str(changes), lambda: Small(**changes).reset(), *facts)


def of_config() -> Iterator[Mistake]:
    """Every key of the config misspelt or of a wrong type, and every argument misspelt."""
    for field in fields(EnvConfig):
        wrong = misspelt(field.name)
        yield made(f"'{wrong}'", f"'{field.name}'", **{wrong: 1})
        name = re.compile(field.name.partition("_")[0].rstrip("s"))
        yield made(shown(1j), name, WANTED, **{field.name: 1j})
    for name in _ARGUMENTS:
        yield made(f"'{misspelt(name)}'", f"'{name}'", **{misspelt(name): None})
    for name in ("isolation", "backend"):
        yield made(shown("wrong"), **{name: "wrong"})
    own = list(inspect.signature(fmugym.FMUVectorEnv.__init__).parameters.values())[2:]
    for name in (one.name for one in own if one.kind is one.KEYWORD_ONLY):
        options = {misspelt(name): None}
        yield python(
            str(options),
            lambda options=options: fmugym.FMUVectorEnv(Small, 2, **options),
            misspelt(name),
            name,
        )


def of_calls() -> Iterator[Mistake]:
    """Methods with wrong arguments, or in a wrong order."""
    yield python("reset(42)", lambda: Small().reset(42), "reset(seed=42)")
    many = functools.partial(fmugym.FMUVectorEnv, Small, 2)
    yield python("reset(42) of many", lambda: many().reset(42), "reset(seed=42)")
    for seed in (-1, 1.5, "7"):
        yield python(f"seed {seed}", lambda s=seed: Small().reset(seed=s), "seed", shown(seed))
    yield python("options", lambda: Small().reset(options={"parameters": {}}), "'parameters'")
    yield python("options 3", lambda: Small().reset(options=3), "option", "3")
    parameters = {"model_parameters": {"mm": 1.0}}
    yield python("a parameter", lambda: Small().reset(options=parameters), "'mm'", "'m'")
    yield python("step first", lambda: Small().step(0.0), "step", "reset")
    yield python("variable", lambda: fmugym.FMU("model.fmu").variable("qq"), "'qq'", "'q'")
    yield python("load()", lambda: fmugym.load(), "config")
    yield python("load(3)", lambda: fmugym.load(3), "3")
    yield python("scenario", lambda: fmugym.load("task.toml", scenario="x"), "'x'")
    yield python(
        "argument", lambda: fmugym.load("task.toml", bakend="auto"), "'bakend'", "'backend'"
    )
    yield python("Uniform", lambda: fmugym.Uniform(lo=0, high=1), "'lo'", "'low'")


GROUPS: dict[str, Callable[[], list[Mistake]]] = {
    "keys": lambda: list(of_keys()),
    "names": lambda: list(of_names()),
    "expressions": lambda: list(of_expressions()),
    "files": lambda: [task(change, *facts) for change, facts in FILES],
    "config": lambda: list(of_config()),
    "calls": lambda: list(of_calls()),
}


def make_folder(folder: Path) -> None:
    """What users have beside them."""
    (folder / "model.fmu").write_bytes(fmugym.bundled_fmu("Pendulum").read_bytes())
    for name in ("task.toml", "base.toml"):
        (folder / name).write_text(tomlkit.dumps(TASK))
    (folder / "prices.csv").write_text("time,price\n0,1\n1,2\n")
    (folder / "drive.py").write_text("class Drive: pass\n")
    (folder / "broken.py").write_text("oops\n")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        make_folder(Path(place))
        sys.path.append("")
        os.environ["COLUMNS"] = "200"
        for group, mistakes in GROUPS.items():
            for mistake in mistakes():
                print(f"{group}: {mistake.label}\n    {mistake.make()}")
