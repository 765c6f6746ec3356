"""Strings that FMUs give: monitored, so that hooks read them as texts."""

import contextlib
import importlib.util
import logging
import os
import pickle
import signal
import threading
from concurrent.futures import ThreadPoolExecutor

import foreign_talker
import numpy as np
import pytest
import test_strings
import values_tools
import wine_tools
from pythonfmu import FmuBuilder

import fmugym
from fmugym import Choice, ConfigError, FMUVectorEnv, SimulationError
from fmugym.archive.fmu import FMU
from fmugym.archive.texts import number_of
from fmugym.pool import PoolSpec, has_native_pool
from fmugym.pool.local import local_pool
from fmugym.series import RecordSeries

WORDS = test_strings.WORDS
pools, versions = test_strings.pools, test_strings.versions


class Echo(test_strings.Reading):
    """``String_told`` is ``String_parameter``, and ``String_out`` is ``String_in``."""

    def __init__(self, path, words=test_strings.CHOICE, **changes):
        own = {
            "model_parameters": {"String_parameter": words, "String_in": "start"},
            "monitor_names": ["String_told", "String_out", "Boolean_out"],
        }
        super().__init__(path, **(own | changes))

    def _reward_policy(self):
        return 1.0 * (self.out["String_told"] == "a") + 2.0 * (self.out["String_out"] == "start")

    def _get_info(self):
        return {"told": self.out["String_told"]}


@pytest.fixture(scope="module")
def feedthrough(tmp_path_factory):
    folder = tmp_path_factory.mktemp("strings")
    versions = test_strings.VERSIONS
    return {v: values_tools.feedthrough_fmu(folder / f"F{v}.fmu", v) for v in versions}


@versions
@pools
def test_hooks_read_texts(feedthrough, version, options):
    env = Echo(feedthrough[version], **options)
    for _ in range(6):
        _, info = env.reset()
        word = info["drawn"]["String_parameter"]
        assert info["told"] == env.out["String_told"] == word
        _, reward, _, _, info = env.step(0)
        assert reward == (word == "a") + 2
        assert info["told"] == word
        assert env.read_variables("String_told", "length") == {
            "String_told": word,
            "length": test_strings.SIZES[word],
        }
    assert env.observation_space.shape == (1,)
    assert dict(env.out)["String_out"] == "start"
    env.close()


@pools
@pytest.mark.parametrize("hooks", ["auto", "array", "per_env"])
def test_vector_environments_read_texts(feedthrough, options, hooks):
    def make():
        return Echo(feedthrough[3], max_episode_steps=2, **options)

    envs = FMUVectorEnv(make, 3, hooks=hooks)
    singles = [make() for _ in range(3)]
    _, infos = envs.reset(seed=4)
    assert infos["told"].tolist() == [e.reset(seed=4 + i)[1]["told"] for i, e in enumerate(singles)]
    for step in range(8):
        _, rewards, _, ended, infos = envs.step(np.zeros(3, np.int64))
        for index, env in enumerate(singles):
            if step % 3 == 2:
                assert infos["told"][index] == env.reset()[1]["told"]
            else:
                _, reward, _, over, info = env.step(0)
                assert (rewards[index], ended[index]) == (reward, over)
                assert infos["told"][index] == info["told"]
    for env in singles:
        env.close()
    envs.close()


def test_the_other_hooks_stay_compiled(feedthrough, caplog):
    with caplog.at_level("INFO", "fmugym"):
        envs = FMUVectorEnv(lambda: Echo(feedthrough[3]), 2)
        envs.reset()
        envs.step(np.zeros(2, np.int64))
        envs.close()
    assert "_reward_policy" in caplog.text
    assert "'String_told'" in caplog.text
    assert "_is_done" not in caplog.text


@pools
def test_snapshots_hold_the_texts(feedthrough, options):
    env = Echo(feedthrough[3], **options)
    env.reset(seed=1)
    env.step(0)
    word = env.out["String_told"]
    saved = pickle.loads(pickle.dumps(env.save_state()))
    while env.out["String_told"] == word:
        env.reset()
    env.restore_state(saved)
    assert env.out["String_told"] == word
    assert env.step(0)[4]["told"] == word
    envs = FMUVectorEnv(lambda: Echo(feedthrough[3], **options), 2)
    envs.reset()
    envs.restore_state(saved)
    assert envs.step(np.zeros(2, np.int64))[4]["told"].tolist() == [word] * 2
    env.restore_state(envs.save_state()[1])
    assert env.out["String_told"] == word
    env.close()
    envs.close()


@pytest.mark.skipif(not has_native_pool() or not hasattr(os, "fork"), reason="needs C and forks")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_fork_while_a_pool_reads_texts(feedthrough):
    """A lock that another thread holds would stay locked in the child."""
    from fmugym import _native

    fmu = FMU(feedthrough[3])
    told = tuple(fmu.description.variables[name] for name in ("String_told", "String_out"))
    spec = PoolSpec((), told * 20, 0.1)
    pool = local_pool(fmu, spec, 1000, logging.getLogger("fmugym.test"), native=True, threads=1)
    done = threading.Event()

    def step():
        while not done.is_set():
            assert not pool.step()[1].any()

    with contextlib.closing(pool), ThreadPoolExecutor(1) as executor:
        pool.reset((), np.zeros((0, 1000)))
        steps = executor.submit(step)
        try:
            for _ in range(30):
                child = os.fork()
                if child == 0:
                    signal.alarm(5)  # ends the process if it hangs
                    _native.text_with(1.0)
                    os._exit(0)
                assert os.waitpid(child, 0)[1] == 0
        finally:
            done.set()
        steps.result()


@pytest.mark.usefixtures("wine")
class TestInWine:
    @pytest.mark.parametrize("version", [1, 3])
    def test_each_environment_has_its_own(self, tmp_path, version):
        with wine_tools.building_for_windows():
            path = values_tools.feedthrough_fmu(tmp_path / "Windows.fmu", version)
        envs = FMUVectorEnv(lambda: Echo(path), 2)
        for episode in range(3):
            _, infos = envs.reset(seed=None if episode else 3)
            drawn = infos["drawn"]["String_parameter"].tolist()
            assert drawn == [test_strings.drawn_words(seed, 3)[episode] for seed in (3, 4)]
            assert infos["told"].tolist() == drawn
            assert envs.step(np.zeros(2, np.int64))[4]["told"].tolist() == drawn
        saved = envs.save_state()
        envs.reset()
        envs.restore_state(saved)
        assert [out["String_told"] for out in envs.get_attr("out")] == drawn
        envs.close()


class Pair(test_strings.Reading):
    """Two components without connections."""

    def __init__(self, path, **options):
        super().__init__(
            fmugym.FMUSystem({"a": path, "b": path}, []),
            model_output_names=["a.length", "b.length"],
            monitor_names=["a.String_told", "b.String_told"],
            model_parameters={"a.String_parameter": Choice(WORDS), "b.String_parameter": "zz"},
            **options,
        )

    def _is_done(self):
        return self.out["a.String_told"] == "never"


@versions
@pools
def test_components_of_a_system(feedthrough, version, options):
    env = Pair(feedthrough[version], **options)
    for episode, word in enumerate(test_strings.drawn_words(1, 4)):
        env.reset(seed=None if episode else 1)
        env.step(0)
        assert env.state == (test_strings.SIZES[word], 2.0)
        assert (env.out["a.String_told"], env.out["b.String_told"]) == (word, "zz")
    env.close()


@pools
def test_an_fmu_of_another_exporter(tmp_path, options):
    path = FmuBuilder.build_FMU(foreign_talker.__file__, dest=tmp_path)
    config = {"monitor_names": "said"}
    config |= {"model_parameters": {"word": Choice(WORDS)}}
    env = test_strings.Reading(path, **config, **options)
    env.reset(seed=2)
    for time in ("0.0", "0.1"):
        env.step(0)
        assert env.out["said"] == f"{test_strings.drawn_words(2, 1)[0]} at {time}"
    env.close()


class Rig:
    """A backend that tells how often it was stepped, as a text."""

    def reset(self, start_values):
        self.steps, self.word = 0, start_values["String_parameter"]
        return self.outputs()

    def step(self, inputs):
        self.steps += 1
        return self.outputs(), fmugym.Status.OK

    def outputs(self):
        return {"length": 1.0, "String_told": f"{self.word} {self.steps}"}

    def stop(self):
        pass


def test_a_backend_gives_texts(feedthrough):
    changes = {"words": "abc", "monitor_names": ["String_told"]}
    env = test_strings.Reading(feedthrough[3], backend=Rig(), **changes)
    env.reset()
    assert env.out["String_told"] == "abc 0"
    env.step(0)
    assert env.out["String_told"] == "abc 1"
    env.close()


@pytest.mark.parametrize(
    ("given", "facts"),
    [
        ({"String_told": 3.0}, "'String_told'.*String.*3.0"),
        ({"String_told": None}, "'String_told'.*String.*None"),
        ({"length": "one"}, "'one'"),
    ],
)
def test_a_backend_that_mixes_texts_and_numbers_fails(feedthrough, given, facts):
    class Mixed(Rig):
        def outputs(self):
            return super().outputs() | given

    changes = {"words": "abc", "monitor_names": ["String_told"]}
    env = test_strings.Reading(feedthrough[3], backend=Mixed(), **changes)
    with pytest.raises(SimulationError, match=facts):
        env.reset()
    env.close()


def test_long_and_foreign_texts(feedthrough):
    texts = ["x" * 199, "日本語", "\n\t"]
    for backend in ("native", "python"):
        env = Echo(feedthrough[3], words=Choice(texts), backend=backend)
        for _ in range(5):
            _, info = env.reset()
            assert info["told"] == info["drawn"]["String_parameter"]
        env.close()


def test_numbers_of_texts():
    """Those of FNV-1a, folded: the published hashes of two texts of its authors."""
    fold = [(h >> 53) ^ (h % 2**53) for h in (0xCBF29CE484222325, 0x85944171F73967E8)]
    assert [number_of(""), number_of("foobar")] == fold


def test_nobody_is_asked_for_an_empty_text():
    """A question to worker processes would take its time in each step."""
    spec = importlib.util.find_spec("fmugym.archive.texts")
    fresh, asked = importlib.util.module_from_spec(spec), []
    spec.loader.exec_module(fresh)
    fresh.ask_for_texts(asked.append)
    assert [fresh.text_of(number_of(text)) for text in ("", "never met")] == ["", ""]
    assert asked == [number_of("never met")]


def test_series_leave_texts_out(feedthrough):
    env = RecordSeries(Echo(feedthrough[3]))
    env.reset(seed=0)
    env.step(0)
    names = [column.name for column in env.series.columns]
    assert "length" in names
    assert not {"String_told", "String_out", "String_parameter"} & set(names)
    env.close()
    with pytest.raises(ConfigError, match="String_told"):
        RecordSeries(Echo(feedthrough[3]), ["String_told"])


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        ({"model_output_names": "String_in"}, r"'String_in'.*String.*monitor_names"),
        ({"samplings": {"String_told": "mean"}}, r"'String_told'.*String.*'last'.*'mean'"),
        ({"monitor_names": ["Binary_in"]}, r"'Binary_in'.*Binary"),
    ],
)
def test_what_cannot_be_read(feedthrough, changes, facts):
    with pytest.raises(ConfigError, match=facts):
        Echo(feedthrough[3], **changes)


def test_an_environment_without_hooks_that_read_texts(feedthrough):
    """All hooks are compiled, though a String is monitored."""
    envs = FMUVectorEnv(
        lambda: test_strings.Reading(feedthrough[3], monitor_names="String_told"),
        2,
        hooks="compiled",
    )
    envs.reset(seed=2)
    envs.step(np.zeros(2, np.int64))
    told = [out["String_told"] for out in envs.get_attr("out")]
    assert told == [one["String_parameter"] for one in envs.get_attr("parameters")]
    envs.close()
