"""Contract of the command line: laws that hold for every command, and the mistakes of users.

``COMMANDS`` has a row for each command. A law is a test that runs all rows, in a folder of its own
with the files that ``folder`` makes. ``command_mistakes.py`` has the table of mistakes.
"""

import inspect
import json
import logging
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import command_mistakes
import pytest
from process_tools import run_python

import fmugym
from fmugym.cli.command_line import _parser, run_command_line
from fmugym.cli.options import EXAMPLES

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


class Command(NamedTuple):
    """A short run of a command, which succeeds.

    Attributes:
        line: Its arguments, in the folder of ``folder``.
        files: What it writes; its options name the first one.
        varies: Why it does not print the same twice; "" if it does.
    """

    line: str
    files: tuple[str, ...] = ()
    varies: str = ""

    @property
    def target(self):
        """The FMU or the task that it is about."""
        return next(word for word in self.arguments if word in ("model.fmu", "task.toml"))

    @property
    def arguments(self):
        return shlex.split(self.line)

    def of(self, target):
        """The arguments with another FMU or task."""
        return [target if word == self.target else word for word in self.arguments]


COMMANDS = {
    "info": Command("info model.fmu"),
    "new": Command("new model.fmu --output made.toml", ("made.toml", "fmugym.schema.json")),
    "validate": Command("validate task.toml", varies="it measures times"),
    "simulate": Command("simulate task.toml --steps 3 --output made.csv", ("made.csv",)),
    "train": Command("train task.toml --rounds 3 --episodes 1 --output made", ("made",)),
    "evaluate": Command(
        "evaluate task.toml --steps 3 --episodes 1 --plot made.svg",
        ("made.svg",),
        "it measures the speed",
    ),
    "tune": Command(
        "tune task.toml 'pid of=q setpoint=0 kp=0.1..1' --rounds 1 --candidates 8 --episodes 1 "
        "--steps 3 --output made.toml",
        ("made.toml",),
    ),
    "fit": Command(
        "fit task.toml --log log.csv --parameter l --candidates 2 --output made.toml",
        ("made.toml", "made.npz"),
    ),
    "export": Command(
        "export --controller still --task task.toml --output made.c", ("made.c", "made.h")
    ),
    "serve": Command(
        "serve task.toml --modbus --speed 1000 --steps 2", varies="it takes a free port"
    ),
    "bench": Command("bench task.toml --envs 2 --seconds 0.01", varies="it measures times"),
}

ENDS = ("fails", "is odd", "now")
PROGRAM = "import sys; from fmugym.__main__ import main; sys.exit(main())"
CHATTY = """
import logging
from fmugym.envs import CartPoleEnv

class Chatty(CartPoleEnv):
    def __init__(self):
        super().__init__()
        logger = logging.getLogger("fmugym.chatty")
        for number in range(10):
            logger.warning("0: environment %d fails", number)
        for number in range(2):
            logger.warning("1: number %d is odd", number)
        logger.info("I speak now")
        logger.error("E: an error now")
"""

all_commands = pytest.mark.parametrize("name", COMMANDS)
commands_that_write = pytest.mark.parametrize(
    "name", [name for name, one in COMMANDS.items() if one.files]
)
commands_that_repeat = pytest.mark.parametrize(
    "name", [name for name, one in COMMANDS.items() if not one.varies]
)


@pytest.fixture(autouse=True)
def row(request):
    """The row of the test's command; skips it where a library is missing."""
    name = request.node.callspec.params.get("name") if hasattr(request.node, "callspec") else None
    needs = {"serve": ("pymodbus", "plant"), "evaluate": ("matplotlib", "plot")}
    if name in needs:
        module, extra = needs[name]
        pytest.importorskip(module, reason=f"needs the extra {extra}")
    return COMMANDS.get(name)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The working directory, with what users have there."""
    command_mistakes.make_folder(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for module in ("drive", "broken"):
        sys.modules.pop(module, None)


def contents(folder):
    """The bytes of all files below a folder, by their paths."""
    files = (path for path in command_mistakes.files_in(folder) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def is_one_line(text):
    """Whether an error is a short line that a user reads, and no traceback."""
    return text.count("\n") == 1 and text.startswith("fmugym") and len(text) < 500


def test_every_command_has_a_row(commands):
    assert COMMANDS.keys() == commands
    assert all(name == one.arguments[0] for name, one in COMMANDS.items())


class TestHelp:
    """``--help``, the documents, and completion by shells."""

    @all_commands
    def test_it_is_printed_and_has_the_common_options(self, name, row, capsys):
        """With ``--force`` where files are written; ``info`` does so for repairs and datasets."""
        with pytest.raises(SystemExit) as caught:
            run_command_line([name, "--help"])
        out, err = capsys.readouterr()
        assert (caught.value.code, err) == (0, "")
        assert {"--json", "--quiet", "--verbose"} <= set(re.findall(r"--\w+", out))
        assert ("--force" in out) == (bool(row.files) or name == "info")

    @all_commands
    def test_its_examples_stand_in_the_documents(self, name, help_of):
        """Where they are run, by ``test_cli_docs.py``."""
        pages = " ".join(page.read_text() for page in DOCS.glob("*.md"))
        documents = " ".join(pages.replace("\\\n", " ").split())
        said = help_of(name)
        for example in EXAMPLES[name]:
            assert f"\n  {example}\n" in said
            assert example in documents

    def test_the_documents_list_all_commands_and_exit_codes(self):
        page = (DOCS / "command-line.md").read_text()
        assert set(re.findall(r"^\| \[?`([\w-]+)`", page, re.M)) >= COMMANDS.keys()
        codes = re.findall(r"^\| (\d+(?:, \d+)*) \|", page, re.M)
        assert codes == ["0", "1", "2", "130, 143, 129"]

    def test_the_version_is_a_number(self, capsys):
        with pytest.raises(SystemExit) as caught:
            run_command_line(["--version"])
        assert caught.value.code == 0
        assert capsys.readouterr().out.strip()[0].isdigit()

    @pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
    def test_shells_complete_commands_options_and_choices(self, shell, folder):
        wanted = {
            "fmugym ": set(COMMANDS),
            "fmugym sim": {"simulate"},
            "fmugym simulate --var": {"--variables"},
            "fmugym info model.fmu --master ja": {"jacobi"},
        }
        for line, words in wanted.items():
            assert words <= completions(line, shell, folder / "said"), line

    @pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
    def test_the_line_of_the_documents_gives_a_script_for_each_shell(self, shell):
        program = shutil.which("register-python-argcomplete", path=os.path.dirname(sys.executable))
        done = subprocess.run([program, "--shell", shell, "fmugym"], capture_output=True, text=True)
        assert done.returncode == 0
        assert "fmugym" in done.stdout


def completions(line, shell, file):
    """What a shell is told of a line that ends where the Tab key is pressed."""
    settings = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_SHELL": shell,
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(file),
    }
    program = "from fmugym.cli.command_line import run_command_line; run_command_line()"
    run_python("-c", program, environment=settings, check=True)
    return {re.split(r"[:\t]", one)[0].strip() for one in file.read_text().splitlines()}


class TestOutput:
    """Results go to standard output, messages to the error stream."""

    @all_commands
    def test_a_run_writes_its_files_and_nothing_else(self, name, row, folder, cli):
        before = {path.name for path in folder.iterdir()}
        code, _, err = cli(*row.arguments)
        assert code == 0, err
        assert {path.name for path in folder.iterdir()} - before == set(row.files)

    @all_commands
    def test_quiet_leaves_the_result_and_json_is_one_object(self, name, row, cli):
        forced = ["--force"] if row.files else []
        code, out, err = cli(*row.arguments, "-q", "--json")
        assert (code, err) == (0, "")
        assert json.loads(out)["schema"] == 1
        loud = cli(*row.arguments, *forced, "--json")
        assert loud[0] == 0
        assert row.varies or loud[1] == out

    @commands_that_repeat
    def test_the_same_arguments_print_the_same(self, name, row, cli):
        """Seeds have defaults, so that nothing depends on chance."""
        forced = ["--force"] if row.files else []
        code, out, _ = cli(*row.arguments)
        assert code == 0
        assert cli(*row.arguments, *forced)[:2] == (0, out)

    @pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
    @all_commands
    def test_a_reader_that_has_ended_is_no_error(self, name, row, folder, monkeypatch, capsys):
        """As ``head`` does: its end of the pipe is closed."""
        reader, writer = os.pipe()
        os.close(reader)
        with open(writer, "w") as stdout, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", stdout)
            assert run_command_line([*row.arguments, "-q"]) == 0
        assert capsys.readouterr().err == ""
        assert all((folder / file).exists() for file in row.files)

    @pytest.mark.parametrize(
        ("options", "told"), [([], "000 11 E"), (["-v"], "0000000000 11 IE"), (["-q"], "E")]
    )
    def test_three_warnings_of_a_kind_are_told(self, options, told, folder, cli, monkeypatch):
        """A line says how many are left out; the logger is then as before."""
        (folder / "chatty.py").write_text(CHATTY)
        logger = logging.getLogger("fmugym")
        before = logger.handlers[:], logger.level
        code, _, err = cli("simulate", "chatty:Chatty", "--steps", 1, *options)
        assert code == 0
        lines = err.splitlines()
        said = [
            "".join(line[0] for line in lines if line.endswith(end)) for end in ("fails", "odd")
        ]
        rest = "".join(line[0] for line in lines if line.endswith("now"))
        assert [one for one in (*said, rest) if one] == told.split()
        assert ("7 more warnings of these kinds; -v shows them" in err) == (not options)
        assert (logger.handlers, logger.level) == before
        sys.modules.pop("chatty")

    def test_arguments_of_an_algorithm_may_stand_anywhere(self):
        """But not those of other commands."""
        line = "train task.toml x=1 --output made --algorithm PPO y=2 z"
        assert "'z'" in command_mistakes.refusal(*line.split(), code=1)
        for wrong in ("simulate task.toml y=2", "train task.toml --output made --y c"):
            command_mistakes.refusal(*wrong.split(), code=2)

    @pytest.mark.parametrize("program", [["-m", "fmugym"], ["-c", PROGRAM]])
    def test_classes_in_the_working_directory_are_found(self, program, folder):
        """The program ``fmugym`` has its own folder in front, not the working directory."""
        text = "from fmugym.envs import CartPoleEnv\n\n\nclass Cart(CartPoleEnv):\n    pass\n"
        (folder / "cart.py").write_text(text)
        command = "-P" if "-c" in program else "-B", *program, "simulate", "cart:Cart"
        done = run_python(*command, "--steps", 3, cwd=folder)
        assert "reward 3 in 3 steps" in done.stdout, done.stderr
        failed = run_python(*command[:-1], "absent.toml", cwd=folder)
        assert (failed.returncode, failed.stdout) == (1, "")
        assert is_one_line(failed.stderr)


class TestRefusals:
    """What cannot be used is one line on the error stream, and leaves no file behind."""

    @all_commands
    @pytest.mark.parametrize("wrong", ["absent", "folder", "text", "wrong"])
    def test_a_target_that_is_none(self, wrong, name, row, folder, cli):
        """It is missing, a folder, no FMU and no task, or one with a mistake."""
        target = f"{wrong}{Path(row.target).suffix}"
        before = contents(folder)
        code, out, err = cli(*row.of(target))
        assert (code, out) == (1, "")
        assert is_one_line(err), err
        assert target in err
        assert contents(folder) == before

    @all_commands
    def test_each_option_misspelt_has_its_nearest_name(self, name, row):
        for option in options_of(name):
            wrong = command_mistakes.misspelt(option)
            line = command_mistakes.refusal(*row.arguments, wrong, code=2)
            assert wrong in line
            assert f"did you mean {option!r}" in line

    @all_commands
    def test_the_command_misspelt_has_its_nearest_name(self, name, row):
        wrong = command_mistakes.misspelt(name)
        line = command_mistakes.refusal(wrong, *row.arguments[1:], code=2)
        assert wrong in line
        assert f"did you mean {name!r}" in line

    @all_commands
    def test_without_arguments_the_first_missing_one_is_named(self, name):
        line = command_mistakes.refusal(name, code=2)
        assert "required" in line
        assert first_required(name) in line

    @all_commands
    def test_an_option_without_a_value_takes_none(self, name, row):
        line = command_mistakes.refusal(*row.arguments, "--json=1", code=2)
        assert "--json" in line
        assert "'1'" in line

    @all_commands
    def test_a_word_is_no_number(self, name, row):
        for option, kind in numbers_of(name).items():
            what = "an integer" if kind is int else "a number"
            line = command_mistakes.refusal(*row.arguments, option, "abc", code=2)
            assert all(fact in line for fact in (option, "'abc'", what)), line

    @all_commands
    def test_a_number_out_of_its_range(self, name, row, folder):
        """Below 0 in any case; one without a fraction is never NaN."""
        before = contents(folder)
        for option, kind in numbers_of(name).items():
            for wrong in ("-1",) if kind is int else ("-1", "nan"):
                line = command_mistakes.refusal(*row.arguments, option, wrong, code=1)
                assert wrong in line or option in line
        assert contents(folder) == before


def options_of(name):
    """The long options of a command."""
    actions = _parser()[1][name]._actions
    return [text for one in actions for text in one.option_strings if text.startswith("--")]


def numbers_of(name):
    """The options of a command that are numbers, with their types."""
    actions = _parser()[1][name]._actions
    return {one.option_strings[-1]: one.type for one in actions if one.type in (int, float)}


def first_required(name):
    """The name in the usage of the first argument that a command needs."""
    needed = next(one for one in _parser()[1][name]._actions if one.required)
    return (needed.option_strings or [needed.metavar])[0]


class TestOldFiles:
    """A file that exists is replaced only by ``--force``, and only by a new one."""

    @pytest.fixture(autouse=True)
    def old(self, row, folder):
        """What a training or a user has left where the command writes."""
        old = folder / row.files[0]
        if old.suffix:
            old.write_text("precious")
        else:
            old.mkdir()
            (old / "agent.json").write_text("precious")

    @commands_that_write
    def test_it_is_found_before_anything_is_opened(self, name, row, folder, cli):
        before = contents(folder)
        code, out, err = cli(*row.of("absent.toml"))
        assert (code, out) == (1, "")
        assert err == (
            f"fmugym: error: {row.files[0]} exists; name a new one, or replace it with --force\n"
        )
        assert contents(folder) == before

    @commands_that_write
    @pytest.mark.parametrize("wrong", ["absent", "wrong"])
    def test_it_stays_if_no_new_one_comes(self, wrong, name, row, folder, cli):
        before = contents(folder)
        target = f"{wrong}{Path(row.target).suffix}"
        code, out, err = cli(*row.of(target), "--force", "-q")
        assert (code, out) == (1, "")
        assert is_one_line(err), err
        assert contents(folder) == before

    @commands_that_write
    def test_it_is_replaced_by_a_new_one(self, name, row, folder, cli):
        before = {path.name for path in folder.iterdir()}
        assert cli(*row.arguments, "--force")[0] == 0
        now = contents(folder)
        assert b"precious" not in now.values()
        assert {path.name for path in folder.iterdir()} == before | set(row.files)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
class TestCtrlC:
    """The exit code is 130, and each file is the old one or a new one as a whole."""

    @all_commands
    @pytest.mark.parametrize("part", [0.6, 0.3, 0.9])
    def test_it_ends_a_command_at_any_moment(self, part, name, row, folder, cli):
        """After so much of all calls of functions of the package.

        A command that measures times has more or fewer of them in another run: there it is early.
        """
        forced = ["--force"] if row.files else []
        assert cli(*row.arguments)[0] == 0  # which loads the modules that it needs
        with InterruptedCalls() as whole:
            assert cli(*row.arguments, *forced)[0] == 0
        before = contents(folder)
        last = part * whole.count * (0.05 if row.varies else 1.0)
        with InterruptedCalls(int(last)):
            code, _, err = cli(*row.arguments, *forced)
        assert code == 130
        assert "rror" not in err
        assert "Traceback" not in err
        now = contents(folder)
        assert now.keys() <= before.keys()
        assert {Path(path).parts[0] for path in before} == {Path(path).parts[0] for path in now}
        assert all(now[path][-1:] == before[path][-1:] for path in now)


class InterruptedCalls:
    """Counts the calls of functions of the package outside ``cli``, and interrupts one of them.

    Generators do not count: Python ignores what is raised in one that nobody uses any more.

    Args:
        last: The number of the call that Ctrl-C interrupts; 0 for none.
    """

    def __init__(self, last=0):
        self.count, self.last = 0, last
        self.package = str(Path(fmugym.__file__).parent)

    def __enter__(self):
        sys.setprofile(self.see)
        return self

    def __exit__(self, *error):
        sys.setprofile(None)

    def see(self, frame, event, argument):
        path, is_generator = frame.f_code.co_filename, frame.f_code.co_flags & inspect.CO_GENERATOR
        if event != "call" or is_generator:
            return
        if not path.startswith(self.package) or "/cli/" in path:
            return
        self.count += 1
        if self.count == self.last:
            sys.setprofile(None)
            raise KeyboardInterrupt


class TestMistakes:
    """Each mistake is a line that says what is wrong, and what was meant."""

    @pytest.mark.parametrize(("line", "facts"), command_mistakes.MISTAKES.items())
    def test_it_is_told_in_one_line(self, line, facts, folder):
        command_mistakes.require_refusal(line, facts, folder)

    @pytest.mark.parametrize(("line", "facts"), command_mistakes.OF_ALGORITHMS.items())
    def test_one_of_an_algorithm_is_told_before_the_training(self, line, facts, folder):
        pytest.importorskip("stable_baselines3", reason="needs the extra test-sb3")
        command_mistakes.require_refusal(line, facts, folder)

    @pytest.mark.parametrize(("line", "library"), command_mistakes.MISSING_LIBRARIES.items())
    def test_a_library_that_is_missing_names_its_extra(self, line, library, folder, monkeypatch):
        """Before anything is played for what it would make."""
        module, extra = library
        if "--algorithm" in line and extra != "sb3" and not find_spec("stable_baselines3"):
            pytest.skip("needs the extra test-sb3")
        monkeypatch.setitem(sys.modules, module, None)
        command_mistakes.require_refusal(line, (f".[{extra}]",), folder)
