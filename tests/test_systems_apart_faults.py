"""Components of a system in processes of their own: what happens when one of these dies."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from apart_tools import (  # noqa: F401  # some are fixtures
    LOG,
    MASSES,
    NAMES,
    apart,
    asking_for,
    children,
    closing_pools,
    compiled,
    is_running,
    play,
    reset,
    where_they_run,
    with_fault,
)
from process_tools import fixture_faulty  # noqa: F401  # the fixture "faulty"
from system_tools import masses

from fmugym import (
    FMULoadError,
    SimulationError,
)
from fmugym.pool import PoolSpec
from fmugym.pool.local import local_pool
from fmugym.systems.fmu import SystemFMU

pytestmark = where_they_run

on_linux = pytest.mark.skipif(not Path("/proc/self").exists(), reason="/proc lists processes")


class TestFaults:
    OUTPUTS = ("bad.y", "sound.y1")

    @pytest.mark.parametrize(
        ("fault", "cause"),
        [
            ("crash", "signal SIGSEGV"),
            ("abort", "signal SIGABRT"),
            ("exit", "exit status 0"),
            ("hang", "call_timeout"),
        ],
    )
    def test_one_ends_the_systems_of_its_worker(self, make, fmus, faulty, fault, cause):
        timeout = 1.0 if fault == "hang" else 60.0
        plan = with_fault(fmus, faulty)
        pool = make(plan, self.OUTPUTS, 4, time_step=0.5, call_timeout=timeout)
        assert not reset(pool, NAMES, asking_for(fault, "none", "none", "none")).any()
        pool.step()
        before = pool.outputs.copy()
        _, statuses = pool.step()
        assert statuses.tolist() == [4, 4, 0, 0]
        assert pool.outputs[:, :2].tobytes() == before[:, :2].tobytes()
        for text in ("component 'bad'", cause, "this is fault"):
            assert text in pool.failure(0)
        assert cause in pool.failure(1)
        assert "this is fault" not in pool.failure(1)
        mask = np.array([True, True, False, False])
        pool.reset(tuple(map(pool.variable, NAMES)), asking_for(*["none"] * 4), mask)
        assert not pool.step()[1].any()
        assert pool.outputs[0, 0] == pool.outputs[0, 1] == before[0, 0]

    def test_a_crash_in_an_initialization_harms_no_other_system(self, make, fmus, faulty):
        pool = make(with_fault(fmus, faulty), self.OUTPUTS, 3, time_step=0.5, threads=1)
        statuses = reset(pool, NAMES, asking_for("crash", "none", "none", stage="initialize"))
        assert statuses.tolist() == [4, 0, 0]
        assert "signal SIGSEGV" in pool.failure(0)
        assert not pool.step()[1][1:].any()

    def test_a_reset_without_the_fault_begins_anew(self, make, fmus, faulty):
        """The others of its worker get a new worker, too, and begin where they should."""
        pool = make(with_fault(fmus, faulty), self.OUTPUTS, 2, time_step=0.5, threads=1)
        reset(pool, NAMES, asking_for("none", "none"))
        expected = [pool.step()[0].copy() for _ in range(3)]
        reset(pool, NAMES, asking_for("crash", "none"))
        for _ in range(2):
            pool.step()
        assert not reset(pool, NAMES, asking_for("none", "none")).any()
        for row in expected:
            assert pool.step()[0].tobytes() == row.tobytes()

    def test_it_is_given_up_after_five_deaths_in_a_row(self, make, fmus, faulty):
        pool = make(with_fault(fmus, faulty), self.OUTPUTS, 1, time_step=0.5)
        for _ in range(5):
            assert reset(pool, NAMES, asking_for("crash", stage="initialize")).all()
        assert reset(pool, NAMES, asking_for("none")).all()
        assert "5 deaths in a row" in pool.failure(0)

    @on_linux
    def test_a_snapshot_is_lost_with_its_process(self, make, fmus):
        pool = make(apart(masses([fmus[2], fmus[2]]), "first"), MASSES, 1)
        play(pool, 2)
        snapshot = pool.save()
        (worker,) = set(children()) - self.others
        os.kill(worker, signal.SIGKILL)
        assert pool.step()[1].tolist() == [4]
        assert "signal SIGKILL" in pool.failure(0)
        play(pool, 2)
        with pytest.raises(SimulationError, match="another instance"):
            pool.restore(snapshot)

    @on_linux
    def test_a_library_that_is_gone_for_a_while(self, fmus, tmp_path):
        fmu = SystemFMU(apart(masses([fmus[2], fmus[2]]), "first"))
        spec = PoolSpec((), (fmu.variable("first.y1"),), 0.1)
        pool = local_pool(fmu, spec, 1, LOG)
        pool.variable = fmu.variable
        with contextlib.closing(pool):
            rows = play(pool, 3)
            library = fmu.parts[0].extract() / fmu.parts[0].library
            library.rename(tmp_path / "away")
            (worker,) = set(children()) - self.others
            os.kill(worker, signal.SIGKILL)
            assert pool.step()[1].tolist() == [4]
            assert pool.reset((), np.zeros((0, 1)))[1].tolist() == [4]
            assert library.name in pool.failure(0)
            (tmp_path / "away").rename(library)
            assert play(pool, 3).tobytes() == rows.tobytes()

    @pytest.fixture(autouse=True)
    def note_others(self):
        self.others = set(children()) if Path("/proc/self").exists() else set()

    @on_linux
    def test_workers_end_with_their_pool(self, make, fmus):
        pool = make(apart(masses([fmus[2], fmus[2]]), "first"), MASSES, 4, threads=2)
        play(pool, 2)
        assert len(set(children()) - self.others) == 2
        pool.close()
        assert not set(children()) - self.others

    @on_linux
    @pytest.mark.parametrize("stage", ["nowhere", "step"])
    def test_workers_end_with_a_process_that_is_killed(self, fmus, faulty, stage):
        """Also if the FMU hangs."""
        script = f"""
            import numpy as np
            from apart_tools import *
            plan = with_fault({dict(fmus)!r}, {str(faulty)!r})
            fmu = SystemFMU(plan)
            spec = PoolSpec((), (fmu.variable("bad.y"),), 0.5)
            pool = local_pool(fmu, spec, 1, LOG)
            names = tuple(map(fmu.variable, NAMES))
            pool.reset(names, asking_for("hang", stage={stage!r}))
            print(*children(), flush=True)
            for _ in range(10**9):
                pool.step()
        """
        script = textwrap.dedent(script).replace("PosixPath", "Path")
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
        with subprocess.Popen(
            [sys.executable, "-c", script], stdout=subprocess.PIPE, env=environment
        ) as parent:
            worker = int(parent.stdout.readline())
            time.sleep(0.3)
            parent.kill()
        deadline = time.monotonic() + 20
        while is_running(worker):
            assert time.monotonic() < deadline
            time.sleep(0.05)

    @on_linux
    @pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
    def test_a_fork_gets_workers_of_its_own(self, make, fmus):
        pool = make(apart(masses([fmus[2], fmus[2]]), "first"), MASSES, 1)
        rows = play(pool, 5)
        child = os.fork()
        if child == 0:
            try:
                lost = pool.step()[1].tolist() == [4] and "forked" in pool.failure(0)
                os._exit(0 if lost and play(pool, 5).tobytes() == rows.tobytes() else 1)
            finally:
                os._exit(2)
        assert os.waitpid(child, 0)[1] == 0
        assert not pool.step()[1].any()

    def test_a_library_that_cannot_be_loaded(self, fmus):
        from fmugym import _native

        fmu = SystemFMU(apart(masses([fmus[2], fmus[2]]), "second"))
        part = fmu.parts[1]
        shutil.copy(_native.__file__, part.extract() / part.library)
        with pytest.raises(FMULoadError, match="'second': it does not export fmi2"):
            local_pool(fmu, PoolSpec((), (), 0.1), 1, LOG)
