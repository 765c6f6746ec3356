"""Decision of an agent: the network and other formulas between observation and action."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.baselines.controller import Controller
from fmugym.baselines.law import Law
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.export.network import Activation, Layer, Network, Scaling
from fmugym.export.policies import network_of_model
from fmugym.expressions.value import Value
from fmugym.scaling import are_scaled
from fmugym.search.policy import LIMIT, ResidualAgent, ResidualPolicy
from fmugym.search.residual import Residual

__all__ = ["Decision", "decision_of"]

_MEMORY: Final = ("agent.last_observation", "agent.leaky_integral", "agent.last_action")
_CONTROLLER: Final = "agent.controller"

_Ask = Callable[[Sequence[Value]], Sequence[Value]]
_Decided = tuple[Sequence[Value], Sequence[Sequence[Value]]]


def _decided_by_any(seen: Sequence[Value], memory: Sequence[Any], ask: _Ask) -> _Decided:
    return ask(seen), ()


@dataclass(frozen=True)
class Decision:
    """Decision rule of an agent; by default any action may follow from the observation.

    Attributes:
        network: Its network; None for none.
        decide: Takes formulas: the elements of the observation, what the agent remembers, and a
            function that asks the network for its last values, or for any action if there is none.
            Returns the elements of the action, and what the agent remembers then.
        starts: Memory at the beginning of an episode, by name.
    """

    network: Network | None = None
    decide: Callable[[Sequence[Value], Sequence[Sequence[Value]], _Ask], _Decided] = _decided_by_any
    starts: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)


def decision_of(env: FMUEnv, model: Any, normalization: Any = None) -> Decision:
    """Make the decision rule of an agent.

    Args:
        env: The environment.
        model: See ``agent_of``.
        normalization: A ``VecNormalize``, or None.

    Raises:
        ConfigError: If the agent cannot be exported, or is for another task.
    """
    model = model.policy() if isinstance(model, ResidualAgent) else model
    if isinstance(model, Controller):
        policy = copy(model) if isinstance(model, ResidualPolicy) else ResidualPolicy(model)
        policy.baseline = deepcopy(policy.baseline)
        return _of_policy(policy.bind(env))
    network = model if isinstance(model, Network) else network_of_model(model, normalization)
    if are_scaled(network.space, env.action_space):
        network = network.unscaled(env.action_space)
    return Decision(network, lambda seen, memory, ask: (network.chosen(ask(seen)), ()))


def _of_policy(policy: ResidualPolicy) -> Decision:
    if policy.choices and policy.masks is not None:
        raise ConfigError("a policy that needs masks of actions cannot be exported")
    controller, past = policy.baseline, policy.starts
    starts = dict(zip(_MEMORY, past, strict=False))  # without a history there are none
    if isinstance(controller, Law) and controller.starts:
        starts[_CONTROLLER] = np.concatenate([np.ravel(one) for one in controller.starts])
    network, chosen = _network_of(policy)

    def decide(seen: Sequence[Value], memory: Sequence[Sequence[Value]], ask: _Ask) -> _Decided:
        given: list[Value] = []

        def changes(features: Sequence[Value]) -> Sequence[Value]:
            if network is None:
                given[:] = [seen[0].beside(one) for (one,) in policy._network(np.empty((1, 0)))]
            else:
                given[:] = chosen(ask(features))
            return given

        observation, count = [one.number for one in seen], len(past)
        base: Sequence[Value] = [seen[0].beside(one) for (one,) in policy.middle]
        states: list[Sequence[Value]] = []
        if controller is not None:
            base, state = controller.decision(observation, *memory[count:])
            states = [state] if memory[count:] else []
        action, now = policy.corrected(observation, memory[:count], base, changes)
        added = policy.added(given)
        if controller is not None and states and added is not None:
            states = [controller.decision(observation, memory[count], added)[1]]
        return policy.action_of(action), [*now, *states]

    return Decision(network, decide, starts)


def _network_of(policy: ResidualPolicy) -> tuple[Network | None, _Ask]:
    """Read the network, and the meaning of its last values.

    There is none if nobody corrects the controller, or the network sees nothing and so gives
    constants.
    """
    if isinstance(policy, Residual):
        unit = network_of_model(policy.model, policy.normalization)
        network = replace(unit, space=policy.space)
        return network, lambda values: [one.number for one in unit.chosen(values)]
    if not policy.agent.features:
        return None, lambda values: values
    matrices = [one[0] for one in policy._layers]
    functions = [(Activation("tanh"),)] * (len(matrices) - 1) + [()]
    layers = [Layer(m[:-1].T, m[-1], then) for m, then in zip(matrices, functions, strict=True)]
    mean, divisor = policy.agent.scale
    scaling = Scaling(mean, divisor, np.full(mean.shape, LIMIT))
    network = Network(tuple(layers), policy.space, scaling, dtype=np.dtype(np.float64))
    return network, network.chosen if policy.choices else lambda values: values
