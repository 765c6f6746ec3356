"""A process that an FMU may crash: ``python crash_host.py FMU WISH...``; see ``test_crashes.py``.

The wishes are words of the form ``name`` or ``name=value``:
``fault``, ``call`` and ``at`` are for the FMU, ``faulthandler`` turns that on before or after the
environment is made, ``do`` names what this process does to itself after the first step, and
``handler`` handles SIGFPE in Python. The answer is a line of JSON.
"""

import contextlib
import ctypes
import faulthandler
import json
import logging
import os
import resource
import signal
import sys
from pathlib import Path

import numpy as np
import zoo_tools

import fmugym
from fmugym.trial.known import known_verdict


def say(line):
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def die_of_a_null_pointer():
    ctypes.string_at(0)


def die_in_a_fork():
    pid = os.fork()
    if pid == 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        die_of_a_null_pointer()
    os.waitpid(pid, 0)
    os.kill(os.getpid(), signal.SIGKILL)


def damage_the_heap():
    """As an FMU may do in a step: the C library notices it at a later call of anybody."""
    library = ctypes.CDLL(None)
    library.malloc.restype = ctypes.c_void_p
    library.malloc.argtypes = [ctypes.c_size_t]
    library.free.argtypes = [ctypes.c_void_p]
    place = library.malloc(5000)
    ctypes.memset(place - 8, 0xFF, 8)
    library.free(place)


DEEDS = {
    "damage": damage_the_heap,
    "null": die_of_a_null_pointer,
    "abort": os.abort,
    "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "_exit": lambda: os._exit(3),
    "exit": lambda: sys.exit(0),
    "fork": die_in_a_fork,
    "wait": lambda: (say("waiting"), sys.stdin.readline()),
    "nothing": lambda: None,
}


def main(path, wishes):
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    logging.basicConfig(level=logging.DEBUG, filename=os.environ.get("HOST_LOG", os.devnull))
    if "handler" in wishes:
        signal.signal(signal.SIGFPE, lambda *_: None)
    if wishes.get("faulthandler") == "before":
        faulthandler.enable()
    play = play_vector if "vector" in wishes else play_single
    with zoo_tools.Messages() as messages:
        isolated, outcome = play(path, wishes)
    verdict = known_verdict(fmugym.FMU(path))
    answer = {
        "isolated": isolated,
        "outcome": outcome,
        "warnings": messages.texts,
        "reasons": [] if verdict is None else verdict.reasons,
    }
    say(json.dumps(answer))


def options_of(wishes):
    return {name: wishes[name] for name in ("isolation", "backend") if name in wishes}


def fault_of(wishes):
    return zoo_tools.parameters(
        wishes.get("fault", "none"), wishes.get("call", "step"), int(wishes.get("at", 2))
    )


def play_single(path, wishes):
    env = make_env(path, wishes)
    if wishes.get("faulthandler") == "after":
        faulthandler.enable()
    isolated = is_isolated(env._pool)
    with contextlib.closing(env):
        env.reset(options={"model_parameters": fault_of(wishes)})
        env.step([1.0])
        DEEDS[wishes.get("do", "nothing")]()
        for _ in range(3):
            *_, truncated, info = env.step([1.0])
            if truncated:
                return isolated, info["fault"]
    return isolated, ""


def make_env(path, wishes):
    class Env(zoo_tools.ZooEnv):
        """As ``ZooEnv``, which takes no constructor arguments but the config."""

        def __init__(self, **options):
            config = {
                "model_input_names": "u",
                "model_output_names": "y",
                "model_parameters": zoo_tools.SOUND,
                "time_step": float(wishes.get("time_step", zoo_tools.STEP)),
                "bounds": {"u": (-1, 1)},
            }
            if "untried" in wishes:
                config["probe_timeout"] = None
            fmugym.FMUEnv.__init__(self, path, config, **options)

    return Env(**options_of(wishes))


def play_vector(path, wishes):
    count = 64
    envs = fmugym.FMUVectorEnv(lambda: zoo_tools.ZooEnv(path), count, threads=2, hooks="array")
    faults = fault_of(wishes)
    for name, value in faults.items():
        envs.set_attr(name, [zoo_tools.SOUND[name]] * (count - 1) + [value])
    envs.reset()
    for _ in range(4):
        envs.step(np.ones((count, 1)))
    isolated = is_isolated(envs._pool)
    envs.close()
    return isolated, ""


def is_isolated(pool):
    return type(pool).__name__ == "ProcessPool"


if __name__ == "__main__":
    words = (word.partition("=")[::2] for word in sys.argv[2:])
    main(Path(sys.argv[1]), dict(words))
