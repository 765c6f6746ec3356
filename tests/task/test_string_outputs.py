"""Strings that FMUs give: monitored, so that hooks read them as texts."""

import contextlib
import importlib.util
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import foreign_talker
import gymnasium
import numpy as np
import pytest
import test_strings
import values_tools
import wine_tools
from combinations import in_turn
from pythonfmu import FmuBuilder
from values_tools import (
    POOLS,
    VERSIONS,
    fixture_feedthrough,  # noqa: F401  # the fixture "feedthrough"
    pools,
)
from vector_tools import HOOKS, in_each_mode, require_same_alone

import fmugym
from fmugym import Choice, ConfigError, FMUVectorEnv, SimulationError
from fmugym.archive.fmu import FMU
from fmugym.archive.texts import number_of, numbers_of
from fmugym.logs import PlantLog
from fmugym.pool import PoolSpec
from fmugym.pool.local import local_pool
from fmugym.series import RecordSeries, RecordVectorSeries, TimeSeries, plot, write_report
from fmugym.task.quantity import Quantity

WORDS = test_strings.WORDS


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


@in_turn({"version": VERSIONS, "options": POOLS})
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


@in_turn({"hooks": HOOKS, "options": POOLS})
def test_vector_environments_read_texts(feedthrough, options, hooks):
    def make():
        return Echo(feedthrough[3], max_episode_steps=2, **options)

    assert require_same_alone(make, 8, hooks=hooks)


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
def test_snapshots_hold_the_texts(feedthrough, options, make_envs):
    env = Echo(feedthrough[3], **options)
    env.reset(seed=1)
    env.step(0)
    word = env.out["String_told"]
    saved = pickle.loads(pickle.dumps(env.save_state()))
    while env.out["String_told"] == word:
        env.reset()
    env.restore_state(saved)
    assert env.out["String_told"] == env.parameters["String_parameter"] == word
    assert env.step(0)[4]["told"] == word
    envs = make_envs(lambda: Echo(feedthrough[3], **options), 2)
    envs.reset()
    envs.restore_state(saved)
    assert [one["String_parameter"] for one in envs.get_attr("parameters")] == [word] * 2
    assert envs.step(np.zeros(2, np.int64))[4]["told"].tolist() == [word] * 2
    env.restore_state(envs.save_state()[1])
    assert env.out["String_told"] == word
    env.close()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs forks")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_fork_while_a_pool_reads_texts(feedthrough):
    """A lock that another thread holds would stay locked in the child."""
    from fmugym import _native

    fmu = FMU(feedthrough[3])
    told = tuple(fmu.description.variables[name] for name in ("String_told", "String_out"))
    spec = PoolSpec((), told * 20, 0.1)
    pool = local_pool(fmu, spec, 1000, logging.getLogger("fmugym.test"), threads=1)
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
    def test_each_environment_has_its_own(self, tmp_path, version, make_envs):
        with wine_tools.building_for_windows():
            path = values_tools.feedthrough_fmu(tmp_path / "Windows.fmu", version)
        envs = make_envs(lambda: Echo(path), 2)
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


@in_turn({"version": VERSIONS, "options": POOLS})
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
        return self.outputs(), fmugym.fmi.Status.OK

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
    env = Echo(feedthrough[3], words=Choice(texts))
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


ALL = ("String_told", "String_out", "String_parameter", "length")


class TestSeries:
    """The text of each step is in columns, and comes back out of files."""

    def record(self, env, names=ALL, steps=(3, 2, 4), **options):
        """Play episodes; return the recorder and the texts that the hooks have read."""
        recorded, told = RecordSeries(env, names, **options), []
        for seed, count in enumerate(steps):
            recorded.reset(seed=seed)
            told.append(env.out["String_told"])
            for _ in range(count):
                recorded.step(0)
                told.append(env.out["String_told"])
        return recorded, told

    @in_turn({"version": VERSIONS, "options": POOLS})
    def test_of_one_environment(self, feedthrough, version, options):
        recorded, told = self.record(Echo(feedthrough[version], **options))
        series = recorded.series
        recorded.close()
        assert series["String_told"].tolist() == told
        assert series["String_parameter"].tolist() == told
        assert set(series["String_out"]) == {"start"}
        assert series["length"].tolist() == [test_strings.SIZES[word] for word in told]
        assert len({column.kind for column in series.columns if column.name in ALL}) == 3

    def test_monitored_ones_are_there_by_default(self, feedthrough):
        recorded, _ = self.record(Echo(feedthrough[3]), None)
        names = [column.name for column in recorded.series.columns]
        assert {"String_told", "String_out"} <= set(names)
        assert "String_parameter" not in names
        recorded.close()

    def test_ones_that_are_not_monitored(self, feedthrough):
        recorded = RecordSeries(test_strings.Reading(feedthrough[3]), ["String_t*", "length"])
        recorded.reset(seed=0)
        recorded.step(0)
        series = recorded.series
        recorded.close()
        lengths = [test_strings.SIZES[word] for word in series["String_told"]]
        assert series["length"].tolist() == lengths

    @in_each_mode({"options": POOLS})
    def test_of_many_environments(self, feedthrough, options, hooks, mode):
        envs = FMUVectorEnv(
            lambda: Echo(feedthrough[3], max_episode_steps=2, **options),
            3,
            hooks=hooks,
            autoreset_mode=mode,
        )
        recorded = RecordVectorSeries(envs, ALL)
        recorded.reset(seed=4)
        for _ in range(7):
            ended = recorded.step(np.zeros(3, np.int64))[3]
            if mode is gymnasium.vector.AutoresetMode.DISABLED and ended.any():
                recorded.reset(options={"reset_mask": ended})
        episodes = recorded.series.episodes()
        recorded.close()
        assert len(episodes) > 6
        for rows in episodes.values():
            (word,) = set(rows["String_told"])
            assert set(rows["String_parameter"]) == {word}
            assert set(rows["length"]) == {test_strings.SIZES[word]}
        assert len({rows["String_told"][0] for rows in episodes.values()}) > 1

    def test_csv_files(self, feedthrough, tmp_path):
        recorded, told = self.record(Echo(feedthrough[3]), path=tmp_path / "a.csv")
        recorded.close()
        recorded.series.write(tmp_path / "b.csv")
        assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()
        log = PlantLog.read(tmp_path / "a.csv")
        assert log.texts["String_told"].tolist() == told
        assert set(log.texts["String_out"]) == {"start"}
        assert "String_told" not in log.columns
        assert "String_told" not in log.units
        parts = [part.texts["String_parameter"] for part in log.parts()]
        assert np.concatenate(parts).tolist() == told

    def test_texts_that_look_like_something_else(self, feedthrough, tmp_path):
        words = ["1", 'a,"b"', "nan", "two\nlines", " ", "T [degC]"]
        env = Echo(feedthrough[3], fmugym.Choice(words))
        recorded, told = self.record(env, steps=[1] * 30, path=tmp_path / "a.csv")
        recorded.close()
        assert set(told) == set(words)
        assert PlantLog.read(tmp_path / "a.csv").texts["String_told"].tolist() == told

    def test_parquet_files_and_frames(self, feedthrough, tmp_path):
        pytest.importorskip("pyarrow", reason="needs the extra parquet")
        recorded, told = self.record(Echo(feedthrough[3]), path=tmp_path / "a.parquet")
        series = recorded.series
        recorded.close()
        read = TimeSeries.read(tmp_path / "a.parquet")
        assert read["String_told"].tolist() == told
        assert read.columns == series.columns
        np.testing.assert_array_equal(read.values, series.values)
        frame = pytest.importorskip("pandas", reason="needs the extra pandas").read_parquet(
            tmp_path / "a.parquet"
        )
        assert frame["String_told"].tolist() == series.to_pandas()["String_told"].tolist() == told

    def test_another_process_knows_the_texts(self, feedthrough):
        """The numbers of texts that an FMU has made are known to its process only."""
        recorded, told = self.record(Echo(feedthrough[3], isolation="process"))
        data = pickle.dumps(recorded.series)
        recorded.close()
        text = "import pickle, sys; s = pickle.load(sys.stdin.buffer)\n"
        text += "print(ascii(s['String_told'].tolist()))"
        command = [sys.executable, "-c", text]
        found = subprocess.run(command, input=data, capture_output=True, check=True, timeout=60)
        assert found.stdout.decode().strip() == ascii(told)

    def test_pictures_and_reports(self, tmp_path):
        columns = (
            *(Quantity("episode", "index"), Quantity("step", "index"), Quantity("time", "time")),
            *(Quantity("phase", "text"), Quantity("reward", "reward")),
            *(Quantity("terminated", "flag"), Quantity("truncated", "flag")),
        )
        words = [f"phase <{i // 4}> $x$" for i in range(60)]
        values = np.zeros((60, 7))
        values[:, 1] = values[:, 2] = np.arange(60)
        values[:, 3] = numbers_of(words)
        series = TimeSeries(columns, values, texts={number_of(word): word for word in words})
        plot(series, tmp_path / "phases.svg")
        svg = (tmp_path / "phases.svg").read_text()
        assert "phase &lt;0&gt; $x$" in svg
        assert "11 more" in svg
        assert "phase &lt;14&gt;" not in svg
        write_report(tmp_path / "phases.html", {"run": series}, title="Phases")
        page = (tmp_path / "phases.html").read_text()
        assert page.count("6.67 %") == 15
        assert "phase &lt;14&gt; $x$" in page


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


def test_an_environment_without_hooks_that_read_texts(feedthrough, make_envs):
    """All hooks are compiled, though a String is monitored."""
    envs = make_envs(
        lambda: test_strings.Reading(feedthrough[3], monitor_names="String_told"),
        2,
        hooks="compiled",
    )
    envs.reset(seed=2)
    envs.step(np.zeros(2, np.int64))
    told = [out["String_told"] for out in envs.get_attr("out")]
    assert told == [one["String_parameter"] for one in envs.get_attr("parameters")]
