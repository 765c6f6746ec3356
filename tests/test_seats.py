"""Environments of one FMU keep to its limits together, in one process and in several."""

import contextlib
import functools
import gc
import json
import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import fmugym
from fmugym.errors import ConfigError, LicenceError
from fmugym.pool import pacing
from fmugym.pool.pacing import Pacer
from fmugym.pool.seats import Seats, taking
from fmugym.pool.spec import PoolSpec

PROGRAM = """
import os
import sys
import fmugym
from test_seats import SeatedEnv
env = SeatedEnv(max_instances=int(sys.argv[1]))
print("open", flush=True)
sys.stdin.readline()
{end}
"""
BACKENDS = ["native"]


class SeatedEnv(fmugym.FMI2CSEnv):
    def __init__(self, backend=None, isolation=None, **config):
        config = {"model_input_names": "tau", "model_output_names": ["q", "q_dot"]} | config
        path = fmugym.bundled_fmu("Pendulum")
        super().__init__(path, config, backend=backend, isolation=isolation)

    def _is_done(self):
        return abs(self.out["q"]) > 1e9


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def program(tmp_path):
    """Starts a program that has an environment until it reads a line, and then ends."""
    running = []

    def start(most, end="env.close()"):
        folder = os.path.dirname(__file__)
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(end=end), str(most)],
            env=os.environ | {"PYTHONPATH": folder},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        running.append(process)
        assert process.stdout.readline() == "open\n"
        return process

    yield start
    for process in running:
        process.kill()
        process.communicate()


def take_one(**config):
    env = SeatedEnv(max_instances=1, **config)
    env.reset(seed=0)
    env.close()


class TestSeats:
    @pytest.mark.parametrize(
        "options", [*({"backend": name} for name in BACKENDS), {"isolation": "process"}]
    )
    def test_of_two_environments_in_one_process(self, options):
        first = SeatedEnv(max_instances=2, **options)
        second = SeatedEnv(max_instances=2, **options)
        with pytest.raises(LicenceError) as caught:
            SeatedEnv(max_instances=2, **options)
        text = str(caught.value)
        assert "Pendulum.fmu needs 1 more instance(s)" in text
        assert "'max_instances' allows 2 at once on this machine" in text
        assert text.count("1 by this process for an environment") == 2
        assert "close environments" in text
        assert "licence_wait" in text
        first.reset(seed=0)
        first.close()
        third = SeatedEnv(max_instances=2, **options)
        third.close()
        third.close()
        second.close()

    def test_of_a_vector_environment_beside_a_single_one(self):
        make = functools.partial(SeatedEnv, max_instances=4)
        envs = fmugym.FMUVectorEnv(make, 3)
        single = make()
        with pytest.raises(LicenceError, match=r"in use: .*3 by this process"):
            make()
        envs.close()
        fmugym.FMUVectorEnv(make, 3, isolation="process", workers=2).close()
        with pytest.raises(LicenceError, match="needs 4 more"):
            fmugym.FMUVectorEnv(make, 4)
        single.close()

    def test_of_two_processes(self, program):
        other = program(2)
        mine = SeatedEnv(max_instances=2)
        with pytest.raises(LicenceError, match=rf"1 by process {other.pid} \(-c\) for an env"):
            SeatedEnv(max_instances=2)
        other.communicate("\n", timeout=60)
        SeatedEnv(max_instances=2).close()
        mine.close()

    @pytest.mark.parametrize(
        "end", ["import os; os.kill(os.getpid(), 9)", "import os; os._exit(3)"]
    )
    def test_of_a_process_that_has_died(self, program, cache, end):
        other = program(1, end)
        with pytest.raises(LicenceError):
            take_one()
        other.communicate("\n", timeout=60)
        take_one()
        assert not list((cache / "licences").glob("*-*"))

    def test_are_waited_for(self, program, caplog):
        other = program(1)
        over = threading.Event()

        def end():
            while not over.wait(0.05) and "waiting for" not in caplog.text:
                pass
            other.communicate("\n", timeout=60)

        thread = threading.Thread(target=end)
        thread.start()
        try:
            take_one(licence_wait=60.0)
        finally:
            over.set()
            thread.join()
        assert f"1 by process {other.pid}" in caplog.text

    def test_waiting_ends(self, program):
        program(1)
        with pytest.raises(LicenceError, match=r"no licence came within 0\.2 s"):
            take_one(licence_wait=0.2)

    def test_environments_that_nobody_uses_have_none(self):
        class Knot(SeatedEnv):
            def __init__(self, **config):
                super().__init__(**config)
                self.knot = self

        gc.disable()
        try:
            Knot(max_instances=1)
            take_one()
        finally:
            gc.enable()

    @pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no forks")
    def test_a_fork_neither_keeps_nor_returns_them(self):
        env = SeatedEnv(max_instances=1)
        ready, done = os.pipe(), os.pipe()
        child = os.fork()
        if child == 0:
            with contextlib.suppress(BaseException):
                env.close()
                gc.collect()
                os.write(ready[1], b"1")
                os.read(done[0], 1)
            os._exit(0)
        os.read(ready[0], 1)
        try:
            with pytest.raises(LicenceError):
                take_one()
            env.close()
            take_one()
        finally:
            os.write(done[1], b"1")
            os.waitpid(child, 0)
            for end in (*ready, *done):
                os.close(end)

    def test_other_fmus_and_environments_without_the_key_do_not_count(self, cache):
        free = [SeatedEnv() for _ in range(3)]
        assert not (cache / "licences").exists()
        take_one()
        other = fmugym.envs.CartPoleEnv()
        for env in (*free, other):
            env.close()

    def test_a_constructor_that_fails_returns_them(self):
        with pytest.raises(fmugym.FMUGymError):
            SeatedEnv(max_instances=1, model_parameters={"m": -1.0}, time_step=-1.0)
        take_one()

    def test_threads_never_get_more_than_there_are(self, tmp_path):
        seats, most, taken, lock = Seats("x.fmu", tmp_path / "key", 3), [0], [0], threading.Lock()

        def work():
            for _ in range(20):
                with contextlib.suppress(LicenceError), taking(seats, 2, "a test"):
                    with lock:
                        taken[0] += 2
                        most[0] = max(most[0], taken[0])
                    time.sleep(1e-3)
                    with lock:
                        taken[0] -= 2

        threads = [threading.Thread(target=work) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert most == [2]
        assert sorted(path.name for path in tmp_path.iterdir()) == ["key.lock"]

    def test_damaged_files_count_as_one_seat_while_they_are_locked(self, tmp_path):
        seats = Seats("x.fmu", tmp_path / "key", 2)
        claim = seats.take(1, "a test")
        (path,) = tmp_path.glob("key-*")
        assert json.loads(path.read_text())["process"] == os.getpid()
        path.write_text("{")
        with pytest.raises(LicenceError, match="in use: 1 by"):
            seats.take(2, "a test")
        claim.release()
        seats.take(2, "a test").release()

    def test_where_no_file_can_be_made(self, cache, tmp_path):
        cache.mkdir()
        (cache / "licences").mkdir()
        with pytest.raises(ConfigError, match=r"max_instances.*nowhere"):
            Seats("x.fmu", tmp_path / "nowhere" / "key", 2).take(1, "a test")

    def test_without_a_cache_they_are_in_the_folder_for_temporary_files(
        self, cache, tmp_path, monkeypatch
    ):
        cache.write_text("no folder")
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        with contextlib.closing(SeatedEnv(max_instances=1)), pytest.raises(LicenceError):
            take_one()
        assert list(tmp_path.glob("fmugym-*/licences/*-*")) == []


def spec_of(tmp_path, interval=0.05):
    return PoolSpec((), (), 0.1, initialization_interval=interval, locks=str(tmp_path / "key"))


class TestPace:
    """Moments are taken here without waiting for them."""

    @pytest.fixture(params=BACKENDS, autouse=True)
    def way(self, request, monkeypatch):
        monkeypatch.setattr(pacing, "has_native_pool", lambda: request.param == "native")

    def test_of_several_environments(self, tmp_path):
        pacers = [Pacer(spec_of(tmp_path, interval)) for interval in (100.0, 100.0, 50.0)]
        waits = [pacer._claim() for pacer in pacers for _ in range(2)]
        np.testing.assert_allclose(waits, [0.0, 100.0, 200.0, 300.0, 350.0, 400.0], atol=1.0)

    def test_begins_anew_with_the_machine(self, tmp_path):
        Pacer(spec_of(tmp_path, 1e6))._claim()
        assert Pacer(spec_of(tmp_path, 1e6))._claim() > 9e5
        times = pacing._opened(tmp_path / "key.pace")
        times[1] -= 3600
        assert Pacer(spec_of(tmp_path, 1e6))._claim() == 0.0

    def test_without_a_file(self):
        pacer = Pacer(PoolSpec((), (), 0.1, initialization_interval=100.0))
        assert pacer._claim() == 0.0
        assert pacer._claim() > 99.0


def test_pace_of_two_processes(program, monkeypatch):
    """Each has made and initialized an instance; the next call comes after them."""
    code = PROGRAM.replace("max_instances=int(sys.argv[1])", "max_initializations_per_second=0.01")
    monkeypatch.setitem(globals(), "PROGRAM", code)
    program(0)
    path = next(p for p in _licences().glob("*.pace"))
    now = time.monotonic_ns()
    (last,) = pacing._opened(path)[:1]
    assert 0 < last <= now
    spec = PoolSpec((), (), 0.1, initialization_interval=100.0, locks=str(path)[: -len(".pace")])
    assert Pacer(spec)._claim() > 50.0


def _licences():
    from pathlib import Path

    return Path(os.environ["FMUGYM_CACHE_DIR"]) / "licences"
