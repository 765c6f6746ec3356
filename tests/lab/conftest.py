"""What the tests of the lab share."""

import pytest
from lab_tools import experiment

from fmugym.lab import Lab, ManualClock


@pytest.fixture
def lab():
    with Lab("ideal", clock=ManualClock(), seed=0) as made:
        yield made


@pytest.fixture
def single(lab):
    return experiment(lab)


@pytest.fixture
def double(lab):
    return experiment(lab, "DoublePendulum")
