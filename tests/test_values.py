"""Reading outputs and writing episode variables by name."""

import copy
import pickle

import pytest

from fmugym import ConfigError
from fmugym.task.values import EpisodeVariables, LateDict, NamedValues


class TestNamedValues:
    def test_it_shows_the_present_values(self):
        values = [1.0, 2.0]
        named = NamedValues("output", ["x", "y"], lambda: values)
        values[1] = 3.0
        assert named["y"] == 3.0
        assert dict(named) == {"x": 1.0, "y": 3.0}
        assert list(named) == ["x", "y"]
        assert len(named) == 2
        assert repr(named) == "NamedValues({'x': 1.0, 'y': 3.0})"

    def test_unknown_name(self):
        named = NamedValues("output", ["theta"], lambda: [0.0])
        with pytest.raises(ConfigError, match="unknown output 'thet'; did you mean 'theta'"):
            named["thet"]

    def test_it_cannot_be_written(self):
        named = NamedValues("output", ["x"], lambda: [0.0])
        with pytest.raises(TypeError):
            named["x"] = 1.0


class TestEpisodeVariables:
    @pytest.fixture
    def variables(self):
        variables = EpisodeVariables({"target": 1.0, "integral": 0.0})
        variables["target"], variables["integral"] = 1.0, 0.0
        return variables

    def test_read_and_write(self, variables):
        variables["integral"] += 0.5
        variables.update(target=2.0)
        variables |= {"integral": 0.7}
        assert variables == {"target": 2.0, "integral": 0.7}
        assert variables.setdefault("target", 9.0) == 2.0

    @pytest.mark.parametrize(
        "write",
        [
            lambda v: v["targt"],
            lambda v: v.__setitem__("targt", 1.0),
            lambda v: v.update(targt=1.0),
            lambda v: v.update({"targt": 1.0}),
            lambda v: v.__ior__({"targt": 1.0}),
            lambda v: v.setdefault("targt", 1.0),
        ],
    )
    def test_misspelt_name(self, variables, write):
        with pytest.raises(ConfigError, match="variable 'targt'; did you mean 'target'"):
            write(variables)
        assert set(variables) == {"target", "integral"}

    @pytest.mark.parametrize(
        "remove",
        [
            lambda v: v.pop("target"),
            lambda v: v.popitem(),
            lambda v: v.clear(),
            lambda v: v.__delitem__("target"),
        ],
    )
    def test_none_can_be_removed(self, variables, remove):
        with pytest.raises(ConfigError, match="none can be removed"):
            remove(variables)
        assert set(variables) == {"target", "integral"}

    @pytest.mark.parametrize(
        "clone", [copy.copy, copy.deepcopy, lambda v: pickle.loads(pickle.dumps(v))]
    )
    def test_copies_are_dicts(self, variables, clone):
        """For an info, for example, that is sent to another process."""
        assert clone(variables) == {"target": 1.0, "integral": 0.0}


class TestLateDict:
    def make(self):
        self.calls = 0

        def fill():
            self.calls += 1
            return {"a": 1, "b": 2}

        return LateDict.of(fill)

    @pytest.mark.parametrize(
        "look",
        [
            lambda d: d["a"],
            lambda d: "a" in d,
            list,
            len,
            dict,
            lambda d: {**d},
            lambda d: d.get("a"),
            lambda d: list(d.items()),
            lambda d: list(d.values()),
            lambda d: list(d.keys()),
            lambda d: d.copy(),
            lambda d: d == {},
            repr,
            pickle.dumps,
            copy.deepcopy,
        ],
    )
    def test_is_filled_once_by_any_look(self, look):
        late = self.make()
        assert isinstance(late, dict)
        assert self.calls == 0
        look(late)
        look(late)
        assert self.calls == 1
        assert late == {"a": 1, "b": 2}

    def test_is_like_a_plain_dict(self):
        late = self.make()
        late["c"] = 3
        del late["a"]
        assert dict(late) == {"b": 2, "c": 3}
        assert pickle.loads(pickle.dumps(late)) == {"b": 2, "c": 3}
        assert repr(late) == "{'b': 2, 'c': 3}"
        assert late | {"d": 4} == {"b": 2, "c": 3, "d": 4}
