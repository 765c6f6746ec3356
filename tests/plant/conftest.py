"""What the tests of plants share."""

import pytest
from plant_tools import LockStep, nothing_left


@pytest.fixture(autouse=True)
def _nothing_left():
    with nothing_left():
        yield


@pytest.fixture
def clock():
    return LockStep()
