"""Mutations of the package that its contract suites must find: ``python tests/tools/mutations.py``.

    python tests/tools/mutations.py [--only ROOM ...] [--list]

Tests are contracts. Each mutation is a plausible fault in a room of the package that no type
checker and no import finds, with a sentence on what a user would notice. The program makes one at a
time, in a copy of the tree in a temporary folder, and runs the room's suite on it until a test
fails. First, the suites must pass on the copy as it is. The exit status is 1 if a mutation has
survived, or if its old text does not stand in its file exactly once.
"""

import argparse
import itertools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

TOP: Final = Path(__file__).resolve().parents[2]
PARTS: Final = ("fmugym", "tests", "benchmarks", "examples", "docs", "native", "resources")
"""The folders that tests read. The files beside them are copied, too."""

LONGEST: Final = 900.0
"""Seconds after which a suite has met a fault that keeps it from its end."""

FOUND, SURVIVED, STUCK, BROKEN = "found", "SURVIVED", "no end", "BROKEN"

Suite = tuple[str, ...]

SUITES: Final[Mapping[str, Suite]] = {
    "pool": ("tests/pool/test_pool.py", "-k", "not wine"),
    "environment": (
        "tests/environment/vector/test_order_of_step.py",
        "tests/golden/test_golden_tasks.py",
        "tests/environment/test_contract.py",
        "-k",
        "not exported and not training and not worker_processes",
    ),
    "expressions": ("tests/expressions",),
    "command line": ("tests/cli/test_commands.py",),
}
"""Contract suites by room, as arguments of pytest; without Wine, and without the golden cases that
are not of environments but of agents."""


class Mutation(NamedTuple):
    """A fault that somebody could make.

    Attributes:
        room: One of ``SUITES``.
        file: The module, in ``fmugym``.
        old: Text that stands in it once.
        new: What stands there instead.
        noticed: What a user would notice.
        suite: The suite that is to find it, if it is not that of the room.
    """

    room: str
    file: str
    old: str
    new: str
    noticed: str
    suite: Suite = ()

    @property
    def finder(self) -> Suite:
        """The suite that is to find it."""
        return self.suite or SUITES[self.room]


MUTATIONS: Final = (
    # Pools
    Mutation(
        "pool",
        "pool/rig/rig_pool.py",
        "wanted = np.ones(self.num_instances, np.bool_) if skip is None else ~np.asarray(skip)",
        "wanted = np.ones(self.num_instances, np.bool_) if skip is None else np.asarray(skip)",
        "with FMPy, a step moves the instances that were to rest, and no others",
    ),
    Mutation(
        "pool",
        "pool/rig/fmpy_pool.py",
        "self._start_time, self._count = starts.pop(START_TIME.name, self._spec.start_time), 0",
        "self._start_time = starts.pop(START_TIME.name, self._spec.start_time)",
        "with FMPy, an episode begins at the time at which the one before has ended",
    ),
    Mutation(
        "pool",
        "pool/rig/rig_pool.py",
        "                    start.get(variable.name, variable.start_number)\n",
        "                    variable.start_number\n",
        "with FMPy, warm-ups ignore the start values that a config gives to inputs",
    ),
    Mutation(
        "pool",
        "pool/saving_pool.py",
        "            skip[:] = True\n            for record, index in records:\n",
        "            for record, index in records:\n",
        "a short episode that is replayed beside a longer one goes on after its end",
    ),
    Mutation(
        "pool",
        "pool/saving_pool.py",
        "before = self.inputs.copy()  # of the other instances, too",
        "before = self.inputs  # of the other instances, too",
        "a restored episode of FMI 1.0 changes the inputs that were written in place",
    ),
    Mutation(
        "pool",
        "pool/engine.py",
        ".array(places, np.int64)",
        ".array(np.sort(places), np.int64)",
        "instances that are to change places go on from their own states",
    ),
    Mutation(
        "pool",
        "pool/pool_form.py",
        "    writer.numbers(spec.start_time)\n",
        "    writer.numbers(0.0)\n",
        "the time of the FMU begins at 0 whatever the start time of the config is",
    ),
    Mutation(
        "pool",
        "pool/processes/process_pool.py",
        "self._group.lost[block] &= ~mask[block]",
        "self._group.lost[block] = False",
        "after a worker's death, the reset of one instance lets its neighbours step on",
        ("tests/pool/processes/test_process_pool.py::TestPool",),
    ),
    Mutation(
        "pool",
        "pool/health.py",
        "return {name: self._counts[:, index].copy() for index, name in enumerate(HEALTH)}",
        "return {name: self._counts[:, index] for index, name in enumerate(HEALTH)}",
        "counts of health that a user has kept go on counting",
    ),
    Mutation(
        "pool",
        "pool/processes/worker_group.py",
        "within: IndexArray = indices - supervisor.block.start",
        "within: IndexArray = indices",
        "the state of an instance of the second worker process cannot be saved",
    ),
    # Environments
    Mutation(
        "environment",
        "environment/vector/rollouts.py",
        "first = ends.argmax(axis=0) + 1 if horizon",
        "first = ends.argmax(axis=0) if horizon",
        "the length of a candidate of a rollout leaves its last step out",
    ),
    Mutation(
        "environment",
        "environment/vector/tasks.py",
        "infos = merged(restricted(told, ~ended), infos)",
        "infos = merged(restricted(told, ended), infos)",
        "with same_step, infos of running episodes are lost where others end",
    ),
    Mutation(
        "environment",
        "environment/vector/episodes.py",
        "        self.ended[mask] = False\n",
        "        self.ended[:] = False\n",
        "a reset of some environments lets others step on after their end",
    ),
    Mutation(
        "environment",
        "environment/vector/array_episodes.py",
        "        if self.prototype._own_hooks.update:\n            self.restore_variables(mask)\n",
        "",
        "memory keeps the update of a step that a fault has undone",
    ),
    Mutation(
        "environment",
        "environment/vector/vector_env.py",
        "autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,",
        "autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,",
        "without an autoreset mode, episodes begin in the step that ends those before",
    ),
    Mutation(
        "environment",
        "environment/step_result.py",
        "cut_off = read.step_count >= env.step_limit",
        "cut_off = read.step_count > env.step_limit",
        "an episode with hooks has one step more than max_episode_steps",
    ),
    Mutation(
        "environment",
        "environment/vector/array_episodes.py",
        '        self.ended[where] = columns["ended"][whence]\n',
        "",
        "an environment that is restored after an end starts the next episode all the same",
    ),
    Mutation(
        "environment",
        "environment/reset.py",
        "parts = [repr(values_by_name(variables, starts)).encode(), *own]",
        "parts = [repr(values_by_name(variables, starts)).encode()]",
        "an episode begins with a state that was warmed up at another time of the year",
        ("tests/task/test_declared_warm_up.py::TestCache",),
    ),
    Mutation(
        "environment",
        "environment/vector/hook_tasks.py",
        "            for env, before in befores:\n"
        "                env._episode.take_back(before)\n"
        "            self._pool.inputs",
        "            self._pool.inputs",
        "if an action is refused, the environments before it have taken theirs",
        ("tests/environment/vector/test_vector_hooks.py",),
    ),
    Mutation(
        "environment",
        "environment/vector/compiled_step.py",
        "arrays.variables[name][...] = arrays.before[name]",
        "arrays.before[name][...] = arrays.variables[name]",
        "a single environment updates its memory twice in the step of a fault",
    ),
    Mutation(
        "environment",
        "environment/step_result.py",
        "variables = read.variables.copy() if env._own_hooks.update else None",
        "variables = None",
        "a single environment with hooks keeps the update of a step that a fault has undone",
    ),
    Mutation(
        "environment",
        "environment/actions.py",
        "    if isinstance(action, np.ndarray):\n        return action.copy()\n",
        "",
        "who uses the array of an action again changes the action before, which hooks read",
    ),
    Mutation(
        "environment",
        "environment/vector/hook_tasks.py",
        "return value if is_apart else value.copy()",
        "return value",
        "two variables that are swapped on arrays become one",
    ),
    Mutation(
        "environment",
        "environment/vector/hook_tasks.py",
        "return array.astype(dtype, copy=False)",
        "return array",
        "an episode begins with 0 where another one has made a whole number of a 0.5",
    ),
    Mutation(
        "environment",
        "environment/vector/hook_tasks.py",
        "        if self._idle is not None and self._idle.any():\n"
        "            self.episodes.restore_variables(self._idle)\n",
        "",
        "with next_step, memory begins with an update without a step",
    ),
    Mutation(
        "environment",
        "environment/vector/hook_tasks.py",
        "            found &= self._busy\n",
        "            pass\n",
        "an episode that begins where the task ends is told to be done at once",
    ),
    Mutation(
        "environment",
        "environment/vector/array_faults.py",
        "result.rewards[faulty] = array_results.rewards(env._fault_reward(), count)[faulty]",
        "result.rewards[:] = array_results.rewards(env._fault_reward(), count)",
        "where one FMU fails, all environments get the reward of a fault",
    ),
    Mutation(
        "environment",
        "environment/vector/array_faults.py",
        'env.done[faulty] = on_fault == "terminate"',
        "env.done[faulty] = True",
        "an episode that a fault has cut short is told to be done",
    ),
    Mutation(
        "environment",
        "environment/vector/array_episodes.py",
        '            self.streams.put(where, columns["streams"][whence], seeds)\n',
        "            seeds.flags.writeable = False\n",
        "the episodes after a restored one begin with other values than they did",
    ),
    Mutation(
        "environment",
        "environment/vector/array_episodes.py",
        "        read.action[..., indices] = np.asarray(action)[..., np.newaxis]\n",
        "",
        "the action before the first one is the last of the episode before",
    ),
    # Expressions
    Mutation(
        "expressions",
        "expressions/language.py",
        "return reduce(partial(_applied, ast.And()), parts)",
        "return reduce(partial(_applied, ast.Or()), parts)",
        "'0 < x < 1' holds everywhere",
    ),
    Mutation(
        "expressions",
        "expressions/language.py",
        "return (condition & first) | ((condition ^ True) & second)",
        "return (condition & first) | second",
        "a choice between two conditions holds where only the one not chosen does",
    ),
    Mutation(
        "expressions",
        "expressions/language.py",
        "return self._flag(node.operand, operand) ^ True",
        "return self._flag(node.operand, operand)",
        "'not' changes nothing",
    ),
    Mutation(
        "expressions",
        "expressions/graph.py",
        "where(x < 0.0, -1.0, x + 0.0)",
        "where(x < 0.0, 1.0, x + 0.0)",
        "the sign of a negative number is 1",
    ),
    Mutation(
        "expressions",
        "expressions/compiler.py",
        "for operand in set(operands) if last[operand] == index",
        "for operand in operands if last[operand] == index",
        "a value that is used twice at once, such as in x*x, makes others wrong",
    ),
    Mutation(
        "expressions",
        "expressions/compiler.py",
        "if are_neighbours and (first + count, last.extra + count) == (row, place):",
        "if are_neighbours and last.extra + count == place:",
        "an output that is observed a second time is another number",
    ),
    Mutation(
        "expressions",
        "expressions/numpy_evaluation.py",
        "np.interp(place, table[:count], table[count:-2], table[-2], table[-1])",
        "np.interp(place, table[:count], table[count:-2], table[-1], table[-2])",
        "before its first point, a curve has the value after the last one",
    ),
    Mutation(
        "expressions",
        "expressions/functions.py",
        "return splitmix64(episode + count.cast(np.int64) * _STEP + np.int64(channel))",
        "return splitmix64(episode + count.cast(np.int64) * _STEP)",
        "all sensors have the same noise",
    ),
    Mutation(
        "expressions",
        "expressions/numpy_evaluation.py",
        "        return first % second\n",
        "        return np.fmod(first, second)\n",
        "in a hook, a remainder of a negative number is negative, unlike in a program",
    ),
    Mutation(
        "expressions",
        "expressions/quantities.py",
        '"previous_outputs", "previous_state", "states", _FLOAT, "output", "kept", of="state"',
        '"previous_outputs", "previous_state", "states", _FLOAT, "output", "output", of="state"',
        "'previous(x)' is the value of x after the step",
    ),
    Mutation(
        "expressions",
        "deployment/export/c_source.py",
        '"absolute": "fabs"',
        '"absolute": "abs"',
        "an exported agent in C cuts the digits off 'abs(x)'",
    ),
    Mutation(
        "expressions",
        "deployment/export/c_source.py",
        "return ((r < 0) != (b < 0)) ? r + b : r;",
        "return (r < 0) ? r + b : r;",
        "in C, a remainder of a negative divisor has the wrong sign",
    ),
    Mutation(
        "expressions",
        "deployment/export/c_source.py",
        "return (a > b || a != a) ? a : b;",
        "return (a > b) ? a : b;",
        "in C, the maximum of a number and what is none is the number",
    ),
    Mutation(
        "expressions",
        "deployment/export/onnx_model.py",
        '"rint": "Round"',
        '"rint": "Floor"',
        "an exported agent in ONNX rounds down",
    ),
    Mutation(
        "expressions",
        "deployment/export/onnx_model.py",
        "inside = where(x < table[0], table[-2]",
        "inside = where(x < table[0], table[-1]",
        "in ONNX, before its first point a curve has the value after the last one",
    ),
    # The command line
    Mutation(
        "command line",
        "cli/signals.py",
        'return 128 + getattr(error, "number", signal.SIGINT)',
        'return int(getattr(error, "number", signal.SIGINT))',
        "after Ctrl-C the exit code is that of wrong arguments",
    ),
    Mutation(
        "command line",
        "cli/options.py",
        "if _is_replaceable(path) and not is_forced:",
        "if path.is_dir() and not is_forced:",
        "files that exist are replaced without --force",
    ),
    Mutation(
        "command line",
        "cli/options.py",
        "                _remove(path)\n                aside.rename(path)\n",
        "                _remove(aside)\n",
        "a command that fails with --force has removed the old file",
    ),
    Mutation(
        "command line",
        "cli/command_line.py",
        "        drop_output()\n    except (FMUGymError, OSError) as error:",
        "        return 1\n    except (FMUGymError, OSError) as error:",
        "'fmugym info model.fmu | head' fails",
    ),
    Mutation(
        "command line",
        "cli/options.py",
        "if is_needed or not quiet.get():",
        "if not quiet.get():",
        "with -q, a command that fails does not say why",
    ),
    Mutation(
        "command line",
        "cli/options.py",
        'say(json.dumps({"schema": _JSON_VERSION, **facts}, indent=2, default=str))',
        "say(json.dumps(facts, indent=2, default=str))",
        "the JSON of a command has no version",
    ),
    Mutation(
        "command line",
        "cli/task_arguments.py",
        "if path.is_file() and not takes_fmu:",
        "if path.is_file() and takes_fmu:",
        "commands play for a reward that nobody has looked at",
    ),
    Mutation(
        "command line",
        "cli/command_line.py",
        'self.error(str(unknown_name("option", text.partition("=")[0], self.options)))',
        'self.error(f"unknown option {text!r}")',
        "an option that is misspelt does not get its nearest name",
    ),
    Mutation(
        "command line",
        "cli/options.py",
        "return kinds[kind] <= _OF_ONE_KIND",
        "return kinds[kind] < _OF_ONE_KIND",
        "two warnings of a kind are told instead of three",
    ),
    Mutation(
        "command line",
        "cli/training_commands.py",
        '        _refuse(arguments, _OF_SEARCHES, "is for searches, without --algorithm")\n',
        "        pass\n",
        "a training with an algorithm ignores --minutes and --rounds",
    ),
)


def misfits(top: Path = TOP, mutations: Iterable[Mutation] = MUTATIONS) -> Iterator[str]:
    """Yield a line for each mutation whose old text does not stand in its file once."""
    for one in mutations:
        count = (top / "fmugym" / one.file).read_text(encoding="utf-8").count(one.old)
        if count != 1:
            yield f"{one.file}: the old text of {one.noticed!r} stands there {count} times"


# The copy


class Copy:
    """A copy of the tree, in which one file at a time is another.

    Args:
        folder: An empty folder for it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "tree"
        self._bytecode = folder / "bytecode"
        self._times = itertools.count(1)
        self.folder.mkdir()
        left_out = shutil.ignore_patterns("__pycache__", ".*")
        for name in PARTS:
            shutil.copytree(TOP / name, self.folder / name, ignore=left_out)
        for path in TOP.iterdir():
            if path.is_file() and not path.name.startswith("."):
                shutil.copy(path, self.folder)

    def write(self, file: str, text: str) -> None:
        """Write a module; its time is another each time, so that no older bytecode counts."""
        path, stamp = self.folder / "fmugym" / file, next(self._times)
        path.write_text(text, encoding="utf-8")
        os.utime(path, (stamp, stamp))

    def play(self, suite: Suite) -> tuple[str, str]:
        """Run a suite until a test fails; returns the outcome, and the test or what was said."""
        options = ("-x", "-q", "--tb=no", "-rfE", "-n", "0", "-m", "", "-p", "no:cacheprovider")
        paths = [str(self.folder), os.environ.get("PYTHONPATH", "")]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "PYTHONPYCACHEPREFIX": str(self._bytecode),
        }
        command = (sys.executable, "-m", "pytest", *options, *suite)
        try:
            done = subprocess.run(
                command,
                cwd=self.folder,
                env=environment,
                capture_output=True,
                text=True,
                timeout=LONGEST,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return STUCK, f"after {LONGEST:.0f} s"
        outcome = {0: SURVIVED, 1: FOUND}.get(done.returncode, BROKEN)
        failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
        last = (done.stdout + done.stderr).strip().splitlines()[-1:]
        return outcome, failed.group(1) if failed else " ".join(last)

    def mutated(self, mutation: Mutation) -> tuple[str, str]:
        """Run the suite of a mutation on it."""
        text = (TOP / "fmugym" / mutation.file).read_text(encoding="utf-8")
        self.write(mutation.file, text.replace(mutation.old, mutation.new))
        try:
            return self.play(mutation.finder)
        finally:
            self.write(mutation.file, text)


# The table


def say(*cells: str) -> None:
    """Write a row of the table."""
    sys.stdout.write(f"| {' | '.join(cells)} |\n")
    sys.stdout.flush()


def run(mutations: Iterable[Mutation]) -> bool:
    """Run all mutations, and tell of each; returns whether all were found."""
    all_found = True
    with tempfile.TemporaryDirectory(prefix="fmugym-mutations-") as folder:
        copy = Copy(Path(folder))
        say("room", "what a user would notice", "found by", "s")
        say(*["---"] * 4)
        for suite, some in by_suite(mutations).items():
            begin = time.perf_counter()
            outcome, what = copy.play(suite)
            is_fine = outcome == SURVIVED
            told = "as it should be" if is_fine else f"{outcome}: {what}"
            say(suite[0], "nothing: no mutation", told, f"{time.perf_counter() - begin:.0f}")
            all_found &= is_fine
            for one in some if is_fine else ():
                begin = time.perf_counter()
                outcome, what = copy.mutated(one)
                told = what if outcome == FOUND else f"{outcome} ({what})"
                say(one.room, one.noticed, told, f"{time.perf_counter() - begin:.0f}")
                all_found &= outcome in (FOUND, STUCK)
    return all_found


def by_suite(mutations: Iterable[Mutation]) -> dict[Suite, list[Mutation]]:
    """Group mutations by the suites that are to find them."""
    found: dict[Suite, list[Mutation]] = {}
    for one in mutations:
        found.setdefault(one.finder, []).append(one)
    return found


def main() -> int:
    """Run the mutations of some rooms, or list them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=SUITES, nargs="+", default=tuple(SUITES))
    parser.add_argument("--list", action="store_true", help="list the mutations, and run nothing")
    arguments = parser.parse_args()
    chosen = [one for one in MUTATIONS if one.room in arguments.only]
    wrong = list(misfits(mutations=chosen))
    sys.stdout.writelines(f"{line}\n" for line in wrong)
    if wrong:
        return 1
    if arguments.list:
        for one in chosen:
            say(one.room, one.file, one.noticed, one.finder[0])
        return 0
    return int(not run(chosen))


if __name__ == "__main__":
    sys.exit(main())
