"""Damages the forms that open pools, and the messages to and from worker processes.

    python tests/tools/fuzz_forms.py --count 1000 --seed 0 [--first N]

A case damages one of these:

* The form of a pool, a list of variables, draws, a play or a program, which goes to the C
  extension. It is taken or refused with a ``ValueError``.
* The requests to a worker. The worker answers, or it ends by itself without a fault.
* The answers of a worker. Calls raise nothing but errors of the family, and a reset makes the pool
  whole again, unless a worker has been given up after many deaths in a row.

See ``fuzz_driver.py``.
"""

import contextlib
import functools
import logging
import math
import re
import sys
from unittest import mock

import numpy as np
from fuzz_driver import Case, main, require
from pool_tools import sampled
from program_tools import (
    RESULT_ROWS,
    code,
    constants,
    no_observation,
    results_of,
    stored_results,
    uniform_draws,
)

from fmugym import FMU, Connection, FMUSystem, SimulationError, _native, bundled_fmu
from fmugym.pool import PoolSpec, native_pool
from fmugym.pool.health import no_counts
from fmugym.pool.native_pool import prepare
from fmugym.pool.play_form import form_of_play
from fmugym.pool.pool_form import (
    Files,
    form_of_draws,
    form_of_listing,
    form_of_pool,
    form_of_program,
    form_of_programs,
)
from fmugym.pool.processes.channel import Channel
from fmugym.pool.processes.process_pool import ProcessPool
from fmugym.pool.processes.supervisor import Supervisor

LOG = logging.getLogger("fmugym.fuzz")
ODD = (0, 1, 2, 3, 7, 255, -1, -2, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**61, 2**63 - 1, -(2**63))
CALLS = 6
N = 3


def damaged(rng, data):
    """Bytes with up to three faults."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        rng.choice(FAULTS)(rng, data)
    return bytes(data)


def flip(rng, data):
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def odd_number(rng, data):
    if len(data) >= 8:
        place = 8 * rng.randrange(len(data) // 8)
        data[place : place + 8] = (rng.choice(ODD) % 2**64).to_bytes(8, sys.byteorder)


def near_number(rng, data):
    if len(data) >= 8:
        place = 8 * rng.randrange(len(data) // 8)
        number = int.from_bytes(data[place : place + 8], sys.byteorder) + rng.choice((-8, -1, 1, 8))
        data[place : place + 8] = (number % 2**64).to_bytes(8, sys.byteorder)


def cut(rng, data):
    del data[rng.randrange(len(data) + 1) :]


def drop(rng, data):
    place = 8 * rng.randrange(len(data) // 8 + 1)
    del data[place : place + 8 * rng.randint(1, 3)]


def repeat(rng, data):
    place = 8 * rng.randrange(len(data) // 8 + 1)
    data[place:place] = data[place : place + 8 * rng.randint(1, 8)]


def noise(rng, data):
    place = 8 * rng.randrange(len(data) // 8 + 1)
    data[place : place + 16] = rng.randbytes(16)


FAULTS = (flip, flip, odd_number, odd_number, odd_number, near_number, cut, drop, repeat, noise)


@contextlib.contextmanager
def refusals():
    """A refusal of the extension counts as one of the package."""
    try:
        yield
    except (ValueError, OSError, IndexError, MemoryError) as error:
        raise SimulationError(type(error).__name__) from None


@functools.cache
def opened():
    """FMUs of all versions and a system, each with its specification."""
    found = []
    for version in ("1.0", "2.0", "3.0"):
        fmu = FMU(bundled_fmu("CartPole", version))
        found.append((fmu, [fmu.variable("f")], [fmu.variable("x"), fmu.variable("theta")]))
    pair = FMUSystem(
        {"a": bundled_fmu("Pendulum"), "b": bundled_fmu("Pendulum", "3.0")},
        [Connection(f"{a}.theta", f"{b}.tau", convert_units=False) for a, b in ("ab", "ba")],
    ).as_fmu()
    found.append((pair, [], [pair.variable("a.theta"), pair.variable("b.theta")]))
    return found


def spec_of(rng, inputs, outputs):
    samplings = ("mean", "last") if rng.random() < 0.5 else None
    return PoolSpec(
        tuple(inputs),
        sampled(tuple(outputs), samplings),
        0.05,
        num_observed=rng.randint(0, 2),
        substeps=rng.randint(1, 3),
        stop_time=rng.choice((None, 10.0)),
    )


def pool_form(rng):
    """Without libraries: the instances are elsewhere."""
    fmu, inputs, outputs = rng.choice(opened())
    spec = spec_of(rng, inputs, outputs)
    form = form_of_pool(fmu.description, spec, Files((), (b"resources",) * 2), N, 2)
    arrays = (
        np.zeros((len(inputs), N)),
        np.zeros((2, N)),
        np.zeros(N, np.int8),
        np.zeros((N, spec.num_observed), np.float32),
        no_counts(N),
    )
    form = damaged(rng, form)

    def play():
        with refusals():
            pool = _native.Pool(form, arrays, print)
            pool.step(None)
            pool.close()

    return Case(play, "pool")


def listing_form(rng):
    fmu, inputs, outputs = rng.choice(opened()[:3])
    version = fmu.description.fmi_major_version
    form = damaged(rng, form_of_listing([*inputs, *outputs], version))

    def play():
        with refusals():
            _native.access(form)

    return Case(play, "listing")


def draws_form(rng):
    kinds = [_native.DISTRIBUTIONS.index(name) for name in ("uniform", "choice")]
    table = [[kinds[0], 0, 0, 2], [kinds[1], -1, 2, 3]]
    form = damaged(rng, form_of_draws(table, [0.0, 1.0, 2.0, 3.0, 4.0]))

    def play():
        with refusals():
            _native.draw((form, 0, 0), np.ones((2, 6), np.uint64), np.zeros((2, 2)))

    return Case(play, "draws")


def program_form(rng):
    rows = [
        ("load_row", 0, 3),
        ("multiply d", 0, 4, 3, 0),
        ("less d", 0, 1, 4, 3),
        ("where 8", 0, 2, 1, 4, 3),
        ("cast", 1, 5, 2),
        ("store_row", 2, 0, 5),
        ("store_floats", 3, 0, 0, 2),
        ("store_row", 1, 0, 2),
    ]
    form = form_of_program(code(*rows), constants(0.0), (np.arange(4.0),), 6)
    form, n = damaged(rng, form), rng.choice((1, 130))
    arrays = np.ones(n), np.ones(n), *np.zeros((n, 3), np.float32).T

    def play():
        with refusals():
            _native.evaluate((form, arrays), n)

    return Case(play, "program")


def play_of(inputs, outputs):
    """The parts of a play: it passes the action on, and ends beyond an output of 1."""
    push, kept_actions = code(("load_row", 1, 0), ("store_row", 0, 0, 0)), np.zeros(N)
    ended = np.zeros(N, np.bool_)
    judge = code(
        ("load_row", 0, 1),
        ("greater d", 0, 2, 1, 0),
        *stored_results(1, 1, 2, 2),
        ("store_row", 4, 0, 2),
    )
    programs = (
        (form_of_program(push, b"", (), 1), (inputs[0], kept_actions)),
        (form_of_program(judge, constants(1.0), (), 3), (outputs[0], *RESULT_ROWS, ended)),
        no_observation(),
    )
    kept, variables = np.zeros_like(outputs), np.zeros((2, N))
    surroundings = {
        "kept": kept,
        "reads_kept": True,
        "before_inputs": (tuple(variables),),
        "before_conclusion": (tuple(variables),),
        "starts": (
            (variables[0], np.float64(2.0).tobytes()),
            (inputs[0], np.float64(0.5).tobytes()),
            (kept[0], outputs[0]),
        ),
        **results_of(N, 1, 0),
    }
    actions = {
        "size": 8,
        "check": 2,
        "lowest": 0,
        "highest": 0,
        "current": kept_actions,
        "previous": np.zeros(N),
        "none": np.zeros(1),
    }
    streams = uniform_draws(), np.zeros((N, 6), np.uint64)
    return programs, actions, np.zeros((0, N)), streams, ended, surroundings


def play_form(rng):
    """Its instances are elsewhere, so that none steps."""
    fmu, *_ = opened()[1]
    spec = PoolSpec((fmu.variable("f"),), (fmu.variable("x"),), 0.05, num_observed=1)
    own = np.zeros((1, N)), np.zeros((1, N)), np.zeros(N, np.int8), np.zeros((N, 1), np.float32)

    def play():
        pool = _native.Pool(form_of_programs(spec, N, 1), (*own, no_counts(N)), print)
        parts, form = play_of(*own[:2]), lambda *a: damaged(rng, form_of_play(*a))
        with mock.patch.object(native_pool, "form_of_play", form), refusals():
            prepare(pool, _native.access(form_of_listing(())), *parts)
            for _ in range(3):
                pool.play_before(np.zeros(N))
                pool.play_after()

    return Case(play, "play")


class Noise:
    """Damages messages of all channels while it has a direction; notes why workers have ended."""

    def __init__(self):
        self.rng, self.direction, self.rate, self.deaths = None, "", 0.0, []

    def hits(self, direction):
        return self.direction == direction and self.rng.random() < self.rate

    def install(self, patch):
        """Put itself around the functions; ``patch`` replaces one until the end of the program."""
        send, head, content = Channel.send, Channel.receive_head, Channel.receive_content
        forget = Supervisor._forget_process

        def send_damaged(channel, code, data=b"", deadline=math.inf):
            if self.hits("request"):
                data = damaged(self.rng, data or bytes(8))
                code = self.rng.randrange(24) if self.rng.random() < 0.1 else code
            send(channel, code, data, deadline)

        def receive_odd_head(channel, deadline):
            code, size = head(channel, deadline)
            if self.hits("answer") and self.rng.random() < 0.3:
                code = self.rng.choice((code, *b"RTELD", 0, 2**40))
                size += self.rng.choice((0, 0, 8, 2**40))
            return code, size

        def receive_damaged(channel, size, deadline):
            data = content(channel, size, deadline)
            return damaged(self.rng, data or bytes(8)) if self.hits("answer") else data

        def note(supervisor, reason):
            self.deaths.append(reason)
            forget(supervisor, reason)

        patch(Channel, "send", send_damaged)
        patch(Channel, "receive_head", receive_odd_head)
        patch(Channel, "receive_content", receive_damaged)
        patch(Supervisor, "_forget_process", note)


def variable(name):
    fmu, *_ = opened()[1]
    return fmu.variable(name)


def step(rng, pool, kept):
    pool.step(np.ones((1, N)), rng.choice((None, np.array([True, False, False]))))


def reset(rng, pool, kept):
    pool.reset((variable("x_0"),), np.full((1, N), 0.1), None)


def save(rng, pool, kept):
    kept["snapshot"] = pool.save()


def restore(rng, pool, kept):
    if "snapshot" in kept:
        pool.restore(kept["snapshot"])


def save_states(rng, pool, kept):
    kept["states"] = pool.save_states(np.arange(N), rng.random() < 0.5)


def restore_states(rng, pool, kept):
    if "states" in kept:
        sources = np.array(rng.choices(range(N), k=N))
        pool.restore_states(kept["states"], sources, np.arange(N))


def read(rng, pool, kept):
    pool.read((variable("x"),))


def write(rng, pool, kept):
    pool.write((variable("f"),), np.ones((1, N)))


def differentiate(rng, pool, kept):
    pool.differentiate((variable("x"),), (variable("f"),))


def ask(rng, pool, kept):
    pool.failure(rng.randrange(N))
    pool.health()


ACTIONS = step, step, reset, save, restore, save_states, restore_states, read, write, ask
ACTIONS += (differentiate,)
FAULT = re.compile(r"ended with (signal (?!SIGKILL)|exit status [1-9])")


def make_pool():
    fmu = FMU(bundled_fmu("CartPole"))
    spec = PoolSpec((fmu.variable("f"),), (fmu.variable("x"),), 0.05, num_observed=1, records=True)
    return ProcessPool(fmu, spec, N, LOG, workers=2, call_timeout=0.4)


def conversation(direction, noise, rng):
    """Calls of a pool, of which messages in one direction are damaged."""

    def play():
        noise.direction, noise.deaths = "", []
        with contextlib.closing(make_pool()) as pool:
            kept = {}
            reset(rng, pool, kept)
            noise.rng, noise.rate, noise.direction = rng, rng.choice((0.2, 0.6)), direction
            try:
                refused = calls(rng, pool, kept)
            finally:
                noise.direction = ""
            reasons, noise.deaths = noise.deaths, []
            require(not any(map(FAULT.search, reasons)), f"a worker has died: {reasons}")
            for _ in range(2):
                reset(rng, pool, kept)
            failures = map(pool.failure, np.flatnonzero(pool.statuses).tolist())
            lost = [one for one in failures if "given up after 5 deaths in a row" not in one]
            require(not lost, f"lost for good: {lost}")
            if refused is not None:
                raise refused

    return Case(play, direction)


def calls(rng, pool, kept):
    """Make some calls; returns the first error."""
    first = None
    for _ in range(CALLS):
        try:
            rng.choice(ACTIONS)(rng, pool, kept)
        except SimulationError as error:
            first = first or error
    return first


@contextlib.contextmanager
def program():
    """See ``fuzz_driver.run``."""
    noise = Noise()
    kinds = (
        *(pool_form, listing_form, draws_form, program_form, play_form) * 2,
        functools.partial(conversation, "request", noise),
        functools.partial(conversation, "answer", noise),
    )
    with contextlib.ExitStack() as stack:

        def patch(owner, name, function):
            stack.callback(setattr, owner, name, getattr(owner, name))
            setattr(owner, name, function)

        noise.install(patch)
        make_pool().close()
        yield lambda rng, own: rng.choice(kinds)(rng)


if __name__ == "__main__":
    sys.exit(main(program, __doc__, 1000))
