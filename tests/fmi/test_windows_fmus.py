"""FMUs that have only a library for Windows: in Wine they run as any other does.

That pools in Wine keep the contract of all pools is shown by test_pool.py.
"""

import logging
import shutil
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import exchange_tools
import numpy as np
import pytest
from fmu_tools import edited_fmu, read_fmu, write_fmu
from process_tools import FaultyEnv, faulty_fmu, start_values, wait_until
from vector_tools import require_same_alone
from ways import in_way
from wine_tools import exchange_fmu, for_windows

import fmugym
from fmugym import FMU, ConfigError, FMULoadError, FMUSystem, bundled_fmu
from fmugym.fmi import wine as windows_worker
from fmugym.fmi.wine import Wine, can_run_windows
from fmugym.pool import opening
from fmugym.pool.opening import PoolOptions
from fmugym.pool.pool_spec import PoolSpec
from fmugym.pool.processes.process_pool import ProcessPool

if sys.platform != "win32":
    import fcntl

LOG = logging.getLogger("fmugym.test")

pytestmark = pytest.mark.skipif(
    not can_run_windows(), reason="Windows libraries run in Wine on Linux on x86_64 only"
)


@pytest.fixture(name="cart_pole")
def fixture_cart_pole(tmp_path):
    return for_windows(bundled_fmu("CartPole"), tmp_path)


@pytest.fixture(name="bare")
def fixture_bare(monkeypatch, tmp_path):
    """A machine without Wine and ziglang."""
    monkeypatch.setenv("FMUGYM_WINE", "/nowhere/wine64")
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(windows_worker, "_compiler_version", lambda: "")


def open_pool(path, num_instances=1, inputs=("f",), outputs=("x", "theta"), **options):
    fmu = FMU(path)
    spec = PoolSpec(
        tuple(map(fmu.variable, inputs)), tuple(map(fmu.variable, outputs)), time_step=0.05
    )
    return opening.open_pool(fmu, spec, num_instances, LOG, PoolOptions(**options))


def is_locked(file):
    """Lock a file, if nobody else has."""
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


class TestWithoutWine:
    def test_obstacles_tell_what_to_install(self, cart_pole, bare):
        fmu = FMU(cart_pole)
        assert fmu.in_wine
        assert not fmu.runs_here
        (text,) = fmu.obstacles
        assert "apt install wine64" in text
        assert ".[windows]" in text

    def test_a_pool_is_refused_with_the_same_words(self, cart_pole, bare):
        with pytest.raises(FMULoadError, match=r"wine64.*\[windows\]"):
            open_pool(cart_pole)

    def test_info_says_how_to_get_there(self, cart_pole, bare, ran):
        out = ran("info", cart_pole)
        line, *_ = (r for r in out.splitlines() if "this machine" in r)
        assert "does NOT run here" in line
        assert "wine64" in line


class TestChoice:
    def test_a_library_for_this_system_is_preferred(self):
        assert not FMU(bundled_fmu("CartPole")).in_wine

    @pytest.mark.parametrize("version", ["1.0", "2.0", "3.0"])
    def test_of_the_library(self, tmp_path, version):
        fmu = FMU(for_windows(bundled_fmu("CartPole", version), tmp_path))
        folder = "x86_64-windows" if version == "3.0" else "win64"
        assert fmu.library == f"binaries/{folder}/CartPole.dll"
        assert (fmu.extract() / fmu.library).stat().st_size > 0
        fmu.close()

    def test_libraries_for_32_bits_are_refused(self, tmp_path):
        files = read_fmu(bundled_fmu("CartPole"))
        library = files.pop("binaries/win64/CartPole.dll")
        files = {n: c for n, c in files.items() if not n.startswith("binaries")}
        path = write_fmu(tmp_path / "Old.fmu", files | {"binaries/win32/CartPole.dll": library})
        (text,) = FMU(path).obstacles
        assert "32-bit Windows" in text

    @pytest.mark.parametrize("wish", [{"isolation": "none"}, {"private_libraries": True}])
    def test_what_is_impossible_in_wine_is_refused(self, cart_pole, wish):
        with pytest.raises(FMULoadError, match=next(iter(wish))):
            open_pool(cart_pole, **wish)

    def test_fmpy_does_not_step_it(self, cart_pole):
        with pytest.raises(ConfigError, match="libraries for Windows"):
            open_pool(cart_pole, backend="fmpy")

    def test_this_process_cannot_load_it(self, cart_pole):
        fmu = FMU(cart_pole)
        with pytest.raises(FMULoadError, match="Wine"):
            fmu.prepare_libraries()
        fmu.close()


class TestProgram:
    def test_its_sources_fit_the_native_pool(self, tmp_path):
        """Without Wine, too: what they use of the native pool is there."""
        for path in windows_worker.sources():
            if path.parent.name == "worker" and path.suffix == ".c":
                command = [
                    sys.executable,
                    "-m",
                    "ziglang",
                    "cc",
                    "-c",
                    *windows_worker._OPTIONS,
                    f"-I{path.parents[1]}",
                    path,
                ]
                done = subprocess.run(
                    [*command, "-o", "made.o"], cwd=tmp_path, capture_output=True, text=True
                )
                assert done.returncode == 0, done.stderr

    def test_its_sources_are_found(self):
        names = {path.name for path in windows_worker.sources()}
        assert {"main.c", "requests.c", "fmi1.c", "fmi2.c", "fmi3.c", "pool.h"} <= names

    def test_a_checkout_and_an_installed_package_share_it(self, monkeypatch, tmp_path):
        digests = set()
        for name in ("native", "native_sources"):
            folder = tmp_path / name
            (folder / "worker").mkdir(parents=True)
            files = folder / "pool.h", folder / "worker" / "main.c"
            for file in files:
                file.write_text(f"/* {file.name} */")
            monkeypatch.setattr(windows_worker, "sources", lambda files=files: files)
            digests.add(windows_worker.sources_digest.__wrapped__())
        assert len(digests) == 1

    def test_without_a_compiler_one_that_was_built_before_is_used(self, bare, tmp_path):
        assert windows_worker.known_program() is None
        built = windows_worker.wine_folder() / f"worker-{windows_worker.sources_digest()}-0.0.0.exe"
        built.touch()
        assert windows_worker.known_program() == built

    def test_a_build_is_announced_and_a_compiler_that_fails_quoted(
        self, monkeypatch, tmp_path, caplog
    ):
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path))
        broken = tmp_path / "broken.c"
        broken.write_text("#error nonsense\n")
        monkeypatch.setattr(windows_worker, "sources", lambda: (broken,))
        with pytest.raises(FMULoadError, match="nonsense"):
            windows_worker.worker_program()
        assert "takes some minutes" in caplog.text
        assert not list(tmp_path.glob("wine/*.exe"))


def test_a_system_whose_folder_is_gone_is_not_taken_for_one_in_wine():
    """Another thread may close it; the worker program, which takes minutes, is not built then."""
    paths = {name: bundled_fmu("Pendulum") for name in "ab"}
    system = FMU.of(FMUSystem(paths, []))
    shutil.rmtree(system.extract())
    assert [part.in_wine for part, _ in system.parts_in(system.extract())] == [False, False]


@pytest.fixture(name="faulty", scope="module")
def fixture_faulty(tmp_path_factory, wine):
    folder = tmp_path_factory.mktemp("faulty")
    return for_windows(faulty_fmu(folder), folder)


class ForcedCartPole(fmugym.FMI2CSEnv):
    """Pushes a cart with a pole that begins at a random angle."""

    def __init__(self, path):
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "theta", "theta_dot"],
            "model_parameters": {"theta_0": fmugym.Uniform(-0.1, 0.1)},
            "time_step": 0.05,
            "bounds": {"f": (-10, 10)},
        }
        super().__init__(path, config)

    def _is_done(self):
        return abs(self.state[0]) > 2.4


def _link(path, source, *needed):
    """Compile a library for Windows that needs others of its folder."""
    path.with_suffix(".c").write_text(source)
    command = [sys.executable, "-m", "ziglang", "cc", "-target", "x86_64-windows-gnu", "-shared"]
    command += [f"{path.stem}.c", *(f"{name}.lib" for name in needed), "-o", path.name]
    subprocess.run(command, check=True, cwd=path.parent)


@pytest.mark.usefixtures("wine")
class TestInWine:
    @pytest.mark.parametrize(
        ("fault", "cause"),
        [
            ("crash", "Windows error 0xc0000005"),
            ("exit", "exit status 0"),
            ("abort", "exit status"),
            ("hang", "took longer than call_timeout"),
        ],
    )
    def test_a_death_is_told_with_last_words(self, faulty, opened, fault, cause):
        timeout = 0.7 if fault == "hang" else 30.0
        env = opened(FaultyEnv(faulty, fault, call_timeout=timeout))
        env.reset(seed=0)
        env.step(env.action_space.sample())
        *_, truncated, info = env.step(env.action_space.sample())
        assert truncated
        assert cause in info["fault"]
        assert "the FMU said: [last words] this is fault" in info["fault"]

    def test_steps_in_a_row_do_not_put_workers_to_sleep(self, cart_pole, opened):
        """On two processors each sleep takes longer than the step."""
        pool = opened(open_pool(cart_pole, 2, workers=2))
        pool.reset((), np.zeros((0, 2)))
        files = [Path(f"/proc/{process}/status") for process in pool.processes()]

        def sleeps():
            lines = [line for file in files for line in file.read_text().splitlines()]
            return sum(int(r.split()[1]) for r in lines if r.startswith("voluntary"))

        before = sleeps()
        for _ in range(1000):
            pool.step_own()
        assert sleeps() - before < 1000

    def test_a_server_that_takes_long_to_end(self, cart_pole, opened):
        """Wine gives up after six seconds; then a worker is started again."""
        folder = Wine.ready().prefix / "temporary"
        opened(open_pool(cart_pole)).close()  # there is a server now
        locks = list(folder.glob("wine-*/server-*/lock"))
        if not locks:
            pytest.skip("this Wine keeps its servers elsewhere")
        with locks[0].open("r+b") as lock:
            wait_until(lambda: is_locked(lock))  # the server has ended
            release = threading.Timer(7.0, fcntl.lockf, (lock, fcntl.LOCK_UN))
            release.start()
            pool = opened(open_pool(cart_pole))
            release.join()
        _, statuses = pool.reset((), np.zeros((0, 1)))
        assert not statuses.any()

    def test_an_environment_gives_the_native_results(self, cart_pole, opened):
        """The libraries differ in their sine and cosine by rounding."""
        ours = opened(ForcedCartPole(cart_pole))
        native = opened(ForcedCartPole(bundled_fmu("CartPole")))
        for env in (ours, native):
            env.action_space.seed(1)
        starts = [env.reset(seed=3)[0] for env in (ours, native)]
        np.testing.assert_array_equal(*starts)
        for _ in range(20):
            rows = [env.step(env.action_space.sample())[0] for env in (ours, native)]
            np.testing.assert_allclose(*rows, rtol=1e-6, atol=1e-9)

    def test_a_vector_environment(self, cart_pole):
        require_same_alone(partial(ForcedCartPole, cart_pole), 10, workers=2)

    def test_rollouts_go_on_from_a_single_environment(self, cart_pole, opened):
        """Its hooks are called in Python; those of a vector are compiled."""
        single = opened(ForcedCartPole(cart_pole))
        envs = opened(fmugym.FMUVectorEnv(partial(ForcedCartPole, cart_pole), 3, workers=2))
        single.reset(seed=4)
        for _ in range(10):
            single.step(np.full(1, -1.0, np.float32))
        rolled = envs.rollout(single.save_state(), np.full((3, 5, 1), 2.0, np.float32))
        for step in range(5):
            row = single.step(np.full(1, 2.0, np.float32))[0]
            np.testing.assert_array_equal(rolled.observations[1, step], row)

    def test_missing_libraries_are_named(self, tmp_path):
        """The FMU's library needs one that lies beside it, which needs one that nobody has."""
        folder = tmp_path / "binaries/win64"
        folder.mkdir(parents=True)
        _link(folder / "Absent.dll", "double absent(void) { return 1.0; }")
        beside = "double absent(void); double beside(void) { return absent(); }"
        _link(folder / "Beside.dll", beside, "Absent")
        top = "double beside(void); double top(void) { return beside(); }"
        _link(folder / "CartPole.dll", top, "Beside")
        names = ("CartPole.dll", "Beside.dll")
        kept = {f"binaries/win64/{name}": (folder / name).read_bytes() for name in names}
        files = read_fmu(bundled_fmu("CartPole"))
        files = {n: c for n, c in files.items() if not n.startswith("binaries/")} | kept
        path = write_fmu(tmp_path / "Needy.fmu", files)
        with pytest.raises(FMULoadError, match=r"libraries that are missing: Absent\.dll$"):
            open_pool(path)

    def test_compiled_hooks_tell_of_a_death(self, faulty, opened):
        envs = opened(
            fmugym.FMUVectorEnv(
                in_way("arrays", lambda: FaultyEnv(faulty, "crash", call_timeout=30.0)), 2
            )
        )
        envs.reset(seed=0)
        envs.step(np.ones((2, 1), np.float32))
        *_, truncated, infos = envs.step(np.ones((2, 1), np.float32))
        assert truncated.tolist() == [True, True]
        assert "Windows error 0xc0000005" in infos["fault"][0]
        observations, *_ = envs.step(np.ones((2, 1), np.float32))
        assert observations.ravel().tolist() == [0.0, 0.0]

    def test_the_trial_runs_there_too(self, cart_pole, opened, monkeypatch, caplog):
        monkeypatch.setenv("FMUGYM_PROBE", "on")
        with caplog.at_level(logging.INFO, "fmugym"):
            env = opened(fmugym.FMUVectorEnv(lambda: ForcedCartPole(cart_pole), 2))
        assert isinstance(env.pool, ProcessPool)
        (line,) = (r.getMessage() for r in caplog.records if "was tried with 2" in r.getMessage())
        assert " 0 initialization" not in line

    def test_a_system(self, tmp_path, opened):
        """Its components run in one process, as they do outside of Wine."""
        files = [exchange_fmu(tmp_path / "Model.fmu", "dahlquist", 2), bundled_fmu("Pendulum")]
        windows = [files[0], for_windows(files[1], tmp_path)]
        rows = []
        for decay, pendulum in (
            windows,
            [exchange_tools.exchange_fmu(tmp_path / "Here.fmu", "dahlquist"), files[1]],
        ):
            both = FMUSystem({"decay": decay, "pendulum": pendulum}, ["decay.x -> pendulum.tau"])
            fmu = both.as_fmu()
            spec = PoolSpec((), (fmu.variable("decay.x"), fmu.variable("pendulum.theta")), 0.05)
            pool = opened(opening.open_pool(fmu, spec, 3, LOG))
            pool.reset((fmu.variable("decay.k"),), np.array([[0.5, 1.0, 2.0]]))
            for _ in range(20):
                outputs, statuses = pool.step()
                assert not statuses.any(), pool.failure(0)
            rows.append(outputs.copy())
        np.testing.assert_allclose(rows[0], rows[1], rtol=1e-6, atol=1e-9)
        assert abs(rows[0][0, 1] - np.exp(-1.0)) < 1e-5

    def test_rollouts_are_steps(self, cart_pole, opened):
        """To the last bit."""
        envs = opened(fmugym.FMUVectorEnv(partial(ForcedCartPole, cart_pole), 3, workers=2))
        envs.reset(seed=4)
        actions = np.full((3, 5, 1), 2.0, np.float32)
        rolled = envs.rollout(None, actions)
        for step in range(5):
            rows = envs.step(actions[:, step])[0]
            np.testing.assert_array_equal(rolled.observations[:, step], rows)

    def test_a_worker_whose_fmu_leaks_is_replaced(self, faulty, opened):
        fmu = FMU(faulty)
        variables = tuple(map(fmu.variable, start_values()))
        values = np.array([list(start_values("leak", "reset").values())], float).T
        spec = PoolSpec((fmu.variable("u"),), (fmu.variable("y"),), 0.1, leak_limit=2**20)
        pool = opened(opening.open_pool(fmu, spec, 1, LOG))
        processes = set()
        for _ in range(30):
            pool.reset(variables, values)
            assert not pool.statuses.any()
            processes.add(pool.processes()[0])
        assert 1 < len(processes) < 10

    def test_info_says_that_it_runs_in_wine(self, cart_pole, ran):
        assert "win64: runs here, in Wine" in ran("info", cart_pole)

    def test_a_path_with_blanks_and_umlauts(self, tmp_path, opened):
        folder = tmp_path / "a folder, ü"
        folder.mkdir()
        pool = opened(open_pool(for_windows(edited_fmu("CartPole", folder), folder)))
        pool.reset((), np.zeros((0, 1)))
        assert not pool.statuses.any()
