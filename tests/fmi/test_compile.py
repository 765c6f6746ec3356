"""``fmugym info --repair``: FMUs with source code."""

import json
import logging
from contextlib import closing
from functools import partial

import exchange_tools
import fmpy
import fmu_tools
import numpy as np
import pytest
from combinations import in_turn
from source_tools import BOTH, build_description, write_source_fmu

from fmugym import FMU, FMULoadError
from fmugym.fmi.source_compiler import compile_fmu
from fmugym.pool import PoolSpec, opening


@pytest.fixture
def source_fmu(tmp_path):
    """Make an FMU without a library."""
    return partial(write_source_fmu, tmp_path / "with sources.fmu")


def simulated(path, interface):
    fmu = FMU(path, interface=interface, probe_timeout=None)
    spec = PoolSpec((fmu.variable("u"),), (fmu.variable("x"),), time_step=0.1)
    with closing(opening.open_pool(fmu, spec, 2, logging.getLogger("fmugym.test"))) as pool:
        pool.reset((), np.zeros((0, 2)))
        return [pool.step(np.array([[u, -u]]))[0].copy() for u in (0.0, 1.0, 2.0)]


class TestCompile:
    @in_turn({"version": [2, 3], "interface": ["co_simulation", "model_exchange"]})
    def test_the_library_computes_the_same(self, tmp_path, source_fmu, version, interface):
        made = compile_fmu(source_fmu(version))
        assert made.parent == tmp_path
        built = exchange_tools.exchange_fmu(tmp_path / "b.fmu", "dahlquist", version, BOTH)
        np.testing.assert_allclose(
            simulated(made, interface), simulated(built, interface), rtol=1e-15
        )
        assert fmu_tools.read_fmu(made).keys() > fmu_tools.read_fmu(source_fmu(version)).keys()

    def test_the_command(self, source_fmu, refused, ran):
        path = source_fmu(3)
        made = json.loads(ran("info", "--repair", path, "--json"))["output"]
        assert fmpy.platform_tuple in made
        assert "exists" in refused("info", "--repair", path)


class TestRefusals:
    def test_the_error_of_such_an_fmu_names_the_command(self, source_fmu):
        with closing(FMU(source_fmu(3))) as fmu, pytest.raises(FMULoadError) as caught:
            fmu.extract()
        assert "fmugym info --repair 'with sources.fmu'" in str(caught.value)

    def test_no_source_code(self, tmp_path):
        path = exchange_tools.exchange_fmu(tmp_path / "b.fmu", "dahlquist", 2)
        with pytest.raises(FMULoadError, match="no source code"):
            compile_fmu(path)

    def test_source_code_without_a_list(self, tmp_path, source_fmu):
        empty = b'<fmiBuildDescription fmiVersion="3.0"/>'
        path = source_fmu(3, {"sources/buildDescription.xml": empty})
        with pytest.raises(FMULoadError, match="no list"):
            compile_fmu(path)

    @pytest.mark.parametrize("name", ["../other.c", "/etc/passwd", "code/missing.c", ""])
    def test_files_elsewhere(self, source_fmu, name):
        text = build_description().replace("code/usual.c", name)
        path = source_fmu(3, {"sources/buildDescription.xml": text.encode()})
        with pytest.raises(FMULoadError, match="source"):
            compile_fmu(path)

    def test_broken_code(self, tmp_path, source_fmu):
        path = source_fmu(3, {"sources/code/usual.c": b"int wrong = nowhere;\n"})
        with pytest.raises(FMULoadError, match="nowhere"):
            compile_fmu(path)
        assert not list(tmp_path.glob("*_*.fmu"))

    def test_no_compiler(self, source_fmu, monkeypatch):
        monkeypatch.setenv("CC", "no-such-compiler")
        with pytest.raises(FMULoadError, match=r"CMake Error .*no-such-compiler"):
            compile_fmu(source_fmu(3))

    def test_several_sets_of_files(self, source_fmu):
        text = build_description().replace("</SourceFileSet>", "</SourceFileSet><SourceFileSet/>")
        with pytest.raises(FMULoadError, match="2 sets of source files"):
            compile_fmu(source_fmu(3, {"sources/buildDescription.xml": text.encode()}))

    def test_not_xml(self, source_fmu):
        path = source_fmu(3, {"sources/buildDescription.xml": b"<a><b></a>"})
        with pytest.raises(FMULoadError, match="buildDescription"):
            compile_fmu(path)
