"""Components of a system for Windows, in Wine: what they compute, and how they die."""

import contextlib

import building
import fmu_tools
import numpy as np
import pytest
import ssp_tools
import wine_tools
from apart_tools import (  # noqa: F401  # some are fixtures
    MASSES,
    NAMES,
    Chain,
    asking_for,
    chain,
    closing_pools,
    compiled,
    episodes,
    play,
    reset,
    where_they_run,
    with_fault,
)
from process_tools import fixture_faulty  # noqa: F401  # the fixture "faulty"
from system_tools import masses, system

import fmugym
from fmugym import (
    FMULoadError,
    bundled_fmu,
)
from fmugym.systems.fmu import SystemFMU
from fmugym.systems.plan import Component as Planned
from fmugym.tools import cli

pytestmark = where_they_run


@pytest.mark.usefixtures("wine")
class TestInWine:
    def test_linear_equations_are_equal_to_the_last_bit(self, make, fmus, tmp_path):
        """The same source, compiled for Windows."""
        path = linear_for_windows(fmus[2], tmp_path)
        plan = masses([fmus[2], fmus[3]])
        rows = play(make(plan, MASSES))
        mixed = masses([path, fmus[3]])
        assert SystemFMU(mixed).whereabouts_by_name == {"first": "wine", "second": "here"}
        assert play(make(mixed, MASSES)).tobytes() == rows.tobytes()

    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_model_exchange(self, make, tmp_path, version):
        """x' = -k x from 1: the closed form."""
        path = wine_tools.exchange_fmu(tmp_path / "Model.fmu", "dahlquist", version)
        pool = make(system([Planned("d", path)], ()), ["d.x"], tolerance=1e-8)
        assert not reset(pool, ["d.k"], [[1.0, 2.0]]).any(), pool.failure(0)
        for _ in range(10):
            assert not pool.step()[1].any()
        np.testing.assert_allclose(pool.outputs[0], np.exp([-1.0, -2.0]), rtol=1e-6)

    def test_a_pendulum_beside_a_native_one(self, tmp_path):
        """The libraries differ in their sine and cosine by rounding."""
        windows = wine_tools.for_windows(bundled_fmu("Pendulum"), tmp_path)
        results = []
        for source in map(chain, (bundled_fmu("Pendulum"), windows)):
            env = fmugym.FMUVectorEnv(lambda s=source: Chain(s), 2)
            with contextlib.closing(env):
                results.append(episodes(env))
        np.testing.assert_allclose(*results, rtol=1e-6, atol=1e-9)

    @pytest.mark.parametrize(
        ("fault", "cause"), [("crash", "Windows error 0xc0000005"), ("hang", "call_timeout")]
    )
    def test_a_death_is_told_with_last_words(self, make, fmus, faulty, tmp_path, fault, cause):
        path = wine_tools.for_windows(faulty, tmp_path)
        plan = with_fault(fmus, path, isolate=False)
        timeout = 2.0 if fault == "hang" else 60.0
        pool = make(plan, ["bad.y"], 2, time_step=0.5, call_timeout=timeout)
        assert not reset(pool, NAMES, asking_for(fault, "none")).any()
        pool.step()
        assert pool.step()[1].tolist() == [4, 0]
        for text in ("component 'bad'", cause, "this is fault"):
            assert text in pool.failure(0)
        assert not reset(pool, NAMES, asking_for("none", "none")).any()

    def test_preload_is_refused_by_name(self, tmp_path):
        windows = wine_tools.for_windows(bundled_fmu("Pendulum"), tmp_path)
        first = fmugym.FMU(windows, preload=["libm.so.6"])
        with pytest.raises(FMULoadError, match=r"component 'a'.*libm"):
            Chain(chain(first))

    def test_info_says_so(self, tmp_path, capsys):
        windows = wine_tools.for_windows(bundled_fmu("Pendulum"), tmp_path)
        archive = ssp_tools.write(chain(windows), tmp_path / "chain.ssp")
        assert cli.main(["info", str(archive)]) == 0
        assert "in Wine" in capsys.readouterr().out


def linear_for_windows(path, folder):
    """Copy the FMU of linear equations, of FMI 2.0, with a library for Windows only."""
    shim = "zoo/fmi2.c"
    library = wine_tools.windows_library(
        *("zoo/linear.c", "zoo/usual.c", shim),
        flags=("-DFMI_VERSION=2",),
        stubs=fmu_tools.stubs(2, "fmi2", building.HERE / shim),
    )
    description = fmu_tools.read_fmu(path)["modelDescription.xml"]
    files = {"modelDescription.xml": description, "binaries/win64/Zoo.dll": library}
    return fmu_tools.write_fmu(folder / "linear.fmu", files)
