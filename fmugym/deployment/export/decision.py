"""Decision of an agent: the network and other formulas between observation and action.

The networks of agents of Stable-Baselines3 and sb3-contrib become data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.control.controller import Controller, Law
from fmugym.deployment.export.network import Activation, Layer, Network, Scaling, network_of
from fmugym.environment.actions import are_scaled
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.expressions.graph import Value
from fmugym.training.residual import Residual
from fmugym.training.search.policy import LIMIT, ResidualAgent, ResidualPolicy

__all__ = ["Decision", "decision_of", "network_of_model"]

_TRIALS: Final = 64
_TOLERANCE: Final = 1e-4
"""Difference from float32 that another order of sums may cause, as a part of the range of
actions."""

_DISTRIBUTIONS: Final = (
    *("DiagGaussianDistribution", "CategoricalDistribution", "MultiCategoricalDistribution"),
    "StateDependentNoiseDistribution",
)


def network_of_model(model: Any, normalization: Any = None) -> Network:
    """Read the deterministic policy of a model.

    Args:
        model: Model of Stable-Baselines3 or sb3-contrib, with a network of linear layers.
        normalization: A ``VecNormalize``, or None.

    Returns:
        The network. It has been compared with the model's own ``predict`` on random observations.

    Raises:
        ConfigError: If the policy is of another kind, such as one with a memory or images; the
            text names it.
    """
    kinds = [cls.__name__ for cls in type(model.policy).__mro__]
    readers = [_READERS[kind] for kind in kinds if kind in _READERS]
    refused = [_REFUSED[kind] for kind in kinds if kind in _REFUSED]
    if refused or not readers:
        why = f": {refused[0]}" if refused else ""
        raise ConfigError(
            f"a policy of {type(model).__name__} ({kinds[0]}) cannot be exported{why}; those of "
            "PPO, A2C, TRPO, SAC, TQC, TD3, DDPG, DQN and QRDQN with 'MlpPolicy' can"
        )
    space = model.observation_space
    if not isinstance(space, spaces.Box):
        raise ConfigError(f"a policy that observes {space} cannot be exported; a Box can be")
    network = readers[0](model.policy)
    if normalization is not None and normalization.norm_obs:
        network = replace(network, scaling=_scaling(normalization))
    _require_same(model, normalization, network)
    return network


def _of_actor_critic(policy: Any) -> Network:
    kind = type(policy.action_dist).__name__
    if kind not in _DISTRIBUTIONS:
        raise ConfigError(f"a policy with a {kind} cannot be exported")
    shared = policy.share_features_extractor
    _require_flat(policy.features_extractor if shared else policy.pi_features_extractor)
    modules = [policy.mlp_extractor.policy_net, policy.action_net]
    network = network_of(modules, policy.action_space, squashed=policy.squash_output)
    return _squashed(network) if policy.squash_output else network


def _of_sac(policy: Any) -> Network:
    actor = policy.actor
    _require_flat(actor.features_extractor)
    network = network_of([actor.latent_pi, actor.mu], policy.action_space, squashed=True)
    return _squashed(network)


def _squashed(network: Network) -> Network:
    *others, last = network.layers
    last = replace(last, activations=(*last.activations, Activation("tanh")))
    return replace(network, layers=(*others, last))


def _of_td3(policy: Any) -> Network:
    _require_flat(policy.actor.features_extractor)
    return network_of(policy.actor.mu, policy.action_space, squashed=True)


def _of_dqn(policy: Any) -> Network:
    _require_flat(policy.q_net.features_extractor)
    return network_of(policy.q_net.q_net, policy.action_space)


def _of_qrdqn(policy: Any) -> Network:
    """The value of an action is the mean of its quantiles, which the last layer gives."""
    own = policy.quantile_net
    _require_flat(own.features_extractor)
    wide = spaces.Discrete(own.n_quantiles * int(policy.action_space.n))
    *others, last = network_of(own.quantile_net, wide).layers
    shape = own.n_quantiles, int(policy.action_space.n)
    weights = last.weights.reshape(*shape, -1).mean(axis=0, dtype=np.float64)
    bias = last.bias.reshape(shape).mean(axis=0, dtype=np.float64)
    mean = Layer(weights.astype(np.float32), bias.astype(np.float32))
    return Network((*others, mean), policy.action_space)


_READERS: Final[dict[str, Callable[[Any], Network]]] = {
    "ActorCriticPolicy": _of_actor_critic,
    "SACPolicy": _of_sac,
    "TQCPolicy": _of_sac,
    "TD3Policy": _of_td3,
    "DQNPolicy": _of_dqn,
    "QRDQNPolicy": _of_qrdqn,
}

_REFUSED: Final[dict[str, str]] = {
    "RecurrentActorCriticPolicy": "it has a memory of its own",
    "MaskableActorCriticPolicy": "it needs masks of actions",
    "CrossQPolicy": "it normalizes batches",
}


def _require_flat(extractor: Any) -> None:
    """Refuse a features extractor that does more than flatten an observation."""
    kind = type(extractor).__name__
    if kind != "FlattenExtractor":
        raise ConfigError(f"a policy whose features come from {kind} cannot be exported")


def _scaling(normalization: Any) -> Scaling:
    """The normalization of each element of an observation."""
    rms = normalization.obs_rms
    mean, divisor = rms.mean.ravel(), np.sqrt(rms.var + normalization.epsilon).ravel()
    return Scaling(mean, divisor, np.full(mean.shape, normalization.clip_obs))


def _require_same(model: Any, normalization: Any, network: Network) -> None:
    """Compare the network with the model: a class derived from a known policy may do more."""
    rng, space = np.random.default_rng(0), model.observation_space
    for _ in range(_TRIALS):
        observation = rng.normal(size=space.shape).astype(space.dtype)
        seen = observation if normalization is None else normalization.normalize_obs(observation)
        wanted = np.ravel(model.predict(seen, deterministic=True)[0])
        own = network.action(observation.ravel())
        if isinstance(network.space, spaces.Box):
            size = np.ravel(network.space.high - network.space.low)
            same = np.abs(own - wanted) <= _TOLERANCE * np.maximum(1.0, np.minimum(size, 1e6))
        else:
            same = (own == wanted) | _is_tie(network, observation.ravel())
        if not np.all(same):
            raise ConfigError(
                f"the policy {type(model.policy).__name__} cannot be exported: it does more than "
                f"its layers say. For a random observation it gives {wanted}, its layers {own}"
            )


def _is_tie(network: Network, observation: npt.NDArray[Any]) -> bool:
    """Whether rounding decides between two actions."""
    values, ends = network.values(observation), np.cumsum(network.parts)[:-1]
    tops = (np.sort(part)[-2:] for part in np.split(values, ends))
    return any(top[-1] - top[0] <= _TOLERANCE * (1 + abs(top[-1])) for top in tops)


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
