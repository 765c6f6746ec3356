"""The random streams of N environments; each equals that of a single environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding

from fmugym.pool.base import FloatArray
from fmugym.task.episode import EpisodePlan

__all__ = ["EpisodeStreams"]

_BLOCK_BYTES = 16 * 2**20
"""The most memory for values drawn ahead."""

_LONGEST_BLOCK = 32
"""The most episodes drawn ahead for one environment."""


class EpisodeStreams:
    """Draws the episodes of N environments from N generators.

    Seeded with s, environment i draws what a single environment seeded with s + i draws, episode
    after episode. If all distributions are uniform, each takes one number of the stream. Several
    episodes are then drawn ahead in one call. When a reset needs other draws, the stream returns
    to the position that the episodes have reached.

    Args:
        num_envs: N.
        plan: The draws of an episode, without overrides.

    Attributes:
        num_draws: How many numbers of the stream an episode takes; None if some are not uniform.
        block: Uniform numbers drawn ahead, shape (N, episodes, draws).
        used: How many episodes of its block an environment has used, shape (N,).
        version: Goes up whenever an environment gets another generator.
    """

    def __init__(self, num_envs: int, plan: EpisodePlan) -> None:
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._seeds = [0] * num_envs
        self.version = 0
        self.num_draws = plan.num_uniform
        self._draws = plan.num_uniform or 0
        row = 8 * num_envs * max(self._draws, 1)
        self._length = max(1, min(_LONGEST_BLOCK, _BLOCK_BYTES // row))
        self.block = np.empty((num_envs, self._length, self._draws))
        self._rows = list(self.block)
        self.used = np.full(num_envs, self._length)

    def generator(self, index: int) -> np.random.Generator:
        """The generator of an environment, at the position that its episodes have reached."""
        generator = self._generators[index] or self._unseeded(index)
        ahead = int(self._length - self.used[index]) * self._draws
        if ahead:
            _take_back(generator.bit_generator, ahead)
            self.used[index] = self._length
        return generator

    def _unseeded(self, index: int) -> np.random.Generator:
        return self._renew(index, None)

    def _renew(self, index: int, seed: int | None) -> np.random.Generator:
        generator, self._seeds[index] = seeding.np_random(seed)
        self._generators[index] = generator
        self.version += 1
        return generator

    def seed_of(self, index: int) -> int:
        """The seed that an environment's generator was made with."""
        if self._generators[index] is None:
            self._unseeded(index)
        return self._seeds[index]

    def bit_generators(self) -> list[np.random.BitGenerator]:
        """The bit generators of all environments."""
        generators = enumerate(self._generators)
        return [(known or self._unseeded(index)).bit_generator for index, known in generators]

    def seed(self, seeds: Sequence[int | None], indices: npt.NDArray[np.intp]) -> None:
        """Seed some of the environments anew; None leaves a stream as it is."""
        if not any(seed is not None for seed in seeds):
            return
        for index in indices.tolist():
            if seeds[index] is not None:
                self._renew(index, seeds[index])
                self.used[index] = self._length

    def fractions(self, indices: npt.NDArray[np.intp]) -> FloatArray:
        """Draw the uniform numbers of one episode for some environments, shape (draws, M)."""
        used = self.used[indices]
        if used.max() == self._length:
            self._refill(indices[used == self._length])
            used = self.used[indices]
        self.used[indices] = used + 1
        fractions: FloatArray = self.block[indices, used].T
        return fractions

    def _refill(self, indices: npt.NDArray[np.intp]) -> None:
        """Draw new blocks for environments whose blocks are used up."""
        generators, rows = self._generators, self._rows
        for index in indices.tolist():
            (generators[index] or self._unseeded(index)).random(out=rows[index])
        self.used[indices] = 0


def _take_back(bits: Any, count: int) -> None:
    """Go back in a stream, but keep the unused half that an integer draw has left over."""
    before = bits.state
    bits.advance(-count)
    if before["has_uint32"]:
        bits.state = {**before, "state": bits.state["state"]}
