"""Results that stay as they were: those of a second implementation, which there was once.

``golden/make.py`` has written them at revision 179b934. They are exact on x86-64 Linux; elsewhere
compilers and libraries of mathematics round in other ways.
"""

import json
import platform
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from golden.cases import cases

GOLDEN = Path(__file__).parents[1] / "golden"
RESULTS = json.loads((GOLDEN / "results.json").read_text(encoding="utf-8"))
IS_EXACT = sys.platform == "linux" and platform.machine() == "x86_64"

CASES = cases()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("golden")


def test_every_result_has_its_case():
    assert list(RESULTS) == list(CASES)


@pytest.mark.parametrize("name", RESULTS)
def test_is_as_it_was(name, folder):
    require_same(name, CASES[name](folder))


def test_all_are_those_of_fmi_2():
    """So what others compute for FMI 2.0 is a reference for all versions."""
    for name in (name for name in RESULTS if re.match("bundled|exchange|sys|way", name)):
        found, expected = numbers(name), numbers(re.sub(r" [13](?=[. ]|$)", " 2", name))
        both = min(len(found), len(expected))  # a state of FMI 1.0 is not restored
        np.testing.assert_array_equal(found[:both], expected[:both], name)


def numbers(name):
    values = [float.fromhex(text) for text in RESULTS[name]["values"].split()]
    return np.reshape(values, RESULTS[name]["shape"])


def require_same(name, found):
    expected = numbers(name)
    if IS_EXACT:
        np.testing.assert_array_equal(found, expected)
    else:
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
