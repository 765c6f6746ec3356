"""A short form of ``python tests/fuzz_systems.py``."""

import fuzz_driver
import fuzz_systems
import pytest

from fmugym.fmi import parts
from fmugym.pool import has_native_pool


def test_both_engines_do_the_same():
    tally = fuzz_driver.run(fuzz_systems.program, 40, seed="tests")
    assert tally.failures == []
    assert tally.total("accepted") > 15


@pytest.mark.skipif(not has_native_pool(), reason="no C extension was built")
def test_a_difference_is_reported(monkeypatch):
    """The fuzzing is able to fail: here the last bit of what gains make is another one."""

    def scaled(gain, offset, value):
        return value if gain == 1.0 and offset == 0.0 else (gain * value + offset) * (1 + 2**-50)

    monkeypatch.setattr(parts, "scaled", scaled)
    failures = fuzz_driver.run(fuzz_systems.program, 20, seed="tests").failures
    assert any("step" in failure for failure in failures)
