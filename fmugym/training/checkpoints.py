"""Checkpoints: files with everything on which the next step of a training depends.

A checkpoint is made between two updates of the agent. It has the model with its optimizer, the
replay buffer, the normalization, the FMUs with their random streams (``FMUVectorEnv.save_state``),
and the generators of Python, numpy and PyTorch. So a training that is resumed takes the same course
as one that was not interrupted, to the last bit.
"""

from __future__ import annotations

import json
import pickle
import random
import shutil
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.errors import FMUGymError, reading_file, shown
from fmugym.files import write_whole
from fmugym.training.agents import algorithm_of, read_facts

__all__ = [
    "CHECKPOINT",
    "NOTHING_TO_RESUME",
    "latest_checkpoint",
    "load_checkpoint",
    "save_checkpoint",
]

CHECKPOINT: Final = "checkpoint.json"
NOTHING_TO_RESUME: Final = "has no training to resume"
_OF_NORMALIZATION: Final = ("obs_rms", "ret_rms", "returns", "old_obs", "old_reward")
_OF_MONITOR: Final = ("episode_returns", "episode_lengths", "episode_count")
_OF_RESIDUAL: Final = ("memory",)


def save_checkpoint(folder: Path, model: Any, venv: Any, more: dict[str, Any]) -> None:
    """Write a checkpoint; the one before stays until this one is complete.

    Args:
        folder: Folder of the training.
        model: The model of Stable-Baselines3.
        venv: Its environments: wrappers around a ``FMUVecEnv``.
        more: Further objects to keep; it must be possible to pickle it.
    """
    place = _new_place(folder, int(model.num_timesteps))
    try:
        _write(place, model, venv, more)
    except BaseException:  # such as a full disk
        shutil.rmtree(place, ignore_errors=True)
        raise
    facts = {"folder": place.name, "steps": int(model.num_timesteps)}
    write_whole(folder / CHECKPOINT, json.dumps(facts).encode())
    for old in folder.glob("checkpoint-*"):
        if old != place:
            shutil.rmtree(old, ignore_errors=True)


def _new_place(folder: Path, steps: int) -> Path:
    """A new folder; there may be a checkpoint of the same step."""
    names = (f"checkpoint-{steps}{suffix}" for suffix in ("", "-again"))
    now = latest_checkpoint(folder)[0].name if (folder / CHECKPOINT).exists() else None
    place = next(folder / name for name in names if name != now)
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    return place


def _write(place: Path, model: Any, venv: Any, more: dict[str, Any]) -> None:
    model.save(place / "model.zip")
    if getattr(model, "replay_buffer", None) is not None:
        model.save_replay_buffer(place / "replay.pkl")
    state = {"more": more, "wrappers": _wrappers(venv), "envs": _envs(venv)}
    state["random"] = _random_states(venv)
    with (place / "state.pkl").open("wb") as file:
        pickle.dump(state, file)


def _layers(venv: Any) -> list[Any]:
    layers = [venv]
    while hasattr(layers[-1], "venv"):
        layers.append(layers[-1].venv)
    return layers


def _wrappers(venv: Any) -> list[dict[str, Any]]:
    names = (*_OF_NORMALIZATION, *_OF_MONITOR, *_OF_RESIDUAL)
    return [
        {name: vars(layer)[name] for name in names if name in vars(layer)}
        for layer in _layers(venv)[:-1]
    ]


def _envs(venv: Any) -> Any:
    """A snapshot of the FMUs; None if they cannot be saved, and their episodes begin anew."""
    try:
        return _layers(venv)[-1].vector_env.save_state()
    except FMUGymError:
        return None


def _random_states(venv: Any) -> dict[str, Any]:
    torch: Any = import_module("torch")
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002  (the generator that SB3 uses)
        "torch": torch.get_rng_state(),
        "actions": venv.action_space.np_random.bit_generator.state,
    }


def latest_checkpoint(folder: Path) -> tuple[Path, int]:
    """The folder of the latest checkpoint of a training, and its steps.

    Raises:
        ConfigError: If there is none.
    """
    facts = read_facts(folder, CHECKPOINT, NOTHING_TO_RESUME, "folder", "steps")
    with reading_file(f"{shown(str(folder))} {NOTHING_TO_RESUME}"):
        return folder / facts["folder"], int(facts["steps"])


def load_checkpoint(folder: Path, algorithm: str, venv: Any) -> tuple[Any, dict[str, Any], bool]:
    """Load the latest checkpoint.

    Only load checkpoints from sources that you trust: the files hold pickles, which can run code.

    Args:
        folder: Folder of the training.
        algorithm: The name of the algorithm.
        venv: The same environments as before, which are brought to where they were.

    Returns:
        The model, what else was kept, and whether the FMUs go on where they were.

    Raises:
        ConfigError: If there is none, its files are damaged, or it is of another task.
    """
    place, _ = latest_checkpoint(folder)
    with reading_file(f"the checkpoint in {shown(str(folder))} cannot be resumed"):
        return _loaded(place, algorithm, venv)


def _loaded(place: Path, algorithm: str, venv: Any) -> tuple[Any, dict[str, Any], bool]:
    with (place / "state.pkl").open("rb") as file:
        state = pickle.load(file)
    has_envs = state["envs"] is not None
    model = algorithm_of(algorithm).load(
        place / "model.zip", env=venv, device="cpu", force_reset=not has_envs
    )
    if (place / "replay.pkl").exists():
        model.load_replay_buffer(place / "replay.pkl")
    if has_envs:
        inner = _layers(venv)[-1]
        inner.vector_env.restore_state(state["envs"])
        inner._reset_seeds()  # the model has set some while it was loaded
    for layer, kept in zip(_layers(venv), state["wrappers"], strict=False):
        vars(layer).update(kept)
    _set_random_states(venv, state["random"])
    return model, state["more"], has_envs


def _set_random_states(venv: Any, states: dict[str, Any]) -> None:
    torch: Any = import_module("torch")
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])  # noqa: NPY002  (as above)
    torch.set_rng_state(states["torch"])
    venv.action_space.np_random.bit_generator.state = states["actions"]
