"""Trainings of residual policies: their controllers, and their facts in folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from importlib import import_module
from typing import Any, Final

import numpy as np

from fmugym.baselines import controller_of
from fmugym.baselines.parsing import has_range, plans_ahead, search_of
from fmugym.baselines.tuning import tune
from fmugym.checks import check_number
from fmugym.env import FMUEnv
from fmugym.episodes.simulation import given_controller
from fmugym.errors import ConfigError, shown
from fmugym.search.residual import Residual

__all__ = ["begin_at_zero", "residual_facts", "residual_of"]

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
