"""Reset of episodes: the FMUs start, warm-ups run, and hooks read the first quantities.

A warm-up consists of steps with moving inputs before the first observation. The states that
warm-ups lead to are kept.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from threading import Lock
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from fmugym.environment.episode import Episode, standing_in
from fmugym.environment.episode_start import EpisodeStart, EpisodeValues
from fmugym.environment.spaces import to_input_types
from fmugym.fmi.variable import values_by_name
from fmugym.pool import Pool
from fmugym.pool.licences import require_started
from fmugym.pool.pool import FloatArray
from fmugym.pool.states import Bundle, IndexArray, SaveMethod, StateFiles, essence
from fmugym.pool.trial.verdict import state_files

__all__ = ["FIRST", "EpisodeReset", "ResetEpisodes", "WarmUp", "WarmUps"]

FIRST: Final = np.zeros(1, np.int64)
"""The index of the only instance."""


class ResetEpisodes(Protocol):
    """Quantities of the episodes that a reset writes: numbers of one, or arrays of N."""

    def clear(
        self, indices: IndexArray, inputs: list[Any], action: Any, values: EpisodeValues
    ) -> None:
        """Set the quantities of before the first step.

        Args:
            indices: The environments, shape (M,).
            inputs: For each a number, or a row of shape (N,).
            action: Stands for that of a step, the same in all these environments.
            values: The start values.
        """

    def look(self, indices: IndexArray, outputs: FloatArray) -> None:
        """Let hooks read the outputs of episodes that have not stepped yet, shape (k, N)."""

    def some(self, indices: IndexArray) -> Episode:
        """Quantities of some episodes in new arrays, environments on the last axis."""

    def row(self, name: str) -> Any:
        """The values of an episode variable, shape (..., N)."""

    def warmed(self, indices: IndexArray, values: Mapping[str, Any], inputs: FloatArray) -> None:
        """Take the episode variables that a warm-up has written, and its last inputs."""


class EpisodeReset:
    """Reset of the episode of one environment, or of some of N.

    Args:
        env: The environment, or the prototype of N.
        episodes: The quantities of these environments.
        draws: What the values were drawn from.
        values: These values; of N environments, rows.
        indices: The environments, shape (M,).

    Attributes:
        pool: Has their FMUs.
        episodes, draws, values, indices: As given.
    """

    def __init__(
        self,
        env: Any,
        episodes: ResetEpisodes,
        draws: EpisodeStart,
        values: EpisodeValues,
        indices: IndexArray = FIRST,
    ) -> None:
        self._env, self.episodes, self.draws = env, episodes, draws
        self.values, self.indices = values, indices
        self.pool: Pool = env._instance.pool

    def run(self) -> None:
        """Start the FMUs, and show hooks the first quantities of the episodes.

        Raises:
            SimulationError: If an FMU cannot be initialized, or its warm-up fails.
            ConfigError: If an input of a warm-up does not fit its type.
        """
        warm_ups = self._env._warm_ups
        if warm_ups is None:
            self._start(self.indices)
            self._clear()
        else:
            self._clear()
            warm_ups.begin(self)
        self.episodes.look(self.indices, self.pool.outputs)

    def start(self, indices: IndexArray) -> Episode:
        """Start the FMUs of some of the environments before their warm-up.

        Returns:
            What their hooks read, environments on the last axis.
        """
        self._start(indices)
        self.episodes.look(self.indices, self.pool.outputs)
        return self.episodes.some(indices)

    def _start(self, indices: IndexArray) -> None:
        pool, mask = self.pool, None
        if len(indices) < pool.num_instances:
            mask = np.zeros(pool.num_instances, np.bool_)
            mask[indices] = True
        pool.reset(self.draws.model_variables, self.values.start_values, mask)
        if any(pool.statuses.tolist()):
            require_started(pool, indices)

    def _clear(self) -> None:
        """Let hooks read nothing of earlier episodes, but for the outputs."""
        env, given = self._env, self.values.parameters.get
        inputs = [given(name, start) for name, start in env.interface.start_inputs]
        self.episodes.clear(self.indices, inputs, env._conversions.no_action, self.values)


_MOST_BYTES: Final = 2**28
"""The size of all warmed-up states in memory; the ones that were not used for longest go first."""

_FAILED: Final = "the warm-up failed: "


class WarmUp(ABC):
    """Warm-up of episodes by moving inputs.

    Its methods read the environment as hooks do. The episodes are arrays with M environments on the
    last axis, also in a single environment. ``step_count`` rises to 0.

    Attributes:
        steps: How many steps it has.
        caches: Whether to keep the states that it leads to.
        depends_on: The episode variables on which it depends.
        writes: The episode variables that it writes.
        digest: Tells it from others that lead to other states.
    """

    steps: int
    caches: bool = False
    depends_on: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    digest: str = ""

    @abstractmethod
    def begin(self, count: int) -> None:
        """Prepare for the warm-up of some environments.

        Args:
            count: M.
        """

    @abstractmethod
    def inputs(self, env: Any) -> Any:
        """Choose the action, and return the FMU's inputs that follow, numbers or of shape (M,)."""

    @abstractmethod
    def update(self, env: Any) -> None:
        """Write the episode variables that the warm-up changes, when the FMU has stepped."""


class _Memory:
    """Warmed-up states of all environments of this process by key."""

    def __init__(self) -> None:
        self._states: OrderedDict[bytes, bytes] = OrderedDict()
        self._lock, self._size = Lock(), 0

    def find(self, key: bytes) -> bytes | None:
        with self._lock:
            if key in self._states:
                self._states.move_to_end(key)
            return self._states.get(key)

    def keep(self, key: bytes, warmed: bytes) -> None:
        with self._lock:
            if key in self._states or len(warmed) > _MOST_BYTES:
                return
            self._states[key] = warmed
            self._size += len(warmed)
            while self._size > _MOST_BYTES:
                self._size -= len(self._states.popitem(last=False)[1])


_memory: Final = _Memory()

Found = dict[int, bytes]
"""By the index of an environment, what its warm-up leads to: the inputs and the episode variables
that it writes, all float64, and the FMU's state."""


class WarmUps:
    """The warm-ups of one environment, or of N.

    Args:
        env: The environment, or the prototype of N.
        warm_up: What happens in them.

    Attributes:
        warm_up: The same.
    """

    def __init__(self, env: Any, warm_up: WarmUp) -> None:
        self._env, self.warm_up = env, warm_up
        starts = env.config.variable_starts
        self._shapes = {name: np.shape(starts[name]) for name in warm_up.writes}
        sizes = len(env.interface.inputs), *map(math.prod, self._shapes.values())
        self._ends = np.cumsum(sizes)
        self._size = 8 * int(self._ends[-1])  # of the bytes before an FMU's state
        self._prefix: str | None = None
        self._scope = b""
        self._keys: dict[int, bytes] = {}
        self._has_told = False

    def begin(self, reset: EpisodeReset) -> None:
        """Bring new episodes to where their warm-ups lead; known states take the place of steps.

        Args:
            reset: The episodes; their pool then has the last inputs.

        Raises:
            SimulationError: If an FMU fails or refuses a state.
            ConfigError: If an input does not fit its type.
        """
        pool, left = reset.pool, reset.indices.tolist()
        while left:
            found = self._find(reset, left)
            first = self._distinct(index for index in left if index not in found)
            if first:
                where = np.array(first)
                reset.episodes.warmed(
                    where, self._run(pool, reset.start(where), where), pool.inputs
                )
            self._restore(reset, found)
            left = [index for index in left if index not in found and index not in first]

    # States that are known

    def _find(self, reset: EpisodeReset, indices: Iterable[int]) -> Found:
        """Look for states that warm-ups of new episodes lead to."""
        self._keys = {}
        if not self.warm_up.caches or not self._can_keep(reset.pool):
            return {}
        variables = reset.draws.model_variables
        rows = [np.asarray(reset.episodes.row(name)) for name in self.warm_up.depends_on]
        found = {}
        for index in indices:
            own = (np.float64(row[..., index]).tobytes() for row in rows)
            starts = reset.values.start_values[:, index].tolist()
            parts = [repr(values_by_name(variables, starts)).encode(), *own]
            key = self._key(parts)
            warmed = _memory.find(key) or self._read(key)
            if warmed is None:
                self._keys[index] = key
            else:
                found[index] = warmed
        return found

    def _distinct(self, indices: Iterable[int]) -> list[int]:
        """Of environments without a known state, those whose warm-ups lead to different ones."""
        by_key = {self._keys.get(index, index): index for index in reversed(list(indices))}
        return sorted(by_key.values())

    def _can_keep(self, pool: Pool) -> bool:
        """Whether the FMU's states can be kept; says so once if they cannot."""
        can = pool.save_method is SaveMethod.STATE
        if not can and not self._has_told:
            self._has_told = True
            self._env.logger.warning(
                "%s: no state is kept after the warm-up, because its states cannot be serialized",
                self._env.fmu.path.name,
            )
        return can

    def _key(self, parts: Iterable[bytes]) -> bytes:
        if self._prefix is None:
            self._prefix = state_files(self._env.fmu)
            spec = repr(essence(self._env.pool_spec))
            self._scope = f"{self._prefix} {spec} {self.warm_up.digest}".encode()
        digests = (hashlib.sha256(part).digest() for part in (self._scope, *parts))
        return hashlib.sha256(b"".join(digests)).digest()

    def _restore(self, reset: EpisodeReset, found: Found) -> None:
        """Bring FMUs to states that were found, each state once to all that begin with it."""
        groups: dict[bytes, list[int]] = {}
        for index, warmed in found.items():
            groups.setdefault(warmed, []).append(index)
        for warmed, indices in groups.items():
            where = np.array(indices)
            pool, values = reset.pool, self._restored(reset.pool, warmed, where)
            reset.episodes.warmed(where, values, pool.inputs)

    def _restored(self, pool: Pool, warmed: bytes, indices: IndexArray) -> dict[str, Any]:
        inputs, *parts = np.split(np.frombuffer(warmed[: self._size]), self._ends[:-1])
        bundle, sources = Bundle((warmed[self._size :],)), np.zeros(len(indices), np.int64)
        pool.restore_instances(bundle, sources, indices)
        require_started(pool, indices, _FAILED)
        pool.inputs[:, indices] = inputs[:, None]
        shapes = self._shapes.items()
        return {name: p.reshape(*n, 1) for (name, n), p in zip(shapes, parts, strict=True)}

    # Warm-ups

    def _run(self, pool: Pool, episodes: Episode, indices: IndexArray) -> Mapping[str, Any]:
        """Warm up episodes that have just begun; return the variables that this has written."""
        skip = np.ones(pool.num_instances, np.bool_)
        skip[indices] = False
        variables = self._play(pool, episodes, indices, skip)
        self._keep(pool, variables, indices)
        return variables

    def _play(
        self,
        pool: Pool,
        episodes: Episode,
        indices: IndexArray,
        skip: npt.NDArray[np.bool_],
    ) -> dict[str, Any]:
        count, warm_up = len(indices), self.warm_up
        warm_up.begin(count)
        with standing_in(self._env, episodes), np.errstate(all="ignore"):
            env: Any = self._env
            for step in range(-warm_up.steps, 0):
                env.step_count = np.full(count, step)
                self._step(pool, indices, skip)
                env.step_count = np.full(count, step + 1)
                warm_up.update(env)
            return {name: env.variables[name] for name in warm_up.writes}

    def _step(self, pool: Pool, indices: IndexArray, skip: npt.NDArray[np.bool_]) -> None:
        env: Any = self._env
        env._episode.keep()
        given = np.empty((len(pool.inputs), len(indices)))
        for row, value in zip(given, self.warm_up.inputs(env), strict=True):
            row[:] = value
        if not env._conversions.input_writer.all_real:
            columns = [to_input_types(env.interface.inputs, column) for column in given.T]
            given = np.array(columns).T
        env.inputs = given
        pool.inputs[:, indices] = given
        pool.step(None, skip)
        require_started(pool, indices, _FAILED)
        env._episode.outputs = outputs = pool.outputs[:, indices]
        env.state = outputs[: env.interface.output_count]

    def _keep(self, pool: Pool, rows: Mapping[str, Any], indices: IndexArray) -> None:
        """Keep the states of those for which none was known."""
        for place, index in enumerate(indices.tolist()):
            key = self._keys.pop(index, None)
            if key is None:
                continue
            values = pool.inputs[:, index], *(row[..., place] for row in rows.values())
            numbers = b"".join(np.asarray(value, np.float64).tobytes() for value in values)
            (state,) = pool.save_instances(np.array([index])).states
            _memory.keep(key, numbers + state)
            if self._prefix:
                StateFiles(self._prefix).keep(key.hex()[:32], numbers + state)

    def _read(self, key: bytes) -> bytes | None:
        """Find a state on disk."""
        found = StateFiles(self._prefix).find(key.hex()[:32]) if self._prefix else None
        if found is None or len(found) <= self._size:
            return None
        _memory.keep(key, found)
        return found
