"""Mutations that can be made; ``mutations.py`` makes them, and runs the suites that find them."""

from collections import Counter

import mutations
import pytest


def test_each_room_has_ten():
    counts = Counter(one.room for one in mutations.MUTATIONS)
    assert counts.keys() == mutations.SUITES.keys()
    assert min(counts.values()) >= 10
    assert len({one.noticed for one in mutations.MUTATIONS}) == len(mutations.MUTATIONS)


def test_every_old_text_stands_in_its_file_once():
    assert list(mutations.misfits()) == []


def test_one_that_does_not_is_told():
    first, *_ = mutations.MUTATIONS
    wrong = first._replace(old="def ")
    assert [line.startswith(first.file) for line in mutations.misfits(mutations=[wrong])] == [True]


@pytest.mark.parametrize("suite", sorted({one.finder for one in mutations.MUTATIONS}))
def test_suites_are_there(suite):
    paths = [one.partition("::")[0] for one in suite if one.startswith("tests/")]
    assert paths
    assert all((mutations.TOP / path).exists() for path in paths)
