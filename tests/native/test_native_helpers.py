"""How the native pool's work is divided among helper threads: shown by counters, not by times."""

import json
import subprocess
import sys

import numpy as np
import pytest
from process_tools import run_python
from test_native_pool import NativePool, busy_fmu, make, on_linux

from fmugym.pool.machine_limits import (
    available_memory,
    available_processors,
    processor_quota,
    used_memory,
)

COUNT = """
import json, sys, time
import numpy as np
from fmugym import _native
from test_native_pool import NativePool, make

def count(threads, n, work, rest, rounds):
    pool = make(NativePool, sys.argv[1], ["work"], ["steps"], n, threads=threads)
    pool.reset((), np.zeros((0, n)))
    inputs = np.full((1, n), float(work))
    for _ in range(20):  # until the cost is known, and all helpers are there
        pool.step(inputs)
    before = _native.statistics()
    for _ in range(rounds):
        time.sleep(rest / 1e3)  # helpers go to sleep
        pool.step(inputs)
    after = _native.statistics()
    pool.close()
    return {name: after[name] - before[name] for name in after}

print(json.dumps([count(*job) for job in json.loads(sys.argv[2])]))
"""
JOBS = {
    "for one thread": (64, 2, 1),
    "short": (64, 20, 1),
    "of two": (2, 2, 200),
    "of many": (4, 400, 5),
    "long": (3, 100, 20),
    "lasting": (2, 2, 3000),
}
"""The number of threads, that of instances, and the work of each in us."""


def count(folder, jobs, rest=2, rounds=50, program=COUNT):
    """Count what helpers do in rounds of steps: in a process of its own, where no other pools are.

    Args:
        folder: Where to put the FMU.
        jobs: As in ``JOBS``.
        rest: Between two rounds, in ms.
        rounds: How many there are.
        program: The text of the Python program.
    """
    jobs = [(*job, rest, rounds) for job in jobs]
    done = run_python("-c", program, busy_fmu(folder), json.dumps(jobs))
    assert done.returncode == 0, done.stderr
    return [counted | {"rounds": rounds} for counted in json.loads(done.stdout)]


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    """What helpers do in each of the jobs."""
    counts = count(tmp_path_factory.mktemp("busy"), JOBS.values())
    return dict(zip(JOBS, counts, strict=True))


def test_work_for_one_thread_is_no_job(counted):
    assert counted["for one thread"]["jobs"] == 0


def test_a_short_job_wakes_few_of_many_helpers(counted):
    """Work of some 20 us is for two or three threads, whatever the number of threads is."""
    short = counted["short"]
    assert 0 < short["wakes"] <= 8 * short["rounds"]


@pytest.mark.parametrize("job", ["short", "of two", "of many"])
def test_the_caller_does_its_first_chunk_before_it_wakes_any_helper(counted, job):
    """But for rare rounds of a busy machine, where a helper has not gone to sleep before them.

    Such a helper finds the work by itself, and wakes others.
    """
    assert counted[job]["wakes"] > 0
    assert counted[job]["early_wakes"] <= counted[job]["rounds"] / 5


def test_the_caller_wakes_a_helper_first_where_an_instance_takes_milliseconds(counted):
    """Or else two of them would be stepped one after the other."""
    lasting = counted["lasting"]
    assert lasting["early_wakes"] >= 0.8 * lasting["rounds"]


def test_a_long_job_wakes_no_more_helpers_than_there_are(counted):
    """A helper of the job before the first may still wake another."""
    long = counted["long"]
    assert 0 < long["wakes"] <= 2 * (long["rounds"] + 1)


@on_linux
def test_a_busy_machine_does_not_shrink_chunks(tmp_path):
    """Samples of the cost that other work has made too high do not count."""
    options = {"jobs": [(2, 400, 1)], "rest": 0, "rounds": 100}
    (quiet,) = count(tmp_path, **options)
    crowd = "import subprocess, sys, time\n"
    crowd += "[subprocess.Popen([sys.executable, '-c', 'import time\\nend = time.time() + 8\\n"
    crowd += "while time.time() < end: pass']) for _ in range(4)]\n"
    (loaded,) = count(tmp_path, program=crowd + COUNT, **options)
    assert loaded["chunks"] < 3 * quiet["chunks"]
    assert loaded["chunks"] < 400 * loaded["jobs"] / 4


def test_results_do_not_depend_on_where_ranges_begin(tmp_path):
    """Ranges begin at whole lines of the cache where there are many instances."""
    path = busy_fmu(tmp_path)
    for n in (2, 15, 17, 127, 128, 129, 1000, 1025):
        pool = make(NativePool, path, ["work"], ["steps"], n, threads=4)
        pool.reset((), np.zeros((0, n)))
        for number in range(1, 6):
            pool.step(np.full((1, n), 30.0 if n < 200 else 1.0))
            assert (pool.outputs == number).all()
        pool.close()


class TestQuota:
    def write(self, root, files):
        for name, text in files.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return root

    @pytest.mark.parametrize(
        ("files", "expected"),
        [
            ({}, np.inf),
            ({"proc/self/cgroup": "0::/\n"}, np.inf),
            (
                {"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "150000 100000\n"},
                1.5,
            ),
            ({"proc/self/cgroup": "0::/a/b\n", "sys/fs/cgroup/a/cpu.max": "200000 100000"}, 2.0),
            (
                {
                    "proc/self/cgroup": "0::/a/b\n",
                    "sys/fs/cgroup/a/b/cpu.max": "max 100000",
                    "sys/fs/cgroup/a/cpu.max": "50000 100000",
                },
                0.5,
            ),
            (
                {
                    "proc/self/cgroup": "12:memory:/x\n5:cpu,cpuacct:/docker/1\n",
                    "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us": "300000",
                    "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us": "100000",
                },
                3.0,
            ),
            (
                {
                    "proc/self/cgroup": "5:cpu:/\n",
                    "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1",
                    "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000",
                },
                np.inf,
            ),
            ({"proc/self/cgroup": "0::/../..\n", "sys/fs/cgroup/cpu.max": "1 0"}, np.inf),
            ({"proc/self/cgroup": "nonsense\n\n:::", "sys/fs/cgroup/cpu.max": "a b c"}, np.inf),
        ],
    )
    def test_of_control_groups(self, tmp_path, monkeypatch, files, expected):
        monkeypatch.setattr("fmugym.pool.machine_limits._ROOT", self.write(tmp_path, files))
        assert processor_quota() == expected

    @pytest.mark.parametrize(
        ("files", "expected"),
        [
            ({}, np.inf),
            ({"proc/meminfo": "MemTotal:  9 kB\nMemAvailable:     4 kB\n"}, 4096.0),
            (
                {
                    "proc/meminfo": "MemAvailable:     4 kB\n",
                    "proc/self/cgroup": "0::/a/b\n",
                    "sys/fs/cgroup/a/memory.max": "1000\n",
                    "sys/fs/cgroup/a/memory.current": "300\n",
                    "sys/fs/cgroup/a/b/memory.max": "max\n",
                    "sys/fs/cgroup/a/b/memory.current": "300\n",
                },
                700.0,
            ),
            (
                {
                    "proc/self/cgroup": "5:cpu:/\n6:memory:/x\n",
                    "sys/fs/cgroup/memory/memory.limit_in_bytes": "100",
                    "sys/fs/cgroup/memory/memory.usage_in_bytes": "130",
                },
                0.0,
            ),
        ],
    )
    def test_memory(self, tmp_path, monkeypatch, files, expected):
        monkeypatch.setattr("fmugym.pool.machine_limits._ROOT", self.write(tmp_path, files))
        assert available_memory() == expected

    @pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
    def test_used_memory_counts_processes_that_were_started(self):
        size = 50 * 2**20
        code = f"import sys; a = b'x' * {size}; print(); sys.stdin.read()"
        before = used_memory()
        with subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as child:
            child.stdout.readline()
            during = used_memory()
            child.communicate()
        assert size < during - before < 3 * size

    @pytest.mark.parametrize(("quota", "expected"), [(np.inf, 8), (3.0, 3), (1.5, 2), (0.1, 1)])
    def test_counts_as_processors_do(self, monkeypatch, quota, expected):
        name = "fmugym.pool.machine_limits."
        monkeypatch.setattr(name + "processor_quota", lambda: quota)
        monkeypatch.setattr(name + "os.sched_getaffinity", lambda _: set(range(8)), raising=False)
        assert available_processors() == expected
