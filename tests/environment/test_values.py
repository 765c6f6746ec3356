"""Reading outputs and writing episode variables by name."""

import copy
import json
import pickle
from collections.abc import Mapping

import pytest

from fmugym import ConfigError
from fmugym.environment.value_mappings import UNFILLED, EpisodeVariables, LateDict, NamedValues


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

    def test_it_is_a_mapping(self):
        named = NamedValues("output", ["x", "y"], lambda: (1.0, 2.0))
        assert isinstance(named, Mapping)
        assert (named.get("y"), named.get("z"), named.get("z", 3.0)) == (2.0, None, 3.0)
        assert list(named.items()) == [("x", 1.0), ("y", 2.0)]
        assert list(named.values()) == [1.0, 2.0]
        assert named.keys() == {"x", "y"}
        assert named.keys() & {"y", "z"} == {"y"}
        assert ("x" in named, "z" in named, [] in named) == (True, False, False)
        assert named == {"x": 1.0, "y": 2.0}

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


LOOKS = {
    "__contains__": lambda d: ("a" in d, "z" in d),
    "__delitem__": lambda d: d.__delitem__("a"),
    "__eq__": lambda d: (d == {"a": 1, "b": 2}, d == {"a": 1, "b": 2}, d == {}, d == {}),
    "__ge__": lambda d: d.keys() >= {"a"},
    "__getitem__": lambda d: d["a"],
    "__gt__": lambda d: d.keys() > {"a"},
    "__ior__": lambda d: d.__ior__({"c": 3}),
    "__iter__": list,
    "__le__": lambda d: d.keys() <= {"a"},
    "__len__": lambda d: (len(d), bool(d)),
    "__lt__": lambda d: d.keys() < {"a"},
    "__ne__": lambda d: (d != {"a": 1, "b": 2}, d != {"a": 1, "b": 2}, d != {}, d != {}),
    "__or__": lambda d: d | {"a": 9, "c": 3},
    "__repr__": lambda d: (repr(d), str(d), f"{d}"),
    "__reversed__": lambda d: list(reversed(d)),
    "__ror__": lambda d: {"a": 9, "c": 3} | d,
    "__setitem__": lambda d: d.__setitem__("c", 3),
    "__sizeof__": lambda d: d.__sizeof__() > 0,
    "clear": lambda d: d.clear(),
    "copy": lambda d: d.copy(),
    "get": lambda d: (d.get("a"), d.get("z"), d.get("z", 5)),
    "items": lambda d: list(d.items()),
    "keys": lambda d: list(d.keys()),
    "pop": lambda d: (d.pop("a"), d.pop("z", 7)),
    "popitem": lambda d: d.popitem(),
    "setdefault": lambda d: (d.setdefault("a", 7), d.setdefault("z", 8)),
    "update": lambda d: (d.update({"a": 5}, z=7), d.update([("y", 1)])),
    "values": lambda d: list(d.values()),
}
"""A use of each method of ``dict`` that depends on its items."""

FUNCTIONS = [
    dict,
    list,
    set,
    sorted,
    len,
    lambda d: {**d},
    lambda d: (lambda **items: items)(**d),
    lambda d: {"a": 9, **d},
    lambda d: {"a": 9}.__or__(d),
    lambda d: plain_after(lambda plain: plain.update(d)),
    lambda d: plain_after(lambda plain: plain.__ior__(d)),
    json.dumps,
    lambda d: json.dumps(d, indent=1),
    lambda d: json.dumps({"drawn": d}),
    lambda d: pickle.loads(pickle.dumps(d)),
    lambda d: pickle.loads(pickle.dumps(d, protocol=2)),
    copy.copy,
    copy.deepcopy,
    lambda d: "{a}".format(**d),
    lambda d: "{a}".format_map(d),
    lambda d: d == d.copy(),
]


def plain_after(change):
    plain = {"a": 9, "c": 3}
    change(plain)
    return plain


def outcome(function, values):
    """What a function returns, or the type of what it raises, and the items afterwards."""
    try:
        result = function(values)
    except Exception as error:
        result = type(error)
    return result, dict(values)


class TestLateDict:
    def make(self):
        self.calls = 0

        def fill(offset):
            self.calls += 1
            return {"a": 1 + offset, "b": 2}

        return LateDict({UNFILLED: (fill, 0)})

    def test_every_method_of_dict_is_tried(self):
        others = {
            *("__class_getitem__", "__doc__", "__getattribute__", "__hash__", "__init__"),
            *("__new__", "fromkeys"),
        }
        assert set(vars(dict)) - others == set(LOOKS)

    def test_is_like_a_plain_dict(self):
        for name, function in [*LOOKS.items(), *enumerate(FUNCTIONS)]:
            late, plain = self.make(), {"a": 1, "b": 2}
            assert isinstance(late, dict)
            assert self.calls == 0, name
            assert outcome(function, late) == outcome(function, plain), name
            assert outcome(function, late) == outcome(function, plain), f"filled: {name}"
            assert self.calls == 1, name

    @pytest.mark.parametrize(
        "together",
        [lambda a, b: a == b, lambda a, b: a | b, lambda a, b: a.__ior__(b), lambda a, b: a != b],
    )
    def test_two_of_them(self, together):
        assert together(self.make(), self.make()) == together({"a": 1, "b": 2}, {"a": 1, "b": 2})

    def test_cannot_be_hashed(self):
        with pytest.raises(TypeError):
            hash(self.make())
