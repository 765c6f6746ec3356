"""Vector environments for RLlib on Ray: each env runner steps one ``FMUVectorEnv``.

Needs the extra ``rllib``. See ``docs/rllib.md``.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import gymnasium
from gymnasium.vector import AutoresetMode, VectorWrapper

from fmugym.checks import check_text
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, reason, shown
from fmugym.extras import lacking
from fmugym.files import lasting_folder, replace_file
from fmugym.task import Task
from fmugym.training.rl_library_envs import make_vector_env

try:
    import ray
    from ray.tune.registry import register_env
except ImportError as error:
    raise ImportError(
        lacking("fmugym.training.rllib", "RLlib", "rllib"), name=error.name
    ) from error

__all__ = ["RunnerVectorEnv", "assigned_processors", "register_task"]

logger = logging.getLogger(__name__)

_OF_TASKS: Final = "fmugym/FMU-v0"
_MOST_BYTES: Final = 100 * 2**20
"""Largest size of a registration, which Ray keeps in the memory of the head node."""


def register_task(
    name: str, env: str | os.PathLike[str] | Task | Callable[..., FMUEnv], **kwargs: Any
) -> None:
    """Register a task with Ray, so that each env runner steps N environments in one call.

    The algorithm's config names it, and asks for one vector environment a runner::

        register_task("cart-pole", "fmugym/CartPole-v0")
        config.environment("cart-pole").env_runners(
            gym_env_vectorize_mode="vector_entry_point", num_envs_per_env_runner=64
        )

    The files of the task travel with the registration to the nodes: the FMU and the data of a task
    file, and every file that an argument names. The module of a class does not: give it to Ray, in
    ``ray.init(runtime_env={"py_modules": [...]})``.

    Args:
        name: The name for ``config.environment(name)``.
        env: A registered id, a class, a task file (``.toml``), or a ``Task``.
        kwargs: Arguments of ``FMUVectorEnv`` and of the environment. ``env_config`` of RLlib adds
            to them. ``threads`` is by default the number of processors that the runner has in Ray.

    Raises:
        ConfigError: If the name is no text, the task has a mistake, a file is missing, or the files
            are larger than 100 MB.
    """
    register_env(check_text("name", name), _Maker.of(env, kwargs))


class RunnerVectorEnv(VectorWrapper):
    """The N environments of one env runner, with seeds that no other runner has.

    RLlib seeds runner w with ``config.seed + w``, in evaluation with a million more. Vector
    environments seed environment i with the seed plus i, so that runners would share streams. Here,
    environment i has the seed ``(config.seed + w) * N + i``.
    """

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes; see the class for the seeds."""
        if isinstance(seed, int):
            seed *= self.num_envs
        return self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]  # takes lists


@dataclass(frozen=True)
class _Files:
    """Files by name, which pickle with their contents."""

    contents: dict[str, bytes] = field(default_factory=dict)

    def add(self, path: str | os.PathLike[str]) -> str:
        """Take a file along.

        Returns:
            Its path, relative to the folder of ``unpack``.
        """
        try:
            data = Path(path).expanduser().read_bytes()
        except OSError as error:
            raise ConfigError(f"{shown(str(path))} cannot be read: {reason(error)}") from None
        place = f"{hashlib.sha256(data).hexdigest()[:16]}/{Path(path).name}"
        self.contents[place] = data
        size = sum(map(len, self.contents.values()))
        if size > _MOST_BYTES:
            raise ConfigError(
                f"the files of the task have {size / 2**20:.0f} MB, at most "
                f"{_MOST_BYTES / 2**20:.0f} MB can be registered: copy them to each node, or let "
                "Ray do it by the 'working_dir' of its runtime environment"
            )
        return place

    def unpack(self) -> Path:
        """Write the files, unless this machine has them already.

        Returns:
            Their folder.
        """
        root = lasting_folder("ray")
        for place, data in self.contents.items():
            file = root / place
            if not file.exists():
                file.parent.mkdir(parents=True, exist_ok=True)
                replace_file(file, data)  # other runners of this machine may write the same
        return root


@dataclass(frozen=True)
class _Maker:
    """Makes the environments of a runner, on whatever machine it runs.

    Attributes:
        env: A registered id or a class.
        kwargs: Arguments that are the same everywhere.
        paths: Arguments that name files, by their places in ``files``.
        document: What the task file declares, paths relative to the files; None without one.
        files: The files.
    """

    env: str | Callable[..., FMUEnv]
    kwargs: dict[str, Any]
    paths: dict[str, str]
    document: dict[str, Any] | None
    files: _Files

    @classmethod
    def of(cls, env: Any, kwargs: Mapping[str, Any]) -> _Maker:
        files, left = _Files(), dict(kwargs)
        task = _task_of(env, left)
        document = None if task is None else task.with_listed_files().with_paths(files.add)
        paths = {key: files.add(value) for key, value in left.items() if _is_file(value)}
        for key in paths:
            del left[key]
        return cls(env if task is None else _OF_TASKS, left, paths, document, files)

    def __call__(self, context: Mapping[str, Any]) -> Any:
        """Make a vector environment of the size that RLlib gives, or else a single one."""
        arguments = {**self._local(), **context}
        num_envs = arguments.pop("num_envs", None)
        if num_envs is None:
            logger.warning(
                "RLlib asks for single environments, which are slower than one vector environment: "
                "set gym_env_vectorize_mode='vector_entry_point' in config.env_runners"
            )
            return self._single(arguments)
        arguments.setdefault("threads", assigned_processors())
        arguments = {"autoreset_mode": AutoresetMode.NEXT_STEP, **arguments}
        return RunnerVectorEnv(make_vector_env(self.env, num_envs, arguments))

    def _single(self, arguments: dict[str, Any]) -> Any:
        if isinstance(self.env, str):
            return gymnasium.make(self.env, **arguments)
        return self.env(**arguments)

    def _local(self) -> dict[str, Any]:
        """The arguments, with the paths that files have on this machine."""
        folder = self.files.unpack()
        paths = {key: str(folder / place) for key, place in self.paths.items()}
        task = {} if self.document is None else {"config": Task.from_dict(self.document, folder)}
        return {**self.kwargs, **paths, **task}


def _task_of(env: Any, kwargs: dict[str, Any]) -> Task | None:
    """The task of a file, a ``Task``, or the argument ``config`` of ``fmugym/FMU-v0``."""
    if isinstance(env, Task | os.PathLike) or (isinstance(env, str) and env.endswith(".toml")):
        return Task.of(env)
    return Task.of(kwargs.pop("config")) if env == _OF_TASKS and "config" in kwargs else None


def _is_file(value: Any) -> bool:
    return isinstance(value, str | os.PathLike) and Path(value).expanduser().is_file()


def assigned_processors() -> int:
    """Number of processors that Ray has given to this runner; 1 if Ray gives none."""
    if not ray.is_initialized():
        return 1
    with suppress(Exception):  # the driver has no resources of its own
        return max(1, int(ray.get_runtime_context().get_assigned_resources().get("CPU", 1)))
    return 1
