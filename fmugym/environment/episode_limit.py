"""Limit of episodes: specs of environments tell Gymnasium how many steps an episode has at most."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any, Final

from gymnasium.envs.registration import EnvSpec

from fmugym.errors import ConfigError

__all__ = ["EpisodeLimit", "limit_of_make"]

_REGISTRATION: Final = "gymnasium.envs.registration"


@dataclass(frozen=True)
class EpisodeLimit:
    """The largest number of steps of an episode.

    Attributes:
        steps: This number; ``sys.maxsize`` if there is none.
        longest: What ``max_episode_steps`` must not exceed; None if it may be any number.
        reason: Where this stands, with its value.
    """

    steps: int
    longest: int | None = None
    reason: str = ""

    @classmethod
    def of(cls, env: Any) -> EpisodeLimit:
        """Limit of an environment; nothing may be longer than the episodes of a declared task."""
        length = env.config.max_episode_steps
        if env.resolved is None or length is None:
            return cls(env.step_limit)
        seconds = length * env.pool_spec.time_step
        return cls(env.step_limit, length, f"the task's 'episode_length' of {seconds:g} s")

    def shortened(self, max_episode_steps: int | None) -> EpisodeLimit:
        """The same, unless another limit is shorter.

        Raises:
            ConfigError: If it is longer than ``longest``.
        """
        self.require(max_episode_steps)
        return replace(self, steps=min(self.steps, max_episode_steps or self.steps))

    def require(self, max_episode_steps: int | None) -> None:
        """Refuse a limit that no episode would reach.

        Raises:
            ConfigError: If it is longer than ``longest``.
        """
        longest, given = self.longest, max_episode_steps
        if longest is not None and given is not None and given > longest:
            raise ConfigError(
                f"max_episode_steps = {given} is longer than {self.reason}, which is {longest} "
                "steps; leave it out, or change the task"
            )

    def told_by(self, spec: EnvSpec | None) -> EnvSpec | None:
        """A spec that tells the limit, unless its own is shorter.

        Raises:
            ConfigError: If its own is longer than ``longest``.
        """
        if spec is None:
            return None
        steps = self.shortened(spec.max_episode_steps).steps
        return replace(spec, max_episode_steps=None if steps == sys.maxsize else steps)


def limit_of_make(frame: FrameType) -> int | None:
    """The ``max_episode_steps`` of the ``gymnasium.make`` that sets a spec; None if it is another.

    ``make`` tells the limit to its wrapper ``TimeLimit`` only, which asks nobody.

    Args:
        frame: The caller.
    """
    if frame.f_globals.get("__name__") != _REGISTRATION or frame.f_code.co_name != "make":
        return None
    given, spec = (frame.f_locals.get(name) for name in ("max_episode_steps", "env_spec"))
    return getattr(spec, "max_episode_steps", None) if given is None else given
