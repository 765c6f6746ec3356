"""Exported agents: agents with all formulas around their networks, ready to be written.

A surrogate becomes one, too: from inputs and kept values to outputs.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any, Final

import numpy as np

from fmugym.checks import check_text
from fmugym.control.surrogate.surrogate import Surrogate
from fmugym.deployment.export.decision import decision_of
from fmugym.deployment.export.logic import Kept, Logic, Parameter, logic_of
from fmugym.deployment.export.network import Network
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.expressions.graph import Graph, Value, where
from fmugym.fmi.description import Unit
from fmugym.pool.pool_spec import is_start_time
from fmugym.training.search.policy import ResidualAgent

__all__ = ["ExportedAgent", "agent_of", "agent_of_surrogate", "check_name"]

_TAKEN: Final = frozenset(
    {"math", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string"}
    | {"agent_fmi2", "agent_fmi3", "fmu_instance", "fmu_model"}
    | {f"fmi{n}{part}" for n in (2, 3) for part in ("Functions", "FunctionTypes", "TypesPlatform")}
    | {"fmi3PlatformTypes"}
)
"""Headers and sources beside those of an agent, whose names are taken."""


@dataclass(frozen=True)
class ExportedAgent:
    """An agent of a task.

    Attributes:
        name: Name of functions and files.
        logic: Logic around the network.
        network: The network; None for none.
        notes: Lines that tell a reader what it is.
        units: The units of the plant by name.
        is_plant: Whether it stands for the plant, so that the first sample is that of the start.
    """

    name: str
    logic: Logic
    network: Network | None
    notes: tuple[str, ...]
    units: Mapping[str, Unit]
    is_plant: bool = False

    @property
    def version(self) -> str:
        """The version of fmugym."""
        return version("fmugym-toolbox")


def agent_of(
    env: FMUEnv,
    model: Any,
    normalization: Any = None,
    *,
    name: str = "agent",
    all_inputs: bool = False,
    external: Collection[str] = (),
) -> ExportedAgent:
    """Put an agent together from its task and its policy.

    Args:
        env: The environment that the agent was trained in, without wrappers. Agents of a search
            and controllers need the physical form of a task, see ``Task.physical``.
        model: An agent that a search has found, or its policy; a ``PID``, a ``Hysteresis`` or an
            ``LQR``; a model of Stable-Baselines3 or sb3-contrib; or a ``Network``.
        normalization: The ``VecNormalize`` of the training; None if there was none.
        name: Name of functions and files: letters, digits and _.
        all_inputs: Whether the agent also writes inputs that no action changes, such as the
            weather that the task feeds to the plant.
        external: The names of data that the agent is given as measurements, forecasts of them
            included, instead of looking them up in the task's tables.

    Raises:
        ConfigError: If the policy or the task cannot be exported; the text names what cannot.
    """
    check_name(name)
    decision = decision_of(env, model, normalization)
    logic = logic_of(env, decision, all_inputs=all_inputs, external=external)
    return ExportedAgent(
        name, logic, decision.network, _notes(env, model), env.fmu.description.units
    )


def check_name(name: str) -> str:
    """Check and return the name of functions and files.

    Raises:
        ConfigError: If it has more than letters, digits and _, or is that of another file.
    """
    if not check_text("name", name).isidentifier() or not name.isascii():
        raise ConfigError(f"the name must have letters, digits and _ only, got {shown(name)}")
    if name in _TAKEN:
        raise ConfigError(f"the name {name!r} is that of a file of C; choose another one")
    return name


def _notes(env: FMUEnv, model: Any) -> tuple[str, ...]:
    spec = getattr(env, "spec", None)
    task = type(env).__name__ if spec is None else str(spec.id)
    policy = type(model).__name__
    if isinstance(model, ResidualAgent):
        policy = model.name if model.text is None else f"{model.name} ({model.text})"
    return (
        f"Task: {task}, FMU: {env.fmu.description.model_name}, policy: {policy}.",
        "Compile it with -ffp-contract=off for the same numbers on every processor.",
    )


_DOUBLE: Final = np.dtype(np.float64)


def agent_of_surrogate(surrogate: Surrogate, name: str, units: Mapping[str, Unit]) -> ExportedAgent:
    """A surrogate in the form of an agent: the FMU's inputs are measurements, its outputs actions.

    The first sample gives the outputs at the start, and each other one those after a step. What
    was set before initialization in its courses are parameters.

    Args:
        surrogate: The surrogate.
        name: Name of functions and files: letters, digits and _.
        units: Units of the FMU by name.

    Raises:
        ConfigError: If the name cannot be that of a file and a function of C.
    """
    logic = _Writer(surrogate).logic()
    note = f"Surrogate: {surrogate.terms.form}; fitted to simulations of an FMU."
    return ExportedAgent(check_name(name), logic, None, (note,), units, is_plant=True)


class _Writer:
    """Makes the graph of a surrogate."""

    def __init__(self, surrogate: Surrogate) -> None:
        self._surrogate, self._graph = surrogate, Graph()
        self._loads: dict[int, Any] = {}
        self._kept: list[Kept] = []

    def logic(self) -> Logic:
        """Make the logic from inputs and kept values to outputs."""
        surrogate, spec = self._surrogate, self._surrogate.spec
        outputs, lags = len(spec.outputs), surrogate.terms.form.lags
        given = [self._loaded("measurement", place) for place in range(len(spec.inputs))]
        starts = [float(mean) for mean in surrogate.start.mean]
        parameters = self._keeping("starts", starts)
        before = self._keeping("outputs", [0.0] * outputs * (1 + lags))
        inputs, updates = self._inputs(given)
        row = [*before, *inputs, *(parameters if surrogate.terms.form.starts else ())]
        is_later = self._loaded("active", dtype=np.dtype(np.bool_))
        first = surrogate.start.values(parameters) if parameters else self._constants()
        pairs = zip(surrogate.next_outputs(row), first, strict=True)
        after = [where(is_later, one, other) for one, other in pairs]
        changes = [
            where(is_later, one - other, 0.0) for one, other in zip(after, before, strict=False)
        ]
        self._update("outputs", [*after, *changes, *before[outputs:]][: len(before)])
        self._update("inputs", updates)
        return Logic(
            self._graph,
            self._loads,
            spec.inputs,
            spec.outputs,
            tuple(one.node for one in after),
            (),
            tuple(self._kept),
            tuple(self._parameters()),
            spec.time_step,
        )

    def _inputs(self, given: Sequence[Value]) -> tuple[list[Value], list[Value]]:
        """Part of a row for inputs and their changes, and the values that are kept for it."""
        lags = self._surrogate.terms.form.lags
        kept = self._keeping("inputs", [0.0] * len(given) * lags)
        count = self._loaded("count", dtype=np.dtype(np.int64))
        changes = [
            where(count > 1, one - other, 0.0) for one, other in zip(given, kept, strict=False)
        ]
        row = [*given, *changes, *kept[len(given) :]]
        return row, row[: len(kept)]

    def _constants(self) -> list[Value]:
        """Outputs at the start of all episodes, if no start values are set."""
        return [Value.of(self._graph, float(one)) for one in self._surrogate.start.weights[:, 0]]

    def _loaded(self, *load: Any, dtype: np.dtype[Any] = _DOUBLE) -> Value:
        value = Value.read(self._graph, *map(str, load), dtype=dtype)
        self._loads[value.node] = load
        return value

    def _keeping(self, name: str, starts: Sequence[float]) -> list[Value]:
        """Keep numbers that begin so; nothing if there are none."""
        if not starts:
            return []
        self._kept.append(Kept(name, _DOUBLE, tuple(starts), ()))
        field = len(self._kept) - 1
        return [self._loaded("kept", field, place) for place in range(len(starts))]

    def _update(self, name: str, values: Sequence[Value]) -> None:
        """Let kept numbers become these."""
        nodes = tuple(one.node for one in values)
        self._kept = [
            replace(one, updates=nodes) if one.name == name else one for one in self._kept
        ]

    def _parameters(self) -> list[Parameter]:
        variables = enumerate(self._surrogate.variables)
        means = self._surrogate.start.mean
        return [
            Parameter(one.name, 0, place, float(means[place]), one)
            for place, one in variables
            if not is_start_time(one)
        ]
