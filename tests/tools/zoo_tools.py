"""FMUs that do wrong what they are told to (``zoo/zoo.c``), and what a user sees of that."""

import contextlib
import ctypes
import logging
import os
from pathlib import Path

import fmu_tools
import model_tools
import numpy as np

import fmugym

CALLS = (
    *("nowhere", "instantiate", "setup", "enter", "exit", "set", "step", "get", "reset"),
    *("get_state", "set_state", "terminate", "free"),
)
FAULTS = (
    *("none", "segv", "fpe", "ill", "bus", "abort", "leave", "overflow", "loop", "sleep"),
    *("close_standard", "close_others", "status", "not_a_number", "infinite"),
    *("print", "print_no_newline", "print_much", "log_from_thread", "round_up", "flush_denormals"),
    *("change_directory", "change_environment", "leak", "do_nothing"),
    *("fork", "fork_and_crash", "fork_and_loop", "fork_a_twin"),
)
"""In the order of the enumerations in ``zoo.h``."""

PARAMETERS = ("fault", "call", "at", "status")
STEP = 0.5
NUM_ENVS = 3
GROWTH = 20e6
"""In bytes, that of a process with a leak; ten episodes leak twice as much at the least."""


def parameters(fault="none", call="step", at=2, status=0):
    """Those that ask for a fault in a call, from a step on."""
    values = (FAULTS.index(fault), CALLS.index(call), at, status)
    return dict(zip(PARAMETERS, map(float, values), strict=True))


SOUND = parameters()
FINE = ("fine", "")


# The FMUs

VARIABLES = (
    ("u", "input", 'start="0"'),
    ("y", "output", ""),
    *((name, "parameter", 'start="0"') for name in PARAMETERS),
)


def zoo_fmu(folder, version, token="{zoo}", *definitions):
    """Write an FMU; see ``zoo.c`` for the tokens."""
    path = Path(folder) / "Zoo.fmu"
    return model_tools.model_fmu(path, "zoo", version, token, VARIABLES, definitions)


def spoil(path, how):
    """Break the archive of an FMU: ``"cut"``, ``"no FILE"`` or ``"short FILE"``."""
    if how == "cut":
        path.write_bytes(path.read_bytes()[:-100])
        return
    files = fmu_tools.read_fmu(path)
    what, part = how.split()
    name = next(name for name in files if part in name)
    content = files.pop(name)
    if what == "short":
        files[name] = content[:5000]
    fmu_tools.write_fmu(path, files)


# The environments


class ZooEnv(fmugym.FMUEnv):
    """Integrates its action until the FMU does what its parameters say."""

    def __init__(self, path, **config):
        config = {
            "model_input_names": "u",
            "model_output_names": "y",
            "model_parameters": SOUND,
            "time_step": STEP,
            "bounds": {"u": (-1, 1)},
        } | config
        super().__init__(path, fmu_tools.grouped(config))

    def _is_done(self):
        return self.state[0] < -1e9


class Single:
    """A single environment as ``play`` needs it."""

    def __init__(self, path, **config):
        self._env = ZooEnv(path, **config)
        self.close = self._env.close

    def reset(self, values):
        self._env.reset(options={"model_parameters": values})

    def step(self):
        """Returns the observation and why the episode was ended."""
        observation, _, terminated, truncated, info = self._env.step([1.0])
        assert truncated == ("fault" in info)
        assert not terminated
        return observation.item(), info.get("fault", "")


class Vector:
    """A vector environment, in which the first only has the fault."""

    def __init__(self, path, workers=None, **config):
        options = {"workers": workers} if workers else {}
        self._env = fmugym.FMUVectorEnv(lambda: ZooEnv(path, **config), NUM_ENVS, **options)
        self.close = self._env.close

    def reset(self, values):
        for name, value in values.items():
            self._env.set_attr(name, [value] + [SOUND[name]] * (NUM_ENVS - 1))
        self._env.reset()
        self._steps = 0

    def step(self):
        """Returns the same of the first; the others must not notice, but for what all do wrong."""
        observations, _, terminated, truncated, infos = self._env.step(np.ones((NUM_ENVS, 1)))
        self._steps += 1
        first, *others = observations.ravel().tolist()
        if truncated[0] or first == STEP * self._steps:
            assert others == [STEP * self._steps] * (NUM_ENVS - 1)
        assert not terminated.any()
        assert not truncated[1:].any()
        return first, infos["fault"][0] if truncated[0] else ""


def make(cell):
    """The environment of a cell of the table."""
    cls = Vector if "vector" in cell["setting"] else Single
    return cls(cell["path"], **cell["options"])


# What a user sees


def visit(cell):
    """Play episodes with faults, one fault after another in one environment.

    Args:
        cell: See ``Specimen.cells``.

    Returns:
        For each fault the kind of the outcome and the reason that was told; and the harm that was
        done to this process.
    """
    with Messages() as messages, Harm() as harm:
        outcomes = _live(cell, messages)
    return outcomes, harm.done


def _live(cell, messages):
    try:
        env = make(cell)
    except fmugym.FMULoadError as error:
        return [("refused", str(error))]
    with contextlib.closing(env):
        outcomes = [messages.added_to(_meet(env, values, cell)) for values in cell["parameters"]]
    return [*outcomes[:-1], messages.added_to(outcomes[-1])]  # those of the end


def _meet(env, values, cell):
    """Play episodes with a fault and, if it heals, one without."""
    outcomes = [play(env, values) for _ in range(cell["rounds"])]
    if cell["heals"]:
        after = play(env, SOUND)
        assert after == FINE, after
    return next((outcome for outcome in outcomes if outcome != FINE), FINE)


def play(env, values, steps=4):
    """Play an episode; returns how it ended, and the reason."""
    try:
        env.reset(values)
    except fmugym.SimulationError as error:
        return "reset", str(error)
    for step in range(1, steps + 1):
        observation, reason = env.step()
        if reason:
            assert observation == STEP * (step - 1), "not the last good one"
            return "truncated", reason
        if observation != STEP * step:
            return "wrong", f"{observation} after {step} steps"
    return FINE


class Messages(logging.Handler):
    """Keeps the warnings of the package."""

    def __init__(self):
        super().__init__(logging.WARNING)
        self.texts = []

    def emit(self, record):
        self.texts.append(record.getMessage())

    def added_to(self, outcome):
        """What was seen of a fault, with the messages since the one before, if there are any."""
        texts = list(dict.fromkeys(self.texts))
        self.texts.clear()
        return ("told", " | ".join(texts)) if outcome == FINE and texts else outcome

    def __enter__(self):
        logging.getLogger("fmugym").addHandler(self)
        return self

    def __exit__(self, *_):
        logging.getLogger("fmugym").removeHandler(self)


class Harm:
    """Finds what has changed in this process."""

    def __enter__(self):
        self._descriptor = os.open(os.devnull, os.O_RDONLY)
        self._before, self._bytes = self._look(), resident_bytes()
        return self

    def __exit__(self, *_):
        after = self._look()
        self.done = [name for name, value in self._before.items() if after[name] != value]
        self.done += ["memory"] if resident_bytes() > self._bytes + GROWTH else []
        with contextlib.suppress(OSError):
            os.close(self._descriptor)

    def _look(self):
        tiny = float("1e-30")
        return {
            "working directory": os.getcwd(),
            "environment": ctypes.CDLL(None).getenv(b"ZOO"),
            "rounding mode": 1.0 + tiny > 1.0,
            "denormal numbers": float("4e-324") * 1.0,
            "standard streams": all(map(_is_open, range(3))),
            "open files": _is_open(self._descriptor),
        }


def _is_open(descriptor):
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def resident_bytes(pid="self"):
    """The memory of a process; 0 where none is told."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0
