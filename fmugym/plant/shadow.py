"""An environment in the shadow of a plant: it reads, and writes nothing."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import gymnasium
import numpy as np

from fmugym.archive.variable import Variable
from fmugym.checks import check_flag
from fmugym.declared import Task, TaskEnv
from fmugym.declared.format import DEVICE
from fmugym.errors import shown
from fmugym.logs import Actions
from fmugym.plant.feed import Feed, local_time
from fmugym.plant.modbus import ModbusClient
from fmugym.plant.reading import Poller
from fmugym.plant.serving import endless, environment
from fmugym.plant.tags import Plant, in_fmu, read_plant
from fmugym.pool.backend.clocks import Clock, RealClock
from fmugym.pool.base import FloatArray
from fmugym.task.actions import flat_inputs
from fmugym.task.warm_up import WarmUp, WarmUps

__all__ = ["Shadow", "connect"]

logger = logging.getLogger(__name__)

_OF_SIMULATIONS: Final = ("clock", "warm_up", "start_time")
_CLIENTS: Final[Mapping[str, Any]] = {"modbus": ModbusClient}


class _PresentTime:
    """The start time of an episode: that of the plant."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed

    def sample(self, rng: np.random.Generator) -> float:
        """Return the time of the present tick, in seconds of the year."""
        return self._feed.time


def _watched(task: Task, feed: Feed) -> Task:
    """The task on a plant: its time, its sensors and actuators, and no end of episodes."""
    document = {k: v for k, v in endless(task).document.items() if k not in _OF_SIMULATIONS}
    variables = document.get("variables", {})
    document["variables"] = {
        alias: {key: value for key, value in given.items() if key not in DEVICE}
        for alias, given in variables.items()
    }
    agent = dict(document.get("agent", {}))
    if "forecast" in agent:
        given = agent["forecast"]
        several = given if isinstance(given, list) else [given]
        agent["forecast"] = [{k: v for k, v in one.items() if k != "error"} for one in several]
    if "history" in agent:
        document["warm_up"] = {"period": agent["history"]["length"], "cache": True}
    return replace(task, document={**document, "agent": agent, "start_time": _PresentTime(feed)})


class _Watching(WarmUp):
    """Fills histories: the steps before the first observation, with what acts in the plant."""

    def __init__(self, declared: WarmUp, feed: Feed, written: _Written) -> None:
        self.steps, self.writes = declared.steps, declared.writes
        self._declared, self._feed, self._written = declared, feed, written

    def begin(self, count: int) -> None:
        """See ``WarmUp.begin``."""
        self._declared.begin(count)

    def inputs(self, env: Any) -> Any:
        """See ``WarmUp.inputs``: wait, and see what has acted."""
        values = self._declared.inputs(env)
        self._feed.advance()
        return self._written.over(np.array([np.ravel(value)[0] for value in values]))

    def update(self, env: Any) -> None:
        """See ``WarmUp.update``."""
        self._declared.update(env)


class _Written:
    """What acts in a plant, in the place of what an environment would write.

    Args:
        env: The environment. Its hook ``_get_inputs`` becomes one that reads the plant.
        feed: Has what acts.
    """

    def __init__(self, env: TaskEnv, feed: Feed, plant: Plant) -> None:
        self._feed, self._inputs = feed, env.inside.spec.inputs
        places = {variable.name: place for place, variable in enumerate(self._inputs)}
        self._tags = [
            (places[variable.name], alias, conversion)
            for alias, (variable, conversion) in in_fmu(env).items()
            if variable.name in places and alias in plant.tags
        ]
        self.actions = Actions(env, self, math.inf)
        self._own = env._get_inputs
        env._get_inputs = self._get_inputs  # type: ignore[method-assign]
        self.names = [alias for _, alias, _ in self._tags]

    def _get_inputs(self) -> FloatArray:
        return self.over(flat_inputs(self._own(), self._inputs, shown))

    def over(self, values: FloatArray) -> FloatArray:
        """The inputs with what acts in the plant, in the FMU's units."""
        for place, alias, conversion in self._tags:
            values[place] = conversion.inverse(self._feed.values[alias][0])
        return values

    def action(self) -> Any:
        """The action that comes nearest to what acts in the plant."""
        values = self.over(np.zeros(len(self._inputs)))
        row = dict(zip([one.name for one in self._inputs], values.tolist(), strict=True))
        return self.actions.of(row, self._feed.time)

    def proposed(self, action: Any) -> dict[str, float]:
        """What an action would write, in the task's units."""
        values = self.actions.inputs(action)
        return {alias: float(conversion(values[place])) for place, alias, conversion in self._tags}

    # For ``Actions``.

    def require(self, variable: Variable) -> None:
        """Refuse an input that no tag tells: what acts would be unknown."""
        if variable.name not in {self._inputs[place].name for place, *_ in self._tags}:
            raise _lacks_tag(variable.name)

    def range_of(self, variable: Variable) -> float:
        """How far apart its values are, if that is known."""
        width = variable.maximum - variable.minimum
        return width if math.isfinite(width) and width > 0 else 1.0


class Shadow(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A task in the shadow of a plant.

    ``reset`` sets nothing: it waits for good values and a tick, and for as long as histories go
    back. ``step`` writes nothing: it takes what an agent would do, waits for the next tick, and
    goes on with what has acted in the plant. So rewards, histories and inputs are those of the
    plant. Infos have

    * ``"proposed"``: what the action would have written, by variable;
    * ``"missing"``: the variables that have no value any longer; the last ones go on;
    * ``"fault"``: what is wrong, also while last values hold.

    An episode ends (``truncated``) if the plant's time jumps.
    """

    def __init__(self, env: TaskEnv, feed: Feed, poller: Poller, written: _Written) -> None:
        super().__init__(env)
        self._feed, self._poller, self._written = feed, poller, written

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin to watch.

        Raises:
            ConfigError: If the server does not know a tag, or one has a wrong type.
            SimulationError: If the server does not answer.
        """
        self._feed.begin()
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, info | self._told(dict.fromkeys(self._written.names, math.nan))

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Wait for the next tick; see the class."""
        proposed = self._written.proposed(action)
        self._feed.advance()
        observation, reward, terminated, truncated, info = self.env.step(self._written.action())
        has_jumped = self._feed.jump != 0.0
        return observation, reward, terminated, truncated or has_jumped, info | self._told(proposed)

    def _told(self, proposed: dict[str, float]) -> dict[str, Any]:
        feed = self._feed
        faults = [f"{name}: {why}" for name, why in feed.faults.items()]
        if feed.jump:
            faults.append(f"the plant's clock has jumped by {feed.jump:.6g} s")
        found: dict[str, Any] = {"proposed": proposed, "missing": feed.missing}
        return found | ({"fault": "; ".join(faults)} if faults else {})

    def close(self) -> None:
        """End the connection."""
        self._poller.stop()
        super().close()


def _lacks_tag(name: str) -> Any:
    from fmugym.errors import ConfigError

    return ConfigError(f"[plant] has no tag for {name!r}, which the task needs")


def connect(
    config: Any,
    address: str | None = None,
    *,
    physical: bool = False,
    clock: Clock | None = None,
) -> Shadow:
    """Connect to the plant of a task.

    Args:
        config: The task, as for ``fmugym.load``, with a section ``[plant]``.
        address: In the place of that of the task.
        physical: Whether observations and actions are in the units of the task, as controllers
            need them.
        clock: A monotonic clock; ``RealClock(speed)`` for a plant that ``fmugym serve`` runs
            faster.

    Returns:
        The environment. Closing it ends the connection.

    Raises:
        ConfigError: If the task has a mistake, has no ``[plant]``, or lacks a tag, or if the extra
            ``plant`` is missing.
    """
    task, clock = Task.of(config), clock or RealClock()
    start = local_time()
    is_real = getattr(clock, "speed", 1.0) == 1.0
    feed = Feed(clock, local_time if is_real else lambda: start + clock.time())
    watched = _watched(task, feed)
    env = environment(
        watched.physical() if check_flag("physical", physical) else watched, backend=feed
    )
    try:
        plant = read_plant(env)
        written = _Written(env, feed, plant)
        outputs = _outputs(env, plant)
        warm_ups = env.inside.warm_ups
        client = _CLIENTS[plant["protocol"]](plant, address or plant["address"])
        poller = Poller(client, clock, plant.poll, plant["timeout"])
    except BaseException:
        env.close()
        raise

    def read() -> dict[str, float]:
        return {
            name: conversion.inverse(feed.values[alias][0])
            for name, (alias, conversion) in outputs.items()
        }

    samplings = {alias: env.inside.spec.samplings.get(n, "last") for n, (alias, _) in outputs.items()}
    feed.open(plant, poller, samplings | dict.fromkeys(written.names, "median"), read)
    del warm_ups
    return Shadow(env, feed, poller, written)


def _outputs(env: TaskEnv, plant: Plant) -> dict[str, Any]:
    """The tags of all that the task reads, by the FMU's names, with conversions to the task."""
    outputs = {one.name for one in env.inside.spec.outputs}
    found = {
        variable.name: (alias, conversion)
        for alias, (variable, conversion) in in_fmu(env).items()
        if variable.name in outputs and alias in plant.tags
    }
    for name in sorted(outputs - found.keys()):
        raise _lacks_tag(name)
    return found
