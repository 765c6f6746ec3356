"""Fixtures for the tests of several modules."""

import collections
import functools
import os
import tempfile

import fmu_tools
import pytest
import tiers

# Nearly every test makes an FMU that nobody has met; test_trial.py turns their trials on.
os.environ["FMUGYM_PROBE"] = "off"
_cache = tempfile.TemporaryDirectory(prefix="fmugym-cache-")
os.environ["FMUGYM_CACHE_DIR"] = _cache.name


@pytest.hookimpl(tryfirst=True)  # before pytest looks at -m
def pytest_collection_modifyitems(items):
    """Mark what ``tiers.py`` leaves out of the default run and of ``.ci/run``."""
    seen = collections.Counter()
    for item in items:
        node_id = item.nodeid.removeprefix("tests/")
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


@pytest.fixture
def make_env(probe):
    """Make environments over the probe that are closed after the test."""
    envs = []

    def make(version=2, *, cls=fmu_tools.PlainEnv, path=None, render_mode=None, **config):
        env = cls(path or probe(version), fmu_tools.probe_config(**config), render_mode=render_mode)
        envs.append(env)
        return env

    yield make
    for env in envs:
        env.close()


@pytest.fixture
def temp_root(tmp_path, monkeypatch):
    """An empty folder in which all temporary folders are made."""
    root = tmp_path / "temporary"
    root.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(root))
    monkeypatch.setenv("TMPDIR", str(root))  # for child processes
    return root


@pytest.fixture
def same_working_directory():
    """Fail if the test leaves another working directory."""
    before = os.getcwd()
    yield
    assert os.getcwd() == before
