"""The leak watch in simulated processes: whatever their heap does, it judges the FMU alone."""

import logging

import pytest

from fmugym.pool import leaks
from fmugym.pool.health import Column, no_counts
from fmugym.pool.leaks import LeakWatch

KB, MB = 2**10, 2**20
LIMIT, LEAK = 4 * MB, 64 * KB


class Process:
    """A process that resets one instance of an FMU that leaks.

    Args:
        monkeypatch: Lets the watch see this process instead of the real one.
        leak: Bytes that a reset leaks until the instance is freed.
        lost: Bytes that a reset leaks for ever.
        free: Bytes that other work has freed before, and that the heap has kept.
        trims: Whether the heap gives freed memory back to the system.
        heap_is_known: Whether the C library tells how much of the heap is in use.
    """

    def __init__(self, monkeypatch, leak=0, lost=0, free=0, trims=False, heap_is_known=True):
        self._leak, self._lost, self._trims = leak, lost, trims
        self._used, self._peak = 100 * MB, 100 * MB + free
        self._leaked = 0
        self._is_fresh, self._is_to_be_replaced = True, False
        monkeypatch.setattr(leaks, "heap_is_known", lambda: heap_is_known)
        monkeypatch.setattr(leaks, "grown_bytes", lambda: self._peak)
        heap = (lambda: self._used) if heap_is_known else (lambda: self._peak)
        monkeypatch.setattr(leaks, "heap_bytes", heap)
        self.counts, self.text = no_counts(1), []
        log = logging.Logger("leaks")
        log.addFilter(lambda record: self.text.append(record.getMessage()))
        self._watch = LeakWatch(LIMIT, self.counts, self._recycle, log, "Leaky.fmu")
        self.highest = self._peak

    def _recycle(self):
        self._is_to_be_replaced = True

    def take(self, size):
        """Take memory, or free it if the size is negative."""
        self._used += size
        self._peak = self._used if self._trims else max(self._peak, self._used)
        self.highest = max(self.highest, self._peak)

    def _reset(self):
        if self._is_to_be_replaced:
            self.take(-self._leaked)
            self._leaked, self._is_to_be_replaced, self._is_fresh = 0, False, True
            self.counts[0, Column.RECYCLINGS] += 1
        if not self._is_fresh:  # a new instance is not reset before its first episode
            self.take(self._leak + self._lost)
            self._leaked += self._leak
        self._is_fresh = False
        self.counts[0, Column.RESETS] += 1

    def play(self, resets, caller=lambda number: 0):
        """Reset the instance; ``caller`` gives what the caller takes after each reset."""
        for number in range(resets):
            self._watch.call(self._reset)
            self.take(caller(number))
        return int(self.counts[0, Column.RECYCLINGS])


@pytest.fixture(name="process")
def fixture_process(monkeypatch):
    return lambda **options: Process(monkeypatch, **options)


def keeps(number):
    """A caller who keeps 64 kB after each reset."""
    return LEAK


def sometimes(number):
    """A caller who takes 16 MB after each hundredth reset, and frees it fifty resets later."""
    return {0: 16 * MB, 50: -16 * MB}.get(number % 100, 0)


heaps = pytest.mark.parametrize("heap_is_known", [True, False])
trims = pytest.mark.parametrize("trims", [True, False])


@heaps
@trims
@pytest.mark.parametrize("free", [0, 20 * MB])
def test_a_leaking_fmu_is_recycled_as_often_as_it_has_leaked_the_limit(
    process, free, trims, heap_is_known
):
    one = process(leak=LEAK, free=free, trims=trims, heap_is_known=heap_is_known)
    start = one.highest
    recyclings = one.play(20_000)
    if heap_is_known:
        assert recyclings == pytest.approx(20_000 * LEAK / LIMIT, rel=0.3)
    assert recyclings > 20_000 * LEAK / (LIMIT + free) / 1.5
    assert one.highest - start < 2 * LIMIT
    assert one.text == []


@trims
@pytest.mark.parametrize("caller", [keeps, sometimes])
def test_what_the_caller_takes_is_not_the_fmus(process, caller, trims):
    """However long it goes on: an error of a percent in what a reset leaks would be many MB."""
    assert process(trims=trims).play(20_000, caller) < 12
    one = process(leak=LEAK, trims=trims)
    assert 0.7 < one.play(20_000, caller) / (20_000 * LEAK / LIMIT) < 2.0
    assert one.text == []


@heaps
@trims
@pytest.mark.parametrize("leak", [0, LEAK])
def test_what_is_lost_for_ever_is_said_once(process, leak, trims, heap_is_known):
    one = process(leak=leak, lost=LEAK, trims=trims, heap_is_known=heap_is_known)
    one.play(20_000)
    assert len(one.text) == 1
    assert "Leaky.fmu" in one.text[0]
    assert "isolation='process'" in one.text[0]
