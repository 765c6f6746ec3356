"""What the tests of plants share."""

from contextlib import ExitStack

import pytest
from plant_tools import LockStep, nothing_left, watched

from fmugym.deployment.plant import Server


@pytest.fixture(autouse=True)
def _nothing_left():
    with nothing_left():
        yield


@pytest.fixture
def clock():
    return LockStep()


@pytest.fixture
def shadowed(clock):
    """Make an environment in the shadow of a plant, which another task may serve."""
    with ExitStack() as stack:

        def make(task, plant=None):
            server = stack.enter_context(Server(plant or task, "thermostat", clock=clock))
            return stack.enter_context(watched(clock, server.address, task))

        yield make
