"""Signals that end the command line: clean-ups are made, and what was written stays."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from process_tools import faulty_fmu, start_values

import fmugym
from fmugym import __main__ as program
from fmugym.cli.signals import SignalledEnd
from fmugym.control.candidate_evaluation import CandidateEvaluator
from fmugym.training import search_training, training_report
from fmugym.training.search.policy_search import Search
from fmugym.training.search.probe import Probe

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

CART_POLE = str(Path(__file__).parents[2] / "examples" / "cart_pole.toml")
HANGING = """
import sys
from fmugym.cli import signals as signal_handling
signal_handling._TIMEOUT = 0.5
from fmugym.__main__ import main
sys.exit(main())
"""


@pytest.fixture
def start(temp_root):
    """Start the command line, and wait until it has a temporary folder."""
    processes = []

    def started(*arguments, begin=("-m", "fmugym"), ignored=()):
        def prepare():
            for number in (signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_IGN if number in ignored else signal.SIG_DFL)

        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        command = [sys.executable, *begin, *map(str, arguments)]
        process = subprocess.Popen(command, preexec_fn=prepare, **pipes)
        processes.append(process)
        wait_for(lambda: any(temp_root.glob("fmugym-*")))
        return process

    yield started
    for process in processes:
        process.kill()
        process.communicate()


def wait_for(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


class TestEnd:
    def ended(self, process, number, temp_root):
        """Send a signal; returns what was printed, after a look at what remains."""
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
        assert process.returncode == 128 + number
        assert "Traceback" not in err
        assert list(temp_root.iterdir()) == []
        return out, err

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
    def test_of_bench(self, start, temp_root, number):
        process = start("bench", CART_POLE, "--seconds", "100")
        self.ended(process, number, temp_root)

    def test_of_simulate(self, start, temp_root):
        """The episodes until then are told, as after Ctrl-C."""
        process = start("simulate", CART_POLE, "--episodes", "1000000", "--json")
        time.sleep(1.0)
        out, _ = self.ended(process, signal.SIGTERM, temp_root)
        assert json.loads(out)["episodes"]

    def test_while_an_fmu_hangs(self, start, temp_root, tmp_path):
        """Python cannot end the call; the process ends all the same, after a while."""
        task = tmp_path / "hanging.toml"
        facts = {
            "fmu": str(faulty_fmu(tmp_path)),
            "time_step": 0.1,
            "episode_length": "10s",
            "agent": {"actions": ["u"], "observations": ["y"]},
            "variables": {"u": {"min": -1, "max": 1}},
            "parameters": start_values("hang", at=1),
            "reward": "1",
        }
        fmugym.Task.from_dict(facts).write(task)
        process = start("simulate", task, begin=("-c", HANGING))
        time.sleep(1.0)
        assert process.poll() is None
        self.ended(process, signal.SIGTERM, temp_root)

    def test_is_not_asked_for_by_what_is_ignored(self, start, temp_root):
        """``nohup`` lets programs ignore that the terminal closes."""
        process = start("bench", CART_POLE, "--seconds", "100", ignored=[signal.SIGHUP])
        process.send_signal(signal.SIGHUP)
        time.sleep(0.3)
        assert process.poll() is None
        self.ended(process, signal.SIGTERM, temp_root)


PENDULUM = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.05,
    "episode_length": "0.5s",
    "variables": {"tau": {"min": -0.1, "max": 0.1}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
    "reward": "-abs(q)",
}
MOMENTS = {
    "a look at the task": (Probe, "of", 1),
    "the first round": (Search, "advance", 1),
    "a later round": (Search, "advance", 30),
    "writing an agent": (search_training, "bytes_of", 1),
    "writing a better one": (search_training, "bytes_of", 3),
    "the test": (search_training, "judge", 1),
    "the picture": (training_report, "draw_curve", 1),
}


def end(number, frame):
    raise SignalledEnd(number)


@pytest.fixture(params=[signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def number(request):
    """A signal that ends commands."""
    before = signal.signal(request.param, end)
    yield request.param
    signal.signal(request.param, before)


@pytest.mark.parametrize("moment", MOMENTS)
def test_of_train(moment, number, tmp_path, cli, monkeypatch):
    """The exit status tells the signal; the folder has the best agent until then, or is gone."""
    owner, name, which = MOMENTS[moment]
    function, count = getattr(owner, name), itertools.count(1)

    def signalled(*arguments, **options):
        if next(count) == which:
            os.kill(os.getpid(), number)
        return function(*arguments, **options)

    fmugym.Task.from_dict(PENDULUM).write(tmp_path / "task.toml")
    folder = tmp_path / "agent"
    monkeypatch.setattr(owner, name, signalled)
    command = "train", tmp_path / "task.toml", "--output", folder, "--episodes", "1"
    code, _, err = cli(*command, "--rounds", "40")
    assert next(count) > which
    assert code == 128 + number, err
    assert not [line for line in err.splitlines() if "rror" in line]
    if folder.exists():
        kept = {path.name for path in folder.iterdir()}
        assert {"policy.json", "agent.json", "search.npz"} <= kept
        assert not [name for name in kept if ".part" in name]
        assert cli("simulate", tmp_path / "task.toml", "--agent", folder)[0] == 0
    else:
        assert moment in ("a look at the task", "the first round", "writing an agent")


def test_an_error_in_a_clean_up_does_not_hide_the_signal(number, tmp_path, cli, monkeypatch):
    """Errors of the system, too, which happen while the signal ends the command."""
    fmugym.Task.from_dict(PENDULUM).write(tmp_path / "task.toml")

    def fails(*arguments):
        raise OSError(39, "Directory not empty")

    def signalled(search, evaluator):
        monkeypatch.setattr(CandidateEvaluator, "close", fails)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(Search, "advance", signalled)
    command = "train", tmp_path / "task.toml", "--output", tmp_path / "agent"
    code, _, err = cli(*command, "--rounds", "40")
    assert code == 128 + number, err
    assert "Directory not empty" in err


@pytest.mark.parametrize(
    ("error", "code"), [(KeyboardInterrupt(), 130), (SignalledEnd(signal.SIGTERM), 143)]
)
def test_while_modules_are_loaded(error, code, monkeypatch):
    def interrupted():
        raise error

    monkeypatch.setattr(program, "end_as_after_ctrl_c", interrupted)
    assert program.main() == code
