"""Useful FMUs that break one promise each, and what fmugym does about it.

The tests expect it, and tests/zoo/README.md tells it: ``python tests/tools/quirk_table.py`` prints
its table. The FMUs are those of ``zoo/quirks.c``.
"""

import functools
import sys
from dataclasses import dataclass
from pathlib import Path

import fmu_tools
import model_tools

OUTPUTS = ("y", "clock", "calls")
VARIABLES = (
    ("u", "input", 'start="0" min="-1" max="1"'),
    ("y", "output", ""),
    ("gain", "parameter", 'start="1"'),
    ("tau", "parameter", 'start="0.5"'),
    ("clock", "output", ""),
    ("calls", "output", ""),
    ("returns", "output", ""),
)
"""As ``quirks.c`` has them, in the order of their value references."""

STATES = (2, 3)
"""The versions of FMI that have FMU states, and flags with which an FMU asks to stop."""

NEEDS = {
    "independent": "share the process",
    "one initialization at a time": "are initialized one at a time",
    "libraries": "get a copy of the library each",
    "processes": "get a process with a copy of the FMU's files each",
}


@dataclass(frozen=True)
class Quirk:
    """One FMU.

    Attributes:
        token: As ``quirks.c`` knows it.
        what: What the FMU does, for the document.
        method: How episodes begin, of ``ResetMethod``; with FMI 1.0, which has no FMU states,
            ``"restore"`` becomes ``"reset"``.
        neighbours: What several instances need, of ``Neighbours``.
        log: A part of the warning in the log; empty if there is none.
        versions: Of FMI.
        probe_timeout: In seconds.
        may_die_early: Whether the FMU may end the trial before a reset method is tried. Then
            episodes begin by the reset function.
        length: The most steps of an episode.
        equal: The token of an FMU with the same values, where the tests' own process cannot load
            this one.
    """

    token: str
    what: str
    method: str = "restore"
    neighbours: str = "independent"
    log: str = ""
    versions: tuple[int, ...] = (1, 2, 3)
    probe_timeout: float = 30.0
    may_die_early: bool = False
    length: int = 60
    equal: str = ""

    def __str__(self):
        return self.token

    def methods_of(self, version):
        """How episodes may begin with a version of FMI."""
        found = "reset" if version == 1 and self.method == "restore" else self.method
        return {found, "reset"} if self.may_die_early else {found}

    @property
    def row(self):
        """The row of the document."""
        method = f'`"{self.method}"`'
        if self.method == "restore" and 1 in self.versions:
            method += ' (FMI 1.0: `"reset"`)'
        log = f"`{self.log}`" if self.log else ""
        return f"| {self.what} | {method} | {NEEDS[self.neighbours]} | {log} |"


def keeps(what, method="instance"):
    """A reset that keeps something which an episode shows."""
    log = "does not begin anew when it is reset" if method == "instance" else ""
    return Quirk(f"reset keeps {what}", f"keeps {what} in a reset", method, log=log)


LONG = 1500
BAD_RESET = "does not begin anew when it is reset"
DISTURB = "disturb each other"

QUIRKS = (
    Quirk("well behaved", "nothing wrong"),
    # Resets and restored states
    Quirk("reset does nothing", "does nothing in a reset", "instance", log=BAD_RESET),
    keeps("the state"),
    keeps("inputs", "restore"),
    keeps("outputs"),
    keeps("parameters", "restore"),
    keeps("the time"),
    Quirk(
        "reset keeps files", "keeps its state in a file among its resources", "process",
        "processes", log=BAD_RESET,
    ),
    Quirk(
        "reset ignores parameters",
        "uses the parameters of its first episode in all others",
        "instance",
        log=BAD_RESET,
    ),
    Quirk("stops, reset keeps that", "keeps its wish to stop in a reset", "instance",
          log=BAD_RESET, versions=STATES),
    Quirk("stops, slow at first", "does so, too, and takes long for its first step", "instance",
          log=BAD_RESET, versions=STATES),
    Quirk("second reset fails", "returns Error in its second reset (a new instance replaces it)"),
    Quirk("second episode hangs", "hangs in the first step after a reset if parameters are set",
          "instance", log=BAD_RESET, probe_timeout=5.0),
    Quirk("reset frees twice", "corrupts the heap in a reset", "instance", log=BAD_RESET),
    Quirk("reset is not exact", "begins with a rounding error after a reset", "instance"),
    Quirk("library keeps", "keeps a drift in a global variable of its library", "library",
          "libraries", log=BAD_RESET),
    Quirk("long memory", "keeps values of the last 1,000 steps in a reset", "instance",
          log=BAD_RESET, length=LONG),
    Quirk("long memory of the library", "keeps such values in global variables", "library",
          "libraries", log=BAD_RESET, length=LONG),
    Quirk("restore forgets", "leaves its state out of its FMU state (restores are given up)",
          versions=STATES),
    Quirk("restore keeps the time", "leaves the time out of its FMU state (likewise)",
          versions=STATES),
    # Several instances
    Quirk("globals", "keeps its state in a global variable", "reset", "libraries", log=DISTURB),
    Quirk("one in a process", "refuses a second instance", neighbours="libraries", log=DISTURB),
    Quirk(
        "global parameters", "keeps parameters in global variables",
        neighbours="libraries", log=DISTURB,
    ),
    Quirk(
        "one saved state", "has one place for the FMU states of all instances",
        neighbours="libraries", log=DISTURB, versions=STATES,
    ),
    Quirk("static buffer", "steps with a static buffer", neighbours="libraries", log=DISTURB),
    Quirk(
        "scratch file", "writes and reads a file among its resources",
        neighbours="processes", log=DISTURB,
    ),
    Quirk(
        "scratch in directory", "writes and reads a file in its working directory",
        neighbours="processes", log=DISTURB,
    ),
    Quirk("overruns with two", "writes beyond its memory if there is a second instance",
          neighbours="libraries", log=DISTURB),
    Quirk("strtok", "initializes with `strtok`", neighbours="one initialization at a time"),
    Quirk(
        "heap model", "has one model on the heap, which steps if the time is later than its own",
        method="reset", neighbours="libraries", log=DISTURB,
    ),
    Quirk("heap buffer", "steps with a buffer on the heap that all instances share",
          neighbours="libraries", log=DISTURB),
    Quirk("shared outputs", "has a buffer on the heap for the outputs of all instances", "restore",
          "libraries", log=DISTURB),
    Quirk("newest turns", "turns the sign of the instance that was initialized last, at t = 1 s",
          neighbours="libraries", log=DISTURB),
    Quirk("initialized together", "shares its state with those that are initialized with it",
          method="reset", neighbours="libraries", log=DISTURB),
    Quirk("two slots", "has room for the states of two instances on the heap",
          method="reset", neighbours="libraries", log=DISTURB),
    Quirk("static time", "steps from the time of the last step in a global variable",
          method="reset", neighbours="libraries", log=DISTURB),
    Quirk("static random numbers", "draws from global variables, which an initialization seeds",
          method="reset", neighbours="libraries", log=DISTURB),
    Quirk("counts instances", "depends on the number of instances",
          neighbours="libraries", log=DISTURB),
    Quirk("reset disturbs", "changes the instance that was initialized last in a reset",
          neighbours="libraries", log=DISTURB),
    Quirk("free disturbs", "changes the instance that was initialized last when it is freed",
          neighbours="libraries", log=DISTURB),
    # Memory, files and calls
    Quirk("free before a step", "frees a bad pointer if it is freed before any step (it runs in "
          "worker processes)", log="harms its process", equal="well behaved"),
    Quirk("free before initialization", "does so before its initialization (likewise)",
          log="harms its process", equal="well behaved"),
    Quirk("warns", "returns Warning in each step until its first reset"),
    Quirk("overruns", "writes a byte beyond its memory (it runs in worker processes)",
          log="harms its process", may_die_early=True),
    Quirk("changes directory", "makes its resources the working directory (you get yours back "
          "when the environment is closed)"),
    Quirk("needs its directory", "reads a file beside its library while that is loaded"),
    Quirk("no early reading", "returns Error if it is read before its initialization"),
    Quirk(
        "no reading before a step",
        "returns Error if it is read before its first step (until then, outputs have the start "
        "values of the model description)",
        log="cannot be read before its first step",
    ),
    Quirk("no reading of inputs", "returns Error if an input is read"),
    Quirk("no reading of parameters", "returns Error if a parameter is read"),
    Quirk("reads a table", "has `\\` in the names of its archive"),
)  # fmt: skip


def quirk_fmu(folder, version, token):
    """Write an FMU."""
    add = {"resources/tables/offset.txt": "0.25"}
    if token == "needs its directory":
        library = Path(fmu_tools.library_name(version, "Zoo"))
        add[library.with_name("Zoo.txt").as_posix()] = "beside the library"
    path = Path(folder) / "Quirks.fmu"
    model_tools.model_fmu(path, "quirks", version, token, VARIABLES, add=add)
    if token == "reads a table":
        files = fmu_tools.read_fmu(path)
        files = {name.replace("/", "\\"): content for name, content in files.items()}
        fmu_tools.write_fmu(path, files)
    return path


def making_quirks(folder):
    """A function of a token and an FMI version that writes each FMU once."""

    @functools.cache
    def make(token, version=2):
        return quirk_fmu(folder / f"{token} {version}", version, token)

    return make


def markdown():
    """The table of the document."""
    lines = [
        "| the FMU | episodes begin by | several instances | in the log |",
        "|---|---|---|---|",
    ]
    return "\n".join([*lines, *(quirk.row for quirk in QUIRKS)])


if __name__ == "__main__":
    sys.stdout.write(markdown() + "\n")
