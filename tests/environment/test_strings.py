"""Strings that episodes begin with: constant, drawn, and given for one episode. None is read."""

import pickle
from functools import partial

import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import grouped
from gymnasium import spaces
from process_tools import run_python
from values_tools import (
    POOLS,
    VERSIONS,
    fixture_feedthrough,  # noqa: F401  # the fixture "feedthrough"
    pools,
)
from vector_tools import require_same_alone
from ways import in_way

import fmugym
from fmugym import Choice, ConfigError, Uniform
from fmugym.records import RecordSeries

WORDS = ("a", "ünter", "longest of all", "")
CHOICE = Choice(WORDS)
SIZES = {word: len(word.encode()) for word in WORDS}
"""``length`` of ``feedthrough.c`` is the number of bytes of ``String_parameter``."""


class Reading(fmugym.FMUEnv):
    """An FMU of ``feedthrough.c``, with the text among the infos."""

    def __init__(self, path, words=CHOICE, backend=None, isolation=None, **changes):
        config = {
            "model_input_names": [],
            "model_output_names": "length",
            "model_parameters": {"String_parameter": words},
            "time_step": 0.1,
            "probe_timeout": None,
        }
        super().__init__(path, grouped(config | changes), backend=backend, isolation=isolation)

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return []

    def _is_done(self):
        return self.out["length"] > 1e9


class Telling(Reading):
    """Has hooks that read the text."""

    def _reward_policy(self):
        return 2.0 * (self.parameters["String_parameter"] == "a")

    def _get_info(self):
        return {"long": self.out["length"] > 3}


def drawn_words(seed, count):
    """What numpy draws with the same generator."""
    rng = np.random.default_rng(seed)
    return [WORDS[rng.choice(len(WORDS), p=None)] for _ in range(count)]


@in_turn({"version": VERSIONS, "options": POOLS})
def test_a_string_is_drawn_for_each_episode(feedthrough, version, options):
    env = Reading(feedthrough[version], **options)
    wanted = drawn_words(3, 12)
    for episode, word in enumerate(wanted):
        observation, info = env.reset(seed=None if episode else 3)
        assert info["drawn"] == {"String_parameter": word}
        assert env.parameters["String_parameter"] == word
        assert observation.tolist() == [SIZES[word]]
        assert env.step(0)[0].tolist() == [SIZES[word]]
    assert len(set(wanted)) > 2
    env.close()


HOOKED = [(Reading, "arrays"), (Telling, "arrays"), (Telling, "one by one")]


@in_turn(
    {
        "mode,cls,hooks": [(mode, *one) for one in HOOKED for mode in ("next_step", "same_step")],
        "options": POOLS,
    }
)
def test_vector_environments_draw_what_single_ones_do(feedthrough, options, mode, cls, hooks):
    drawn = {"String_parameter": CHOICE, "Float64_parameter": Uniform(0, 1)}
    config = {"model_parameters": drawn, "model_output_names": ["length", "Float64_told"]}
    make = partial(cls, feedthrough[3], max_episode_steps=2, **config, **options)
    assert require_same_alone(make, 9, mode, way=hooks)


@pools
def test_a_text_for_one_episode(feedthrough, options):
    env = Reading(feedthrough[3], words="abc", **options)
    _, info = env.reset(options={"model_parameters": {"String_parameter": "four"}})
    assert (info["drawn"], env.state) == ({"String_parameter": "four"}, (4.0,))
    _, info = env.reset(seed=3, options={"model_parameters": {"String_parameter": CHOICE}})
    assert info["drawn"]["String_parameter"] == drawn_words(3, 1)[0]
    assert env.state == (SIZES[drawn_words(3, 1)[0]],)
    env.reset()
    assert env.state == (3.0,)
    assert env.parameters["String_parameter"] == "abc"
    _, info = env.reset(options={"model_parameters": {"String_in": "other"}})
    assert info["drawn"] == {"String_in": "other"}
    env.close()


@in_turn({"hooks": ["arrays", "one by one"], "options": POOLS})
def test_each_environment_has_its_own_text(feedthrough, options, hooks, make_envs):
    envs = make_envs(in_way(hooks, lambda: Telling(feedthrough[3], words="abc", **options)), 3)
    assert envs.reset()[0][:, 0].tolist() == [3, 3, 3]
    envs.set_attr("String_parameter", ["a", "bbbb", "cc"])
    for _ in range(2):
        assert envs.reset()[0][:, 0].tolist() == [1, 4, 2]
        assert envs.step(np.zeros(3, np.int64))[1].tolist() == [2, 0, 0]
    assert [one["String_parameter"] for one in envs.get_attr("parameters")] == ["a", "bbbb", "cc"]
    given = {"model_parameters": {"String_parameter": "sixsix"}}
    assert envs.reset(options=given)[0][:, 0].tolist() == [6, 6, 6]
    assert envs.reset()[0][:, 0].tolist() == [1, 4, 2]
    envs.set_attr("String_parameter", "all")
    assert envs.reset()[0][:, 0].tolist() == [3, 3, 3]
    with pytest.raises(ConfigError, match=r"'String_parameter'.*String.*3"):
        envs.set_attr("String_parameter", ["a", "b", 3])


@pools
def test_texts_that_only_one_reset_knows_take_turns(feedthrough, options):
    """Each is the only one that its reset knows, also where an initial state could be kept."""
    env = Reading(feedthrough[3], words="abc", **options)
    for word in ("four", "sixsix", "four", "four", "sixsix", "sixsix", "abc"):
        given = {} if word == "abc" else {"model_parameters": {"String_parameter": word}}
        assert env.reset(options=given)[0].tolist() == [len(word)]
        assert env.parameters["String_parameter"] == word
        assert env.step(0)[0].tolist() == [len(word)]
    env.close()


@in_turn({"hooks": ["arrays", "one by one"], "options": POOLS})
def test_texts_for_one_episode_of_each_environment(feedthrough, options, hooks, make_envs):
    envs = make_envs(in_way(hooks, lambda: Telling(feedthrough[3], words="abc", **options)), 5)
    idle = np.zeros(5, np.int64)

    def texts():
        return [one["String_parameter"] for one in envs.get_attr("parameters")]

    def reset(words):
        for index, word in enumerate(words):
            given = {"reset_mask": np.arange(5) == index}
            if word != "abc":
                given["model_parameters"] = {"String_parameter": word}
            observations = envs.reset(options=given)[0]
            assert observations[index].tolist() == [len(word)]
        assert texts() == words

    envs.reset()
    words = ["a", "abc", "four", "", "sixsix"]
    reset(words)
    observations, rewards, *_ = envs.step(idle)
    assert observations[:, 0].tolist() == [1, 3, 4, 0, 6]
    assert rewards.tolist() == [2, 0, 0, 0, 0]
    saved = envs.save_state()
    reset(["sixsix", "a", "abc", "abc", "bb"])
    envs.restore_state(saved)
    assert texts() == words
    assert envs.step(idle)[0][:, 0].tolist() == [1, 3, 4, 0, 6]
    envs.set_attr("String_parameter", ["sixsix", "", "x", "abc", "yy"])
    assert texts() == words, "until the next reset"
    assert envs.step(idle)[1].tolist() == [2, 0, 0, 0, 0]
    assert envs.reset()[0][:, 0].tolist() == [6, 0, 1, 3, 2]
    assert texts() == ["sixsix", "", "x", "abc", "yy"]


def test_another_process_learns_the_text_of_a_snapshot(feedthrough, tmp_path):
    """A text that is not in the config, so that nothing else tells it."""
    with Reading(feedthrough[3]) as env:
        env.reset(seed=4, options={"model_parameters": {"String_parameter": "sixsix"}})
        env.step(0)
        (tmp_path / "state").write_bytes(pickle.dumps(env.save_state()))
    code = f"""
import pickle, test_strings
env = test_strings.Reading({str(feedthrough[3])!r})
with open({str(tmp_path / "state")!r}, "rb") as file:
    env.restore_state(pickle.load(file))
print(env.parameters["String_parameter"], *env.step(0)[0])
env.close()
"""
    result = run_python("-c", code)
    assert result.stdout.split() == ["sixsix", "6.0"], result.stderr


def test_a_weighted_choice(feedthrough, make_envs):
    envs = make_envs(lambda: Reading(feedthrough[2], words=Choice(["a", "bb"], [0.25, 0.75])), 2)
    rng = [np.random.default_rng(seed) for seed in (8, 9)]
    for episode in range(20):
        observations, _ = envs.reset(seed=None if episode else 8)
        wanted = [(1, 2)[one.choice(2, p=[0.25, 0.75])] for one in rng]
        assert observations[:, 0].tolist() == wanted


class Alternating:
    """A distribution of the user's own, which tells its texts."""

    values = ("x", "yy")

    def sample(self, rng):
        """One of the texts."""
        return self.values[int(rng.random() < 0.5)]


@pytest.mark.parametrize("hooks", ["arrays", "one by one"])
def test_a_distribution_of_the_users_own(feedthrough, hooks, make_envs):
    def make():
        return Reading(feedthrough[3], words=Alternating(), max_episode_steps=1)

    envs = make_envs(in_way(hooks, make), 2)
    streams = [np.random.default_rng(seed) for seed in (8, 9)]
    envs.reset(seed=8)
    wanted = [[1 + (one.random() < 0.5) for _ in range(4)] for one in streams]
    seen = [envs.step(np.zeros(2, np.int64))[0][:, 0].tolist() for _ in range(6)]
    assert seen[0] == [row[0] for row in wanted]
    assert seen[1] == [row[1] for row in wanted]
    assert seen[3] == [row[2] for row in wanted]


def test_a_task_file_draws_texts(feedthrough, tmp_path):
    (tmp_path / "task.toml").write_text(
        f"""
        fmu = "{feedthrough[3]}"
        time_step = 0.1
        [agent]
        actions = ["idle"]
        observations = ["length"]
        [variables]
        idle = {{ name = "Float64_in", min = -1, max = 1 }}
        [reward]
        near = "-length"
        [parameters]
        String_parameter = {{ distribution = "choice", values = ["a", "bb"] }}
        """
    )
    env = fmugym.load(tmp_path / "task.toml")
    seen = set()
    for _ in range(20):
        observation, info = env.reset()
        word = info["drawn"]["String_parameter"]
        assert observation.tolist() == [len(word)]
        seen.add(word)
    assert seen == {"a", "bb"}
    env.close()


@pytest.mark.parametrize(
    ("value", "facts"),
    [
        (3, r"'String_parameter'.*String.*3"),
        (Uniform(0, 1), r"'String_parameter'.*String.*Choice.*Uniform"),
        (Choice(["a", 2]), r"'String_parameter'.*String.*2"),
        (Choice(["a", "b\0"]), r"'String_parameter'.*NUL"),
        (["a", "b"], r"'String_parameter'.*String.*\['a', 'b'\]"),
    ],
)
def test_what_no_string_can_be(feedthrough, value, facts):
    with pytest.raises(ConfigError, match=facts):
        Reading(feedthrough[3], words=value)
    env = Reading(feedthrough[3])
    with pytest.raises(ConfigError, match=facts):
        env.reset(options={"model_parameters": {"String_parameter": value}})
    env.close()


def test_a_distribution_that_draws_another_text(feedthrough):
    class Wrong(Alternating):
        def sample(self, rng):
            return "zzz"

    with pytest.raises(ConfigError, match=r"'String_parameter'.*'zzz'.*'x'"):
        Reading(feedthrough[3], words=Wrong()).reset()


NUMBERS = "number or an Enumeration"
"""What the author of an FMU can add in the place of a String."""


class TestNoStringIsRead:
    @pytest.mark.parametrize("version", VERSIONS)
    @pytest.mark.parametrize("key", ["model_output_names", "monitor_names"])
    def test_by_a_config(self, feedthrough, version, key):
        with pytest.raises(ConfigError, match=f"'String_told'.*String.*{NUMBERS}"):
            Reading(feedthrough[version], **{key: "String_told"})

    def test_by_read_variables(self, feedthrough):
        env = Reading(feedthrough[3])
        env.reset()
        with pytest.raises(ConfigError, match=f"'String_told'.*String.*{NUMBERS}"):
            env.read_variables("length", "String_told")
        env.close()

    @pytest.mark.parametrize("name", ["String_told", "String_parameter"])
    def test_by_a_recorder(self, feedthrough, name):
        env = Reading(feedthrough[3])
        with pytest.raises(ConfigError, match=f"'{name}'.*String.*{NUMBERS}"):
            RecordSeries(env, ["length", name]).reset()
        env.close()

    def test_by_recorders_of_all(self, feedthrough):
        recorded = RecordSeries(Reading(feedthrough[3]), ["*", "length"])
        recorded.reset()
        names = {column.name for column in recorded.series.columns}
        recorded.close()
        assert "length" in names
        assert not {"String_told", "String_parameter", "String_in", "String_out"} & names

    def test_by_a_task_file(self, feedthrough, tmp_path):
        (tmp_path / "task.toml").write_text(
            f"""
            fmu = "{feedthrough[3]}"
            time_step = 0.1
            [agent]
            actions = ["idle"]
            observations = ["length"]
            [variables]
            idle = {{ name = "Float64_in", min = -1, max = 1 }}
            [reward]
            near = "-length * (String_told == 1)"
            """
        )
        with pytest.raises(ConfigError, match=f"(?s)String_told.*String.*{NUMBERS}"):
            fmugym.load(tmp_path / "task.toml")

    def test_info_lists_them(self, feedthrough, ran):
        listed = ran("info", feedthrough[3])
        for name in ("String_told", "String_parameter"):
            assert name in listed
