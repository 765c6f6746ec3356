"""All calls of native pools against each other, from many threads, for some seconds.

    python tests/tools/native_stress.py SECONDS [SEED] [python] [in-turn]

Threads close pools while others use them, and replace what ``play`` uses while it runs. FMUs log.
The receiver of their messages raises, and so do signal handlers. The interpreter ends while threads
still call. With ``python``, one of the FMUs is written in Python and so needs the GIL. Then there
are no signals, as ``pythonfmu`` corrupts memory where a handler raises in its FMU, and the process
skips the unloading of libraries at its end, where ``pythonfmu`` frees the same memory twice.

With ``in-turn``, one thread plays at a time: before a play enters the pool, it reads where episodes
have ended. That is harmless, but the thread sanitizer tells of it.

Prints how often each call came through. The exit status is 0 if all is well. ``sanitize.py`` runs
this with sanitizers.
"""

import collections
import contextlib
import faulthandler
import json
import logging
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from exchange_tools import exchange_fmu
from program_tools import (
    DISCRETE,
    RESULT_ROWS,
    code,
    constants,
    kept_actions,
    no_observation,
    results_of,
    stored_results,
    uniform_draws,
)

from fmugym import FMU, Connection, FMUSystem, SimulationError, _native, bundled_fmu
from fmugym.expressions.program import TYPES
from fmugym.pool import PoolSpec
from fmugym.pool.native_pool import NativePool
from fmugym.pool.pool_form import form_of_program
from fmugym.pool.pool_spec import SOLVERS, ResetMethod

THREADS = 6
LONGEST_WAIT = 120.0
"""Seconds after which a call counts as one that never returns."""

counts = collections.Counter()
ending = threading.Event()
"""Set when the interpreter is about to end: receivers are silent then, and temporary files go."""


def programs(pool, variables, actions, ended):
    """Programs that use the numbers of the pool, those from before, and the C library."""
    push = code(
        ("load_row", 1, 1),
        ("cast", 2 * len(TYPES), 2, 1),
        ("multiply d", 0, 3, 2, 0),
        ("store_row", 0, 0, 3),
    )
    judge = code(
        ("load_row", 0, 2),
        ("sin d", 0, 3, 2),
        ("absolute d", 0, 4, 3),
        ("greater d", 0, 5, 4, 0),
        ("load_row", 2, 6),
        ("store_row", 1, 0, 4),
        *stored_results(3, 4, 5, 1),
        ("store_row", 6, 0, 5),
    )
    rows = pool.outputs[0], variables[0], actions["previous"], *RESULT_ROWS, ended
    pushing = form_of_program(push, constants(3.0), (), 4)
    judging = form_of_program(judge, constants(0.2, 0.0), (), 7)
    return (pushing, (pool.inputs[0], actions["current"])), (judging, rows), no_observation()


DRAWS = uniform_draws(0)


class ReceiverError(Exception):
    """Raised by a receiver of messages."""


class Receiver(logging.Handler):
    """Raises now and then, as receivers may, and calls the pool back."""

    def __init__(self, rng):
        super().__init__()
        self._rng = rng
        self.pool = None

    def emit(self, record):
        if ending.is_set():  # nobody catches what is raised while pools close at the end
            return
        dice = self._rng.random()
        if dice < 0.05:
            raise ReceiverError("a receiver fails")
        if dice < 0.1:
            raise KeyboardInterrupt
        if dice < 0.3 and self.pool is not None:
            self.pool.failure(0)
        counts["message"] += 1


class Subject:
    """A pool over one of the FMUs, and the arrays for its calls."""

    def __init__(self, source, names, start, rng, **options):
        log = logging.Logger("stress")
        receiver = Receiver(rng)
        log.addHandler(receiver)
        inputs, outputs = names
        fmu = FMU(source) if isinstance(source, Path | str) else source.as_fmu()
        self.n = int(rng.choice([1, 3, 40, 300] if "m_cart" in start[0] else [1, 3]))
        spec = PoolSpec(
            tuple(map(fmu.variable, inputs)),
            tuple(map(fmu.variable, outputs)),
            0.05,
            num_observed=len(outputs),
            solver=str(rng.choice(SOLVERS)),
            max_step=0.01,
            **options,
        )
        self.spec = spec
        self.pool = NativePool(fmu, spec, self.n, log, threads=int(rng.integers(1, 5)))
        receiver.pool = self.pool
        self.rng = rng
        self.start = tuple(map(fmu.variable, start))
        self.values = np.ones((len(start), self.n))
        self.outputs = tuple(map(fmu.variable, outputs))
        self.snapshot = self.bundled = None
        self.playing = threading.Lock()
        self.reset()

    def run(self, name):
        """Call a method."""
        with self.playing if name in IN_TURN else contextlib.nullcontext():
            getattr(self, name)()

    def mask(self):
        return self.rng.random(self.n) < 0.3

    def step_own(self):
        self.pool.step_own()

    def step(self):
        self.pool._pool.step(self.mask())  # as numpy would race with other calls

    def reset(self):
        values = self.values.copy()
        values[0, :: int(self.rng.integers(2, 9))] = -1.0  # what the cart-pole refuses, aloud
        self.pool.reset(self.start, values, self.mask() if self.rng.random() < 0.7 else None)

    def prepare_play(self):
        variables, before = np.zeros((1, self.n)), np.zeros((1, self.n))
        actions, ended = kept_actions(self.n), np.zeros(self.n, np.bool_)
        self.pool.prepare_play(
            self.start,
            programs(self.pool, variables, actions, ended),
            DISCRETE | actions,
            self.values.copy(),
            (DRAWS, self.rng.integers(2**64, size=(self.n, 6), dtype=np.uint64)),
            ended,
            {
                "kept": np.zeros_like(self.pool.outputs),
                "reads_kept": bool(self.rng.random() < 0.5),
                "before_inputs": ((variables[0], before[0]),),
                "before_conclusion": ((variables[0], before[0]),),
                "starts": (
                    (variables[0], np.float64(1.0).tobytes()),
                    (variables[0], 0),
                    *((row, np.float64(0.0).tobytes()) for row in self.pool.inputs),
                    (before[0], variables[0]),
                ),
                **results_of(self.n, len(self.outputs), 1),
            },
        )

    def draw(self):
        """Draw from streams while other threads play."""
        streams = self.rng.integers(2**64, size=(self.n, 6), dtype=np.uint64)
        _native.draw(DRAWS, streams, np.empty((1, self.n)))

    def play(self):
        actions = self.rng.integers(0, 2, self.n)
        at_ends = bool(self.rng.random() < 0.5)  # episodes start in the step that ends others
        with contextlib.suppress(ValueError):  # there may be nothing prepared
            *_, starts = self.pool._pool.play(actions, at_ends)
            counts["played"] += 1
            if self.rng.random() < 0.5:
                self.starts = starts

    def start_episodes(self):
        """Hold what some starts return, and read it later."""
        with contextlib.suppress(ValueError):  # as above
            result = self.pool._pool.start(self.mask())
            if result is not None and self.rng.random() < 0.5:
                self.held = result
                assert self.held[-1].shape == (1, self.n)

    def save(self):
        self.snapshot = self.pool.save()

    def restore(self):
        if self.snapshot is not None:
            self.pool.restore(self.snapshot, self.mask())

    def bundle(self):
        """Save the states of some, as far as the FMU can, or the records of their episodes."""
        indices = np.flatnonzero(self.mask())
        with contextlib.suppress(ValueError):
            self.bundled = self.pool.save_states(indices, bool(self.rng.integers(2)))
            counts["bundled"] += 1

    def unbundle(self):
        """Restore them in others."""
        bundled = self.bundled  # another thread may replace it
        if bundled:
            indices = self.rng.permutation(self.n)[: int(self.rng.integers(1, self.n + 1))]
            sources = self.rng.integers(len(bundled), size=len(indices))
            self.pool.restore_states(bundled, sources, indices)

    def write(self):
        self.pool.write(self.spec.inputs, np.zeros_like(self.pool.inputs))

    def forget(self):
        self.snapshot = None

    def failure(self):
        self.pool.failure(int(self.rng.integers(self.n)))

    def read(self):
        self.pool.read(self.outputs)

    def health(self):
        self.pool.health()

    def close(self):
        if self.rng.random() < 0.05:
            self.pool.close()


ACTIONS = (
    *("step_own", "step_own", "step", "reset", "prepare_play", "draw"),
    *(
        "play",
        "play",
        "play",
        "start_episodes",
        "save",
        "restore",
        "forget",
        "failure",
        "read",
        "health",
    ),
    "close",
    *("bundle", "unbundle", "unbundle", "write"),
)


IN_TURN = {"play", "prepare_play", "start_episodes"} if "in-turn" in sys.argv else set()


class Ring:
    """The subjects, of which closed ones are replaced."""

    def __init__(self, recipes, seed):
        self.recipes, self.seed = recipes, seed
        self.subjects = [self._make(recipe) for recipe in recipes]

    def _make(self, recipe):
        while True:
            self.seed += 1
            with contextlib.suppress(KeyboardInterrupt, ReceiverError, SimulationError):
                source, names, start, options = recipe
                rng = np.random.default_rng(self.seed)
                return Subject(source, names, start, rng, **options)

    def act(self, rng):
        index, name = int(rng.integers(len(self.subjects))), str(rng.choice(ACTIONS))
        try:
            self.subjects[index].run(name)
        except SimulationError as error:
            if "closed" in str(error):
                self.subjects[index] = self._make(self.recipes[index])
                counts["closed"] += 1
        except KeyboardInterrupt:
            counts["interrupted"] += 1
        except ReceiverError:
            counts["refused message"] += 1
        counts[name] += 1


def systems():
    """Carts and a pendulum: with a reset method each; and with estimates of errors."""
    paths = {"a": bundled_fmu("CartPole", "2.0"), "b": bundled_fmu("CartPole", "3.0")}
    paths["c"] = bundled_fmu("Pendulum", "2.0")
    links = [
        Connection("a.x", "b.f", 0.1, convert_units=False),
        Connection("b.x_dot", "c.tau", 0.1, convert_units=False),
    ]
    names = ["a.f"], ["a.x", "c.theta"]
    for methods in (("restore", "instance", "restore"), ("reset", "restore", "reset")):
        own = {"component_resets": tuple(map(ResetMethod, methods))}
        yield FMUSystem(paths, links), names, ["a.m_cart"], own


def recipes(folder, with_python):
    """What there are pools of."""
    for version in ("2.0", "3.0"):
        path = bundled_fmu("CartPole", version)
        yield path, (["f"], ["x", "theta"]), ["m_cart"], {}
    yield from systems()
    for version, model, input_, output, start in (
        (1, "ball", "e", "h", "h"),
        (2, "circuit", "duty", "voltage", "limit"),
        (3, "van_der_pol", "mu", "x1", "x2"),
    ):
        path = exchange_fmu(f"{folder}/{model}.fmu", model, version)
        yield path, ([input_], [output]), [start], {}
    if with_python:
        import foreign_tank
        from pythonfmu.builder import FmuBuilder

        path = FmuBuilder.build_FMU(foreign_tank.__file__, folder)
        yield path, (["inflow"], ["level"]), ["area"], {}


def on_alarm(*_):
    raise KeyboardInterrupt


class Crowd:
    """Threads that act on a ring.

    Those of an odd number stop in time; the others go on to the very end of the interpreter.
    """

    def __init__(self, ring, seed, end):
        self.trouble = []
        self._ring, self._seed, self._end = ring, seed, end
        self._threads = [
            threading.Thread(target=self._loop, args=[i], daemon=True) for i in range(THREADS)
        ]
        for thread in self._threads:
            thread.start()

    def join(self):
        for thread in self._threads[1::2]:
            thread.join()
        ending.set()

    def _loop(self, number):
        rng = np.random.default_rng([self._seed, number])
        try:
            while number % 2 == 0 or time.monotonic() < self._end:
                self._ring.act(rng)
        except BaseException as error:
            if not ending.is_set():
                self.trouble.append(repr(error))


def act_with_alarms(ring, seed, end):
    """What the main thread does, as only that handles signals."""
    rng = np.random.default_rng(seed)
    signal.signal(signal.SIGALRM, on_alarm)
    while time.monotonic() < end:
        with contextlib.suppress(KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, float(rng.uniform(1e-3, 20e-3)))
            while time.monotonic() < end:
                ring.act(rng)
    signal.signal(signal.SIGALRM, signal.SIG_IGN)


def act(ring, seed, end):
    """What the main thread does without signals."""
    rng = np.random.default_rng(seed)
    while time.monotonic() < end:
        ring.act(rng)


def watch(seconds):
    faulthandler.enable()
    faulthandler.dump_traceback_later(seconds + LONGEST_WAIT, exit=True)
    sys.unraisablehook = lambda _: counts.update(["unraisable"])
    sys.setswitchinterval(1e-4)  # many changes of threads, without waiting for them


def main():
    seconds, seed = float(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    with_python = "python" in sys.argv
    watch(seconds)
    folder = tempfile.TemporaryDirectory()
    ring = Ring(list(recipes(folder.name, with_python)), seed)
    end = time.monotonic() + seconds
    crowd = Crowd(ring, seed, end)
    (act if with_python else act_with_alarms)(ring, seed, end)
    crowd.join()
    sys.stdout.write(json.dumps(counts) + "\n")
    sys.stdout.flush()
    wanted = {*ACTIONS, "played", "message", "refused message", "closed"}
    missing = (wanted if with_python else {*wanted, "interrupted"}) - {*counts}
    if missing or crowd.trouble:
        sys.exit(f"never done: {sorted(missing)}; trouble: {crowd.trouble}")
    if with_python:
        os._exit(0)


if __name__ == "__main__":
    main()
