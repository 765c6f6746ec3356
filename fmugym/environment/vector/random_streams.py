"""The random streams of N environments; each equals that of a single environment."""

from __future__ import annotations

import functools
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.environment.episode_start import EpisodeStart
from fmugym.environment.saved_episode import row_of, state_of
from fmugym.pool.pool import FloatArray
from fmugym.pool.states import IndexArray

if TYPE_CHECKING:
    from fmugym.environment.vector.saved_batch import Which

__all__ = ["EpisodeStreams"]

_NONE: Final = -1
_SEED_BITS: Final = 128
"""The bits of entropy that numpy takes from the system where no seed is given."""


@functools.lru_cache(maxsize=4096)
def _seeded(seed: int) -> tuple[int, ...]:
    """The state of a stream with a seed; searches play many candidates with the same seeds."""
    return tuple(row_of(np.random.PCG64(seed).state))


class EpisodeStreams:
    """Draws the episodes of N environments from N random streams.

    Seeded with s, environment i draws what a single environment seeded with s + i draws, episode
    after episode. A stream is the state of a ``numpy.random.PCG64``, which has seeded it. The C
    extension draws from the streams; a generator of numpy takes the place of a stream only for
    distributions that Python must draw.

    Args:
        num_envs: N.

    Attributes:
        states: The streams, shape (N, 6): state, increment (the higher half first), whether a half
            of a number is left over, and that half.
    """

    def __init__(self, num_envs: int) -> None:
        self.states = np.zeros((num_envs, 6), np.uint64)
        self._seeds: npt.NDArray[Any] = np.full(num_envs, _NONE, object)
        self._all_seeded = False
        self._generator = np.random.Generator(np.random.PCG64(0))

    def seed_of(self, index: int) -> int | None:
        """The seed of an environment; None if it goes on with a stream of unknown seed."""
        self._seed_others([index])
        seed: int | None = self._seeds[index]
        return seed

    def seed(self, seeds: Sequence[int | None] | None, indices: IndexArray) -> None:
        """Seed some of the environments anew; None leaves a stream, or all, as it is."""
        if seeds is None:
            return
        chosen = ((index, seeds[index]) for index in indices.tolist())
        self._seed({index: seed for index, seed in chosen if seed is not None})

    def taken(self, which: Which) -> tuple[npt.NDArray[np.uint64], npt.NDArray[Any]]:
        """Copies of the streams and the seeds of some environments."""
        self.require_seeds()
        return np.array(self.states[which]), np.array(self._seeds[which])

    def put(self, which: Which, rows: npt.NDArray[np.uint64], seeds: npt.NDArray[Any]) -> None:
        """Let environments go on with other streams, shape (M, 6), and their seeds."""
        self.states[which] = rows
        self._seeds[which] = seeds

    def require_seeds(self) -> None:
        """Seed all that have no seed yet; native code may then draw from the streams."""
        if not self._all_seeded:
            self._seed_others(range(len(self._seeds)))
            self._all_seeded = True

    def _seed_others(self, indices: Sequence[int]) -> None:
        """Seed those environments that have no seed yet from the system's entropy."""
        unseeded = [index for index in indices if self._seeds[index] == _NONE]
        self._seed({index: secrets.randbits(_SEED_BITS) for index in unseeded})

    def _seed(self, seeds: dict[int, int]) -> None:
        for index, seed in seeds.items():
            self._seeds[index] = seed
            self.states[index] = _seeded(seed)

    def draw(self, draws: EpisodeStart, indices: IndexArray) -> FloatArray:
        """Draw one episode for each of some environments.

        Returns:
            The values in the order of ``draws.drawn``, shape (draws, M).

        Raises:
            ConfigError: If a drawn value does not fit its variable's type.
        """
        self.require_seeds()
        values = np.empty((len(draws.drawn), len(indices)))
        if draws.native is not None:
            from fmugym._native import draw

            rows = self.states[indices]
            draw(draws.native, rows, values)
            self.states[indices] = rows
            return values
        for place, index in enumerate(indices.tolist()):
            with self._as_generator(index) as generator:
                values[:, place] = draws.draw_values(generator)
        return values

    @contextmanager
    def _as_generator(self, index: int) -> Iterator[np.random.Generator]:
        """Lend a generator that goes on with a stream."""
        bits: Any = self._generator.bit_generator
        bits.state = state_of(self.states[index].tolist())
        try:
            yield self._generator
        finally:
            self.states[index] = row_of(bits.state)
