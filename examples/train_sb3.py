"""Train Stable-Baselines3's PPO and SAC on FMUs and on Gymnasium's own environments.

    pip install -e ".[examples,sb3]"
    python examples/train_sb3.py

PPO learns to balance the cart-pole, and SAC to swing up the pendulum. Each is trained from several
seeds, on the FMU and on Gymnasium's own environment, with the same settings. The program scores
each trained policy on both sides, on the same held-out episodes. It prints the scores, the
durations, and whether the training episodes were the same on both sides, and it draws the learning
curves. This takes about ten minutes on two cores.

Both sides give the same observations for the same seed and actions, so a policy should score the
same on both. Two trainings stay equal as long as all rewards are equal; a single reward that
differs in its last bit makes them diverge.
"""

import argparse
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor

from fmugym.sb3 import make_sb3_env

SIDES = ("fmu", "gymnasium")
SIDE_TITLES = {"fmu": "FMU", "gymnasium": "Gymnasium"}
COLOURS = {"fmu": "#0072b2", "gymnasium": "#e69f00"}
HELD_OUT_SEED = 1_000_000  # no training uses seeds from here on

FULL = {"seeds": 5, "episodes": 100}
QUICK = {"seeds": 2, "episodes": 20}

HEADERS = (
    "Scored\non FMU",
    "Scored on\nGymnasium",
    "Worst\nseed",
    "Same on\nboth",
    "Time per\ntraining",
    "in the\nenvs",
)


def falling(value: float) -> Callable[[float], float]:
    """Return a schedule that falls from the value to 0 during the training."""
    return lambda remaining: value * remaining


@dataclass(frozen=True)
class Study:
    """An algorithm and a task that exists on both sides.

    Attributes:
        title: The title of tables and figures.
        ids: The environment's id on each side.
        algorithm: SB3's class.
        settings: The algorithm's arguments.
        num_envs: Number of environments that step together.
        steps: Environment steps of a training.
        quick_steps: The same with `--quick`.
        label: The label of the measure of an episode.
    """

    title: str
    ids: dict[str, str]
    algorithm: type[BaseAlgorithm]
    settings: dict[str, Any]
    num_envs: int
    steps: int
    quick_steps: int
    label: str


STUDIES = {
    "ppo": Study(
        "PPO on the cart-pole",
        {"fmu": "fmugym/CartPole-v0", "gymnasium": "CartPole-v1"},
        PPO,
        {
            "learning_rate": falling(1e-3),
            "clip_range": falling(0.2),
            "n_steps": 32,
            "batch_size": 256,
            "n_epochs": 20,
            "gae_lambda": 0.8,
            "gamma": 0.98,
        },
        num_envs=8,
        steps=100_000,
        quick_steps=3_000,
        label="return of an episode (steps balanced)",
    ),
    "sac": Study(
        "SAC on the pendulum",
        {"fmu": "fmugym/Pendulum-v0", "gymnasium": "Pendulum-v1"},
        SAC,
        {
            "learning_rate": 1e-3,
            "learning_starts": 1000,
            "gradient_steps": 4,
            "policy_kwargs": {"net_arch": [64, 64]},
        },
        num_envs=4,
        steps=16_000,
        quick_steps=2_000,
        label="return of an episode",
    ),
}


@dataclass(frozen=True)
class Task:
    """One training that is to be done.

    Attributes:
        study: A key of `STUDIES`.
        side: Where to train, "fmu" or "gymnasium".
        seed: Seed of the training.
        steps: Environment steps.
        episodes: Held-out episodes of the evaluation.
    """

    study: str
    side: str
    seed: int
    steps: int
    episodes: int


@dataclass(frozen=True)
class Run:
    """The result of one training.

    Attributes:
        task: The task.
        ends: The environment step at which each training episode ended, of shape (k,).
        returns: The returns of those episodes, of shape (k,).
        seconds: Duration of the training [s].
        env_seconds: The part of it that the environments took [s].
        scores: The returns of the held-out episodes on each side, of shape (episodes,).
    """

    task: Task
    ends: NDArray[np.int64]
    returns: NDArray[np.float64]
    seconds: float
    env_seconds: float
    scores: dict[str, NDArray[np.float64]]


# --- training, in the worker processes -----------------------------------------------------------


class Stopwatch(VecEnvWrapper):
    """Measure the time that the environments take."""

    seconds = 0.0

    def reset(self) -> Any:
        """Reset the environments."""
        return self.venv.reset()

    def step_async(self, actions: NDArray[Any]) -> None:
        """Begin a step."""
        self._begin = perf_counter()
        super().step_async(actions)

    def step_wait(self) -> Any:
        """End a step."""
        result = self.venv.step_wait()
        self.seconds += perf_counter() - self._begin
        return result


class Episodes(BaseCallback):
    """Record the ends and the returns of the training episodes."""

    def _on_training_start(self) -> None:
        self.ended: list[tuple[int, float]] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.ended.append((self.num_timesteps, float(info["episode"]["r"])))
        return True


def make_envs(study: Study, side: str, count: int) -> VecEnv:
    """Return several environments of one side."""
    env_id = study.ids[side]
    if side == "fmu":
        return make_sb3_env(env_id, count)
    return VecMonitor(DummyVecEnv([lambda: gym.make(env_id)] * count))


def train_and_evaluate(task: Task) -> Run:
    """Train one policy and score it on both sides."""
    torch.set_num_threads(1)
    study = STUDIES[task.study]
    envs = Stopwatch(make_envs(study, task.side, study.num_envs))
    model = study.algorithm("MlpPolicy", envs, seed=task.seed, device="cpu", **study.settings)
    episodes = Episodes()
    start = perf_counter()
    model.learn(task.steps, callback=episodes)
    seconds = perf_counter() - start
    envs.close()
    scores = {side: evaluate(model, study, side, task.episodes) for side in SIDES}
    ends, returns = map(np.array, zip(*episodes.ended, strict=True))
    return Run(task, ends, returns, seconds, envs.seconds, scores)


def evaluate(model: BaseAlgorithm, study: Study, side: str, episodes: int) -> NDArray[np.float64]:
    """Play all held-out episodes at once, each in its own environment.

    Returns:
        The returns of the episodes, of shape (episodes,).
    """
    envs = make_envs(study, side, episodes)
    envs.seed(HELD_OUT_SEED)
    observations: Any = envs.reset()
    returns = np.full(episodes, np.nan)
    while np.isnan(returns).any():
        actions, _ = model.predict(observations, deterministic=True)
        observations, _, _, infos = envs.step(actions)
        for index, info in enumerate(infos):
            if "episode" in info and np.isnan(returns[index]):
                returns[index] = info["episode"]["r"]
    envs.close()
    return returns


# --- results -------------------------------------------------------------------------------------


def chosen(runs: list[Run], study: str, side: str) -> list[Run]:
    """Return the runs of one study on one side, in the order of their seeds."""
    return [run for run in runs if (run.task.study, run.task.side) == (study, side)]


def studies_of(runs: list[Run]) -> list[str]:
    """Return the keys of the studies that were done."""
    return [name for name in STUDIES if chosen(runs, name, "fmu")]


def summary(runs: list[Run], study: str) -> Table:
    """Return the table of a study: scores and durations, as means over the seeds."""
    episodes = runs[0].task.episodes
    table = Table(title=f"{STUDIES[study].title}: {episodes} held-out episodes")
    table.add_column("Trained on")
    for header in HEADERS:
        table.add_column(header, justify="right")
    for side in SIDES:
        table.add_row(SIDE_TITLES[side], *summary_cells(chosen(runs, study, side)))
    return table


def summary_cells(runs: list[Run]) -> list[str]:
    """Return the numbers of one study on one side."""
    fmu, gymnasium = (np.array([run.scores[side] for run in runs]) for side in SIDES)
    return [
        f"{fmu.mean():.1f}",
        f"{gymnasium.mean():.1f}",
        f"{min(fmu.mean(axis=1).min(), gymnasium.mean(axis=1).min()):.1f}",
        f"{np.sum(fmu == gymnasium)}/{fmu.size}",
        f"{np.mean([run.seconds for run in runs]):.1f} s",
        f"{np.mean([run.env_seconds for run in runs]):.2f} s",
    ]


def equal_trainings(runs: list[Run], study: str) -> str:
    """Return a sentence: for how many seeds all training episodes were the same on both sides."""
    pairs = list(zip(*(chosen(runs, study, side) for side in SIDES), strict=True))
    same = sum(
        np.array_equal(a.ends, b.ends) and np.array_equal(a.returns, b.returns) for a, b in pairs
    )
    return (
        f"{STUDIES[study].title}: with {same} of {len(pairs)} seeds, all training episodes were "
        "the same on both sides."
    )


def learning_curve(run: Run, grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the running mean of the returns of the training episodes.

    Args:
        run: The run.
        grid: The points of the curve, in environment steps, of shape (n,).

    Returns:
        The means of shape (n,). Each is over the episodes that ended within the twentieth of the
        training before a point, or over the last episode if there were none.
    """
    last = np.searchsorted(run.ends, grid, side="right")
    first = np.searchsorted(run.ends, grid - run.task.steps / 20, side="right")
    first = np.maximum(0, np.minimum(first, last - 1))
    total = np.concatenate(([0.0], np.cumsum(run.returns)))
    means = np.full(len(grid), np.nan)
    np.divide(total[last] - total[first], last - first, out=means, where=last > first)
    return means


def draw_results(runs: list[Run], path: Path) -> None:
    """Draw the learning curves and the durations and write them to a PNG file."""
    names = studies_of(runs)
    figure = Figure(figsize=(11, 4.2 * len(names) + 0.6), dpi=130, layout="constrained")
    figure.suptitle("Stable-Baselines3 on FMUs and on Gymnasium's own environments", fontsize=14)
    grid = figure.subplots(len(names), 2, squeeze=False, width_ratios=(5, 2))
    for (curves, durations), name in zip(grid, names, strict=True):
        draw_learning_curves(curves, runs, name)
        draw_durations(durations, runs, name)
        for axes in (curves, durations):
            axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def draw_learning_curves(axes: Axes, runs: list[Run], study: str) -> None:
    """Draw the median and the range over the seeds, for each side."""
    groups = {side: chosen(runs, study, side) for side in SIDES}
    steps = groups["fmu"][0].task.steps
    start = max(run.ends[0] for group in groups.values() for run in group)
    grid = np.linspace(start, steps, 200)
    lines = {"fmu": {"linewidth": 5, "alpha": 0.6}, "gymnasium": {"linewidth": 1.8}}
    for side, group in groups.items():
        curves = [learning_curve(run, grid) for run in group]
        worst, median, best = np.percentile(curves, (0, 50, 100), axis=0)
        axes.fill_between(grid, worst, best, color=COLOURS[side], alpha=0.12, linewidth=0)
        label = f"{SIDE_TITLES[side]}: {STUDIES[study].ids[side]}"
        axes.plot(grid, median, color=COLOURS[side], label=label, **lines[side])
    axes.set_title(f"{STUDIES[study].title}: median and range of {len(group)} seeds", fontsize=11)
    axes.set_xlabel("environment steps")
    axes.set_ylabel(STUDIES[study].label)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.set_xlim(0, steps)
    axes.grid(axis="y", color="0.92")
    axes.legend(loc="lower right", frameon=False)


def draw_durations(axes: Axes, runs: list[Run], study: str) -> None:
    """Draw the duration of a training on each side, and the part that the environments took."""
    for place, side in enumerate(SIDES):
        group = chosen(runs, study, side)
        env = float(np.mean([run.env_seconds for run in group]))
        rest = float(np.mean([run.seconds for run in group])) - env
        axes.bar(place, env, 0.55, color=COLOURS[side])
        bar = axes.bar(place, rest, 0.55, bottom=env, color=COLOURS[side], alpha=0.3)
        axes.bar_label(bar, [f"{env + rest:.1f} s,\nenvs {env:.2f} s"], padding=3, fontsize=9)
    axes.set_title("Duration of a training", fontsize=11)
    axes.set_ylabel("seconds (dark: in the environments)")
    axes.set_xticks(range(len(SIDES)), [SIDE_TITLES[side] for side in SIDES])
    axes.set_xlim(-0.6, len(SIDES) - 0.4)
    axes.margins(y=0.25)


# --- command line --------------------------------------------------------------------------------


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the complete options."""
    options = make_parser().parse_args(arguments)
    for name, value in (QUICK if options.quick else FULL).items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    return options


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description="Train Stable-Baselines3's PPO and SAC on FMUs.")
    add = parser.add_argument
    add("--study", choices=[*STUDIES, "both"], default="both", help="what to train (both)")
    add("--seeds", type=at_least(1), help=f"trainings on each side ({FULL['seeds']})")
    add("--steps", type=at_least(1000), help="environment steps of a training (by study)")
    add("--episodes", type=at_least(1), help=f"held-out episodes ({FULL['episodes']})")
    add("--quick", action="store_true", help="run everything briefly, in a minute")
    add("--output", type=Path, default=Path("results"), help="folder of the picture (results)")
    add("--workers", type=at_least(1), default=os.cpu_count() or 1, help="processes (one per core)")
    return parser


def at_least(lowest: int) -> Callable[[str], int]:
    """Return a function that reads a whole number and refuses lower ones."""

    def whole_number(text: str) -> int:
        if int(text) < lowest:
            raise argparse.ArgumentTypeError(f"must be at least {lowest}, is {text}")
        return int(text)

    return whole_number


def make_tasks(options: argparse.Namespace) -> list[Task]:
    """Return the tasks; the two sides alternate, so that both meet the same load."""
    names = list(STUDIES) if options.study == "both" else [options.study]
    return [
        Task(name, side, seed, options.steps or default_steps(name, options), options.episodes)
        for name, seed, side in product(names, range(options.seeds), SIDES)
    ]


def default_steps(study: str, options: argparse.Namespace) -> int:
    """Return the length of a training of this study."""
    return STUDIES[study].quick_steps if options.quick else STUDIES[study].steps


def run_all(tasks: list[Task], workers: int, console: Console) -> list[Run]:
    """Train in parallel, and print a line for each training that is done."""
    runs = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context) as executor:
        for run in executor.map(train_and_evaluate, tasks):
            runs.append(run)
            title, side = STUDIES[run.task.study].title, SIDE_TITLES[run.task.side]
            done = f"{len(runs)} of {len(tasks)}: {title}, {side}, seed {run.task.seed}"
            console.print(f"{done}: {run.seconds:.1f} s", highlight=False)
    return runs


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the program."""
    options = parse(arguments)
    console = Console(highlight=False)
    runs = run_all(make_tasks(options), options.workers, console)
    for study in studies_of(runs):
        console.print(summary(runs, study))
        console.print(equal_trainings(runs, study))
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "sb3_learning_curves.png"
    draw_results(runs, path)
    console.print(f"Written: {path}")


if __name__ == "__main__":
    main()
