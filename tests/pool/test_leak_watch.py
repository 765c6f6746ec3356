"""The leak watch in simulated processes: whatever their heap does, it judges the FMU alone."""

import logging
from itertools import product

import pytest
from combinations import in_turn

from fmugym.pool import leaks
from fmugym.pool.health import Column, no_counts
from fmugym.pool.leaks import LeakWatch

KB, MB = 2**10, 2**20
LIMIT, LEAK = 4 * MB, 64 * KB


class Process:
    """A process that resets one instance of an FMU that leaks.

    Args:
        monkeypatch: Lets the watch see this process instead of the real one.
        leak: Bytes that a reset leaks.
        free: Bytes that other work has freed before, and that the heap has kept.
        trims: Whether the heap gives freed memory back to the system.
        heap_is_known: Whether the C library tells how much of the heap is in use.
    """

    def __init__(self, monkeypatch, leak=0, free=0, trims=False, heap_is_known=True):
        self._leak, self._trims = leak, trims
        self._used, self._peak = 100 * MB, 100 * MB + free
        monkeypatch.setattr(leaks, "grown_bytes", lambda: self._peak)
        heap = (lambda: self._used) if heap_is_known else (lambda: self._peak)
        monkeypatch.setattr(leaks, "heap_bytes", heap)
        self.counts, self.text = no_counts(1), []
        log = logging.Logger("leaks")
        log.addFilter(lambda record: self.text.append(record.getMessage()))
        self._watched = LeakWatch(LIMIT, self.counts, log, "Leaky.fmu").around(self._reset)

    def take(self, size):
        """Take memory, or free it if the size is negative."""
        self._used += size
        self._peak = self._used if self._trims else max(self._peak, self._used)

    def _reset(self):
        self.take(self._leak)
        self.counts[0, Column.RESETS] += 1

    def play(self, resets, caller=lambda number: 0):
        """Reset the instance; ``caller`` gives what the caller takes after each reset."""
        for number in range(resets):
            self._watched()
            self.take(caller(number))


@pytest.fixture(name="process")
def fixture_process(monkeypatch):
    return lambda **options: Process(monkeypatch, **options)


def nothing(number):
    return 0


def keeps(number):
    """A caller who keeps 64 kB after each reset."""
    return LEAK


def sometimes(number):
    """A caller who takes 16 MB after each hundredth reset, and frees it fifty resets later."""
    return {0: 16 * MB, 50: -16 * MB}.get(number % 100, 0)


CALLERS = list(product([nothing, keeps, sometimes], [True, False]))


@in_turn({"caller,trims": CALLERS, "heap_is_known": [True, False], "free": [0, 20 * MB]})
def test_a_leak_is_told_once(process, caller, free, trims, heap_is_known):
    one = process(leak=LEAK, free=free, trims=trims, heap_is_known=heap_is_known)
    one.play(20_000, caller)
    assert len(one.text) == 1
    assert "Leaky.fmu" in one.text[0]
    assert "isolation='process'" in one.text[0]


def test_soon(process):
    """Twice the limit, and the calls that it takes to see that."""
    one = process(leak=LEAK)
    one.play(2 * LIMIT // LEAK + 100)
    assert len(one.text) == 1


@in_turn({"caller,trims": CALLERS, "heap_is_known": [True, False]})
def test_what_the_caller_takes_is_not_the_fmus(process, caller, trims, heap_is_known):
    one = process(trims=trims, heap_is_known=heap_is_known)
    one.play(20_000, caller)
    assert one.text == []
