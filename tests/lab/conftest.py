"""Fixtures of the lab's tests."""

import pytest
from lab_tools import experiment, ideal_lab


@pytest.fixture
def lab():
    with ideal_lab() as made:
        yield made


@pytest.fixture
def single(lab):
    return experiment(lab)


@pytest.fixture
def double(lab):
    return experiment(lab, "DoublePendulum")
