"""What lies between an observation and an action: a network, and what else an agent computes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.baselines.controller import Controller
from fmugym.baselines.feedback import Law
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.export.network import Activation, Layer, Network, Scaling
from fmugym.export.policies import network_of_model
from fmugym.scaling import are_scaled
from fmugym.search.policy import LIMIT, Agent, Policy

__all__ = ["Decision", "decision_of"]

_MEMORY: Final = ("agent.last_observation", "agent.leaky_integral", "agent.last_action")
_CONTROLLER: Final = "agent.controller"

_Ask = Callable[[Any], Any]


def _decided_by_any(seen: Any, memory: Sequence[Any], ask: _Ask) -> tuple[Any, Sequence[Any]]:
    return ask(seen), ()


@dataclass(frozen=True)
class Decision:
    """How an agent decides; by default any action may follow from the observation.

    Attributes:
        network: Its network; None for none.
        decide: Takes the observation, symbols of shape (k, N), what the agent remembers, and a
            function that asks the network for its last values, or for any action if there is none.
            Returns the elements of the action, environments last, and what the agent remembers
            then.
        starts: What it remembers at the beginning of an episode, by name.
    """

    network: Network | None = None
    decide: Callable[[Any, Sequence[Any], _Ask], tuple[Any, Sequence[Any]]] = _decided_by_any
    starts: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)


def decision_of(env: FMUEnv, model: Any, normalization: Any = None) -> Decision:
    """Find how an agent decides.

    Args:
        env: The environment.
        model: See ``agent_of``.
        normalization: A ``VecNormalize``, or None.

    Raises:
        ConfigError: If the agent cannot be exported, or is for another task.
    """
    model = model.policy() if isinstance(model, Agent) else model
    if isinstance(model, Controller):
        policy = deepcopy(model) if isinstance(model, Policy) else Policy(deepcopy(model))
        return _of_policy(policy.bind(env), env.observation_space)
    network = model if isinstance(model, Network) else network_of_model(model, normalization)
    if are_scaled(network.space, env.action_space):
        network = network.unscaled(env.action_space)
    return Decision(network, lambda seen, memory, ask: (network.chosen(ask(seen)), ()))


def _of_policy(policy: Policy, observed: spaces.Space[Any]) -> Decision:
    law, past = policy.baseline, policy.starts
    _require_known(law, observed)
    if policy.choices and policy.masks is not None:
        raise ConfigError("a policy that needs masks of actions cannot be exported")
    starts = dict(zip(_MEMORY, past, strict=False))  # without a history there are none
    if isinstance(law, Law):
        starts[_CONTROLLER] = np.array(law.starts, np.float64).reshape(-1)
    network = _network_of(policy)

    def constants(features: Any) -> Any:
        return policy._network(np.empty(features.shape))

    def chosen(values: Any) -> Any:
        return network.chosen(values) if network and policy.choices else values

    def decide(seen: Any, memory: Sequence[Any], ask: _Ask) -> tuple[Any, Sequence[Any]]:
        rows = seen.cast(np.float64).T
        base, state = _of_controller(policy, rows, memory[len(past) :])
        given = constants if network is None else lambda features: chosen(ask(features.T))
        before = tuple(one.T for one in memory[: len(past)])
        action, past_now = policy.step(rows, before, base, given)
        elements = policy._as_actions(np.stack(action, axis=-1))
        return np.moveaxis(elements, 0, -1), [*(one.T for one in past_now), *state]

    return Decision(network, decide, starts)


def _require_known(law: Any, observed: spaces.Space[Any]) -> None:
    if law is not None and not isinstance(law, Law):
        raise ConfigError(
            f"a controller of type {type(law).__name__} cannot be exported; a PID or a Hysteresis "
            "can be"
        )
    parts = observed.spaces.values() if isinstance(observed, spaces.Dict) else [observed]
    if not all(isinstance(part, spaces.Box) for part in parts):
        raise ConfigError(
            f"a policy that observes {observed} cannot be exported; a Box can be, or a Dict"
        )


def _of_controller(policy: Policy, rows: Any, memory: Sequence[Any]) -> tuple[Any, Sequence[Any]]:
    """What the controller decides, shape (m, N), and what it remembers then."""
    if isinstance(policy.baseline, Law):
        action, state = policy.baseline.step(rows, memory[0])
        return [action], [state]
    return np.repeat(policy.middle, len(rows), axis=1), []


def _network_of(policy: Policy) -> Network | None:
    """The network; None if there is none, or it sees nothing and so gives constants."""
    if not policy.agent.features:
        return None
    matrices = [one[0] for one in policy._layers]
    functions = [(Activation("tanh"),)] * (len(matrices) - 1) + [()]
    layers = [Layer(m[:-1].T, m[-1], then) for m, then in zip(matrices, functions, strict=True)]
    mean, divisor = policy.agent.scale
    scaling = Scaling(mean, divisor, np.full(mean.shape, LIMIT))
    return Network(tuple(layers), policy.space, scaling, dtype=np.dtype(np.float64))
