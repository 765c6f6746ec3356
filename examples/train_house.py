"""Train agents that heat a house, and let them compete with tuned baselines.

    pip install -e ".[examples,identification]"
    python examples/train_house.py

The agents are linear: the part load is a weighted sum of what they observe, limited to 0 to 1. They
are trained from several seeds by evolution strategies, on episodes of fmugym/House-v0. A thermostat
and a PI controller are tuned on such episodes, too (`fmugym.baselines.tune`). All of them then play
the scenarios "autumn", "frost" and "spring", which training and tuning leave out. The program
prints what they cost, in EUR, and draws two figures. A seed takes some minutes; what it has come to
is kept in the folder, so an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from fmugym import LogUniform, Uniform
from fmugym.baselines import PID, Controller, Hysteresis, tune
from fmugym.envs import HouseEnv

Array = NDArray[np.float64]

ENV_ID = "fmugym/House-v0"
SCENARIOS = ("autumn", "frost", "spring")
TERMS = ("energy", "discomfort")
HELD_OUT_SEED = 1_000_000  # no training uses seeds from here on
EPISODES = 4  # of each scenario; they differ in the temperature at the beginning
SEARCHES: dict[str, tuple[Callable[..., Controller], dict[str, Any]]] = {
    "thermostat": (
        partial(Hysteresis, "T"),
        {"setpoint": Uniform(20, 22), "band": Uniform(0, 1)},
    ),
    "PI": (
        partial(PID, "T"),
        {"setpoint": Uniform(20, 22), "kp": LogUniform(0.05, 5), "ti": LogUniform(1800, 4e5)},
    ),
}


class Linear(Controller):
    """The part load is 0.5 and half a weighted sum of scaled observations.

    Args:
        weights: One for each observation and one more, shape (k + 1,), or (N, k + 1) with those of
            each environment.
        centre: Subtracted from observations, shape (k,).
        width: What they are then divided by, shape (k,).
    """

    def __init__(self, weights: Array, centre: Array, width: Array) -> None:
        self.weights, self._centre, self._width = weights, centre, width

    def _decide(self, rows: Array) -> Array:
        weights = np.broadcast_to(self.weights, (len(rows), self.weights.shape[-1]))
        scaled = (rows - self._centre) / self._width
        return 0.5 + 0.5 * (np.einsum("ij,ij->i", scaled, weights[:, :-1]) + weights[:, -1])


class Evolution:
    """Trains linear agents by evolution strategies.

    In each round, pairs of agents with weights on either side of the present ones play the same
    episodes in one vector environment. The weights follow the differences of the ranks of their
    returns (T. Salimans and others, arXiv:1703.03864), by Adam.

    Args:
        seed: Of the agents and the episodes. What a PI controller observes in the first episodes
            gives the scale of the observations.
    """

    PAIRS, EPISODES, NOISE, RATE = 32, 2, 0.05, 0.05

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._envs = gym.make_vec(ENV_ID, 2 * self.PAIRS * self.EPISODES)
        seen: list[Array] = []
        self._play(PID("T", 21.0, kp=0.5, ti=14400.0), seen)
        rows = np.concatenate(seen)
        self._centre, self._width = rows.mean(axis=0), rows.std(axis=0)
        self._weights = np.zeros(rows.shape[1] + 1)
        self._mean, self._square = np.zeros_like(self._weights), np.zeros_like(self._weights)

    def agent(self) -> Linear:
        """The agent of the present weights."""
        return Linear(self._weights, self._centre, self._width)

    def advance(self, number: int, rounds: int) -> None:
        """Do one of so many rounds, counted from 1; the steps of the weights get smaller."""
        noise = self._rng.normal(size=(self.PAIRS, len(self._weights)))
        tried = self._weights + self.NOISE * np.concatenate([noise, -noise])
        each = np.repeat(tried, self.EPISODES, axis=0)
        returns = self._play(Linear(each, self._centre, self._width))
        order = returns.reshape(len(tried), -1).mean(axis=1).argsort().argsort() / len(tried)
        slope = (order[: self.PAIRS] - order[self.PAIRS :]) @ noise / self.PAIRS
        self._mean = 0.9 * self._mean + 0.1 * slope
        self._square = 0.99 * self._square + 0.01 * slope**2
        step = self._mean / (1 - 0.9**number)
        step /= np.sqrt(self._square / (1 - 0.99**number)) + 1e-8
        self._weights = self._weights + self.RATE * (1 - (number - 1) / rounds) * step

    def _play(self, controller: Controller, seen: list[Array] | None = None) -> Array:
        """The total rewards of new episodes, the same for all agents; notes what they observe."""
        count = self._envs.num_envs // self.EPISODES
        seeds = self._rng.integers(HELD_OUT_SEED, size=self.EPISODES).tolist() * count
        controller.bind(self._envs)
        observations, _ = self._envs.reset(seed=seeds)
        returns, over = np.zeros(self._envs.num_envs), False
        while not over:
            if seen is not None:
                seen.append(observations.astype(np.float64))
            actions = controller.act(observations)
            observations, rewards, terminated, truncated, _ = self._envs.step(actions)
            returns += rewards
            over = (terminated | truncated).any()  # all at once: an episode has its length
        return returns


def played(controller: Controller, scenario: str) -> tuple[NDArray[Any], dict[str, Any]]:
    """Let a controller play a scenario.

    Args:
        controller: An agent or a baseline.
        scenario: Its name.

    Returns:
        The mean costs of electricity and of discomfort in EUR, and the first episode by names.
    """
    envs = gym.make_vec(ENV_ID, EPISODES, scenario=scenario)
    controller.bind(envs)
    observations, info = envs.reset(seed=HELD_OUT_SEED)
    costs, rows, over = np.zeros(len(TERMS)), [], False
    while not over:
        actions = controller.act(observations, info)
        observations, _, terminated, truncated, info = envs.step(actions)
        costs -= [info["reward_terms"][term].mean() for term in TERMS]
        rows.append([*observations[0], *actions[0]])
        over = (terminated | truncated).any()  # all at once: a scenario has its length
    envs.close()
    return costs, dict(zip([*controller.names, "u"], np.array(rows).T.tolist(), strict=True))


def all_costs(controller: Controller) -> list[list[float]]:
    """The costs of each scenario: a list of [electricity, discomfort] in EUR."""
    return [played(controller, scenario)[0].tolist() for scenario in SCENARIOS]


def train(seed: int, rounds: int, folder: Path) -> None:
    """Train one agent, unless its file is there: its costs on the way, and an episode of frost."""
    path = folder / f"agent_{seed}.json"
    if path.exists():
        return
    evolution, curve = Evolution(seed), []
    for number in range(1, rounds + 1):
        evolution.advance(number, rounds)
        if number % 10 == 0:
            curve.append([number, all_costs(evolution.agent())])
    agent = evolution.agent()
    found = {"curve": curve, "costs": all_costs(agent), "episode": played(agent, "frost")[1]}
    path.write_text(json.dumps(found), encoding="utf-8")


def tuned(name: str, folder: Path) -> None:
    """Tune one baseline, unless its file is there."""
    path = folder / f"{name}.json"
    if path.exists():
        return
    make_controller, search = SEARCHES[name]
    found = tune(make_controller, HouseEnv, search, episodes=8, rounds=20)
    facts = {"parameters": found.parameters, "costs": all_costs(found.controller)}
    facts["episode"] = played(found.controller, "frost")[1]
    path.write_text(json.dumps(facts), encoding="utf-8")


def run(seeds: int, rounds: int, workers: int, folder: Path) -> dict[str, list[Any]]:
    """Train and tune all, side by side; return what the files hold, by name."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) as executor:
        jobs = [executor.submit(tuned, name, folder) for name in SEARCHES]
        jobs += [executor.submit(train, seed, rounds, folder) for seed in range(seeds)]
        for job in jobs:
            job.result()
    files = {name: [folder / f"{name}.json"] for name in SEARCHES}
    files["agent"] = [folder / f"agent_{seed}.json" for seed in range(seeds)]
    return {name: [json.loads(path.read_text()) for path in files[name]] for name in files}


def costs_of(facts: dict[str, Any]) -> NDArray[np.float64]:
    """The costs at the end, shape (scenarios, terms)."""
    return np.array(facts["costs"])


def table(found: dict[str, list[Any]]) -> Table:
    """What each costs in each scenario; of the agents the mean, and the least and the most."""
    made = Table("", *SCENARIOS, "sum", "electricity", "discomfort")
    for name, runs in found.items():
        costs = np.array([costs_of(facts) for facts in runs])
        totals = costs.sum(axis=2)
        cells = [f"{total:.2f}" for total in totals.mean(axis=0)]
        sums = totals.sum(axis=1)
        spread = f" ({sums.min():.2f} to {sums.max():.2f})" if len(runs) > 1 else ""
        terms = [f"{term:.2f}" for term in costs.sum(axis=1).mean(axis=0)]
        made.add_row(name, *cells, f"{sums.mean():.2f}{spread}", *terms)
    return made


COLOURS = {"thermostat": "#d55e00", "PI": "#e69f00", "agent": "#0072b2"}


def draw_costs(found: dict[str, list[Any]]) -> Figure:
    """Draw how the agents get better, and what all cost at the end."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    learning, ending = figure.subplots(1, 2, width_ratios=(3, 2))
    for facts in found["agent"]:
        rounds, costs = zip(*facts["curve"], strict=True)
        totals = np.sum(costs, axis=(1, 2))
        learning.plot(rounds, totals, color=COLOURS["agent"], lw=1, alpha=0.7)
    levels = {name: costs_of(runs[0]).sum() for name, runs in found.items() if name != "agent"}
    for name, level in levels.items():
        learning.axhline(level, color=COLOURS[name], ls="--", label=f"tuned {name}")
    learning.set(xlabel="rounds of training", ylabel="cost of 6 held-out weeks [EUR]")
    learning.set_ylim(0.94 * min(levels.values()), 1.1 * max(levels.values()))
    learning.plot([], [], color=COLOURS["agent"], label=f"agents of {len(found['agent'])} seeds")
    learning.legend(frameon=False)
    draw_savings(ending, found)
    return figure


def draw_savings(axes: Any, found: dict[str, list[Any]]) -> None:
    """Draw what each costs beside the tuned PI controller; a dot for each seed."""
    reference = costs_of(found["PI"][0]).sum(axis=1)
    for shift, name in ((-0.15, "thermostat"), (0.15, "agent")):
        costs = np.array([costs_of(facts).sum(axis=1) for facts in found[name]])
        for place, values in enumerate(100 * (costs / reference - 1).T):
            axes.scatter([place + shift] * len(values), values, s=14, color=COLOURS[name])
            axes.hlines(values.mean(), place + shift - 0.12, place + shift + 0.12, COLOURS[name])
    axes.axhline(0, color=COLOURS["PI"], ls="--")
    axes.set(ylabel="cost beside the tuned PI controller [%]", xlim=(-0.6, len(SCENARIOS) - 0.4))
    axes.set_xticks(range(len(SCENARIOS)), SCENARIOS)


def draw_days(found: dict[str, list[Any]], first: int = 4, days: int = 3) -> Figure:
    """Draw some days of frost: temperatures, part loads, price."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    inside, load, price = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 1.3))
    part = slice(96 * first, 96 * (first + days))
    hours = (np.arange(96 * days) + 1) / 4  # an observation is that after a step
    for name in ("PI", "agent"):
        episode = found[name][0]["episode"]
        inside.plot(hours, episode["T"][part], color=COLOURS[name], label=name)
        load.plot(hours, episode["u"][part], color=COLOURS[name], lw=1)
    inside.step(hours, episode["T_set"][part], color="0.5", ls="--", label="at least")
    inside.set(ylabel="inside [degC]", xlim=(0, hours[-1]), xticks=range(0, 24 * days + 1, 6))
    inside.legend(ncols=3, frameon=False)
    load.set(ylabel="part load", ylim=(0, 1))
    price.step(hours, 100 * np.array(episode["price"][part]), where="post", color="#cc79a7")
    price.set(ylabel="ct/kWh", xlabel="hours")
    outside = price.twinx()
    outside.plot(hours, episode["T_out"][part], color="0.4", lw=1)
    outside.set_ylabel("outside [degC]")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, tune, print a table and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, help="of the agents: 0, 1, ...; default 5")
    parser.add_argument("--rounds", type=int, default=150, help="of a training; default 150")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--folder", type=Path, default=Path("house_agents"))
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    found = run(options.seeds, options.rounds, options.workers, options.folder)
    Console(width=110).print(table(found))
    for name, draw in (("costs", draw_costs), ("days", draw_days)):
        draw(found).savefig(options.folder / f"{name}.png", dpi=90)
    print(f"figures: {options.folder / 'costs.png'}, {options.folder / 'days.png'}")


if __name__ == "__main__":
    main()
