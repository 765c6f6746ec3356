"""The table of libraries is what the program that makes it would write."""

import re

import pytest
import try_libraries


@pytest.mark.parametrize("name", try_libraries.LIBRARIES)
def test_programs_are_python(name):
    compile(try_libraries.program(try_libraries.LIBRARIES[name]), name, "exec")


def test_the_page_has_a_row_for_each_library():
    rows = re.findall(
        r"^\| ([\w-]+) \| [\d.]+ \|.*\| (runs).*\|$", try_libraries.PAGE.read_text(), re.M
    )
    assert dict(rows) == dict.fromkeys(try_libraries.LIBRARIES, "runs")


def test_the_page_shows_the_lines_that_are_run():
    text = try_libraries.PAGE.read_text()
    for library in try_libraries.LIBRARIES.values():
        assert f"`{library.line}`" in text
