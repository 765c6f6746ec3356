"""An environment in the shadow of a plant: it reads, and writes nothing."""

from __future__ import annotations

import math
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium

from fmugym.checks import check_flag
from fmugym.declared import Task, TaskEnv, load
from fmugym.declared.format import DEVICE
from fmugym.export.imperfections import ideal
from fmugym.logs import on_time_of_year
from fmugym.plant.feed import Feed
from fmugym.plant.live import Live
from fmugym.plant.plant_actions import PlantActions
from fmugym.plant.polling import Poller, protocol_of
from fmugym.plant.predicting import Predictions
from fmugym.plant.serving import endless, environment
from fmugym.plant.tags import DATA_PREFIX, read_plant
from fmugym.pool.backend.clocks import Clock, RealClock

__all__ = ["Shadow", "connect"]


def _with_past(task: Task) -> Task:
    """The task with a warm-up that fills histories, if the agent sees some."""
    agent = task.root.child("agent")
    history, actions = agent.child("history").value, agent.child("actions").value
    if not history or not actions:
        return task
    held = dict.fromkeys(actions, 0.0)  # what acts in the plant is known then
    warm_up = {"period": history["length"], "controller": held}
    return replace(task, document={**task.document, "warm_up": warm_up})


class Shadow(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A task in the shadow of a plant.

    ``reset`` sets nothing: it waits for good values and a tick, and for as long as histories go
    back. ``step`` writes nothing: it takes what an agent would do, waits for the next tick, and
    goes on with what has acted in the plant. So rewards, histories and inputs are those of the
    plant. Infos have

    * ``"proposed"``: what the action would have written, by variable; the last one holds while a
      value has been missing for longer than the plant's ``hold``;
    * ``"predicted"``: what a copy of the FMU foretold a step ago, by variable;
    * ``"missing"``: the variables that have no good value; the last ones go on, and records leave
      them out;
    * ``"fault"``: what is wrong with these.

    An episode ends (``truncated``) if the plant's time jumps.

    Attributes:
        errors: Returns the errors of all predictions until now.
    """

    def __init__(
        self, env: TaskEnv, feed: Feed, written: PlantActions, copies: Predictions, owned: ExitStack
    ) -> None:
        super().__init__(env)
        self._feed, self._written, self._owned = feed, written, owned
        self._copies, self.errors = copies, copies.errors
        self._proposed: dict[str, float] = {}

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
        self._proposed = dict.fromkeys(self._written.names, math.nan)
        return observation, info | self._told(self._copies.begin())

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Wait for the next tick; see the class."""
        if not self._feed.has_expired:
            self._proposed = self._written.proposed(action)
        self._feed.advance()
        observation, reward, terminated, truncated, info = self.env.step(self._written.action())
        truncated = truncated or self._feed.jump != 0.0
        info |= self._told(self._copies.follow())
        return observation, reward, terminated, truncated, info

    def _told(self, predicted: dict[str, float]) -> dict[str, Any]:
        missing = tuple(name.removeprefix(DATA_PREFIX) for name in self._feed.faults)
        info = {"proposed": self._proposed, "predicted": predicted, "missing": missing}
        fault = self._feed.told()
        return info | ({"fault": fault} if fault else {})

    def close(self) -> None:
        """End the connection."""
        self._owned.close()


def connect(
    config: Any,
    address: str | None = None,
    *,
    physical: bool = False,
    ahead: float = 0.0,
    clock: Clock | None = None,
) -> Shadow:
    """Connect to the plant of a task.

    Args:
        config: The task, as for ``fmugym.load``, with a section ``[plant]``.
        address: In the place of that of the task.
        physical: Whether observations and actions are in the units of the task, as controllers
            need them.
        ahead: How far ahead copies of the FMU predict, in seconds; 0 for no copies.
        clock: A monotonic clock; ``RealClock(speed)`` for a plant that ``fmugym serve`` runs
            faster.

    Returns:
        The environment. Closing it ends the connection.

    Raises:
        ConfigError: If the task has a mistake, has no ``[plant]``, or lacks a tag, or if the extra
            ``plant`` is missing.
    """
    task, clock = Task.of(config), clock or RealClock()
    feed = Feed(clock)
    watched = on_time_of_year(endless(task), feed)
    watched = replace(watched, document=ideal(watched.document, DEVICE))  # the plant's own devices
    own = _with_past(watched.physical() if check_flag("physical", physical) else watched)
    with ExitStack() as stack:
        env = stack.enter_context(closing(environment(own, backend=feed)))
        feed.plant = plant = read_plant(env, address)
        written = PlantActions(env, feed)
        for output in env.pool_spec.outputs:
            plant.require(output)
        env.held_outputs = feed.held  # type: ignore[method-assign]  # of this environment
        model = watched.physical()
        env.planning_model = partial(load, model)
        copies = Predictions(
            lambda: stack.enter_context(closing(environment(model))),
            feed,
            int(ahead / plant.step + 1e-9),
        )
        live = Live([env, *copies.envs], plant)
        client = protocol_of(plant).client(plant)
        poller = Poller(client, clock, plant.poll, plant["timeout"])
        stack.callback(poller.stop)
        feed.open(poller, live)
        return Shadow(env, feed, written, copies, stack.pop_all())
