"""Recordings of episodes as small files, which can be replayed to the last bit.

::

    recorder = Recorder(env)
    recorder.reset(seed=1)
    ...                                    # steps as ever
    recorder.recording.save("episode.npz")

    report = replay(Recording.load("episode.npz"), env)
    print(report)                          # equal, or the first difference
"""

from __future__ import annotations

import json
import os
import platform
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces.utils import flatdim, flatten, unflatten
from gymnasium.utils.seeding import np_random

from fmugym.checks import check_seed, require_regular
from fmugym.environment.env import inner_env
from fmugym.environment.saved_episode import generator_of, row_of, scope_of, state_of
from fmugym.environment.snapshots import require_scope
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.files import replaced

_multiarray_umath: Any = import_module("numpy._core._multiarray_umath")

__all__ = [
    "METADATA",
    "Recorder",
    "Recording",
    "ReplayReport",
    "element_from",
    "flat_element",
    "replay",
    "surroundings",
]

_VERSION: Final = 1

_MOST_BYTES: Final = 2**30
"""A file without its compression; a hundred million steps of a small task have no more."""


def surroundings() -> dict[str, str]:
    """Facts by name on which the last bits of results may depend."""
    features: dict[str, bool] = getattr(_multiarray_umath, "__cpu_features__", {})
    return {
        "fmugym": version("fmugym-toolbox"),
        "numpy": np.__version__,
        "system": f"{platform.system()} {platform.machine()}",
        "C library": " ".join(platform.libc_ver()),
        "processor features": " ".join(sorted(name for name, on in features.items() if on)),
    }


@dataclass(frozen=True)
class Recording:
    """An episode.

    Attributes:
        scope: The FMU (by its content) and the config.
        surroundings: See ``surroundings``.
        seed: The seed of the reset; None if it went on with the generator.
        stream: The random generator just before the draws; six integers of 64 bits.
        options: The options of the reset, as JSON.
        drawn: The values that were drawn or overridden, by name.
        actions: The action of each step, shape (steps, ...).
        observations: The first observation and that of each step, flat, shape (steps + 1, ...).
        rewards: Shape (steps,).
        terminated: Shape (steps,).
        truncated: Shape (steps,).

    Raises:
        ConfigError: If the arrays are not of as many steps, or hold no numbers.
    """

    scope: dict[str, str]
    surroundings: dict[str, str]
    seed: int | None
    stream: tuple[int, ...]
    options: str
    drawn: dict[str, float]
    actions: npt.NDArray[Any]
    observations: npt.NDArray[Any]
    rewards: npt.NDArray[np.float64]
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        steps = np.size(self.rewards)
        for name, (kinds, dimensions) in _ARRAYS.items():
            array, rows = getattr(self, name), steps + (name == "observations")
            shape, most = np.shape(array), dimensions or np.ndim(array)
            if shape[:1] != (rows,) or len(shape) > most or array.dtype.kind not in kinds:
                raise ConfigError(
                    f"the {name} of {steps} steps are an array of {array.dtype} of shape {shape}, "
                    f"expected {rows} rows"
                )

    def __len__(self) -> int:
        return len(self.rewards)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the recording to a file, in the format ``npz`` of numpy."""
        fields = {name: getattr(self, name) for name in _ARRAYS}
        header = {name: getattr(self, name) for name in METADATA}
        text = json.dumps({"version": _VERSION, **header}).encode()
        with replaced(Path(path)) as part, part.open("wb") as file:
            np.savez_compressed(file, header=np.frombuffer(text, np.uint8), **fields)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Recording:
        """Read a recording.

        Raises:
            ConfigError: If the file is none, of another version of the format, or damaged.
        """
        try:
            require_regular(Path(path))
            with np.load(path, allow_pickle=False) as file:
                _require_small(file.zip)
                header = json.loads(file["header"].tobytes())
                arrays = {name: file[name] for name in _ARRAYS}
            return cls(**_facts(header), **arrays)
        except Exception as error:  # a damaged file may raise anything
            raise ConfigError(
                f"{shown(str(path))} is no recording of an episode: {error}"
            ) from None


METADATA: Final = ("scope", "surroundings", "seed", "stream", "options", "drawn")
"""Names of the facts of a recording besides arrays."""

_ARRAYS: Final = {
    **dict.fromkeys(("actions", "observations"), ("biuf", None)),
    "rewards": ("f", 1),
    **dict.fromkeys(("terminated", "truncated"), ("b", 1)),
}
"""Kinds of numbers and of dimensions of each array; None for any."""


def _require_small(archive: zipfile.ZipFile) -> None:
    size = sum(entry.file_size for entry in archive.infolist())
    if size > _MOST_BYTES:
        raise ValueError(
            f"unpacked, it has {size / 2**30:.3g} GB; at most {_MOST_BYTES / 2**30:g} GB are read"
        )


def _facts(header: dict[str, Any]) -> dict[str, Any]:
    """Read the facts of a header; damage raises any exception."""
    if header["version"] != _VERSION:
        raise ValueError("it is of another version of the format")
    stream, seed = tuple(map(int, header["stream"])), header["seed"]
    generator_of(state_of(list(stream)))  # which refuses what is none
    json.loads(header["options"])
    return {
        "options": header["options"],
        **{
            name: {key: str(text) for key, text in header[name].items()}
            for name in ("scope", "surroundings")
        },
        "seed": None if seed is None else int(seed),
        "stream": stream,
        "drawn": {name: float(value) for name, value in header["drawn"].items()},
    }


class Recorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Records the present episode of an environment.

    Args:
        env: An ``FMUEnv``, or wrappers around one; what comes out of them is recorded.

    Raises:
        ConfigError: If there is no ``FMUEnv`` inside.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self._inner = inner_env(env)
        self._start: dict[str, Any] | None = None
        self._rows: list[tuple[Any, ...]] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and its recording; see ``FMUEnv.reset``.

        Raises:
            ConfigError: As ``FMUEnv.reset``, and if the options cannot be written as JSON.
        """
        text, seed = _as_json(options), check_seed(seed)
        self._start = None
        stream = _stream_of(self._inner.np_random if seed is None else np_random(seed)[0])
        observation, info = self.env.reset(seed=seed, options=options)
        first = flat_element(self.env.observation_space, observation)
        self._start = {"seed": seed, "stream": stream, "options": text, "first": first}
        self._start["drawn"] = {name: float(value) for name, value in info["drawn"].items()}
        self._rows = []
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Do a step, and record it; see ``FMUEnv.step``."""
        flat = np.array(flat_element(self.env.action_space, action))
        observation, reward, terminated, truncated, info = self.env.step(action)
        seen = flat_element(self.env.observation_space, observation)
        self._rows.append((flat, seen, float(reward), bool(terminated), bool(truncated)))
        return observation, reward, terminated, truncated, info

    @property
    def recording(self) -> Recording:
        """The present episode until now.

        Raises:
            SimulationError: Before the first reset.
        """
        if self._start is None:
            raise SimulationError("there is no recording before the first reset")
        start = self._start
        actions, seen, rewards, *ends = zip(*self._rows, strict=True) if self._rows else [()] * 5
        return Recording(
            scope=scope_of(self._inner),
            surroundings=surroundings(),
            **{name: start[name] for name in ("seed", "stream", "options", "drawn")},
            actions=np.array(actions),
            observations=np.array([start["first"], *seen]),
            rewards=np.array(rewards, np.float64),
            terminated=np.array(ends[0], np.bool_),
            truncated=np.array(ends[1], np.bool_),
        )


@dataclass(frozen=True)
class ReplayReport:
    """Result of a replay.

    Attributes:
        steps: How many steps were replayed.
        difference: The first difference; "" if all is equal to the last bit.
        surroundings: Differences in the surroundings, by name: then and now.
    """

    steps: int
    difference: str = ""
    surroundings: dict[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def is_equal(self) -> bool:
        """Whether all is equal to the last bit."""
        return not self.difference

    def __str__(self) -> str:
        told = self.difference or "all is equal to the last bit"
        others = "; ".join(
            f"{name} was {then!r}, is {now!r}" for name, (then, now) in self.surroundings.items()
        )
        return f"{self.steps} steps were replayed: {told}{f' ({others})' if others else ''}"


def replay(recording: Recording, env: gymnasium.Env[Any, Any]) -> ReplayReport:
    """Play a recorded episode again, and compare it to the last bit.

    Args:
        recording: The episode.
        env: An environment with the same FMU and config, and the same wrappers.

    Raises:
        ConfigError: If the FMU or the config is another one.
    """
    inner, now = inner_env(env), surroundings()
    require_scope(recording.scope, scope_of(inner), "recording")
    then = recording.surroundings
    others = {n: (then.get(n, ""), now[n]) for n in now if then.get(n) != now[n]}
    inner.np_random = generator_of(state_of(list(recording.stream)))
    observation, info = env.reset(options=json.loads(recording.options))
    drawn = {name: float(value) for name, value in info["drawn"].items()}
    found = _difference_of_starts(
        recording, drawn, flat_element(env.observation_space, observation)
    )
    steps = 0
    while not found and steps < len(recording):
        found = _difference_of_step(recording, env, steps)
        steps += 1
    return ReplayReport(steps, found, others)


def _difference_of_starts(
    recording: Recording, drawn: Mapping[str, float], observation: npt.NDArray[Any]
) -> str:
    for name, value in recording.drawn.items():
        if drawn.get(name) != value:
            return f"the reset has drawn {name} = {drawn.get(name)}, recorded was {value}"
    return _difference("the first observation", observation, recording.observations[0])


def _difference_of_step(recording: Recording, env: gymnasium.Env[Any, Any], step: int) -> str:
    action = element_from(env.action_space, recording.actions[step])
    observation, reward, terminated, truncated, _ = env.step(action)
    seen, when = flat_element(env.observation_space, observation), f"step {step + 1}: the "
    return (
        _difference(f"{when}observation", seen, recording.observations[step + 1])
        or _difference(f"{when}reward", np.float64(reward), recording.rewards[step])
        or _difference(f"{when}flag terminated", terminated, recording.terminated[step])
        or _difference(f"{when}flag truncated", truncated, recording.truncated[step])
    )


def _difference(what: str, found: Any, recorded: Any) -> str:
    found, recorded = np.asarray(found), np.asarray(recorded)
    if found.shape != recorded.shape:
        return f"{what} has shape {found.shape}, recorded was {recorded.shape}"
    if found.astype(recorded.dtype).tobytes() == recorded.tobytes():
        return ""
    place = np.flatnonzero(np.ravel(found != recorded))[:1]
    index = int(place[0]) if len(place) else 0
    values = np.ravel(found)[index], np.ravel(recorded)[index]
    where = f"[{index}]" if found.ndim else ""
    return f"{what}{where} is {values[0]!r}, recorded was {values[1]!r}"


def _stream_of(generator: np.random.Generator) -> tuple[int, ...]:
    state: Any = generator.bit_generator.state
    if state["bit_generator"] != "PCG64":
        raise ConfigError(
            f"the environment has a generator {state['bit_generator']!r}; reset it with a seed"
        )
    return tuple(row_of(state))


def _as_json(options: Any) -> str:
    try:
        return json.dumps(options)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"the options of reset cannot be recorded: {error}") from None


def flat_element(space: gymnasium.Space[Any], value: Any) -> npt.NDArray[Any]:
    """An element of a space as an array of its own type."""
    if isinstance(value, Mapping | tuple):
        return np.asarray(flatten(space, value))
    return np.array(value)


def element_from(space: gymnasium.Space[Any], values: npt.NDArray[Any]) -> Any:
    """The element of a space that ``flat_element`` has made an array of.

    Raises:
        ConfigError: If the array is too short or too long for a space of several parts.
    """
    if not isinstance(space, gymnasium.spaces.Dict | gymnasium.spaces.Tuple):
        return values[()] if values.ndim == 0 else values
    if values.shape != (flatdim(space),):
        raise ConfigError(
            f"{values.shape} is no shape of a flat element of {space}, expected ({flatdim(space)},)"
        )
    return unflatten(space, values)
