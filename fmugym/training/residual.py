"""Residual policies: controllers, to whose actions a network of another library adds.

Their trainings write facts about the controllers in folders.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from importlib import import_module
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import check_number
from fmugym.control import controller_of
from fmugym.control.controller import Controller, limited
from fmugym.control.controller_parsing import has_range, plans_ahead, search_of
from fmugym.control.tuning import tune
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.expressions.graph import Value
from fmugym.pool.pool import FloatArray
from fmugym.records.players import given_controller
from fmugym.training.search.policy import PolicyState, ResidualAgent, ResidualPolicy

__all__ = ["Residual", "begin_at_zero", "residual_facts", "residual_of"]

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


_TRIALS: Final = 64


def residual_facts(
    make_env: Callable[..., FMUEnv],
    name: str,
    scale: float,
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Facts of a training and of its agent's folder; ranges of the controller are tuned.

    Args:
        make_env: Makes the environment; its task has the controller.
        name: Name of a controller of the task, or the text of one.
        scale: The part of the range that is added to its action at most.
        tell: Gets lines of text.

    Raises:
        ConfigError: If there is no such controller, or it plans ahead and so has no formula.
    """
    part = check_number("--residual-scale", scale, positive=True)
    if part > 1:
        raise ConfigError(f"--residual-scale is a part of the range, at most 1, got {part:g}")
    make_physical = partial(make_env, physical=True)
    with closing(make_physical()) as env:
        given = given_controller(env, name)
    if plans_ahead(given):
        raise ConfigError(f"{shown(given)} plans ahead; a residual is for a pid or a hysteresis")
    text = given if isinstance(given, str) else f"schedule 00:00={given}"
    if has_range(text):
        tell(f"tunes {text}")
        search = search_of(text)
        text = search.text(tune(search.make, make_physical, search.ranges).parameters)
        tell(f"adds to {text}")
    controller_of(text)
    return {"controller": text, "scale": part}


def residual_of(facts: Mapping[str, Any], *model: Any) -> Residual:
    """The policy of such facts.

    Args:
        facts: As ``residual_facts`` returns them.
        model: The other arguments of ``Residual``.
    """
    return Residual(controller_of(facts["controller"]), float(facts["scale"]), *model)


def begin_at_zero(model: Any) -> None:
    """Let a new model of Stable-Baselines3 give exactly zeros: its last layer has none but zeros.

    Raises:
        ConfigError: If its policy is of a kind that cannot.
    """
    torch: Any = import_module("torch")
    policy = model.policy
    actor = getattr(policy, "action_net", None)
    if actor is None:
        actor = getattr(getattr(policy, "actor", None), "mu", None)
    modules = [] if actor is None else [*actor.modules()]
    linear = [one for one in modules if isinstance(one, torch.nn.Linear)]
    for parameter in linear[-1].parameters() if linear else ():
        torch.nn.init.zeros_(parameter)
    if hasattr(policy, "actor_target"):
        policy.actor_target.load_state_dict(policy.actor.state_dict())
    rng, space = np.random.default_rng(0), model.observation_space
    trials = rng.normal(size=(_TRIALS, *space.shape)).astype(space.dtype)
    if np.any(model.predict(trials, deterministic=True)[0] != 0):
        raise ConfigError(
            f"a policy of {type(model).__name__} ({type(policy).__name__}) cannot begin at zero, "
            "as a residual policy does; those of PPO, A2C, SAC, TD3 and DDPG with 'MlpPolicy' can"
        )
