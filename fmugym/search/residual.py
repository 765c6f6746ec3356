"""Residual policies: controllers, to whose actions a network of another library adds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.baselines.controller import Controller, limited
from fmugym.errors import ConfigError
from fmugym.expressions.value import Value
from fmugym.pool.base import FloatArray
from fmugym.search.policy import PolicyState, ResidualAgent, ResidualPolicy

__all__ = ["Residual"]

_SINGLE: Final = np.dtype(np.float32)


class Residual(ResidualPolicy):
    """A controller to whose action a model of Stable-Baselines3 adds.

    The model sees the observation and the controller's action, which goes from -1 to 1. It adds a
    part of the range at most. The sum is limited, and the controller's integral does not grow while
    it is at a limit. Where the model gives zeros, this is the controller. (T. Silver et al.,
    Residual Policy Learning, 2018.)

    Args:
        controller: The controller.
        scale: The part of the range.
        model: The model; None for one that is trained now.
        normalization: Its ``VecNormalize``, or None.
        task: The names of what it observes and the action space in words, see ``ResidualAgent``;
            it is for this task only. None for any.
    """

    baseline: Controller

    def __init__(
        self,
        controller: Controller,
        scale: float,
        model: Any = None,
        normalization: Any = None,
        task: tuple[Sequence[str], str] | None = None,
    ) -> None:
        names, actions = task or ((), "")
        super().__init__(controller, ResidualAgent("residual", names=names, actions=actions))
        self.scale, self.model, self.normalization = scale, model, normalization

    def _prepare(self) -> None:
        super()._prepare()
        space = self.space
        if not (isinstance(space, spaces.Box) and space.is_bounded()):
            raise ConfigError(f"a residual policy needs actions with limits, got {space}")

    # Of arrays.

    def seen(self, observation: Any) -> npt.NDArray[np.float32]:
        """Observation of the model, shape (N, k + m); the controller decides first."""
        return self._features(self._rows(observation))

    def _features(self, rows: FloatArray) -> npt.NDArray[np.float32]:
        base = self.baseline._decide(rows).reshape(self.count, -1).T
        self._base = [*base]
        told = np.stack(self._controlled(self._base), axis=-1)
        return np.concatenate([rows, told], axis=1).astype(_SINGLE)

    def actions(self, changes: Any) -> Any:
        """Actions from the outputs of the model, shape (N, ...), from -1 to 1."""
        return self._as_actions(self._summed(np.asarray(changes, np.float64)))

    def _summed(self, changes: FloatArray) -> FloatArray:
        columns = [*changes.reshape(self.count, -1).T]
        self.baseline.add(np.stack(self.added(columns), axis=-1))
        return np.stack(self._with_changes(self._base, columns), axis=-1)

    def _decide(self, rows: FloatArray) -> FloatArray:
        seen: Any = self._features(rows)
        if self.normalization is not None:
            seen = self.normalization.normalize_obs(seen)
        return self._summed(np.asarray(self.model.predict(seen, deterministic=True)[0], np.float64))

    @property
    def memory(self) -> dict[str, Any]:
        """All that it knows of its episodes, for one that goes on."""
        kept = {name: vars(self.baseline).get(name) for name in ("_state", "_before")}
        return {"base": self._base, **kept}

    @memory.setter
    def memory(self, memory: dict[str, Any]) -> None:
        self._base = memory["base"]
        vars(self.baseline).update({name: memory[name] for name in ("_state", "_before")})

    # Of arrays and of formulas.

    def _controlled(self, base: Sequence[Any]) -> list[Any]:
        """The controller's action as the model sees it."""
        limits = zip(base, self.limits, strict=True)
        return self._told([limited(one, low, high) for one, (low, high) in limits])

    def added(self, changes: Sequence[Any]) -> list[Any]:
        """See ``ResidualPolicy.added``."""
        limits = zip(changes, self.limits, strict=True)
        return [self.scale * (high - low) * one for one, (low, high) in limits]

    def _with_changes(self, base: Sequence[Any], changes: Sequence[Any]) -> list[Any]:
        pairs = zip(base, self.added(changes), self.limits, strict=True)
        return [limited(limited(one, *ends) + more, *ends) for one, more, ends in pairs]

    def corrected(
        self,
        observation: Sequence[Value],
        memory: Sequence[Sequence[Value]],
        base: Sequence[Value],
        network: Callable[[Sequence[Value]], Sequence[Value]],
    ) -> tuple[Sequence[Value], Sequence[Sequence[Value]]]:
        """See ``ResidualPolicy.corrected``."""
        features = [*observation, *self._controlled(base)]
        changes = network([one.cast(_SINGLE).number for one in features])
        return self._with_changes(base, changes), ()

    @property
    def starts(self) -> PolicyState:
        """See ``ResidualPolicy.starts``; the model remembers nothing."""
        return ()
