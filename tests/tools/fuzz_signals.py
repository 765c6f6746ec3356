"""Signals at random moments: what their handler raises comes out, and all goes on as before.

    python tests/tools/fuzz_signals.py --count 2000 --seed 0

In each case a timer sends a signal after some microseconds or milliseconds of calls of one
environment: steps, resets, or opening and closing it. The handler raises ``KeyboardInterrupt`` or
an ordinary exception. Nothing else may come out. Afterwards a reset begins an episode that equals
one without a signal, bit for bit, and no file is left.

Some things are not the package's to mend. Python drops what is raised in a destructor, lxml does so
while it reads a file, and ``zipfile`` may raise something else. A folder whose destructor has been
interrupted goes at the end of the process.

When and where a signal arrives depends on the machine, so a case cannot be repeated exactly. See
``fuzz_driver.py``. Not for Windows, which has no such timers.
"""

import collections
import contextlib
import functools
import gc
import logging
import os
import signal
import sys
import tempfile
import traceback

import fmu_tools
import gymnasium as gym
import numpy as np
from fuzz_driver import Case, CaseError, main, require

import fmugym
from fmugym.archive.temporary import remove_rest
from fmugym.envs import CartPoleEnv

NUM_ENVS = 3
LOGGING = {"model_parameters": {"log_status": 1}}
PROBE = "FMUGYM_FUZZ_PROBE"
"""The environment variable with the path of the FMU that logs."""
LOSING = ("weakref.py", "_weakrefset.py", "in __del__", "etree.parse(", "os.mkdir(", "zipfile.py")
"""Where Python or lxml may drop or replace what a signal handler raises, as a stack names it."""

CALLS = 400
"""At most so many calls wait for the signal."""


class AlarmError(Exception):
    """An ordinary exception of a signal handler."""


class Alarm:
    """A timer whose handler raises once.

    Args:
        delay: Seconds.
        error: What the handler raises.

    Attributes:
        may_have_been_lost: Whether what one of them has raised may have been dropped or replaced.
    """

    may_have_been_lost = False

    def __init__(self, delay, error):
        self._delay, self._error = delay, error
        self._armed = self._rang = False
        self._where = ""

    def _ring(self, *_):
        if self._armed:
            self._armed, self._rang = False, True
            self._where = "".join(traceback.format_stack())
            raise self._error

    def interrupt(self, work):
        """Do some work; fail unless what the handler raises comes out of it."""
        before = signal.signal(signal.SIGALRM, self._ring)
        came_out = None
        try:
            self._armed = True
            signal.setitimer(signal.ITIMER_REAL, self._delay)
            work()
            self._armed = False
        except BaseException as error:
            came_out = error
        self._armed = False
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        may_be_lost = any(place in self._where for place in LOSING)
        Alarm.may_have_been_lost |= may_be_lost
        if came_out is not None and not may_be_lost and not self._is_ours(came_out):
            raise CaseError(f"{type(came_out).__name__}: {came_out}") from came_out
        is_lost = came_out is None and self._rang and not may_be_lost
        require(not is_lost, f"lost in {self._where[-2000:]}")

    def _is_ours(self, error):
        """Whether an error is that of the handler, or was made of it.

        Python itself makes another one of it in a codec.
        """
        seen = error
        while seen is not None and seen is not self._error:
            seen = seen.__cause__ or seen.__context__
        if isinstance(self._error, KeyboardInterrupt):
            return isinstance(error, KeyboardInterrupt) and seen is self._error
        return seen is self._error and not isinstance(error, fmugym.FMUGymError)


def single(**options):
    return CartPoleEnv(**options)


def vector(**options):
    return fmugym.FMUVectorEnv(CartPoleEnv, NUM_ENVS, **options)


class Talkative(fmu_tools.PlainEnv):
    """Its FMU logs in every step."""

    def __init__(self, **options):
        super().__init__(
            os.environ[PROBE], fmu_tools.probe_config(**LOGGING), logging.CRITICAL, **options
        )

    def _get_action_space(self):
        return gym.spaces.Discrete(2)

    def _get_inputs(self):
        return 0.5 * self.action


WAYS = {
    "logs": Talkative,
    "single": single,
    "single isolated": functools.partial(single, isolation="process"),
    "compiled": functools.partial(vector, hooks="compiled", threads=2),
    "array": functools.partial(vector, hooks="array"),
    "per_env": functools.partial(vector, hooks="per_env"),
    "same step": functools.partial(vector, autoreset_mode="same_step"),
    "isolated": functools.partial(vector, isolation="process", workers=2),
}


def actions(env):
    count = getattr(env, "num_envs", None)
    return (
        (lambda index: index % 3 % 2) if count is None else (lambda i: np.arange(i, i + count) % 2)
    )


def play(env, calls):
    """Reset and step; yields what each call returns, without the infos."""
    action = actions(env)
    for index in range(calls):
        if index % 50 == 0:
            yield np.array(env.reset(seed=index)[0])
        observation, reward, terminated, truncated, _ = env.step(action(index))
        yield np.concatenate([np.ravel(x) for x in (observation, reward, terminated, truncated)])
        if not hasattr(env, "num_envs") and (terminated or truncated):
            env.reset()


def bits(env):
    return [array.tobytes() for array in play(env, 30)]


class Stage:
    """An environment of each way, and what its episodes are without signals."""

    def __init__(self):
        self._envs, self._expected = {}, {}

    def env(self, way):
        if way not in self._envs:
            self._envs[way] = WAYS[way]()
            self._expected[way] = bits(self._envs[way])
        return self._envs[way]

    def check(self, way):
        require(bits(self._envs[way]) == self._expected[way], "another episode than before")

    def close(self):
        for env in self._envs.values():
            env.close()
        self._envs = {}


def in_calls(way, stage, alarm):
    """Interrupt steps and resets."""
    env = stage.env(way)
    alarm.interrupt(lambda: collections.deque(play(env, CALLS), 0))
    stage.check(way)


def in_life(way, stage, alarm):
    """Interrupt opening and closing."""

    def live():
        for _ in range(3):
            with contextlib.closing(WAYS[way]()) as env:
                env.reset(seed=0)

    stage.env(way)
    alarm.interrupt(live)
    stage.check(way)
    gc.collect()  # an environment that was never returned is in a cycle with its exception


@contextlib.contextmanager
def program():
    """See ``fuzz_driver.run``."""
    stage = Stage()

    def make(rng, folder):
        way = rng.choice(tuple(WAYS))
        call = rng.choice((in_calls, in_calls, in_life))
        delay = 10 ** rng.uniform(-5.0, -1.5)
        alarm = Alarm(delay, rng.choice((KeyboardInterrupt, AlarmError, TimeoutError))("a signal"))
        return Case(
            lambda: call(way, stage, alarm), f"{call.__name__}, {way}", f"{delay:.1e} s", keeps=True
        )

    before, sys.unraisablehook = sys.unraisablehook, lambda unraisable: None
    try:
        with tempfile.TemporaryDirectory() as folder, contextlib.closing(stage):
            os.environ[PROBE] = str(fmu_tools.probe_fmu(folder))
            yield make
        gc.collect()
        if Alarm.may_have_been_lost:
            remove_rest()
    finally:
        sys.unraisablehook = before


if __name__ == "__main__":
    sys.exit(main(program, __doc__, 2000))
