"""Heat a house through a cold week: thermostat, PI controller, and model predictive control.

    python examples/heat_house.py

Each controller plays the first days of the scenario "frost" of fmugym/House-v0, which training
leaves out. The last two try courses of the heat pump over the next 24 hours in each step. The first
of them sees what an agent sees: forecasts of 12 hours, and nothing of the walls' temperatures. The
other one knows the true state and the true future, which nobody does: it shows how much there is to
gain.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from fmugym.baselines import MPC, PID, Hysteresis
from fmugym.envs import HouseEnv

Array = npt.NDArray[np.float64]

SCENARIO = "frost"
COMFORT = 21.0  # the set point of the simple controllers in degC; at night 19 would do
STEPS_PER_DAY = 96


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
    controllers = {
        "thermostat": Hysteresis("T", COMFORT, band=0.3),
        "PI": PID("T", COMFORT, kp=1.3, ti=2000.0),
        "MPC": MPC("24h", candidates=options.candidates),
        "perfect MPC": MPC("24h", candidates=options.candidates, perfect=True),
    }
    steps = STEPS_PER_DAY * options.days
    found = {name: play(env, one.bind(env), steps) for name, one in controllers.items()}
    env.close()
    for name, rows in found.items():
        energy, discomfort = -rows["energy"].sum(), -rows["discomfort"].sum()
        print(f"{name:15} {energy:6.2f} EUR electricity, {discomfort:5.2f} EUR discomfort")
    plot(found).savefig(options.output, dpi=100)
    print(f"plot: {options.output}")


if __name__ == "__main__":
    main()
