"""Clocks: the machine's, and one that is moved by hand."""

import threading
import time

import pytest

from fmugym import ConfigError
from fmugym.pool.rig.clocks import ManualClock, RealClock


class TestRealClock:
    def test_begins_at_zero_and_runs_with_the_machine(self):
        clock = RealClock()
        begin = time.perf_counter()
        clock.sleep(0.05)
        assert 0.05 <= clock.time() <= time.perf_counter() - begin + 0.05

    def test_speed(self):
        clock = RealClock(speed=100.0)
        begin = time.perf_counter()
        clock.sleep(5.0)
        assert clock.time() >= 5.0
        assert time.perf_counter() - begin < 2.0

    def test_negative_waits_are_none(self):
        RealClock().sleep(-10.0)

    @pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf"), "5", None])
    def test_impossible_speed(self, speed):
        with pytest.raises(ConfigError, match="speed must be"):
            RealClock(speed)


class TestManualClock:
    @pytest.mark.parametrize("time", [float("nan"), float("inf"), "noon", None, 10**400])
    def test_impossible_times(self, time):
        clock = ManualClock()
        for use in (ManualClock, clock.advance, clock.sleep):
            with pytest.raises(ConfigError, match=r"must be (a number|finite)"):
                use(time)
        assert clock.time() == 0.0

    def test_stands_still_until_it_is_moved(self):
        clock = ManualClock(start=3.0)
        time.sleep(0.01)
        assert clock.time() == 3.0
        clock.advance(1.5)
        assert clock.time() == 4.5

    def test_a_lone_sleeper_moves_it(self):
        clock = ManualClock()
        clock.sleep(2.0)
        clock.sleep(-1.0)
        assert clock.time() == 2.0

    def test_cannot_be_turned_back(self):
        with pytest.raises(ConfigError, match="-1"):
            ManualClock().advance(-1.0)

    def test_advance_wakes_a_sleeper(self):
        clock = ManualClock()
        busy = threading.Event()
        worker = clock.thread(busy.wait, (10,))  # at work, so that time waits for it
        sleeper = threading.Thread(target=clock.sleep, args=(1.0,))
        worker.start()
        sleeper.start()
        clock.advance(0.5)
        sleeper.join(0.05)
        assert sleeper.is_alive()
        while sleeper.is_alive():
            clock.advance(0.5)
            sleeper.join(0.01)
        busy.set()
        worker.join()

    def test_threads_take_turns_at_exact_times(self):
        clock, seen = ManualClock(), []
        gate = threading.Barrier(3)

        def work(period, count):
            gate.wait(10)
            for _ in range(count):
                clock.sleep(period)
                seen.append((round(clock.time(), 9), period))

        threads = [clock.thread(work, args, name="t") for args in [(0.3, 4), (0.5, 2), (1.3, 1)]]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(10)
        assert [moment for moment, _ in seen] == [0.3, 0.5, 0.6, 0.9, 1.0, 1.2, 1.3]

    def test_time_waits_for_those_who_work_for_a_thread(self):
        clock, seen = ManualClock(), []
        gate, other = threading.Barrier(2), threading.Event()

        def work():
            clock.sleep(0.2)
            clock.leave(threading.current_thread())
            other.wait(10)

        def program():
            helper = threading.Thread(target=work)
            gate.wait(10)
            with clock.handed_over([helper]):
                helper.start()
                while clock.time() < 0.2:
                    time.sleep(0.001)
                seen.append(clock.time())
            clock.sleep(0.3)
            seen.append(clock.time())
            other.set()
            helper.join(10)

        def sleeper():
            gate.wait(10)
            clock.sleep(0.4)
            seen.append(clock.time())

        threads = [clock.thread(program), clock.thread(sleeper)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(10)
        assert seen == pytest.approx([0.2, 0.4, 0.5])

    @pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
    def test_a_thread_that_fails_does_not_stop_the_time(self):
        clock = ManualClock()
        failing, sleeping = clock.thread(lambda: 1 / 0), clock.thread(clock.sleep, (1.0,))
        sleeping.start()
        failing.start()
        failing.join(10)
        sleeping.join(10)
        assert not sleeping.is_alive()

    def test_a_thread_that_cannot_start_is_not_waited_for(self, monkeypatch):
        clock = ManualClock()
        monkeypatch.setattr(threading.Thread, "start", lambda self: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            clock.thread(print).start()
        clock.sleep(1.0)
        assert clock.time() == 1.0
