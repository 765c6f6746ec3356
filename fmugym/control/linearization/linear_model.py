"""Linear models of FMUs from their directional derivatives (FMI 2.0 and 3.0)."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.environment.fmu_variables import start_values
from fmugym.errors import ConfigError, SimulationError
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.fmu import FMU, StandsForFMU
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.systems.system_description import SystemDescription
from fmugym.fmi.variable import Variable, start_of
from fmugym.pool.licences import licence_errors
from fmugym.pool.pool import FloatArray, Pool
from fmugym.pool.pool_spec import PoolSpec
from fmugym.pool.processes.process_pool import ProcessPool

__all__ = ["LinearModel", "linearize"]

logger = logging.getLogger(__name__)

_Variables = tuple[Variable, ...]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A model x_dot = f + A (x - x0) + B (u - u0), in continuous time and the FMU's own units.

    Attributes:
        A: Derivatives of ``derivatives`` by ``states``, shape (n, n).
        B: Derivatives of ``derivatives`` by ``inputs``, shape (n, m).
        f: The values of ``derivatives`` at the point of linearization, shape (n,); 0 at an
            equilibrium.
        x0: The values of ``states`` there, shape (n,).
        u0: The values of ``inputs`` there, shape (m,).
        states: The names of the states, in the order of rows and columns.
        inputs: The names of the inputs, in the order of columns.
        derivatives: The names of the derivatives of the states, in the order of rows.
        units: The unit of each of these variables; None where the FMU gives none.
    """

    A: FloatArray
    B: FloatArray
    f: FloatArray
    x0: FloatArray
    u0: FloatArray
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    derivatives: tuple[str, ...]
    units: Mapping[str, str | None]


def linearize(
    fmu: FMU | StandsForFMU | str | os.PathLike[str],
    *,
    states: str | Sequence[str] | None = None,
    inputs: str | Sequence[str] | None = None,
    at: Mapping[str, Any] | None = None,
) -> LinearModel:
    """Linearize an FMU or a system at the point it reaches by its initialization.

    The FMU computes the derivatives itself, by ``fmi2GetDirectionalDerivative`` or
    ``fmi3GetDirectionalDerivative``, or by ``fmi3GetAdjointDerivative`` if it has nothing else. So
    there is no step size and no truncation error. For a system, the derivatives of its components
    are joined by the chain rule, as if values were exchanged at all times.

    Args:
        fmu: Its path; or an ``FMU``, whose ``limits``, ``preload`` and ``probe_timeout`` are used;
            or an ``FMUSystem``.
        states: Names of continuous states, or one name; by default all that the FMU declares. The
            other states are held constant. The name of an array stands for its elements.
        inputs: Names of continuous inputs, or one name; by default all of them.
        at: Values by name, set before initialization: start values of states, inputs, parameters.

    Returns:
        The linear model.

    Raises:
        ConfigError: If the FMU provides no such derivatives or declares no states; if a name is
            unknown or belongs to a variable of another kind; if a value does not fit.
        FMULoadError: If the FMU cannot be loaded.
        SimulationError: If the FMU fails.
    """
    fmu = FMU.of(fmu)
    description = fmu.description
    _require_derivatives(description)
    x = _chosen(description, "continuous state", states, list(description.state_derivatives))
    u = _chosen(description, "continuous input", inputs, _inputs(description))
    start = _start_values(description, at or {})
    spec = PoolSpec((), (), 1.0, start_time=description.start_time)
    with closing(_open(fmu, spec)) as pool:
        pool.reset(tuple(start), np.array([list(start.values())], float).T)
        if pool.statuses[0] > WARNING_CODE:
            raise SimulationError(pool.failure(0))
        return _linear_model(pool, description, x, u)


@licence_errors()
def _open(fmu: FMU, spec: PoolSpec) -> Pool:
    """An unknown FMU runs in a process of its own, which it may crash."""
    if fmu.bundled and not fmu.isolated:
        from fmugym.pool.native_pool import NativePool

        return NativePool(fmu, spec, 1, logger, threads=1)
    return ProcessPool(fmu, spec, 1, logger, threads=1)


def _require_derivatives(description: ModelDescription) -> None:
    """Refuse an FMU, or a component of a system, that does not tell its derivatives."""
    if isinstance(description, SystemDescription):
        _require_chain(description)
        return
    name = f"{description.model_name} (FMI {description.fmi_version})"
    if not description.capabilities.provides_derivatives:
        raise ConfigError(
            f"{name} cannot be linearized: it provides neither directional derivatives, which are "
            "an option of FMI 2.0 and 3.0, nor adjoint ones, an option of FMI 3.0; its exporter "
            "may have a setting for them"
        )
    if not description.state_derivatives:
        raise ConfigError(
            f"{name} cannot be linearized: its ModelStructure declares no derivatives of "
            "continuous states"
        )


def _require_chain(description: SystemDescription) -> None:
    """Refuse a system to which the chain rule does not apply.

    All components must tell their derivatives, and no connection may carry an array.
    """
    plan = description.plan
    for component, part in zip(plan.components, description.parts, strict=True):
        if not part.capabilities.provides_derivatives:
            raise ConfigError(
                f"{plan.name} cannot be linearized: the derivatives of a system are those of all "
                f"components by the chain rule, and component {component.name!r} provides none"
            )
    parts = dict(zip((one.name for one in plan.components), description.parts, strict=True))
    for link in plan.links:
        if not parts[link.source].variable(link.output).is_scalar:
            raise ConfigError(
                f"{plan.name} cannot be linearized: {link.source}.{link.output} -> "
                f"{link.target}.{link.input} carries elements of arrays, and the chain rule is "
                "applied to connections of scalars only"
            )
    if not description.state_derivatives:
        raise ConfigError(f"{plan.name} cannot be linearized: its components declare no states")


def _inputs(description: ModelDescription) -> list[str]:
    return [
        one.name
        for v in description.variables.values()
        if (v.causality, v.variability, v.kind) == ("input", "continuous", "real")
        for one in v.elements
    ]


def _chosen(
    description: ModelDescription,
    kind: str,
    names: str | Sequence[str] | None,
    known: Sequence[str],
) -> _Variables:
    """Look up the chosen variables, or all known ones if none were chosen."""
    names = known if names is None else (names,) if isinstance(names, str) else names
    chosen = tuple(variable for name in names for variable in description.scalars(name))
    for variable in chosen:
        if variable.name not in known:
            raise ConfigError(
                f"{variable.name!r} is no {kind} of {description.model_name} but a "
                f"{variable.variability} {variable.causality}; expected some of: "
                f"{', '.join(map(repr, known)) or 'none'}"
            )
    return chosen


def _start_values(
    description: ModelDescription, values: Mapping[str, Any]
) -> dict[Variable, float]:
    return dict(start_of(variable, value) for variable, value in start_values(description, values))


def _linear_model(
    pool: Pool, description: ModelDescription, x: _Variables, u: _Variables
) -> LinearModel:
    x_dot = tuple(description.variable(description.state_derivatives[v.name]) for v in x)
    return LinearModel(
        A=pool.differentiate(x_dot, x)[:, :, 0],
        B=pool.differentiate(x_dot, u)[:, :, 0],
        f=pool.read(x_dot)[:, 0],
        x0=pool.read(x)[:, 0],
        u0=pool.read(u)[:, 0],
        states=_names(x),
        inputs=_names(u),
        derivatives=_names(x_dot),
        units={v.name: v.unit for v in (*x, *u, *x_dot)},
    )


def _names(variables: _Variables) -> tuple[str, ...]:
    return tuple(variable.name for variable in variables)
