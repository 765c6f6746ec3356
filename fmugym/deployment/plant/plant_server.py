"""Server of a simulated plant: an FMU whose values are the tags of a server on the loopback.

A task without a section ``[plant]`` gets a default one, with a tag for each value.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, Self

import numpy as np

from fmugym.deployment.plant.feed import forecasts, horizon
from fmugym.deployment.plant.polling import BackgroundLoop, protocol_of
from fmugym.deployment.plant.tags import DATA_PREFIX, Plant, Tag, read_plant
from fmugym.errors import ConfigError, FMUGymError, SimulationError
from fmugym.pool.rig.clocks import Clock, RealClock, speed_of
from fmugym.records.players import Player, Policy, Summary, action_of, policy_of
from fmugym.task import Task, TaskEnv, load
from fmugym.task.declarations import as_declared
from fmugym.task.series import Series, read_data
from fmugym.task.task_keys import DEVICE

__all__ = ["Server", "endless", "environment", "with_plant"]

_ENDS: Final = ("episode_length", "terminated", "truncated")


def endless(task: Task) -> Task:
    """Return the task without an end of its episodes: a plant goes on."""
    return replace(task, document={k: v for k, v in task.document.items() if k not in _ENDS})


def environment(task: Task, **arguments: Any) -> TaskEnv:
    """Make the environment of a task.

    Raises:
        ConfigError: If its class is no ``TaskEnv``, whose variables have names.
    """
    env = load(task, **arguments)
    if isinstance(env, TaskEnv):
        return env
    env.close()
    raise ConfigError(f"a plant needs a declared task, got a {type(env).__name__}")


@dataclass
class _Twin:
    """An FMU that somebody controls, and its values as functions of time.

    Attributes:
        env: The environment.
        plant: Has the tags.
        policy: Acts.
        clock: Tells the time.
        seed: Seed of the episode.
        most: How many steps it has.
    """

    env: Any
    plant: Plant
    policy: Policy
    clock: Clock
    seed: int
    most: float

    def __post_init__(self) -> None:
        quantities, data = self.env.resolved.quantities(), self.env.task.root.child("data").items()
        self._read_all = quantities.read
        self._quantities = {one.name: one for one in quantities.all}
        self._sensors = self._places_of_sensors()
        self._data = {name: read_data(entry, self.plant.standard) for name, entry in data.items()}
        self.policy.begin()
        self._observation, _ = self.env.reset(seed=self.seed)
        self._begin, self._steps, self._reward = self.clock.time(), 0, 0.0
        self._cost: float | None = None
        self._after = self._read()
        self._advance()

    def _places_of_sensors(self) -> dict[str, int]:
        """Places of sensor readings in the observation, by name."""
        names = self.env.observation_names or ()
        if "normalize" in self.env.unphysical_keys:
            return {}
        declared = self.env.task.document.get("variables", {})
        return {
            name: names.index(name)
            for name, one in self._quantities.items()
            if one.kind == "output" and name in names
            if DEVICE.keys() & declared.get(name, {}).keys()
        }

    def _read(self) -> dict[str, float]:
        read = dict(zip(self._quantities, self._read_all(self.env), strict=True))
        seen = {name: self._observation[place] for name, place in self._sensors.items()}
        return {name: float(value) for name, value in (read | seen).items()}

    def _advance(self) -> None:
        self._before = self._after
        action = self.policy.act(self._observation)
        self._observation, reward, terminated, truncated, info = self.env.step(action)
        self._reward += float(reward)
        if "cost" in info:
            self._cost = (self._cost or 0.0) + float(info["cost"])
        if terminated or truncated:
            raise SimulationError(f"the FMU has ended: {info.get('fault', 'its stop time')}")
        self._after = self._read()
        self._steps += 1

    def summary(self) -> Summary:
        """Results until now."""
        seconds = self._steps * self.plant.step
        return Summary(self.seed, self._steps, seconds, self._reward, self._cost, "stopped")

    @property
    def passed(self) -> float:
        """Number of passed steps, with the fraction of the present one."""
        return min((self.clock.time() - self._begin) / self.plant.step, self.most)

    def values(self) -> dict[str, tuple[float, ...]]:
        """Present values of all tags."""
        passed = self.passed
        while self._steps <= passed and self._steps < self.most:
            self._advance()
        part = passed - (self._steps - 1)
        time = float(self.env.resolved.future.clock(self.env)) + (part - 1.0) * self.plant.step
        return {name: self._of_tag(tag, part, time) for name, tag in self.plant.tags.items()}

    def _of_tag(self, tag: Tag, part: float, time: float) -> tuple[float, ...]:
        """Values of a tag at a fraction of a step."""
        if tag.name.startswith(DATA_PREFIX):
            ahead = np.arange(tag.count) * (tag.address.get("step") or 0.0)
            series = self._data[tag.name.removeprefix(DATA_PREFIX)]
            own = series.files[int(self.env.variables.get(series.variable, 0))]
            return tuple(_at(own, time + ahead).tolist())
        if tag.name == "clock":
            return (time,)
        before, after = self._before[tag.name], self._after[tag.name]
        if tag.sampling != "last":
            return (after,)  # that of the whole step
        one = self._quantities[tag.name]
        is_real = not tag.own or self.env.fmu.variable(tag.own).kind == "real"
        moves = is_real and not one.holds and one.kind in ("output", "data")
        return (before + part * (after - before) if moves else before,)


def _at(series: Series, times: Any) -> Any:
    return np.interp((times - series.start) % series.period, series.times, series.values)


def _player_of(text: str) -> Player:
    is_random = text == "random"
    make_policy = partial(action_of if is_random else policy_of, text=text)
    return Player(make_policy, is_physical=not is_random)


class Server:
    """Serves the FMU of a task on the loopback, as the plant that its ``[plant]`` describes.

    Nothing can be written from outside. Values between two steps lie on straight lines; those that
    hold, and what acts, do not. Where an agent's observations are not normalized, they are what the
    sensors of the task show, with noise and delay.

    Args:
        config: The task, as for ``fmugym.load``.
        player: Player; or ``"random"``, or a controller as in a task file.
        port: The port; 0 for a free one.
        clock: Tells the time; by default that of the machine.
        seed: Seed of the episode.
        steps: How many steps to serve; None for no end.

    Attributes:
        address: Address of the server, as ``connect`` takes it.
        summary: Returns what was reached until now.

    Raises:
        ConfigError: If the task has a mistake, or the extra ``plant`` is missing.
        SimulationError: If the FMU fails.
    """

    def __init__(
        self,
        config: Any,
        player: Player | str,
        *,
        port: int = 0,
        clock: Clock | None = None,
        seed: int = 0,
        steps: int | None = None,
    ) -> None:
        self._task, self._port = endless(Task.of(config)), port
        self._player = _player_of(player) if isinstance(player, str) else player
        self._clock, self._seed, self._steps = clock or RealClock(), seed, steps
        self.address = ""
        self.summary: Callable[[], Summary]
        self._background = BackgroundLoop(self._serve, "plant server")
        while not (self.address or self.wait(0.01)):
            pass

    async def _serve(self) -> None:
        env: Any = self._player.make_env(lambda **form: environment(self._task, **form))
        with closing(env):
            plant = read_plant(env)
            policy, most = self._player.make_policy(env), self._steps or math.inf
            twin = _Twin(env, plant, policy, self._clock, self._seed, most)
            self.summary = twin.summary
            async with protocol_of(plant).serve(plant, self._port, twin.values) as self.address:
                pause = plant.step / 2 / speed_of(self._clock)
                is_over = False
                while not is_over:
                    await asyncio.sleep(pause)
                    is_over = twin.passed >= most
                    twin.values()

    def wait(self, seconds: float) -> bool:
        """Wait for the end, for some real time; tells whether it has come.

        Raises:
            SimulationError: If the FMU or the server has failed.
        """
        is_over, error = self._background.join(seconds), self._background.error
        if isinstance(error, FMUGymError):
            raise error
        if error is not None:
            where = f"port {self._port} of the loopback" if self._port else "the loopback"
            raise SimulationError(f"the server at {where} has failed: {error}") from error
        return is_over

    def close(self) -> None:
        """End the server; more than one call is fine."""
        self._background.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: object) -> None:
        self.close()


_SECTIONS: Final[dict[str, dict[str, Any]]] = {
    "modbus": {"protocol": "modbus", "address": "127.0.0.1:502"},
    "opcua": {"protocol": "opcua", "address": "opc.tcp://127.0.0.1:4840", "encryption": False},
}
"""Of the loopback, on which nobody reads along."""


def with_plant(task: Task, protocol: str) -> Task:
    """Give a task a plant on the loopback if it has none, and check the protocol of its own.

    There are tags for the clock, the actions, the outputs that the task reads, and for its data, as
    far ahead as the agent sees them.

    Args:
        task: The task.
        protocol: ``"modbus"`` or ``"opcua"``.

    Raises:
        ConfigError: If the plant of the task has another protocol, or the task has a mistake.
    """
    own = task.document.get("plant", {}).get("protocol", protocol)
    if own != protocol:
        raise ConfigError(f"[plant] of the task has the protocol {own!r}, not {protocol!r}")
    if "plant" in task.document:
        return task
    with closing(environment(task)) as env:
        return replace(task, document={**task.document, "plant": _section(env, protocol)})


def _section(env: Any, protocol: str) -> dict[str, Any]:
    """All tags, one after another."""
    register = 4  # the clock takes those before
    found: dict[str, dict[str, Any]] = {"tags": {}, "data": {}}
    for one in env.resolved.quantities().all:
        if one.kind not in ("action", "output", "data"):
            continue
        ahead = _ahead(env, one.name) if one.kind == "data" else {}
        where = {"node": f"ns=2;s={one.name}"} if protocol == "opcua" else {"register": register}
        found["data" if one.kind == "data" else "tags"][one.name] = where | ahead
        register += 2 * ahead.get("count", 1)
    clock = {"node": "ns=2;s=clock"} if protocol == "opcua" else {"register": 0, "type": "float64"}
    return {**_SECTIONS[protocol], "clock": clock, **{k: v for k, v in found.items() if v}}


def _ahead(env: TaskEnv, name: str) -> dict[str, Any]:
    """Number of data values that the agent's forecasts need."""
    root = as_declared(env.task.root, env.fmu.description)[0]
    own = env.pool_spec.time_step
    steps = [one.get("step") or own for one in forecasts(root, name)]
    if not steps:
        return {}
    return {"count": round(horizon(root, name) / min(steps)) + 1, "step": min(steps)}
