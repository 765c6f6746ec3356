"""The faults of the zoo with their outcomes: what the tests expect and tests/zoo/README.md tells.

``python zoo_table.py`` prints the table of the document.
"""

import itertools
import sys
from dataclasses import dataclass
from typing import NamedTuple

import zoo_tools
from zoo_tools import CALLS, FAULTS

SETTINGS = ("single", "vector", "process", "process vector")
_SAME = "the same"
ANYWHERE = CALLS[1:]
NOT_FINE = (2, 3, 4, 5, 99, -1)
"""Discard, Error, Fatal, Pending, and two that are none of FMI's."""

KINDS = {
    "fine": "nothing",
    "told": "in the log",
    "refused": "`FMULoadError`",
    "reset": "`reset` raises",
    "truncated": "truncated",
    "wrong": "**wrong values**",
    "dies": "**your process ends**",
    "hangs": "**your process hangs**",
}
HARMS = {
    "": "",
    "open files": "your files are closed",
    "standard streams": "your standard streams are closed",
    "working directory": "your working directory changes",
    "environment": "your environment changes",
    "memory": "your memory grows",
    "output": "it is on your standard output",
}


class Outcome(NamedTuple):
    """What a user sees; see ``zoo_tools.visit``.

    The reason is a part of what is told.
    """

    kind: str
    reason: str = ""
    harm: str = ""

    def __str__(self):
        text = KINDS[self.kind] + (f": `{self.reason}`" if self.reason else "")
        return text + (f"; {HARMS[self.harm]}" if self.harm else "")


FINE = Outcome("fine")
TOLD = Outcome("told", "this status was asked for")


@dataclass(frozen=True)
class Specimen:
    """One row of the table.

    Attributes:
        what: What the FMU does.
        here: What comes of it in this process, in a single and a vector environment.
        process: What comes of it with ``isolation="process"``, in both.
        vector: In a vector environment in this process, where that differs.
        fault: What it does, of ``FAULTS``.
        calls: Where, of ``CALLS``.
        at: After how many steps.
        statuses: What it returns, for the fault ``status``.
        token: See ``zoo.c``; made of the parameters where they come too late.
        definitions: For the compiler.
        spoilt: What is wrong with the archive; see ``spoil``.
        versions: Of FMI.
        rounds: How many episodes are played with the fault.
        heals: Whether an episode without the fault is as it should be afterwards.
        met: Whether the FMU is tried before, as it is by default.
        always: Whether the config itself asks for the fault.
    """

    what: str
    here: Outcome
    process: Outcome
    vector: Outcome | None = None
    fault: str = "none"
    calls: tuple[str, ...] = ("step",)
    at: int = 2
    statuses: tuple[int, ...] = (0,)
    token: str = ""
    definitions: tuple[str, ...] = ()
    spoilt: str = ""
    versions: tuple[int, ...] = (1, 2, 3)
    rounds: int = 1
    heals: bool = True
    met: bool = True
    always: bool = False

    def expected(self, setting):
        """The outcome in a setting."""
        if "process" in setting:
            return self.process
        return self.vector if setting == "vector" and self.vector else self.here

    def cells(self, folder, version, setting):
        """What is to be visited: one environment each, for as many faults as it goes on after."""
        faults = {}
        for call, status in itertools.product(self.calls, self.statuses):
            path = str(self._fmu(folder, version, call, status))
            values = zoo_tools.parameters(self.fault, call, self.at, status)
            key = (path,) if self.heals and self.rounds == 1 else (path, call, status)
            faults.setdefault(key, []).append(values)
        for (path, *_), parameters in faults.items():
            yield {
                "path": path,
                "setting": setting,
                "parameters": parameters,
                "rounds": self.rounds,
                "heals": self.heals,
                "seconds": 0.5 if self.here.kind == "hangs" else 60,
                "options": self._options(setting)
                | ({"model_parameters": parameters[0]} if self.always else {}),
            }

    def _fmu(self, folder, version, call, status):
        token = self.token or "{zoo}"
        if call in {"instantiate", "setup"}:
            token = f"{{zoo {FAULTS.index(self.fault)} {CALLS.index(call)} {status}}}"
        parts = (str(version), token, *self.definitions, self.spoilt)
        path = folder / "-".join(parts) / "Zoo.fmu"
        if not path.exists():
            zoo_tools.zoo_fmu(path.parent, version, token, *self.definitions)
            if self.spoilt:
                zoo_tools.spoil(path, self.spoilt)
        return path

    def _options(self, setting):
        options = {} if self.met else {"probe_timeout": None}
        if "process" in setting:
            options["isolation"] = "process"
            options["call_timeout"] = 0.5 if self.here.kind == "hangs" else 20.0
        if setting == "process vector":
            options["workers"] = None if self.token else 2
        return options


def dies(what, signal, **keywords):
    """A row of a fault in a step that ends the process."""
    truncated = Outcome("truncated", f"ended with {signal} in a step")
    return Specimen(what, Outcome("dies", signal), truncated, **keywords)


def crashes(what, process, call, **keywords):
    """A row of a SIGSEGV in a call."""
    here = Outcome("dies", "signal SIGSEGV")
    return Specimen(what, here, process, fault="segv", calls=(call,), **keywords)


def survives(what, harm, process=FINE, **keywords):
    """A row of something that is done to the process."""
    return Specimen(what, Outcome("fine", harm=harm), process, **keywords)


def same(what, outcome, **keywords):
    """A row that has the same outcome in all settings."""
    return Specimen(what, outcome, outcome, **keywords)


def returns(what, outcome, *calls, statuses=NOT_FINE, **keywords):
    """A row of statuses that calls return."""
    asked = {"fault": "status", "calls": calls, "statuses": statuses, "met": False}
    return same(what, outcome, **asked, **keywords)


TRIED = Outcome("refused", "in loading and instantiation it ended the process with signal SIGSEGV")
LOST = Outcome("reset", "ended with signal SIGSEGV in a reset")
AT_END = Outcome("told", "ended with signal SIGSEGV in its end")
LATE = Outcome("truncated", "took longer than call_timeout for a step and was ended")
APART = Outcome("told", "each gets a copy of the library")

SPECIMENS = (
    # The end of the process
    dies("writes to address 0 in a step", "signal SIGSEGV", fault="segv"),
    dies("raises SIGFPE, as a division of integers by 0 does", "signal SIGFPE", fault="fpe"),
    dies("raises SIGILL, as an illegal instruction does", "signal SIGILL", fault="ill"),
    dies(
        "raises SIGBUS, as reading a truncated mapped file does",
        "signal SIGBUS",
        fault="bus",
    ),
    dies("aborts", "signal SIGABRT", fault="abort"),
    dies("calls `exit(0)`", "exit status 0", fault="leave"),
    dies("overflows its stack", "signal SIGSEGV", fault="overflow"),
    Specimen("loops for ever", Outcome("hangs"), LATE, fault="loop", versions=(1, 3)),
    Specimen("sleeps for ever", Outcome("hangs"), LATE, fault="sleep", versions=(2,)),
    dies(
        "forks a process, which lives on, and crashes",
        "signal SIGSEGV",
        fault="fork_and_crash",
    ),
    Specimen(
        "forks a process and loops for ever",
        Outcome("hangs"),
        LATE,
        fault="fork_and_loop",
        versions=(2,),
    ),
    Specimen(
        "crashes in a constructor of its library",
        TRIED,
        Outcome("refused", "ended with signal SIGSEGV in the instantiation"),
        definitions=("CRASH_IN_CONSTRUCTOR",),
    ),
    Specimen(
        "crashes when it is instantiated",
        TRIED,
        Outcome("refused", "ended with signal SIGSEGV in the instantiation"),
        fault="segv",
        calls=("instantiate",),
    ),
    Specimen(
        "crashes whenever it is initialized",
        Outcome("refused", "in initialization it ended the process with signal SIGSEGV"),
        LOST,
        fault="segv",
        calls=("setup",),
        at=0,
        heals=False,
        always=True,
    ),
    crashes("crashes when it is initialized with some parameters", LOST, "exit", at=0),
    crashes(
        "crashes when its inputs are set",
        Outcome("truncated", "ended with signal SIGSEGV in a step"),
        "set",
        at=1,
    ),
    crashes(
        "crashes when its outputs are read",
        Outcome("truncated", "ended with signal SIGSEGV in a step"),
        "get",
    ),
    crashes("crashes when it is reset", FINE, "reset"),
    crashes("crashes when its state is saved", FINE, "get_state", at=0, rounds=4, versions=(2, 3)),
    crashes(
        "crashes when its state is restored", FINE, "set_state", at=0, rounds=4, versions=(2, 3)
    ),
    crashes("crashes when it is terminated", AT_END, "terminate", heals=False),
    crashes("crashes when it is freed", AT_END, "free", heals=False),
    # Statuses
    returns("refuses to be instantiated", Outcome("refused", TOLD.reason), "instantiate"),
    returns(
        "returns Warning in any call",
        TOLD,
        *("enter", "exit", "set", "step", "get", "reset"),
        statuses=(1,),
        at=0,
        rounds=2,
        heals=False,
    ),
    returns(
        "returns a bad status when it is set up",
        Outcome("reset", "returned"),
        "setup",
        at=0,
        heals=False,
    ),
    returns(
        "returns a bad status when it is initialized",
        Outcome("reset", "initialization returned"),
        *("enter", "exit"),
        at=0,
    ),
    returns(
        "returns a bad status when its inputs are set",
        Outcome("truncated", "setting the inputs returned"),
        "set",
        at=1,
    ),
    returns(
        "returns a bad status in a step",
        Outcome("truncated", "the step at t = 0.5 s returned"),
        "step",
    ),
    returns(
        "returns a bad status when its outputs are read",
        Outcome("truncated", "reading the outputs returned"),
        "get",
    ),
    returns("returns a bad status when it is reset (a new instance replaces it)", TOLD, "reset"),
    returns(
        "returns a bad status when its state is saved or restored (it is initialized instead)",
        FINE,
        *("get_state", "set_state"),
        at=0,
        rounds=4,
        versions=(2, 3),
    ),
    returns(
        "returns a bad status when it is terminated",
        TOLD,
        "terminate",
        statuses=(3, 4, 99),
        heals=False,
    ),
    # Values
    same(
        "gives NaN",
        Outcome("truncated", "the outputs are not finite: y = nan"),
        fault="not_a_number",
    ),
    same(
        "gives an infinite number",
        Outcome("truncated", "the outputs are not finite: y = inf"),
        fault="infinite",
    ),
    # What is done to the process
    same("prints a line", Outcome("fine", harm="output"), fault="print"),
    same("prints without a newline", Outcome("fine", harm="output"), fault="print_no_newline"),
    same("prints 20,000 lines in a step", Outcome("fine", harm="output"), fault="print_much"),
    same(
        "logs from another thread",
        Outcome("told", "hello from another thread"),
        fault="log_from_thread",
    ),
    same("changes the rounding mode, in any call", FINE, fault="round_up", calls=ANYWHERE),
    same(
        "lets denormal numbers count as zero, in any call",
        FINE,
        fault="flush_denormals",
        calls=ANYWHERE,
    ),
    survives("changes the working directory", "working directory", fault="change_directory"),
    survives("changes the environment", "environment", fault="change_environment"),
    survives("closes standard streams", "standard streams", fault="close_standard"),
    survives("closes all other files", "open files", fault="close_others"),
    same("forks a process, which lives on", FINE, fault="fork"),
    survives("leaks in each step", "memory", fault="leak", at=0, rounds=10),
    survives(
        "leaks in each reset", "memory", fault="leak", calls=("reset",), rounds=10, versions=(1,)
    ),
    # Lies
    Specimen(
        "allows one instance in a process, without declaring it",
        FINE,
        FINE,
        vector=APART,
        token="{zoo alone}",
    ),
    Specimen(
        "keeps its state in a global variable of its library",
        FINE,
        FINE,
        vector=APART,
        token="{zoo share}",
        versions=(1,),
    ),
    same(
        "leaves part of its state out of its FMU state (it is initialized instead)",
        FINE,
        vector=APART,
        token="{zoo share}",
        versions=(2, 3),
        rounds=6,
        heals=False,
    ),
    same(
        "declares that it can restore its state, and does nothing",
        FINE,
        fault="do_nothing",
        calls=("set_state",),
        at=0,
        rounds=12,
        versions=(2, 3),
    ),
    same(
        "does nothing when it is reset (`check_fmu_env` finds it)",
        Outcome("wrong"),
        fault="do_nothing",
        calls=("reset",),
        rounds=3,
        heals=False,
    ),
    # Archives
    same("an archive cut short", Outcome("refused", "File is not a zip file"), spoilt="cut"),
    same(
        "no model description",
        Outcome("refused", "modelDescription.xml"),
        spoilt="no modelDescription",
    ),
    same("a library cut short", Outcome("refused", "cut short"), spoilt="short Zoo"),
    same("no library for this platform", Outcome("refused", "no library"), spoilt="no Zoo"),
)


def _columns(specimen):
    """The texts of a row."""
    single, *others = map(specimen.expected, SETTINGS[:3])
    return specimen.what, str(single), *(_SAME if one == single else str(one) for one in others)


def markdown():
    """The table of the document."""
    lines = [
        '| the FMU | single environment | vector environment | `isolation="process"` |',
        "|---|---|---|---|",
    ]
    lines += [f"| {' | '.join(_columns(one))} |" for one in SPECIMENS]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(markdown() + "\n")
