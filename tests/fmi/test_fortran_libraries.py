"""FMUs of old tools need a libgfortran that no distribution has; a stand-in serves them."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib

import pytest
from combinations import in_turn
from fmu_tools import HERE, edited_fmu, library_name
from process_tools import run_python

from fmugym import FMU, ConfigError, Task, extras
from fmugym.fmi import fortran_libraries
from fmugym.fmi.library_dependencies import ask_in_a_child, missing_libraries
from fmugym.fmi.system_loader import ask

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="libraries of Linux")
DOCUMENT = HERE.parent / "docs" / "foreign-fmus.md"
ZIG = [sys.executable, "-m", "ziglang", "cc", "-shared", "-fPIC", "-O1", "-g0", "-w"]
SYMBOLS = sorted(set(re.findall(r"_gfortran_\w+", (HERE / "sources/old_fortran.c").read_text())))
OLD = {"_gfortran_pow_i4_i4": "GFORTRAN_1.4"}


def old_library(folder, name, first, versioned=True):
    """Compile a library with the name, symbols and versions of an old libgfortran, and no more."""
    (folder / "empty.c").write_text("".join(f"void {name}(void) {{}}\n" for name in SYMBOLS))
    versions = {symbol: OLD.get(symbol, first) for symbol in SYMBOLS}
    nodes = "".join(
        f"{v} {{ global: {' '.join(s + ';' for s in SYMBOLS if versions[s] == v)} }};\n"
        for v in sorted({*versions.values()})
    )
    (folder / "versions").write_text(nodes)
    script = ["-Wl,--version-script=versions"] if versioned else []
    command = [*ZIG, "empty.c", "-o", name, f"-Wl,-soname,{name}", *script]
    subprocess.run(command, cwd=folder, check=True)


@pytest.fixture(scope="module", params=["libgfortran.so.4"])
def fmu_path(request, probe, tmp_path_factory):
    """The probe, with a library that needs an old libgfortran as it is loaded."""
    folder = tmp_path_factory.mktemp("old")
    name = "libgfortran.so.4" if request.param == "unversioned" else request.param
    old_library(folder, name, fortran_libraries.LIBRARIES[name], request.param != "unversioned")
    sources = ["-DFMI_VERSION=2", HERE / "sources/probe.c", HERE / "sources/old_fortran.c"]
    subprocess.run([*ZIG, *sources, name, "-lm", "-o", "Probe.so"], cwd=folder, check=True)
    add = {library_name(2): (folder / "Probe.so").read_bytes()}
    return edited_fmu(probe(), folder, add=add)


def play(fmu_path, environment=(), **config):
    """Play some steps in a process of its own, after a trial; returns what came of it."""
    script = f"""
import fmugym
from fmu_tools import PlainEnv, probe_config
try:
    config = probe_config(**{config!r})
    env = PlainEnv({str(fmu_path)!r}, config)
    for _ in range(2):
        env.reset()
        observations = [env.step([1.0])[0].tolist() for _ in range(3)]
    print(observations[-1])
    env.close()
except fmugym.FMULoadError as error:
    print(error)
"""
    variables = {"FMUGYM_PROBE": "on", **dict(environment)}
    done = run_python("-W", "error", "-c", script, environment=variables)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().splitlines()[-1]


STEPPED = "[0.30000001192092896, 1.0]"


@pytest.fixture
def compiler(request, monkeypatch, tmp_path):
    """Build with the system's compiler, and without one with that of a package."""
    if request.param == "ziglang":
        monkeypatch.setenv("PATH", str(tmp_path))
    elif not any(map(shutil.which, ("cc", "gcc", "clang"))):
        pytest.skip("there is no system compiler")
    return request.param


@in_turn(
    {
        "fmu_path": ["libgfortran.so.3", "libgfortran.so.4", "unversioned"],
        "compiler": ["cc", "ziglang"],
    },
    indirect=["fmu_path", "compiler"],
)
def test_an_fmu_that_needs_an_old_libgfortran_runs(fmu_path, compiler, tmp_path, ran):
    (name,) = fortran_libraries.replaceable(FMU(fmu_path))
    assert f"not found here: {name} (no current" in play(fmu_path)
    (command,) = re.findall(
        r"^fmugym (info --repair model.fmu .* lib)$", DOCUMENT.read_text(), re.MULTILINE
    )
    replaced = {"model.fmu": str(fmu_path), "lib": str(tmp_path)}
    said = ran(*[replaced.get(word, word) for word in command.split()])
    assert "without _gfortran_matmul_r8" in said
    preload = [str(tmp_path / name)]
    assert f'"foreign": {{"preload": {json.dumps(preload)}}}' in said
    assert f"preload = {json.dumps(preload)}" in said
    assert FMU(fmu_path, preload=preload).runs_here
    assert play(fmu_path, preload=preload) == STEPPED
    assert play(fmu_path, preload=preload, isolation="process") == STEPPED
    for symbol in {*SYMBOLS} - {"_gfortran_matmul_r8"}:
        assert symbol in (tmp_path / name).read_bytes().decode("latin-1")


def test_what_the_stand_in_lacks_ends_the_trial_with_its_name(fmu_path, tmp_path):
    (built,) = fortran_libraries.build_stand_in(FMU(fmu_path), tmp_path)
    assert built.lacking == ("_gfortran_matmul_r8",)
    environment = {"CALL_MATMUL": "1", "FMUGYM_CACHE_DIR": str(tmp_path)}  # nobody has met it
    said = play(fmu_path, environment, preload=[str(built.path)])
    assert "has no function _gfortran_matmul_r8, which the FMU calls" in said


def test_info_tells_before_anything_is_loaded(fmu_path, tmp_path, monkeypatch, cli, ran):
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path))  # nobody has met it
    out = ran("info", fmu_path)
    (name,) = FMU(fmu_path).missing_libraries
    assert (
        f"does NOT run here: Probe.fmu needs shared libraries that are not found here: {name}"
        in out
    )
    assert "'fmugym info --repair FMU' makes a replacement" in out
    assert "runs here\n" not in out
    facts = json.loads(ran("info", fmu_path, "--json"))
    assert facts["runs_here"] is False
    assert [row["name"] for row in facts["missing_libraries"]] == [name]
    code, _, err = cli("new", "--class", fmu_path)
    assert code == 0
    assert "does not run on this machine: Probe.fmu needs shared libraries" in err


def test_a_task_file_finds_the_stand_in_beside_it(fmu_path, tmp_path, monkeypatch, ran):
    """From the FMU to an episode: ``new`` names the library, once it is there in earnest."""
    (name,) = FMU(fmu_path).missing_libraries
    task = tmp_path / "task.toml"
    ran("new", fmu_path, "--output", task)
    assert (
        f"\n[foreign]\n# The FMU needs this: fmugym info --repair {fmu_path.name}"
        in task.read_text()
    )
    assert f'\n# preload = ["./{name}"]' in task.read_text()
    ran("info", "--repair", fmu_path, "--output", tmp_path)
    task.unlink()
    ran("new", fmu_path, "--output", task)
    assert f'\npreload = ["./{name}"]' in task.read_text()
    monkeypatch.setenv("FMUGYM_PROBE", "on")
    # not in this process, which may have loaded another library of that name
    played = run_python("-m", "fmugym", "simulate", task, "--steps", 2)
    assert played.returncode == 0, played.stderr
    said = ran("info", task)
    assert "linux64: runs here" in said
    assert "reset is right" in said
    Task.read(task).write(tmp_path / "copy.toml")
    assert tomllib.loads((tmp_path / "copy.toml").read_text())["foreign"]["preload"] == [
        f"./{name}"
    ]


def test_info_of_the_fmu_alone_does_not_contradict_its_trial(fmu_path, tmp_path, ran):
    (name,) = FMU(fmu_path).missing_libraries
    (built,) = fortran_libraries.build_stand_in(FMU(fmu_path), tmp_path)
    assert play(fmu_path, preload=[str(built.path)]) == STEPPED
    said = ran("info", fmu_path)
    assert "restore is right" in said
    assert "does NOT run here" not in said
    assert "has run here, but not like this: Probe.fmu needs" in said
    assert name in said


def test_it_is_built_only_where_it_is_needed_and_nothing_is_there(
    fmu_path, probe, tmp_path, refused
):
    with pytest.raises(ConfigError, match=r"Probe.fmu lacks neither libgfortran.so.3 nor"):
        fortran_libraries.build_stand_in(FMU(probe()), tmp_path)
    (name,) = FMU(fmu_path).missing_libraries
    (tmp_path / name).write_text("precious")
    assert "exists already" in refused("info", "--repair", fmu_path, "--output", tmp_path)
    assert (tmp_path / name).read_text() == "precious"


def test_where_it_is_written(fmu_path, tmp_path, monkeypatch, ran):
    """By default to the working directory; the path in ``preload`` holds elsewhere, too."""
    (name,) = FMU(fmu_path).missing_libraries
    monkeypatch.chdir(tmp_path)
    assert f'preload = ["{tmp_path / name}"]' in ran("info", "--repair", fmu_path)
    ran("info", "--repair", fmu_path, "--output", "a/b")
    assert (tmp_path / "a" / "b" / name).is_file()
    with pytest.raises(ConfigError, match="cannot hold libraries"):
        fortran_libraries.build_stand_in(FMU(fmu_path), tmp_path / name / "inside")


def test_without_a_compiler(fmu_path, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"needs a C compiler: install gcc .* or ziglang"):
        fortran_libraries.build_stand_in(FMU(fmu_path), tmp_path)


class TestTransitively:
    """All libraries are named at once, those of libraries that the FMU brings along included."""

    @pytest.fixture
    def library(self, tmp_path):
        (tmp_path / "empty.c").write_text("int gone = 1;")
        (tmp_path / "use.c").write_text("extern int gone; int use(void) { return gone; }")
        self.compile(tmp_path, "empty.c", "libgfortran.so.4")
        self.compile(tmp_path, "use.c", "libbeside.so", "libgfortran.so.4")
        code = "int use(void), gone(void); int f(void) { return use() + gone(); }"
        (tmp_path / "model.c").write_text(code)
        (tmp_path / "blas.c").write_text("int gone(void) { return 1; }")
        self.compile(tmp_path, "blas.c", "libnone.so.0")
        self.compile(tmp_path, "model.c", "Model.so", "libnone.so.0", "libbeside.so")
        (tmp_path / "libnone.so.0").unlink()
        (tmp_path / "libgfortran.so.4").unlink()
        return tmp_path / "Model.so"

    @staticmethod
    def compile(folder, source, name, *needed):
        options = ["-o", name, f"-Wl,-soname,{name}", "-Wl,-rpath,$ORIGIN"]
        subprocess.run([*ZIG, source, *needed, *options], cwd=folder, check=True)

    def test_all_are_named(self, library):
        """In a child, as an earlier test may have preloaded one here."""
        found = missing_libraries(library, ask=ask_in_a_child)
        assert sorted(found) == ["libgfortran.so.4", "libnone.so.0"]

    def test_a_library_that_ends_its_process(self, library, tmp_path, monkeypatch):
        """Nothing is known then; but this process lives."""
        (tmp_path / "empty.c").write_text(
            "#include <stdlib.h>\nint gone; __attribute__((constructor)) void f(void) { _Exit(3); }"
        )
        self.compile(tmp_path, "empty.c", "libnone.so.0")
        (tmp_path / "libs").mkdir()
        (tmp_path / "libnone.so.0").rename(tmp_path / "libs" / "libnone.so.0")
        monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path / "libs"))
        assert missing_libraries(library, ask=ask_in_a_child) == []

    def test_a_path_is_never_loaded(self):
        assert ask(["/nowhere/x.so", f"{HERE}/conftest.py"]) == ["/nowhere/x.so"]

    def test_those_that_are_preloaded_are_not(self, library, tmp_path):
        preloaded = tmp_path / "elsewhere.so"
        self.compile(tmp_path, "empty.c", "libgfortran.so.4")
        os.rename(tmp_path / "libgfortran.so.4", preloaded)
        provided = [str(preloaded), "libnone.so.0"]
        assert missing_libraries(library, provided) == []
