"""Exported agents: agents with all formulas around their networks, ready to be written."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Final

from fmugym.archive.description import Unit
from fmugym.checks import check_text
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.export.decisions import decision_of
from fmugym.export.logic import Logic, logic_of
from fmugym.export.network import Network
from fmugym.search.policy import ResidualAgent

__all__ = ["ExportedAgent", "agent_of", "check_name"]


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
