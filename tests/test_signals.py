"""Exceptions of signal handlers are told from those of a user's objects."""

import functools
import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from fmu_tools import PlainEnv, probe_config, probe_fmu
from vector_tools import Drawing

import fmugym
from fmugym.archive.temporary import folder_name, make_folder, remove_folder
from fmugym.signals import Ignoring, ordinary


class RingError(Exception):
    """What the handlers raise."""


def ring(*_):
    raise RingError


def ring_late(*_):
    raise TimeoutError


def ring_once(number, frame):
    """As handlers of timeouts do."""
    signal.signal(number, signal.SIG_DFL)
    raise RingError


class Bell:
    def __call__(self, number, frame):
        raise RingError

    def method(self, number, frame):
        raise RingError


HANDLERS = {
    "a function": ring,
    "named arguments": lambda number, frame: ring(),
    "an object": Bell(),
    "a method": Bell().method,
    "a partial": functools.partial(lambda word, *arguments: ring(), "word"),
    "one that goes": ring_once,
}


@pytest.fixture
def install():
    before = signal.getsignal(signal.SIGTERM)
    yield functools.partial(signal.signal, signal.SIGTERM)
    signal.signal(signal.SIGTERM, before)


def alarm(*_):
    """Let the handler run here."""
    signal.raise_signal(signal.SIGTERM)


def convert():
    """Make another exception of it."""
    try:
        alarm()
    except RingError:
        raise TypeError from None


def caught(work, *kinds):
    """What an ``except`` clause catches."""
    try:
        work()
    except ordinary(*kinds) as error:
        return error
    return None


@pytest.mark.parametrize("handler", HANDLERS.values(), ids=HANDLERS)
def test_a_handlers_exception_is_not_caught(install, handler):
    install(handler)
    with pytest.raises(RingError):
        caught(alarm, Exception)


def test_nor_is_one_that_is_made_of_it(install):
    install(ring)
    with pytest.raises(TypeError):
        caught(convert, Exception)


def test_nor_is_one_that_fits_a_narrow_clause(install):
    install(ring_late)
    with pytest.raises(TimeoutError):
        caught(alarm, OSError)


def test_a_mistake_while_it_is_handled_is_caught(install):
    install(ring)
    try:
        alarm()
    except RingError:
        assert isinstance(caught(lambda: int("a"), ValueError), ValueError)


def test_what_a_handler_raises_when_others_call_it_is_caught(install):
    install(ring)
    assert isinstance(caught(lambda: ring(15, None), Exception), RingError)


def test_what_is_ignored_is_not_what_a_handler_raises(install):
    install(ring)
    with Ignoring(ValueError, RingError):
        int("a")
    with pytest.raises(RingError), Ignoring(RingError):
        alarm()


def test_other_kinds_are_not_caught():
    with pytest.raises(KeyError):
        caught(lambda: {}["a"], ValueError, TypeError)


def test_no_module_catches_what_handlers_raise_in_another_way():
    package = Path(fmugym.__file__).parent
    catch = r"(except (?!ordinary\()|suppress\()"
    wrong = re.compile(catch + r"[^:\n]*\b(Exception|OSError|TimeoutError)\b|except:")
    found = [path for path in package.rglob("*.py") if wrong.search(path.read_text("utf-8"))]
    without_the_package = (
        package / "archive" / "loader.py",
        package / "pool" / "process" / "guard.py",
    )
    assert sorted(found) == sorted(without_the_package)


# As users meet it


class Alarming(list):
    """The signal comes while this is converted."""

    __str__ = __iter__ = __len__ = __getitem__ = alarm


@pytest.mark.parametrize(
    "changes",
    [
        {"log_level": Alarming()},
        {"model_output_names": Alarming()},
        {"preload": Alarming()},
        {"bounds": {"a": Alarming()}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_it_comes_out_of_the_making_of_an_environment(install, tmp_path, changes):
    fmu = probe_fmu(tmp_path)
    level = changes.pop("log_level", 30)
    install(ring)
    with pytest.raises(RingError):
        PlainEnv(fmu, probe_config(**changes), level)


class Branching(Drawing):
    """Its hooks cannot be compiled."""

    def _reward_policy(self):
        return 1.0 if self.state[0] > 0.0 else 0.0


def test_environments_can_be_made_while_it_is_handled(install):
    install(ring)
    try:
        alarm()
    except RingError:
        envs = fmugym.FMUVectorEnv(Branching, 2)
    with pytest.raises(fmugym.ConfigError):
        envs.reset(options={"parameters": {"none": np.ones(2)}})
    envs.close()


def test_a_folder_goes_although_its_removal_is_interrupted(install, monkeypatch):
    install(ring_late)
    folder = folder_name()
    make_folder(folder)
    (folder / "file").touch()

    def interrupted(*arguments, **options):
        monkeypatch.undo()
        alarm()

    monkeypatch.setattr(os, "unlink", interrupted)
    with pytest.raises(TimeoutError):
        remove_folder(folder, os.getpid())
    assert not folder.exists()
