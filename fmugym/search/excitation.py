"""Excitation: actions that show what an FMU does."""

from __future__ import annotations

from typing import Any, Final, Self

import numpy as np
from gymnasium import spaces

from fmugym.baselines.controller import Controller
from fmugym.search.flattening import choices_of

__all__ = ["Excitation"]

_RANDOM: Final = 0.4
"""The part of segments with an action at random,"""

_SHIFTED: Final = 0.3
"""of those that shift the action of the controller,"""

_AT_AN_END: Final = 0.3
"""and of random actions that are an end of their range."""

_SHIFT: Final = 0.3
"""The largest shift, as a part of the range."""

_LONGEST: Final = 16
"""The steps of a segment are between 1 and so many, short ones as often as long ones."""


class Excitation:
    """A controller whose actions are replaced or shifted for some steps at a time.

    Args:
        controller: The controller.
        seed: Of the segments.
        first: The number of the first episode among those with this seed, so that episodes do not
            depend on how many environments step together.
    """

    def __init__(self, controller: Controller, seed: int, first: int = 0) -> None:
        self._controller, self._seed, self._first = controller, seed, first

    def bind(self, env: Any) -> Self:
        """See ``Controller.bind``."""
        self._controller.bind(env)
        space: Any = env.single_action_space
        self._shape, self._dtype = (env.num_envs, *space.shape), env.action_space.dtype
        self._is_discrete = bool(choices_of(space))
        if self._is_discrete:
            counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
            self._low = np.broadcast_to(getattr(space, "start", 0), space.shape)
            self._high = self._low + np.asarray(counts) - 1
        else:
            self._low, self._high = space.low, space.high
        places = range(self._first, self._first + env.num_envs)
        self._rngs = [np.random.default_rng([self._seed, place]) for place in places]
        self._left = np.zeros(self._shape, int)
        self._kind: Any = np.zeros(self._shape)
        self._value: Any = np.zeros(self._shape)
        return self

    def act(self, observation: Any, info: Any = None) -> Any:
        """See ``Controller.act``."""
        self._begin_segments(self._left <= 0)
        self._left -= 1
        base = np.asarray(self._controller.act(observation, info), np.float64)
        width = self._high - self._low
        shifted = base + self._value * width
        action = np.where(self._kind == 1, self._low + self._value * width, base)
        action = np.clip(np.where(self._kind == 2, shifted, action), self._low, self._high)
        return (np.rint(action) if self._is_discrete else action).astype(self._dtype)

    def _begin_segments(self, mask: Any) -> None:
        for place in zip(*np.nonzero(mask), strict=True):
            rng = self._rngs[place[0]]
            drawn, level, end, shift, length = rng.uniform(size=5)
            is_random, is_shifted = drawn < _RANDOM, drawn < _RANDOM + _SHIFTED
            self._kind[place] = 1 if is_random else 2 if is_shifted else 0
            level = round(level) if end < _AT_AN_END else level
            self._value[place] = level if is_random else _SHIFT * (2.0 * shift - 1.0)
            self._left[place] = int((_LONGEST + 1.0) ** length)
