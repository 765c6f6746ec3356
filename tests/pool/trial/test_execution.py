"""The words on how a pool runs, and why: its own, those in the log, and those of commands."""

import logging
from contextlib import closing

import pytest

from fmugym import FMU, ConfigError, bundled_fmu
from fmugym.cli.validation import validate
from fmugym.envs import PendulumEnv
from fmugym.pool.opening import PoolOptions, open_pool
from fmugym.pool.pool_spec import PoolSpec

LOG = logging.getLogger("fmugym.test")
HERE = "in this process"


@pytest.mark.parametrize(
    ("count", "options", "words"),
    [
        (1, {}, f"1 instance runs {HERE}; episodes begin by 'restore'"),
        (3, {"isolation": "process", "workers": 2}, "3 instances run in 2 worker processes;"),
        (2, {"private_libraries": True}, f"{HERE}, each with a copy of the library;"),
        (2, {"threads": 1}, f"{HERE}, stepped one after another;"),
        (2, {"reset_method": "process"}, "in 2 worker processes, each with a copy of the FMU's"),
        (2, {"reset_method": "library"}, "a copy of the library; episodes begin by 'library'"),
        (2, {"backend": "fmpy"}, "2 instance(s) are stepped by FMPy"),
    ],
)
def test_a_pool_and_the_log_tell_it(count, options, words, caplog):
    fmu = FMU(bundled_fmu("Pendulum"))
    spec = PoolSpec((fmu.variable("tau"),), (fmu.variable("q"),), 0.1)
    with (
        caplog.at_level(logging.INFO, LOG.name),
        closing(open_pool(fmu, spec, count, LOG, PoolOptions(**options))) as pool,
    ):
        (told,) = pool.execution
        assert told.startswith("Pendulum.fmu: ")
        assert words in told
        assert told in caplog.text


def test_validate_tells_it():
    report = validate(PendulumEnv)
    assert report.execution[0] in report.as_text().splitlines()
    assert f"1 instance runs {HERE}" in report.as_text()


@pytest.mark.parametrize("option", ["isolation", "reset_method"])
def test_unknown_options_are_refused(option):
    with pytest.raises(ConfigError, match=r"'proces'.*'process'"):
        PoolOptions(**{option: "proces"})
