"""FMU environments for TorchRL: an ``EnvBase`` over ``FMUVectorEnv``.

Needs the extra ``torchrl``. See ``docs/libraries.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from fmugym.checks import check_seed
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.extras import lacking
from fmugym.vector import FMUVectorEnv
from fmugym.vector.libraries import make_vector_env, require_vector_env

try:
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import (
        Binary,
        Bounded,
        Categorical,
        Composite,
        MultiCategorical,
        TensorSpec,
        Unbounded,
    )
    from torchrl.envs import EnvBase
except ImportError as error:
    raise ImportError(lacking("fmugym.torchrl", "TorchRL", "torchrl"), name=error.name) from error

__all__ = ["FMUTorchEnv", "make_torchrl_env"]

MaskArray = npt.NDArray[np.bool_]


def make_torchrl_env(
    env: str | Callable[..., FMUEnv],
    num_envs: int = 1,
    *,
    seed: int | None = None,
    infos: Sequence[str] = (),
    device: Any = "cpu",
    **kwargs: Any,
) -> FMUTorchEnv:
    """Make N environments for TorchRL.

    Args:
        env: A registered id, or a class; ids bring their ``max_episode_steps``.
        num_envs: N, the batch size.
        seed: Environment i is seeded with ``seed + i`` at the first reset.
        infos: As for ``FMUTorchEnv``.
        device: As for ``FMUTorchEnv``.
        kwargs: Arguments of ``FMUVectorEnv`` (``max_episode_steps``, ``hooks``, ``threads``, ...)
            and of the environment.

    Raises:
        ConfigError: If the environment is unknown or not one of fmugym, or an argument does not
            fit.
    """
    seed = check_seed(seed)
    kwargs = {"autoreset_mode": AutoresetMode.DISABLED, **kwargs}
    made = FMUTorchEnv(make_vector_env(env, num_envs, kwargs), infos=infos, device=device)
    if seed is not None:
        made.set_seed(seed)
    return made


class FMUTorchEnv(EnvBase):
    """N environments as one batched environment of TorchRL, of batch size (N,).

    The keys are ``"action"`` and ``"observation"`` (or those of a ``Dict`` space), ``"reward"`` of
    shape (N, 1) and type float32, ``"terminated"``, ``"truncated"`` and ``"done"``.

    Args:
        env: The vector environment, made with ``autoreset_mode="disabled"``.
        infos: Names of numbers in the infos, such as ``"cost"``. Each becomes a key of shape (N, 1)
            and type float32, which is NaN where the info has no number, as after a reset.
        device: Where the tensors are; the FMUs run on the processor.

    Attributes:
        vector_env: The vector environment, as given.

    Raises:
        ConfigError: If ``env`` is something else, has another autoreset mode, or a space of a kind
            that TorchRL lacks.
    """

    def __init__(
        self, env: FMUVectorEnv, *, infos: Sequence[str] = (), device: Any = "cpu"
    ) -> None:
        require_vector_env(env, AutoresetMode.DISABLED)
        super().__init__(device=device, batch_size=[env.num_envs])
        self.vector_env = env
        self._infos = tuple(infos)
        self._first_seed: int | None = None
        self._observations: dict[str, torch.Tensor] = {}
        self._terminated = np.zeros(env.num_envs, bool)
        self._truncated = np.zeros(env.num_envs, bool)
        self._action_space = env.single_action_space
        self._make_specs()

    def _make_specs(self) -> None:
        size, device = self.batch_size, self.device
        observed = _spec(self.vector_env.single_observation_space, size, device)
        if not isinstance(observed, Composite):
            observed = Composite(observation=observed, shape=size, device=device)
        for name in self._infos:
            observed[name] = Unbounded((*size, 1), device=device)
        self.observation_spec = observed
        self.action_spec = _spec(self._action_space, size, device)
        self.reward_spec = Unbounded((*size, 1), device=device)
        flag = Categorical(2, shape=(*size, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            {name: flag.clone() for name in ("done", "terminated", "truncated")}, shape=size
        )

    # What TorchRL calls.

    def _set_seed(self, seed: int | None) -> None:
        self._first_seed = seed

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        chosen = np.ones(len(self._terminated), bool) if mask is None else _flags(mask)
        options = {"reset_mask": chosen}
        observations, infos = self.vector_env.reset(seed=self._first_seed, options=options)
        self._first_seed = None
        self._terminated &= ~chosen
        self._truncated &= ~chosen
        return self._told(observations, infos)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = self._actions(tensordict)
        mask = tensordict.get("_step", None)
        if mask is not None and not (chosen := _flags(mask)).all():
            return self._step_some(actions, chosen)
        return self._stepped(*self.vector_env.step(actions))

    def _step_some(self, actions: Any, chosen: MaskArray) -> TensorDictBase:
        """Step some environments; the others are as before afterwards.

        All step. Those whose episode has ended need a reset before that, and wait for another one
        afterwards; those in mid-episode go back to where they were.
        """
        idle = ~chosen
        over = idle & (self._terminated | self._truncated)
        before = self._terminated, self._truncated
        kept = self.vector_env.save_state(idle & ~over) if (idle & ~over).any() else None
        seen = self._told_again()
        if over.any():
            self.vector_env.reset(options={"reset_mask": over})
        result = self._stepped(*self.vector_env.step(actions))
        if kept is not None:
            self.vector_env.restore_state(kept, idle & ~over)
        self._terminated = np.where(idle, before[0], self._terminated)
        self._truncated = np.where(idle, before[1], self._truncated)
        for key, value in seen.items():
            self._observations[key][idle] = value[idle]
        result["reward"][idle] = 0.0
        return result.update(self._told_again()).update(self._ends())

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the FMU instances."""
        if not self.is_closed:
            self.vector_env.close()
        super().close(raise_if_closed=raise_if_closed)

    # Arrays and tensors.

    def _actions(self, tensordict: TensorDictBase) -> Any:
        actions = tensordict.get("action").detach().cpu().numpy()
        space = self._action_space
        if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
            return actions.astype(space.dtype) + space.start
        return actions.astype(space.dtype, copy=False)

    def _stepped(
        self,
        observations: Any,
        rewards: npt.NDArray[np.float64],
        terminated: MaskArray,
        truncated: MaskArray,
        infos: Mapping[str, Any],
    ) -> TensorDictBase:
        self._terminated, self._truncated = terminated.copy(), truncated.copy()
        told = self._told(observations, infos)
        told["reward"] = self._column(rewards.astype(np.float32))
        return told

    def _told(self, observations: Any, infos: Mapping[str, Any]) -> TensorDictBase:
        """Observations, infos and ends of episodes as tensors."""
        space = self.vector_env.single_observation_space
        named = observations if isinstance(space, spaces.Dict) else {"observation": observations}
        parts = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
        seen = {name: self._tensor(_from_zero(parts[name], named[name])) for name in parts}
        for name in self._infos:
            seen[name] = self._column(self._numbers(name, infos))
        self._observations = seen
        return self._told_again().update(self._ends())

    def _told_again(self) -> TensorDictBase:
        seen = {name: value.clone() for name, value in self._observations.items()}
        return TensorDict(seen, batch_size=self.batch_size, device=self.device)

    def _numbers(self, name: str, infos: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """An info of all environments; NaN where an environment has none."""
        count = len(self._terminated)
        if name not in infos:
            return np.full(count, np.nan, np.float32)
        has = infos.get(f"_{name}", np.ones(count, bool))
        return np.where(has, np.asarray(infos[name], np.float32), np.float32("nan"))

    def _ends(self) -> dict[str, torch.Tensor]:
        return {
            "terminated": self._column(self._terminated),
            "truncated": self._column(self._truncated),
            "done": self._column(self._terminated | self._truncated),
        }

    def _column(self, values: npt.NDArray[Any]) -> torch.Tensor:
        return self._tensor(values[:, np.newaxis])

    def _tensor(self, values: npt.NDArray[Any]) -> torch.Tensor:
        return torch.tensor(values, device=self.device)


def _flags(mask: torch.Tensor) -> MaskArray:
    flags: MaskArray = mask.detach().cpu().numpy().reshape(-1)
    return flags


def _from_zero(space: spaces.Space[Any], values: Any) -> Any:
    """Numbers of a discrete space as TorchRL counts them, from 0 on."""
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return values - space.start
    return values


def _spec(space: spaces.Space[Any], size: torch.Size, device: Any) -> TensorSpec:
    """The spec of N values of a space."""
    if isinstance(space, spaces.Dict):
        named = {name: _spec(part, size, device) for name, part in space.spaces.items()}
        return Composite(named, shape=size, device=device)
    shape = (*size, *(space.shape or ()))
    dtype = torch.from_numpy(np.empty(0, space.dtype)).dtype
    if isinstance(space, spaces.Discrete):
        return Categorical(int(space.n), shape=shape, dtype=dtype, device=device)
    if isinstance(space, spaces.MultiDiscrete) and len(shape) == 2:
        return MultiCategorical(space.nvec.tolist(), shape=shape, dtype=dtype, device=device)
    if isinstance(space, spaces.MultiBinary):
        return Binary(shape[-1], shape=shape, dtype=dtype, device=device)
    if isinstance(space, spaces.Box):
        return _box(space, shape, dtype, device)
    raise ConfigError(f"TorchRL has no spec for {space}")


def _box(space: spaces.Box, shape: tuple[int, ...], dtype: torch.dtype, device: Any) -> TensorSpec:
    if not space.is_bounded():
        return Unbounded(shape, dtype=dtype, device=device)
    low, high = (
        torch.tensor(limit, device=device).expand(shape) for limit in (space.low, space.high)
    )
    return Bounded(low, high, shape=shape, dtype=dtype, device=device)
