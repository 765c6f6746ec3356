"""What an FMU said before it failed: in errors and in ``info["fault"]``, at every log level."""

import logging
import sys
from itertools import product

import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import MAJOR_VERSIONS
from ways import many
from words_tools import WordsEnv, words_fmu

from fmugym.errors import FMULoadError, SimulationError
from fmugym.pool.failure_texts import as_messages, quoted, telling, unpacked

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

WAYS = {
    "native": {"backend": "native"},
    "isolated": {"backend": "native", "isolation": "process"},
}
LEVELS = (logging.INFO, logging.WARNING, logging.CRITICAL)
all_ways = pytest.mark.parametrize("way", WAYS)
all_versions = pytest.mark.parametrize("version", MAJOR_VERSIONS)
newer_versions = pytest.mark.parametrize("version", MAJOR_VERSIONS[1:])


@pytest.fixture
def make_env(tmp_path, opened):
    def make(version, token, way="native", categories=None, **options):
        chosen = {} if categories is None else {"categories": categories}
        path = words_fmu(tmp_path, version, token, **chosen)
        return opened(WordsEnv(path, **WAYS[way], **options))

    return make


def fault(env, steps=3):
    """Play one episode; return why it ended."""
    env.reset()
    for _ in range(steps):
        *_, truncated, info = env.step(np.array([0.5], np.float32))
        if truncated:
            return info["fault"]
    return ""


@in_turn(
    {
        "version,call": list(product((2, 3), ("set", "step", "discard", "get"))),
        "way": list(WAYS),
        "level": LEVELS,
    }
)
def test_a_fault_of_a_step(make_env, caplog, way, version, level, call):
    env = make_env(version, call, way, at=2, level=level)
    assert fault(env).endswith(f"; the FMU said: the valve is stuck because of {call}")


@in_turn({"version,way": list(product(MAJOR_VERSIONS, WAYS)), "level": LEVELS})
def test_an_initialization(make_env, way, version, level):
    env = make_env(version, "initialize", way, level=level)
    with pytest.raises(SimulationError, match="initialization returned Error; the FMU said: the v"):
        env.reset()


@in_turn({"version,way": list(product(MAJOR_VERSIONS, WAYS)), "level": LEVELS})
def test_a_refusal(make_env, way, version, level):
    with pytest.raises(FMULoadError, match=r"refused to be instantiated.*the valve is stuck bec"):
        make_env(version, "refuse", way, level=level)


@pytest.mark.parametrize(("version", "categories"), [(1, ()), (2, ()), (3, ("logEvents",))])
def test_without_categories_the_second_fault_is_explained(make_env, version, categories):
    """The FMU is silent unless it logs everything, which it is asked to once it has failed."""
    env = make_env(version, "step", categories=categories, at=2)
    assert fault(env).endswith("returned Error")
    assert fault(env).endswith("the FMU said: the valve is stuck because of step")
    asked = [fault(env).endswith("because of step") for _ in range(10)]
    assert asked == [False, True] * 3 + [False] * 4


@all_versions
def test_an_fmu_without_a_word(make_env, version):
    env = make_env(version, "mute step", at=2)
    for _ in range(10):
        assert fault(env).endswith("the step at t = 0.5 s returned Error")


@in_turn({"token": ["no categories", "strict"], "version": [2, 3]})
def test_an_fmu_that_cannot_be_asked_works_all_the_same(make_env, version, token):
    env = make_env(version, token)
    assert fault(env) == ""
    assert env.state == pytest.approx([0.75, 0.0])


@newer_versions
def test_an_fmu_that_logs_more_than_asked_for_is_hushed(make_env, caplog, version):
    caplog.set_level(logging.DEBUG)
    env = make_env(version, "chatty")
    assert fault(env, 1001) == ""
    assert env.state[1] == 1.0
    env.reset()
    assert fault(env) == ""
    assert env.state[1] == 2.0
    assert not [r for r in caplog.records if "a step" in r.getMessage()]


def test_nothing_is_asked_for_if_everything_is_logged(make_env):
    env = make_env(2, "step", level=logging.INFO)
    env.reset()
    assert env.state[1] == 0.0


@all_ways
def test_the_cause_is_quoted_though_it_is_not_the_last_line(make_env, way):
    text = fault(make_env(2, "long step", way, at=2))
    assert text.endswith("returned Error; the FMU said: ** Severe ** the node has no flow")


@all_ways
def test_control_characters(make_env, way):
    text = fault(make_env(2, "control step", way, at=2))
    assert text.endswith(r"the valve is stuck because of step \x1b[31m\x07")


@all_ways
def test_messages_of_earlier_episodes_explain_nothing(make_env, way):
    env = make_env(2, "step loud", way, at=2)
    fault(env)
    env.reset()
    env.step(np.array([0.5], np.float32))
    env.pool.inputs[:] = np.nan
    env.pool.step_own()
    assert "stuck" not in env.pool.failure(0)


def test_environments_of_a_vector_say_their_own(tmp_path):
    path = words_fmu(tmp_path, 2, "step")
    at = {"distribution": "choice", "values": [0, 2]}
    for options in ({"threads": 1}, {"threads": 2}, {"isolation": "process", "workers": 2}):
        options |= {"way": "arrays", "autoreset_mode": "Disabled"}
        envs = many(lambda: WordsEnv(path, at=at), 8, **options)
        _, infos = envs.reset(seed=1)
        for _ in range(2):
            _, _, _, truncated, infos = envs.step(np.full((8, 1), 0.5, np.float32))
        assert 0 < truncated.sum() < 8
        for index in np.flatnonzero(truncated):
            assert infos["fault"][index].endswith("the valve is stuck because of step")
        envs.close()


class TestOutput:
    """The last lines that a worker has printed."""

    @pytest.mark.parametrize("token", ["step", "step mute", "crash", "crash mute", "hang"])
    def test_is_quoted(self, make_env, token, capfd):
        env = make_env(2, f"prints {token}", "isolated", at=2, call_timeout=2.0)
        text = fault(env)
        assert text.endswith("; it printed: the solver gives up | CPU time: 3 s | the oil is cold")
        assert ("because of step" in text) is ("mute" not in token)
        printed = capfd.readouterr()
        assert printed.out == "the solver gives up\nCPU time: 3 s\n"
        assert printed.err == "the oil is cold\n"
        env.reset()
        assert env.step(np.array([0.5], np.float32))[4].get("fault") is None

    def test_of_an_initialization(self, make_env):
        env = make_env(2, "prints initialize", "isolated")
        with pytest.raises(SimulationError, match="it printed: the solver gives up"):
            env.reset()

    def test_of_a_refusal(self, make_env):
        with pytest.raises(FMULoadError, match=r"stuck.*it printed: the solver gives up"):
            make_env(2, "prints refuse", "isolated", probe_timeout=None)

    def test_a_line_without_an_end(self, make_env, capfd):
        env = make_env(2, "unflushed step", "isolated", at=2)
        fault(env)
        env.close()
        assert capfd.readouterr().out == "no end"


class TestTelling:
    def test_bad_statuses_come_first(self):
        messages = [(0, "all is well"), (3, "it broke"), (0, "done"), (1, "hot")]
        assert telling(messages) == ["it broke", "hot"]

    def test_the_last_three_if_nothing_sounds_bad(self):
        assert telling(as_messages("abcde")) == ["c", "d", "e"]
        assert telling([]) == []
        assert quoted(as_messages(["", " \n"])) == ""

    def test_long_and_repeated_ones(self):
        (line,) = telling(as_messages(["error " + "x" * 1000] * 5))
        assert len(line) == 300
        assert line.endswith("...")

    def test_names_of_exceptions_that_say_nothing(self):
        assert telling(as_messages(["Exception: no licence"])) == ["no licence"]
        assert telling(as_messages(["ValueError: no licence"])) == ["ValueError: no licence"]

    def test_packed_messages(self):
        assert unpacked("3bad\x1e0good\x1e9?\x1e") == [(3, "bad"), (0, "good"), (9, "?")]
        assert unpacked("cut off\x1e2x\x1e") == [(-1, "cut off"), (2, "x")]
        assert unpacked("") == []
