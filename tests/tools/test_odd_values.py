"""The rule for calls with odd values finds what breaks it."""

import tempfile

import pytest
from odd_values import Unspeakable, working_or_refused

from fmugym import ConfigError


def test_errors_of_the_package_may_come():
    with working_or_refused():
        raise ConfigError("x must be a number\ny must be a number")


@pytest.mark.parametrize("text", ["x" * 10_000, "\x1b[31m", "\x9b2J", "\u202e"], ids=ascii)
def test_a_text_that_nobody_can_read_is_found(text):
    class RawError(ConfigError):
        __str__ = Exception.__str__

    with pytest.raises(AssertionError), working_or_refused():
        raise RawError(text)


def test_other_errors_are_found():
    with pytest.raises(ZeroDivisionError), working_or_refused():
        Unspeakable()()


def test_a_folder_that_is_left_is_found():
    with pytest.raises(AssertionError), working_or_refused():
        tempfile.mkdtemp()
