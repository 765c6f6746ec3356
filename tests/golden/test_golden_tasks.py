"""Results of tasks that stay as they were at revision 0ce11fa0, written by ``golden/make.py``.

A result changes only on purpose, with a sentence in ``CHANGELOG.md`` that says why.
"""

import hashlib
import math
from pathlib import Path

import pytest
from golden import classes, records
from golden.task_cases import cases

CHANGELOG = Path(__file__).parents[2] / "CHANGELOG.md"
RESULTS = records.read(records.TASKS)
CASES = cases()
ORIGINAL = "c6262cd9659de514"
"""A hash of the names and results of all cases as they were at first."""

ONNX = "exported ONNX"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("golden")


def test_every_result_has_its_case():
    assert list(RESULTS) == list(CASES)
    assert len(CASES) > 300


@pytest.mark.parametrize("name", [name for name in RESULTS if not name.startswith(ONNX)])
def test_is_as_it_was(name, folder):
    found = records.difference(RESULTS[name], list(CASES[name](folder)))
    assert found is None, f"{name}: {found}"


@pytest.mark.parametrize("name", [name for name in RESULTS if name.startswith(ONNX)])
def test_an_onnx_model_is_as_it_was(name, folder):
    """With a tolerance: ONNX Runtime rounds as the processor likes."""
    pytest.importorskip("onnx", reason="needs the extra 'onnx'")
    pytest.importorskip("onnxruntime", reason="needs ONNX Runtime")
    found = records.rough_difference(RESULTS[name], list(CASES[name](folder)))
    assert found is None, f"{name}: {found}"


def test_changes_are_told():
    """Each result is the first one, or the changelog says why it is another."""
    changes, results = records.read(records.CHANGES), records.all_results()
    told = " ".join(CHANGELOG.read_text(encoding="utf-8").split())
    first = {name: changes.get(name, {"was": digits})["was"] for name, digits in results.items()}
    text = "\n".join(f"{name} {digits}" for name, digits in first.items() if digits is not None)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == ORIGINAL
    for name, change in changes.items():
        assert change["was"] is None or " ".join(change["why"].split()) in told, name


@pytest.mark.parametrize("name", ["fault compiled truncate single", "fault a file raise same_step"])
def test_each_fault_comes_with_each_end(name, folder):
    """In the step of the fault: no end, one by a hook, one by the limit of steps, or both."""
    seen = set()
    for row in CASES[name](folder):
        infos = row.get("info", [])
        for info in [infos] if isinstance(infos, dict) else infos:
            seen.add(tuple(sorted(info.get("drawn", {}).items())))
    drawn = classes.PARAMETERS | classes.VARIABLES
    assert len(seen - {()}) > 0.9 * math.prod(map(len, drawn.values()))


class TestDifferences:
    """A difference is told in words."""

    ROWS = (
        {"observation": [1.0], "info": {}},
        *({"observation": [number], "reward": 2.0} for number in range(4)),
    )

    def test_of_equal_rows(self):
        assert records.difference(records.record_of(self.ROWS), list(self.ROWS)) is None

    @pytest.mark.skipif(not records.IS_EXACT, reason="other machines compare the first rows")
    @pytest.mark.parametrize(
        ("number", "changed", "words"),
        [
            (0, {"observation": [1.5], "info": {}}, ["row 0", "observation [1.5]", "was", "[1.0]"]),
            (4, {"observation": [3], "reward": 2.5}, ["row 4", "reward 2.5"]),
            (4, {"observation": [3]}, ["row 4", "observation"]),
        ],
    )
    def test_of_a_row(self, number, changed, words):
        rows = list(self.ROWS)
        rows[number] = changed
        found = records.difference(records.record_of(self.ROWS), rows)
        assert all(word in found for word in words)
        assert ("reward" in found) == ("reward" in changed and number == 4)

    def test_of_a_length(self):
        found = records.difference(records.record_of(self.ROWS), list(self.ROWS[:-1]))
        assert found is not None
        assert "5" in found or not records.IS_EXACT
