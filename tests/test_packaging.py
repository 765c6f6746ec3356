"""What is built from the repository works elsewhere: the wheel, the sdist, an editable install."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
from versions import versions

from fmugym.fmi.bundled import BUNDLED_FMUS, FMI_VERSIONS

ROOT = Path(__file__).resolve().parent.parent
NOT_SOURCES = shutil.ignore_patterns(
    *(".*", "__pycache__", "*.egg-info", "*.py[cod]", "*.so", "build", "dist", "results")
)
STEP_EVERY_ENV = ROOT / "tests" / "tools" / "step_every_env.py"
HAS_BUILD_BACKEND = int(version("setuptools").split(".")[0]) >= 77


def run(*command, variables=None, **options):
    """Run a command without the variables that could lead it to the checkout."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(word) for word in command],
        env=env | {"PYTHONUTF8": "1"} | (variables or {}),
        capture_output=True,
        encoding="utf-8",
        timeout=300,
        **options,
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    return done.stdout, done.stderr


def sources(folder):
    """Return the files of a folder of the checkout that belong to the project."""
    folder = ROOT / folder
    ignored = {".mypy_cache", ".ruff_cache", "__pycache__"}
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(ROOT).as_posix() for path in paths if ignored.isdisjoint(path.parts)}


def make_venv(folder):
    """Make an empty environment and return its Python."""
    venv.create(folder, symlinks=os.name != "nt")
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def lend_dependencies(python):
    """Let an environment see the running one's packages, but no editable install of it."""
    purelib = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))")[0]
    lent = [path for path in sys.path if Path(path).name in {"site-packages", "dist-packages"}]
    Path(purelib.strip(), "lent.pth").write_text("\n".join(lent) + "\n", encoding="utf-8")


def pip_install(python, *what, **options):
    pip = (sys.executable, "-m", "pip", "--python", python)
    run(*pip, "install", "--no-deps", *what, **options)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of the checkout, so that building leaves nothing behind in it."""
    return shutil.copytree(ROOT, tmp_path_factory.mktemp("tree") / "tree", ignore=NOT_SOURCES)


@pytest.fixture(scope="module")
def built(tree, tmp_path_factory):
    """The sdist, the wheel that was built from it, and what the build printed."""
    folder = tmp_path_factory.mktemp("dist")
    isolation = ["--no-isolation"] if HAS_BUILD_BACKEND else []
    output = run(sys.executable, "-m", "build", *isolation, "--outdir", folder, tree)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel, "".join(output)


@pytest.fixture(scope="module")
def wheel_python(built, tmp_path_factory):
    python = make_venv(tmp_path_factory.mktemp("wheel") / "venv")
    pip_install(python, "--no-index", built[1])
    lend_dependencies(python)
    return python


@pytest.fixture(scope="module")
def editable_python(tree, tmp_path_factory):
    python = make_venv(tmp_path_factory.mktemp("editable") / "venv")
    lend_dependencies(python)
    isolation = ["--no-index", "--no-build-isolation"] if HAS_BUILD_BACKEND else []
    pip_install(python, *isolation, "--editable", tree)
    return python


def step_every_env(python, folder):
    """Step every registered id in an isolated interpreter that starts in another directory."""
    stdout, _ = run(python, "-I", STEP_EVERY_ENV, cwd=folder)
    report = json.loads(stdout.splitlines()[-1])
    return Path(report["file"]).resolve(), report["steps"]


def assert_every_env_stepped(steps):
    names = ("CartPole", "CloudPendulum", "ModelicaCartPole", "Pendulum")
    ids = [f"fmugym/{name}-v0" for name in names]
    missing = [(i, v) for i in ids for v in FMI_VERSIONS if [i, v, True] not in steps]
    assert missing == []
    assert all(contained for *_, contained in steps)


def test_an_installed_wheel_steps_every_id_from_another_directory(wheel_python, tmp_path):
    file, steps = step_every_env(wheel_python, tmp_path)
    assert file.is_relative_to(wheel_python.parent.parent.resolve())
    assert_every_env_stepped(steps)


def test_an_editable_install_steps_every_id_from_another_directory(editable_python, tree, tmp_path):
    file, steps = step_every_env(editable_python, tmp_path)
    assert file == (tree / "fmugym/__init__.py").resolve()
    assert_every_env_stepped(steps)


@pytest.mark.skipif(os.name == "nt", reason="the compiler of Windows is not found by the PATH")
def test_without_a_compiler_the_extension_is_built_all_the_same(tree, tmp_path):
    copy = shutil.copytree(tree, tmp_path / "tree", ignore=NOT_SOURCES)
    python = make_venv(tmp_path / "venv")
    variables = {"PATH": str(tmp_path / "empty"), "CC": "no-compiler"}
    pip_install(python, "--editable", copy, variables=variables)
    lend_dependencies(python)
    run(python, "-I", STEP_EVERY_ENV, "--native", cwd=tmp_path)


def test_an_installed_wheel_brings_the_command(wheel_python, tmp_path):
    fmu = ROOT / "resources/fmus/2.0/CartPole.fmu"
    command = wheel_python.with_name("fmugym.exe" if os.name == "nt" else "fmugym")
    stdout, _ = run(command, "info", fmu, cwd=tmp_path)
    assert "CartPole" in stdout


def test_the_wheel_holds_the_fmus_byte_for_byte(built):
    names = [f"{fmi_version}/{model}.fmu" for model, fmi_version in BUNDLED_FMUS]
    with zipfile.ZipFile(built[1]) as wheel:
        packed = {name: wheel.read(f"fmugym/fmus/{name}") for name in names}
    assert packed == {name: (ROOT / "resources/fmus" / name).read_bytes() for name in names}


def test_the_wheel_holds_every_module_and_the_typing_marker(built):
    modules = {name for name in sources("fmugym") if name.endswith(".py")}
    with zipfile.ZipFile(built[1]) as wheel:
        assert modules | {"fmugym/py.typed"} <= set(wheel.namelist())


def test_the_wheel_holds_the_sources_of_the_worker_for_windows(built):
    wanted = {name for name in sources("native") if name.endswith((".c", ".h"))}
    wanted = {name for name in wanted if not name.startswith("native/python/")}
    with zipfile.ZipFile(built[1]) as wheel:
        packed = {
            name.replace("fmugym/native_sources", "native"): wheel.read(name)
            for name in wheel.namelist()
            if name.startswith("fmugym/native_sources/")
        }
    assert packed == {name: (ROOT / name).read_bytes() for name in wanted}


def test_the_wheel_holds_nothing_beside_the_package(built):
    with zipfile.ZipFile(built[1]) as wheel:
        tops = {name.split("/")[0] for name in wheel.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"fmugym"}


@pytest.mark.parametrize("folder", ["resources", "tests"])
def test_the_sdist_holds_the_folder(built, folder):
    with tarfile.open(built[0]) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
    assert sources(folder) <= names


def test_the_build_prints_no_warning_of_setuptools(built):
    output = built[2]
    assert "!!" not in output  # the frame around each warning of setuptools
    assert "Deprecat" not in output


def test_every_package_folder_is_listed_in_pyproject():
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    elsewhere = set(setuptools["package-dir"]) - {"fmugym"}
    folders = {Path(name).parent for name in sources("fmugym") if name.endswith(".py")}
    packages = {".".join(folder.parts) for folder in folders}
    assert packages == set(setuptools["packages"]) - elsewhere


def test_the_places_that_give_the_version_agree():
    assert len(set(versions().values())) == 1
    assert versions("v9.9")["the tag"] == "9.9"
    assert versions("v9.9")["CHANGELOG.md"] == "Unreleased"
