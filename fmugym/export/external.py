"""External data of a controller, given at run time: measured weather, forecasts, prices."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.checks import Spellings
from fmugym.declared import TaskEnv
from fmugym.declared.declarations import Declarations
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.export.names import identifier
from fmugym.expressions.graph import Graph

__all__ = ["found_in"]


def found_in(
    env: FMUEnv, names: Collection[str], graph: Graph, observation: Sequence[int]
) -> dict[int, Variable]:
    """Find the values of data in an observation, now or at other times.

    Args:
        env: The environment of a task file.
        names: The names of the data.
        graph: The operations.
        observation: The nodes of the elements of the observation.

    Returns:
        What takes the place of each, by the node that would look it up. Names differ from those of
        the plant's inputs.

    Raises:
        ConfigError: If there are no such data, or the agent does not observe them.
    """
    if not names:
        return {}
    seen = env.observation_names if isinstance(env, TaskEnv) else None
    if not isinstance(env, TaskEnv) or seen is None:
        raise ConfigError("only what a task file observes can be given to the agent from outside")
    series = Declarations(env.task.root, env.fmu.description).series
    spellings, found = Spellings("data", series), {}
    for name in map(spellings.require, names):
        places = [i for i, text in enumerate(seen) if text.partition("[")[0] == name]
        if not places:
            raise ConfigError(f"the agent does not observe {name!r}, so that nobody need give it")
        for place in places:
            node = _lookup_in(graph, observation[place], series[name])
            found[node] = _variable(seen[place], series[name], env)
    return found


def _lookup_in(graph: Graph, root: int, series: Any) -> int:
    for number in reversed(graph.needed([root])):
        node = graph.nodes[number]
        if node.kind == "interpolate" and np.array_equal(
            graph.tables[node.what][:-2], series.points
        ):
            return number
    raise ConfigError("data that do not change cannot be given from outside")


def _variable(name: str, series: Any, env: FMUEnv) -> Variable:
    facts: Mapping[str, Any] = {
        "value_reference": 0,
        "causality": "input",
        "variability": "continuous",
        "initial": None,
        "start": repr(float(series.values[0])),
        "unit": series.unit,
        "description": f"{name} of the task",
    }
    own, taken = identifier(name), env.interface.input_names
    kind = "Float64" if env.fmu.description.fmi_version.startswith("3") else "Real"
    return Variable(f"{own}_given" if own in taken else own, kind, **facts)
