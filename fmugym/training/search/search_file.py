"""File of a search, from which the search continues exactly.

The file is an ``.npz`` archive of NumPy: arrays of numbers, and a text of JSON with all else, in
which the names of arrays stand for them. It holds nothing that could run.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, Final

import numpy as np

from fmugym.control.controller_parsing import controller_of, has_range, search_of
from fmugym.control.tuning import CMA, CandidateSearch
from fmugym.errors import ConfigError
from fmugym.training.search.policy import ResidualAgent
from fmugym.training.search.policy_search import Search
from fmugym.training.search.probe import Probe

__all__ = ["bytes_of", "plain_of", "search_in"]

_SCHEMA: Final = 1
_TEXT: Final = "text"
"""The name of the array of bytes that is the text."""

_COUNTS: Final = ("episodes", "rounds", "gained", "starts", "last_round")
"""Counts of a ``CandidateSearch``."""

_MOST: Final = 1_000_000
"""No count of numbers is larger; a damaged file could ask for any memory."""


def plain_of(value: Any) -> Any:
    """Convert a value to the form in which JSON keeps it; for a task, its identity."""
    return json.loads(json.dumps(value, default=_plain))


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


# Writing


def bytes_of(search: Search) -> bytes:
    """The content of the file of a search.

    Args:
        search: Between two rounds.
    """
    arrays: dict[str, Any] = {}

    def keep(array: Any) -> str:
        name = f"array_{len(arrays)}"
        arrays[name] = np.array(array, np.float64)
        return name

    text = json.dumps({"schema": _SCHEMA, **_facts_of(search, keep)}, default=_plain)
    file = io.BytesIO()
    np.savez(file, **{_TEXT: np.frombuffer(text.encode(), np.uint8), **arrays})
    return file.getvalue()


def _facts_of(search: Search, keep: Callable[[Any], str]) -> dict[str, Any]:
    probe, baseline = search.probe, search.baseline
    numbers = ("limits", "most_steps", "is_same", "seconds", "usual_steps")
    return {
        "task": probe.task,
        "linear": _facts_of_agent(probe.linear, keep),
        "agents": [_facts_of_agent(one, keep) for one in probe.agents],
        **{name: getattr(probe, name) for name in numbers},
        **{name: getattr(search, name) for name in ("seed", "episodes", "rounds", "steps")},
        "random": search.random_state,
        "controllers": [_facts_of_candidate_search(one, keep) for one in search.controllers],
        "policies": [_facts_of_candidate_search(one, keep) for one in search.policies],
        "baseline": None if baseline is None else _place(baseline, search.controllers),
        "scale": keep(search.scale),
        "widths": search.widths,
    }


def _place(candidate_search: CandidateSearch, among: list[CandidateSearch]) -> int:
    return next(place for place, one in enumerate(among) if one is candidate_search)


def _facts_of_agent(
    agent: ResidualAgent | None, keep: Callable[[Any], str]
) -> dict[str, Any] | None:
    if agent is None:
        return None
    facts = {one.name: getattr(agent, one.name) for one in fields(agent)}
    return facts | {"weights": keep(agent.weights), "scale": keep(agent.scale)}


def _facts_of_candidate_search(one: CandidateSearch, keep: Callable[[Any], str]) -> dict[str, Any]:
    return {
        "cma": None if one.cma is None else _facts_of_cma(one.cma, keep),
        **{name: _facts_of_agent(getattr(one, name), keep) for name in ("make", "then", "best")},
        **{n: None if (a := getattr(one, n)) is None else keep(a) for n in ("first", "leader")},
        **{name: list(getattr(one, name)) for name in ("lead", "merit")},
        **{name: getattr(one, name) for name in (*_COUNTS, "agreement")},
    }


def _facts_of_cma(cma: CMA, keep: Callable[[Any], str]) -> dict[str, Any]:
    return {n: keep(v) if isinstance(v, np.ndarray) else v for n, v in cma.state().items()}


# Reading


def search_in(content: bytes) -> Search:
    """The search that a file holds.

    Args:
        content: Content of the file.

    Raises:
        Exception: Of any kind, if the file is damaged; see ``fmugym.errors.reading_file``.
    """
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    facts = json.loads(arrays.pop(_TEXT).tobytes())
    if facts["schema"] != _SCHEMA:
        raise ValueError(f"its schema is {facts['schema']}, expected {_SCHEMA}")
    return _Reader(arrays).search(facts)


class _Reader:
    """Reader of objects from their facts, which refuses impossible ones.

    Args:
        arrays: By name.
    """

    def __init__(self, arrays: Mapping[str, Any]) -> None:
        self._arrays = arrays

    def search(self, facts: Mapping[str, Any]) -> Search:
        """A search."""
        search = Search(self._probe(facts), _count(facts["seed"], math.inf))
        search.episodes, search.rounds, search.steps = (
            _count(facts[name], math.inf) for name in ("episodes", "rounds", "steps")
        )
        search.random_state = facts["random"]
        search.controllers = [
            self._candidate_search(one, search) for one in _some(facts["controllers"])
        ]
        search.policies = [self._candidate_search(one, search) for one in facts["policies"]]
        place = facts["baseline"]
        search.baseline = None if place is None else search.controllers[_count(place)]
        search.scale = self._array(facts["scale"], 2, None)
        search.widths = [_count(one) for one in facts["widths"]]
        return search

    def _probe(self, facts: Mapping[str, Any]) -> Probe:
        limits = {str(name): _number(one) for name, one in facts["limits"].items()}
        return Probe(
            _kind(facts["task"], dict),
            self._agent(facts["linear"]),
            [self._agent(one) for one in _some(facts["agents"])],
            limits,
            _count(facts["most_steps"], math.inf),
            is_same=_kind(facts["is_same"], bool),
            seconds=_number(facts["seconds"], 0.0),
            usual_steps=_count(facts["usual_steps"], math.inf),
        )

    def _agent(self, facts: Mapping[str, Any]) -> ResidualAgent:
        observed, acting, hidden = (_count(facts[n]) for n in ("observed", "acting", "hidden"))
        text = facts["text"]
        _require_controller(text)
        agent = ResidualAgent(
            _kind(facts["name"], str),
            text,
            observed,
            acting,
            hidden,
            _kind(facts["history"], bool),
            self._array(facts["weights"], None),
            self._array(facts["scale"], 2, None),
            [_kind(one, str) for one in _kind(facts["names"], list)],
            _kind(facts["actions"], str),
        )
        if len(agent.weights) not in (0, agent.size):
            raise ValueError(f"{len(agent.weights)} weights, expected {agent.size}")
        return agent

    def _optional_agent(self, facts: Mapping[str, Any] | None) -> ResidualAgent | None:
        return None if facts is None else self._agent(facts)

    def _candidate_search(self, facts: Mapping[str, Any], search: Search) -> CandidateSearch:
        make = self._optional_agent(facts["make"])
        size = 0 if make is None else _size_of(make)
        first, leader = facts["first"], facts["leader"]
        counts = {name: _count(facts[name], math.inf) for name in _COUNTS}
        return CandidateSearch(
            None if facts["cma"] is None else self._cma(facts["cma"], size, search),
            make,
            then=self._optional_agent(facts["then"]),
            best=self._optional_agent(facts["best"]),
            first=None if first is None else self._array(first, None, size),
            leader=None if leader is None else self._array(leader, size),
            lead=_merit(facts["lead"]),
            merit=_merit(facts["merit"]),
            agreement=_number(facts["agreement"], -1.0),
            **counts,
        )

    def _cma(self, facts: Mapping[str, Any], size: int, search: Search) -> CMA:
        given = {n: self._array(v) if isinstance(v, str) else v for n, v in facts.items()}
        mean, population = given["mean"], _count(given.pop("population"))
        if mean.shape != (size,) or population < 2:
            raise ValueError(f"{population} candidates of {mean.size} numbers, expected {size}")
        cma = CMA(mean, 1.0, population, search.rng)
        cma.restore(given)
        return cma

    def _array(self, name: Any, *shape: int | None) -> Any:
        """An array of finite numbers; None stands for any length, no shape for any."""
        array = self._arrays[name]
        fits = not shape or (
            array.ndim == len(shape)
            and all(n in (None, own) for n, own in zip(shape, array.shape, strict=True))
        )
        if array.dtype != np.float64 or not fits or not np.isfinite(array).all():
            raise ValueError(f"{name} has no finite numbers of shape {shape}")
        return array


def _size_of(agent: ResidualAgent) -> int:
    """Number of sought numbers of an agent."""
    return len(search_of(agent.text).ranges) if has_range(agent.text) else agent.size


def _require_controller(text: Any) -> None:
    """Refuse a text that is no controller, with or without ranges."""
    try:
        if text is not None:
            _ = search_of(text) if has_range(_kind(text, str)) else controller_of(text)
    except ConfigError as error:
        raise ValueError(str(error)) from None


def _kind(value: Any, kind: type) -> Any:
    if type(value) is not kind:
        raise TypeError(f"expected {kind.__name__}, got {value!r}")
    return value


def _count(value: Any, most: float = _MOST) -> int:
    if not 0 <= _kind(value, int) <= most:
        raise ValueError(f"the count {value}")
    return int(value)


def _number(value: Any, least: float = -math.inf) -> float:
    if type(value) not in (int, float) or not value >= least:
        raise TypeError(f"expected a number of at least {least}, got {value!r}")
    return float(value)


def _merit(values: Any) -> tuple[float, float]:
    excess, mean = map(_number, values)
    return excess, mean


def _some(values: Any) -> list[Any]:
    if not _kind(values, list):
        raise ValueError("an empty list")
    return list(values)
