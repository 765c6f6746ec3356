"""Heat a house through a cold week: thermostat, PI controller, and thinking ahead.

    python examples/heat_house.py

Each controller plays the first days of the scenario "frost" of fmugym/House-v0, which training
leaves out. The third one tries 256 courses of the heat pump in each step, over 24 hours with the
same weather and prices, and averages them, the better ones with more weight (model predictive path
integral control, see mpc_pendulum.py). So it knows the future, as a perfect forecast would tell it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

import fmugym
from fmugym.baselines import PID, Hysteresis
from fmugym.envs import HouseEnv

Array = npt.NDArray[np.float64]

SCENARIO = "frost"
COMFORT = 21.0  # the set point of the simple controllers in degC; at night 19 would do
STEPS_PER_DAY = 96


class ThinkAhead:
    """Tries courses of the heat pump on copies of the house; one value holds for an hour."""

    hold = 4  # steps
    spread = 0.25  # the standard deviation of the part loads that it tries
    temperature = 0.1  # EUR: how much worse than the best a course may be and still count

    def __init__(self, env: HouseEnv, candidates: int = 256, hours: int = 24) -> None:
        self._env = env
        self._copies = fmugym.FMUVectorEnv(partial(HouseEnv, SCENARIO), candidates)
        self._plan = np.full(hours, 0.4)
        self._rng = np.random.default_rng(0)
        self._step = 0

    def act(self, observation: Any, info: Any) -> npt.NDArray[np.float32]:
        """Choose the next part load."""
        noise = self._rng.normal(0, self.spread, (self._copies.num_envs, len(self._plan)))
        noise[0] = 0.0  # the plan itself is a candidate
        tried = np.clip(self._plan + noise, 0, 1)
        begun = self._step % self.hold  # steps of the first hour that are over
        courses = np.repeat(tried, self.hold, axis=1)[:, begun:, None].astype(np.float32)
        returns = self._copies.rollout(self._env.save_state(), courses).rewards.sum(axis=1)
        weights = np.exp((returns - returns.max()) / self.temperature)
        plan = weights @ tried / weights.sum()
        self._step += 1
        ends = self._step % self.hold == 0
        self._plan = np.append(plan[1:], plan[-1]) if ends else plan
        return np.array([plan[0]], dtype=np.float32)

    def close(self) -> None:
        """Free the copies."""
        self._copies.close()


def play(env: HouseEnv, controller: Any, steps: int) -> dict[str, Array]:
    """Return observed values, actions and rewards by name, each of shape (steps,)."""
    names = [*(env.observation_names or ()), "u", "energy", "discomfort"]
    observation, info = env.reset(seed=0)
    rows = []
    for _ in range(steps):
        action = controller.act(observation, info)
        observation, _, _, _, info = env.step(action)
        terms = info["reward_terms"]
        rows.append([*observation, *action, terms["energy"], terms["discomfort"]])
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


def plot(found: dict[str, dict[str, Array]]) -> Figure:
    """Draw temperatures, part loads and prices over the days."""
    figure = Figure(figsize=(9, 8), layout="constrained")
    inside, load, outside = figure.subplots(3, 1, sharex=True, height_ratios=[3, 2, 2])
    for name, rows in found.items():
        days = np.arange(1, len(rows["T"]) + 1) / STEPS_PER_DAY
        cost = -(rows["energy"].sum() + rows["discomfort"].sum())
        inside.plot(days, rows["T"], lw=1.2, label=f"{name}: {cost:.2f} EUR")
        load.plot(days, rows["u"], lw=0.8)
    inside.step(days, rows["T_set"], where="post", color="0.5", ls="--", label="at least")
    inside.set(ylabel="operative temperature [degC]", title="Costs: electricity and discomfort")
    inside.set_ylim(bottom=18)
    inside.legend(loc="lower center", ncols=4, fontsize="small")
    load.set(ylabel="part load")
    outside.plot(days, rows["T_out"], color="tab:cyan")
    outside.set(xlabel="days", ylabel="outside [degC]", xlim=(0, days[-1]))
    price = outside.twinx()
    price.step(days, 100 * rows["price"], where="post", color="tab:red", lw=0.8)
    price.set_ylabel("price [ct/kWh]", color="tab:red")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Play, print a table, and plot."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--days", type=int, default=5)
    parser.add_argument("--candidates", type=int, default=256, metavar="N")
    parser.add_argument("--output", type=Path, default=Path("heat_house.png"))
    options = parser.parse_args(arguments)
    env: HouseEnv = gym.make("fmugym/House-v0", scenario=SCENARIO).unwrapped  # type: ignore[assignment] # it is one
    ahead = ThinkAhead(env, options.candidates)
    controllers = {
        "thermostat": Hysteresis("T", COMFORT, band=0.3).bind(env),
        "PI": PID("T", COMFORT, kp=0.5, ti=4 * 3600.0).bind(env),
        "thinking ahead": ahead,
    }
    steps = STEPS_PER_DAY * options.days
    found = {name: play(env, controller, steps) for name, controller in controllers.items()}
    ahead.close()
    env.close()
    for name, rows in found.items():
        energy, discomfort = -rows["energy"].sum(), -rows["discomfort"].sum()
        print(f"{name:15} {energy:6.2f} EUR electricity, {discomfort:5.2f} EUR discomfort")
    plot(found).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
