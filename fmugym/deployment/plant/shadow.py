"""Environment in the shadow of a plant: it reads, and writes nothing.

The actions of the plant's own controller are read as actions and inputs of the environment. Copies
of the FMU predict the plant, and the errors of the predictions are kept.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from fmugym.checks import check_flag
from fmugym.control.observer import COPIES, Observer, parameters_of_copies
from fmugym.deployment.export.imperfections import ideal
from fmugym.deployment.plant.feed import Feed, Live
from fmugym.deployment.plant.plant_server import endless, environment
from fmugym.deployment.plant.polling import Poller, protocol_of
from fmugym.deployment.plant.tags import DATA_PREFIX, read_plant
from fmugym.environment.actions import flat_inputs
from fmugym.environment.hooks import AssignedHook
from fmugym.errors import shown
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray
from fmugym.pool.rig.clocks import Clock, RealClock
from fmugym.records.plant_log import Actions, declared_as, on_time_of_year
from fmugym.task import Task, TaskEnv, load
from fmugym.task.task_keys import DEVICE

__all__ = ["Error", "PlantActions", "Predictions", "Shadow", "connect"]


class PlantActions:
    """Actions of the plant, in the place of the actions of an environment.

    Args:
        env: The environment. Its hook ``_get_inputs`` becomes one that reads the plant, and so do
            the inputs of its warm-up.
        feed: Has what acts, and the tags.

    Raises:
        ConfigError: If an action has no tag.
    """

    def __init__(self, env: TaskEnv, feed: Feed) -> None:
        self._feed, plant = feed, feed.plant
        self._inputs = {one.name: one for one in env.pool_spec.inputs}
        for alias in env.task.root.child("agent").child("actions").value or ():
            if variable := self._inputs.get(declared_as(env, alias)[0]):
                plant.require(variable, alias)
        self._tags = plant.of(self._inputs.values())
        self.names = [tag.name for tag in self._tags]
        self.actions = Actions(env, self._range_of, math.inf)
        self._own = env._get_inputs
        env._get_inputs = AssignedHook(self._get_inputs)  # type: ignore[method-assign]
        warm_up = env.warm_up
        if warm_up is not None:
            self._of_warm_up = warm_up.inputs
            # that of this one warm-up, which must wait for the plant before the first observation
            warm_up.inputs = self._warm_inputs  # type: ignore[method-assign]

    def _warm_inputs(self, env: Any) -> FloatArray:
        """Fill histories before the first observation: wait, and read the plant's actions."""
        values = self._of_warm_up(env)
        self._feed.advance()
        return self.over(np.array([np.ravel(value)[0] for value in values]))

    def _get_inputs(self) -> FloatArray:
        return self.over(flat_inputs(self._own(), [*self._inputs.values()], shown))

    def over(self, values: FloatArray) -> FloatArray:
        """Replace inputs by the plant's actions, in the FMU's units."""
        acting, pairs = self._feed.row(), zip(self._inputs, values, strict=True)
        return np.array([acting.get(name, value) for name, value in pairs])

    def action(self) -> Any:
        """Action that is closest to the plant's."""
        return self.actions.of(self._feed.row(), self._feed.time)

    def proposed(self, action: Any) -> dict[str, float]:
        """Inputs that an action would write, in the task's units."""
        values = dict(zip(self._inputs, self.actions.inputs(action), strict=True))
        return {tag.name: float(tag.of_fmu(values)) for tag in self._tags}

    def _range_of(self, variable: Variable) -> float:
        """Width of the range of an input; refuses an input without a tag."""
        self._feed.plant.require(variable)
        width = variable.maximum - variable.minimum
        return width if math.isfinite(width) and width > 0 else 1.0


class Error(NamedTuple):
    """The error of predictions of a variable.

    Attributes:
        name: The variable.
        ahead: How far ahead, in seconds.
        rms: The root of the mean squared error, in the unit of the task.
        bias: The mean of what the plant had beyond the prediction.
        number: How many predictions there were.
    """

    name: str
    ahead: float
    rms: float
    bias: float
    number: int


class Predictions:
    """Copies of the FMU beside a plant, and the observer of MPC, which corrects them.

    They differ in the parameters that the task draws. The one that fits best predicts.

    Args:
        make_env: Makes an environment with the time of the plant, which the caller closes.
        feed: Has what the plant does, and the tags.
        steps: How many steps ahead there are predictions.

    Attributes:
        names: The variables.
        envs: The environments of the copies.
    """

    def __init__(self, make_env: Callable[[], TaskEnv], feed: Feed, steps: int) -> None:
        self._feed = feed
        self.envs = [make_env()] if steps else []
        self._spread = parameters_of_copies(self.envs[0], 0) if steps else {}
        self.envs += [make_env() for _ in range(COPIES - 1 if self._spread else 0)]
        self._written = [PlantActions(env, feed) for env in self.envs]
        self._tags = feed.plant.of(self.envs[0].pool_spec.outputs) if steps else []
        self.names = [tag.name for tag in self._tags]
        # of the errors, by horizon and variable: how many, their sum, and that of their squares
        self._sums = np.zeros((3, steps, len(self.names)))
        self._told: deque[tuple[int, FloatArray]] = deque(maxlen=max(steps, 1))

    def _measured(self) -> FloatArray:
        return np.array([self._feed.values[name][0] for name in self.names])

    def _seen(self) -> FloatArray:
        """Outputs of the copies, shape (n, k)."""
        return np.array([[tag.of_fmu(env.out) for tag in self._tags] for env in self.envs])

    def begin(self) -> dict[str, float]:
        """Begin with the offsets that the plant has now; nothing was foretold for it."""
        for place, env in enumerate(self.envs):
            own = {name: float(values[place]) for name, values in self._spread.items()}
            env.reset(seed=0, options={"model_parameters": own})
        self._observer = Observer(len(self.envs), len(self.names), len(self.names))
        self._told.clear()
        if self.envs:
            self._observer.offsets = self._measured() - self._seen()
            self._tell()
        return dict.fromkeys(self.names, np.nan)

    def _tell(self) -> None:
        """Keep which copy predicts from now on, and its offsets."""
        best = self._observer.best
        self._told.append((best, self._observer.offsets[best]))

    def follow(self) -> dict[str, float]:
        """Go on by a step of the plant.

        Returns:
            What was foretold for this tick at the one before, by name.
        """
        if not self.envs:
            return {}
        for env, written in zip(self.envs, self._written, strict=True):
            *_, terminated, truncated, _ = env.step(written.action())
            if terminated or truncated:  # the FMU has failed
                return self.begin()
        is_new = np.array([name not in self._feed.faults for name in self.names])
        measured, seen = self._measured(), self._seen()
        found = [seen[best] + offsets for best, offsets in reversed(self._told)]
        for place, values in enumerate(found):
            off = np.where(is_new, measured - values, 0.0)
            self._sums[:, place] += [is_new, off, off**2]
        self._observer.follow(np.where(is_new, measured - seen, 0.0))
        self._observer.correct(measured - seen, is_new)
        self._tell()
        return dict(zip(self.names, found[0].tolist(), strict=True))

    def errors(self) -> list[Error]:
        """The errors until now, by variable and horizon."""
        found = []
        for place, ahead in np.argwhere(self._sums[0].T).tolist():
            count, total, squares = self._sums[:, ahead, place].tolist()
            seconds, rms = (ahead + 1) * self._feed.plant.step, math.sqrt(squares / count)
            found.append(Error(self.names[place], seconds, rms, total / count, int(count)))
        return found


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
