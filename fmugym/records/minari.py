"""Datasets of Minari for offline learning, made of recordings, and back.

Needs the extra ``minari``. See ``docs/datasets.md``.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from itertools import islice
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import Space
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from fmugym.environment.env import FMUEnv
from fmugym.environment.saved_episode import scope_of
from fmugym.environment.snapshots import require_scope
from fmugym.errors import ConfigError, reason, shown
from fmugym.extras import lacking
from fmugym.records.recording import METADATA, Recording, element_from, flat_element

try:
    import minari
    from minari.data_collector import EpisodeBuffer
except ImportError as error:
    raise ImportError(
        lacking("fmugym.records.minari", "Minari", "minari"), name=error.name
    ) from error

__all__ = ["read_dataset", "write_dataset"]

_KEY: Final = "fmugym"
"""Key of an episode's options for the facts of a ``Recording`` besides numbers."""


def write_dataset(
    dataset_id: str,
    recordings: Sequence[Recording],
    env: FMUEnv,
    *,
    replaces: bool = False,
    **about: Any,
) -> minari.MinariDataset:
    """Make a dataset of recordings, in Minari's folder on this machine.

    Args:
        dataset_id: Its name, such as ``"house/pi-v0"``.
        recordings: The episodes, at least one.
        env: An environment of the task. It gives the spaces, and its spec if it has one.
        replaces: Whether a dataset of this name is replaced.
        about: Metadata of Minari, such as ``author``, ``algorithm_name`` and ``description``; and
            ``data_format``.

    Returns:
        The dataset. It keeps all that the recordings hold, so that ``read_dataset`` gives them
        back.

    Raises:
        ConfigError: If there are no recordings, one is of another FMU or config, or Minari refuses
            the name or the metadata.
    """
    if not recordings:
        raise ConfigError("a dataset needs at least one recording")
    for recording in recordings:
        require_scope(recording.scope, scope_of(env), "recording")
    episodes = [_buffer(number, one, env) for number, one in enumerate(recordings)]
    spec = {"env": env.spec} if env.spec is not None else {}
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    if replaces and dataset_id in minari.list_local_datasets():
        minari.delete_dataset(dataset_id)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about metadata that the caller leaves out
            return minari.create_dataset_from_buffers(
                dataset_id, episodes, **spec, **spaces, **{"requirements": [_REQUIREMENT], **about}
            )
    except (ValueError, TypeError, ImportError) as error:
        raise ConfigError(f"Minari makes no dataset {shown(dataset_id)}: {reason(error)}") from None


def read_dataset(dataset: str | minari.MinariDataset) -> list[Recording]:
    """Read the recordings of a dataset that ``write_dataset`` has made.

    Args:
        dataset: The dataset, or its name.

    Raises:
        ConfigError: If there is no such dataset, or it was made by another program.
    """
    if isinstance(dataset, str):
        dataset = _loaded(dataset)
    numbers = [int(number) for number in dataset.episode_indices]
    facts = dataset.storage.get_episode_metadata(numbers)
    return [
        _recording(dataset, episode, _facts_of(one, dataset))
        for episode, one in zip(dataset.iterate_episodes(numbers), facts, strict=True)
    ]


_REQUIREMENT: Final = "fmugym-toolbox"


def _loaded(name: str) -> minari.MinariDataset:
    try:
        return minari.load_dataset(name)
    except (FileNotFoundError, ValueError) as error:
        known = ", ".join(sorted(minari.list_local_datasets())) or "none"
        raise ConfigError(
            f"there is no dataset {shown(name)} on this machine ({reason(error)}); there are: "
            f"{known}"
        ) from None


def _buffer(number: int, recording: Recording, env: FMUEnv) -> EpisodeBuffer:
    facts = {name: getattr(recording, name) for name in METADATA}
    return EpisodeBuffer(
        id=number,
        seed=recording.seed,
        options={_KEY: json.dumps(facts)},
        observations=_stacked(env.observation_space, recording.observations),
        actions=_stacked(env.action_space, recording.actions),
        rewards=recording.rewards.tolist(),
        terminations=recording.terminated.tolist(),
        truncations=recording.truncated.tolist(),
    )


def _stacked(space: Space[Any], rows: npt.NDArray[Any]) -> Any:
    """Elements of a space, as Minari has them: arrays, or dicts and tuples of arrays."""
    elements = [element_from(space, row) for row in rows]
    empty: Any = create_empty_array(space, len(elements))
    return concatenate(space, elements, empty)


def _facts_of(metadata: Any, dataset: minari.MinariDataset) -> dict[str, Any]:
    """Facts that ``_buffer`` has put into the options; storages of Minari nest them differently."""
    text = metadata.get(f"options/{_KEY}") or metadata.get("options", {}).get(_KEY)
    if text is None:
        raise ConfigError(
            f"the dataset {dataset.spec.dataset_id!r} was not made by fmugym: it does not tell the "
            "FMU, the config and the random streams of its episodes"
        )
    facts: dict[str, Any] = json.loads(text)
    return facts | {"stream": tuple(facts["stream"])}


def _recording(dataset: minari.MinariDataset, episode: Any, facts: dict[str, Any]) -> Recording:
    return Recording(
        **facts,
        observations=_flat(dataset.observation_space, episode.observations, len(episode) + 1),
        actions=_flat(dataset.action_space, episode.actions, len(episode)),
        rewards=np.asarray(episode.rewards, np.float64),
        terminated=np.asarray(episode.terminations, np.bool_),
        truncated=np.asarray(episode.truncations, np.bool_),
    )


def _flat(space: Space[Any], stacked: Any, count: int) -> npt.NDArray[Any]:
    return np.array(
        [
            flat_element(space, one)
            for one in islice(iterate(batch_space(space, count), stacked), count)
        ]
    )
