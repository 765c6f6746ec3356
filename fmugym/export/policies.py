"""The networks of Stable-Baselines3 and sb3-contrib as data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.errors import ConfigError
from fmugym.export.network import Activation, Layer, Network, Scaling, network_of

__all__ = ["network_of_model"]

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
