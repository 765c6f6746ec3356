"""Fixtures for the tests of several modules."""

import collections
import contextlib
import functools
import gc
import importlib
import os
import re
import sys
import tempfile

import building
import example_tools
import fmu_tools
import pytest
import tiers
import wine_tools
from hypothesis import HealthCheck, settings
from ways import in_python, many

import fmugym
from fmugym.cli.command_line import run_command_line
from fmugym.errors import ConfigError
from fmugym.fmi.wine import Wine
from fmugym.pool.c_extension import require_engine

sys.path += [folder for folder in building.FOLDERS if folder not in sys.path]

# The processes of a test run share a folder: the first one makes it, and removes it.
if building.FOLDER not in os.environ:
    _folder = tempfile.TemporaryDirectory(prefix="fmugym-tests-", ignore_cleanup_errors=True)
    os.environ[building.FOLDER] = _folder.name

# Nearly every test makes an FMU that nobody has met; test_trial.py turns their trials on.
os.environ["FMUGYM_PROBE"] = "off"
os.environ["FMUGYM_CACHE_DIR"] = os.path.join(os.environ[building.FOLDER], "cache")

# Tests of Hypothesis have the same examples in each run. --hypothesis-profile long draws others.
settings.register_profile(
    "short",
    deadline=None,
    derandomize=True,
    print_blob=True,
    report_multiple_bugs=False,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.register_profile(
    "long", settings.get_profile("short"), max_examples=2000, derandomize=False
)
settings.load_profile("short")


def pytest_ignore_collect(collection_path, config):
    """Skip the import of modules that the default run leaves out as a whole."""
    left_out = collection_path.stem in tiers.SLOW_MODULES
    return True if left_out and config.option.markexpr == "not slow" else None


class EngineModule(pytest.Module):
    """A module of tests that need the C extension: it is not imported where that was not built."""

    def collect(self):
        try:
            require_engine(self.path.name)
        except ConfigError as error:
            pytest.skip(str(error), allow_module_level=True)
        return super().collect()


def pytest_pycollect_makemodule(module_path, parent):
    """Leave to pytest only the modules that need no C extension."""
    if module_path.stem in tiers.WITHOUT_EXTENSION:
        return None
    return EngineModule.from_parent(parent, path=module_path)


def pytest_collection_finish():
    """Leave what pytest has made out of garbage collections, which would take 0.3 s each.

    The Python processes that tests start keep their bytecode, too, even where this one does not:
    compiling every module in each of them would take a third of the time.
    """
    gc.collect()
    gc.freeze()
    if sys.dont_write_bytecode:
        os.environ["PYTHONDONTWRITEBYTECODE"] = ""
        os.environ["PYTHONPYCACHEPREFIX"] = os.path.join(os.environ[building.FOLDER], "bytecode")


@pytest.hookimpl(tryfirst=True)  # before pytest looks at -m
def pytest_collection_modifyitems(items):
    """Mark what ``tiers.py`` leaves out of the default run and of ``.ci/run``."""
    seen = collections.Counter()
    for item in items:
        node_id = f"{item.path.name}::{item.nodeid.partition('::')[2]}"
        test = node_id.partition("[")[0]
        if tiers.is_slow(node_id, seen[test]):
            item.add_marker(pytest.mark.slow)
        if tiers.is_exhaustive(node_id, seen[test]):
            item.add_marker(pytest.mark.exhaustive)
        seen[test] += 1


@pytest.fixture(scope="session")
def probe(tmp_path_factory):
    """Make the path of the probe FMU of an FMI version, compiled once a session."""

    @functools.cache
    def make(version=2):
        return fmu_tools.probe_fmu(tmp_path_factory.mktemp(f"probe{version}"), version)

    return make


@pytest.fixture(scope="session")
def wine():
    """What FMUs with libraries for Windows need here; skips the test where something is missing."""
    reason = wine_tools.why_not()
    if reason:
        pytest.skip(reason)
    return Wine.ready()


@pytest.fixture
def engine(request):
    """Skip one test of a module where the C extension was not built."""
    try:
        require_engine(request.node.name)
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.fixture
def opened():
    """Have things closed after the test."""
    with contextlib.ExitStack() as stack:
        yield lambda thing: stack.enter_context(contextlib.closing(thing))


@pytest.fixture
def load(opened):
    """Make environments of declared tasks that are closed after the test.

    Their expressions are evaluated in the way ``"Python"``, or by programs.
    """

    def make(*arguments, way=None, **options):
        env = opened(fmugym.load(*arguments, **options))
        return in_python(env) if way == "Python" else env

    return make


@pytest.fixture
def make_envs(opened):
    """Make vector environments that are closed after the test, and call hooks in a ``way``."""
    return lambda *arguments, **options: opened(many(*arguments, **options))


@pytest.fixture
def vector_of(make_envs):
    """Make some whose episodes do not start by themselves."""
    return lambda make, n=3, **options: make_envs(make, n, autoreset_mode="Disabled", **options)


@pytest.fixture
def make_env(probe, opened):
    """Make environments over the probe that are closed after the test."""

    def make(version=2, *, cls=fmu_tools.PlainEnv, path=None, render_mode=None, **config):
        config = fmu_tools.probe_config(**config)
        return opened(cls(path or probe(version), config, render_mode=render_mode))

    return make


@pytest.fixture
def example(monkeypatch):
    """Import an example by its name, as a program beside it does."""
    monkeypatch.syspath_prepend(str(example_tools.EXAMPLES))
    return importlib.import_module


@pytest.fixture
def cli(capsys):
    """Call the command line; its exit code, and what it printed to both streams."""

    def call(*arguments):
        code = run_command_line(list(map(str, arguments)))
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def help_of(capsys):
    """What ``--help`` prints for the command line, or for one of its commands."""

    def call(*command):
        with pytest.raises(SystemExit):
            run_command_line([*command, "--help"])
        return capsys.readouterr().out

    return call


@pytest.fixture
def commands(help_of):
    """The names of all commands."""
    return set(re.findall(r"^    ([\w-]+)  ", help_of(), re.M))


@pytest.fixture
def ran(cli):
    """Call the command line, which must succeed; what it printed to standard output."""

    def call(*arguments):
        code, out, err = cli(*arguments)
        assert code == 0, err
        return out

    return call


@pytest.fixture
def refused(cli):
    """Call the command line, which must fail; what it printed to the error stream."""

    def call(*arguments):
        code, _, err = cli(*arguments)
        assert code == 1
        return err

    return call


@pytest.fixture
def temp_root(tmp_path, monkeypatch):
    """An empty folder in which all temporary folders are made."""
    root = tmp_path / "temporary"
    root.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(root))
    monkeypatch.setenv("TMPDIR", str(root))  # for child processes
    return root


@pytest.fixture
def trials(monkeypatch):
    """Trials as users have them; their cache serves all tests of a run."""
    monkeypatch.delenv("FMUGYM_PROBE")


@pytest.fixture
def own_trials(trials, monkeypatch, tmp_path):
    """The same with a cache for each test."""
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "cache"))


@pytest.fixture
def same_working_directory():
    """Fail if the test leaves another working directory."""
    before = os.getcwd()
    yield
    assert os.getcwd() == before
