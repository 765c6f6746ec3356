"""Train agents on the cart-pole FMU with numpy alone, and evaluate them.

    pip install -e ".[examples]"
    python examples/train_cart_pole.py

There are two methods, tabular Q-learning and augmented random search (agents.py). Each is trained
from several seeds. The program prints a table of held-out episodes before and after training, and
writes the learning curves and an animation of the best agent. Its measure is the length of an
episode: the number of steps for which the pole was balanced, at most 500. A mean of 475 counts as
solved.
"""

import argparse
import ast
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
from agents import Agent, Env, Policy, QLearning, RandomPolicy, RandomSearch, play
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import fmugym

ENV_ID = "fmugym/CartPole-v0"
AGENTS: dict[str, Callable[[Any, int], Agent]] = {
    "q-learning": QLearning,
    "random-search": RandomSearch,
}
TITLES = {"q-learning": "Q-learning", "random-search": "Random search"}
COLOURS = {"q-learning": "#d55e00", "random-search": "#0072b2"}

EPISODE_LIMIT = 500
SOLVED = 475
HELD_OUT_SEED = 1_000_000  # no training uses seeds from here on
FRAME_STEPS = 2  # the animation shows every second step

FULL = {"seeds": 10, "steps": 100_000, "episodes": 100}
QUICK = {"seeds": 2, "steps": 6_000, "episodes": 10}

HEADERS = (
    "Random\npolicy",
    "Trained\nmean (sd)",
    "Worst\nseed",
    "Solved",
    "Training\nsteps",
    "Time\nper run",
)
SET_HELP = "an argument of the environment; may be repeated"
EPILOG = """examples (the second one changes the plant and the task):
  python examples/train_cart_pole.py --method random-search --seeds 30
  python examples/train_cart_pole.py --env fmugym/ModelicaCartPole-v0 \\
      --set force=15 --set m_pole=2 --set time_step=0.02 --set negative_reward=-50
"""


@dataclass(frozen=True)
class Task:
    """One run that is to be done.

    Attributes:
        method: A key of `AGENTS`.
        seed: Seed of the training.
        steps: Environment steps of training.
        episodes: Held-out episodes of evaluation.
        env_id: The environment's id.
        env_options: Keyword arguments of the environment.
    """

    method: str
    seed: int
    steps: int
    episodes: int
    env_id: str = ENV_ID
    env_options: dict[str, Any] = field(default_factory=dict)

    def make_env(self, render_mode: str | None = None) -> Env:
        """Return the environment, limited to 500 steps per episode."""
        return gym.make(
            self.env_id,
            max_episode_steps=EPISODE_LIMIT,
            disable_env_checker=True,
            render_mode=render_mode,
            **self.env_options,
        )


@dataclass(frozen=True)
class Run:
    """The result of one run.

    Attributes:
        task: The task.
        agent: The trained agent.
        lengths: Length of each training episode [steps].
        seconds: Duration of the training [s].
        before: Mean length of the held-out episodes under a random policy [steps].
        after: Mean length of the same episodes under the trained agent [steps].
    """

    task: Task
    agent: Agent
    lengths: NDArray[np.int64]
    seconds: float
    before: float
    after: float


# --- training, in the worker processes -----------------------------------------------------------

_steps_done: "Synchronized[int]"


def start_worker(steps_done: "Synchronized[int]") -> None:
    """Keep the step counter that is shared with the main process, and leave Ctrl-C to it."""
    global _steps_done
    _steps_done = steps_done
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def train_and_evaluate(task: Task) -> Run:
    """Train one agent and evaluate it."""
    env = task.make_env()
    agent = AGENTS[task.method](env.observation_space, task.seed)
    start = perf_counter()
    lengths = train(agent, env, task)
    seconds = perf_counter() - start
    before = evaluate(env, RandomPolicy(task.seed), task.episodes)
    after = evaluate(env, agent.policy(), task.episodes)
    env.close()
    return Run(task, agent, lengths, seconds, before, after)


def train(agent: Agent, env: Env, task: Task) -> NDArray[np.int64]:
    """Train an agent until it has used up its steps.

    Returns:
        The length of each training episode [steps].
    """
    env.reset(seed=task.seed)
    lengths, left = [], task.steps
    for episode in agent.learn(env):
        lengths.append(episode.steps)
        left -= episode.steps
        with _steps_done.get_lock():
            _steps_done.value += episode.steps
        if left <= 0:
            break
    return np.array(lengths)


def evaluate(env: Env, policy: Policy, episodes: int) -> float:
    """Return the mean length of the held-out episodes under a policy [steps]."""
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + episodes)
    return float(np.mean([play(env, policy, seed).steps for seed in seeds]))


# --- training, as seen by the main process -------------------------------------------------------


def run_all(tasks: list[Task], workers: int, console: Console) -> list[Run]:
    """Train and evaluate in parallel, with a progress bar.

    Args:
        tasks: The tasks.
        workers: Number of processes.
        console: The console for the progress bar, which appears only on a terminal.

    Returns:
        The runs, in the order of the tasks.
    """
    context = multiprocessing.get_context("spawn")  # a fork would share the library of the FMU
    steps_done = context.Value("q", 0)
    with ProcessPoolExecutor(workers, context, start_worker, (steps_done,)) as executor:
        try:
            with ignored_interrupt():
                futures = [executor.submit(train_and_evaluate, task) for task in tasks]
            watch(futures, steps_done, sum(task.steps for task in tasks), console)
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    return [future.result() for future in futures]


@contextmanager
def ignored_interrupt() -> Iterator[None]:
    """Ignore Ctrl-C for a moment, so that processes started meanwhile ignore it from the start."""
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def watch(
    futures: list[Future[Run]], steps_done: "Synchronized[int]", steps: int, console: Console
) -> None:
    """Show the progress until all runs are done; if a run fails, raise its error."""
    columns = (
        TextColumn("Training"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %  {task.description}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task("", total=steps)
        pending = set(futures)
        while pending:
            done, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
            runs = f"{len(futures) - len(pending)} of {len(futures)} runs"
            progress.update(bar, completed=min(steps_done.value, steps), description=runs)


# --- results -------------------------------------------------------------------------------------


def by_method(runs: list[Run]) -> dict[str, list[Run]]:
    """Return the runs of each method that was run, in the order of `AGENTS`."""
    groups = {name: [run for run in runs if run.task.method == name] for name in AGENTS}
    return {name: group for name, group in groups.items() if group}


def summary(runs: list[Run]) -> Table:
    """Return the table of the held-out episodes before and after training."""
    episodes = runs[0].task.episodes
    table = Table(title=f"Mean length of {episodes} held-out episodes, of {EPISODE_LIMIT} steps")
    table.add_column("Method")
    for header in HEADERS:
        table.add_column(header, justify="right")
    for name, group in by_method(runs).items():
        table.add_row(TITLES[name], *summary_cells(group))
    return table


def summary_cells(runs: list[Run]) -> list[str]:
    """Return the numbers of a method: mean and standard deviation over its seeds."""
    after = np.array([run.after for run in runs])
    return [
        f"{np.mean([run.before for run in runs]):.1f}",
        f"{after.mean():.1f} ({after.std():.1f})",
        f"{after.min():.1f}",
        f"{np.sum(after >= SOLVED)}/{len(runs)}",
        f"{np.mean([run.lengths.sum() for run in runs]):,.0f}",
        f"{np.mean([run.seconds for run in runs]):.1f} s",
    ]


def learning_curve(run: Run, grid: NDArray[np.float64], window: float) -> NDArray[np.float64]:
    """Return the running mean of the length of the training episodes.

    Args:
        run: The run.
        grid: The points of the curve, in environment steps, of shape (n,).
        window: The mean is over the episodes that ended within so many steps before a point.

    Returns:
        The mean lengths [steps], of shape (n,).
    """
    ends = np.cumsum(run.lengths)
    last = np.searchsorted(ends, grid, side="right")
    first = np.searchsorted(ends, grid - window, side="right")
    total = np.concatenate(([0], ends))
    means: NDArray[np.float64] = (total[last] - total[first]) / (last - first)
    return means


def draw_results(runs: list[Run], path: Path) -> None:
    """Draw the learning curves beside the held-out results and write them to a PNG file."""
    figure = Figure(figsize=(10, 5), dpi=130, layout="constrained")
    curves, held_out = figure.subplots(1, 2, sharey=True, width_ratios=(5, 2))
    figure.suptitle(f"Learning to balance {runs[0].task.env_id}", fontsize=14)
    draw_learning_curves(curves, runs)
    draw_held_out(held_out, runs)
    for axes in (curves, held_out):
        draw_levels(axes, runs)
    label_levels(held_out, runs)
    figure.savefig(path)


def draw_learning_curves(axes: Axes, runs: list[Run]) -> None:
    """Draw the median, the middle half and the range over the seeds, for each method."""
    steps = runs[0].task.steps
    window = max(steps / 20, 2 * EPISODE_LIMIT)
    grid = np.linspace(EPISODE_LIMIT, steps, 200)
    for name, group in by_method(runs).items():
        curves = [learning_curve(run, grid, window) for run in group]
        worst, low, median, high, best = np.percentile(curves, (0, 25, 50, 75, 100), axis=0)
        axes.fill_between(grid, worst, best, color=COLOURS[name], alpha=0.1, linewidth=0)
        axes.fill_between(grid, low, high, color=COLOURS[name], alpha=0.25, linewidth=0)
        axes.plot(grid, median, color=COLOURS[name], linewidth=2, label=TITLES[name])
    seeds = len({run.task.seed for run in runs})
    axes.set_title(f"Training: median, middle half and range of {seeds} seeds", fontsize=11)
    axes.set_xlabel("environment steps")
    axes.set_ylabel("episode length [steps]")
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.set_xlim(0, steps)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 0.06), frameon=False)


def draw_held_out(axes: Axes, runs: list[Run]) -> None:
    """Draw the held-out result of each seed as a dot, and the mean of each method as a line."""
    groups = by_method(runs)
    for place, (name, group) in enumerate(groups.items()):
        after = [run.after for run in group]
        spread = place + np.linspace(-0.2, 0.2, len(group))
        axes.scatter(spread, after, s=22, color=COLOURS[name], alpha=0.7, linewidth=0, zorder=3)
        axes.hlines(np.mean(after), place - 0.3, place + 0.3, color=COLOURS[name], linewidth=2)
    axes.set_title(f"{runs[0].task.episodes} held-out episodes", fontsize=11)
    axes.set_xticks(range(len(groups)), [TITLES[name] for name in groups])
    axes.set_xlim(-0.6, len(groups) - 0.4)


def draw_levels(axes: Axes, runs: list[Run]) -> None:
    """Draw the levels of the solved task and of the random policy, and style the frame."""
    for level in (SOLVED, random_level(runs)):
        axes.axhline(level, color="0.35", linewidth=1, linestyle=(0, (4, 3)), zorder=1)
    axes.set_ylim(0, EPISODE_LIMIT * 1.04)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="0.92", zorder=0)


def label_levels(axes: Axes, runs: list[Run]) -> None:
    """Label the levels to the right of the axes."""
    random = random_level(runs)
    for level, text in ((SOLVED, f"{SOLVED}: solved"), (random, f"{random:.0f}: random policy")):
        axes.annotate(
            text,
            (1.03, level),
            xycoords=("axes fraction", "data"),
            annotation_clip=False,
            verticalalignment="center",
            fontsize=9,
            color="0.35",
        )


def random_level(runs: list[Run]) -> float:
    """Return the mean length of an episode under the random policy [steps]."""
    return float(np.mean([run.before for run in runs]))


def animate(run: Run, path: Path) -> int:
    """Play the first held-out episode and write it to a GIF file.

    Returns:
        The episode's length [steps].
    """
    env = run.task.make_env(render_mode="rgb_array")
    policy = run.agent.policy()
    frames: list[Image.Image] = []
    step = count()

    def filmed(observation: NDArray[Any]) -> int:
        if next(step) % FRAME_STEPS == 0:
            frames.append(Image.fromarray(np.asarray(env.render())))
        return policy(observation)

    episode = play(env, filmed, HELD_OUT_SEED)
    write_gif(frames, FRAME_STEPS / env.metadata["render_fps"], path)
    env.close()
    return episode.steps


def write_gif(frames: list[Image.Image], seconds: float, path: Path) -> None:
    """Write an endless animation; all frames use the colours of the middle one.

    Args:
        frames: The pictures.
        seconds: Time for which each picture is shown [s].
        path: The file.
    """
    palette = frames[len(frames) // 2].quantize(64)
    first, *rest = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    milliseconds = round(1000 * seconds)
    first.save(path, save_all=True, append_images=rest, duration=milliseconds, loop=0)


# --- command line --------------------------------------------------------------------------------


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the complete and checked options, or end the program with a message."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    for name, value in (QUICK if options.quick else FULL).items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    if options.first_seed + options.seeds > HELD_OUT_SEED:
        parser.error(f"the seeds from {HELD_OUT_SEED} on are kept for the evaluation")
    try:
        check_env(make_tasks(options)[0])
    except (gym.error.Error, fmugym.FMUGymError, TypeError, ValueError) as error:
        parser.error(str(error))
    return options


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        description="Train agents on the cart-pole FMU with numpy alone.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("--method", choices=[*AGENTS, "both"], default="both", help="what to train (both)")
    add("--seeds", type=at_least(1), help=f"runs of each method ({FULL['seeds']})")
    add("--first-seed", type=at_least(0), default=0, help="seed of the first run (0)")
    add("--steps", type=at_least(1000), help=f"environment steps of a run ({FULL['steps']})")
    add("--episodes", type=at_least(1), help=f"held-out episodes ({FULL['episodes']})")
    add("--quick", action="store_true", help="run everything briefly, in a few seconds")
    add("--output", type=Path, default=Path("results"), help="folder of the pictures (results)")
    add("--workers", type=at_least(1), default=os.cpu_count() or 1, help="processes (one per core)")
    add("--env", default=ENV_ID, help=f"a cart-pole's id ({ENV_ID})")
    add("--set", type=assignment, action="append", default=[], metavar="NAME=VALUE", help=SET_HELP)
    return parser


def at_least(lowest: int) -> Callable[[str], int]:
    """Return a function that reads a whole number and refuses lower ones."""

    def whole_number(text: str) -> int:
        if int(text) < lowest:
            raise argparse.ArgumentTypeError(f"must be at least {lowest}, is {text}")
        return int(text)

    return whole_number


def assignment(text: str) -> tuple[str, Any]:
    """Return name and value of `NAME=VALUE`; a value that is no Python literal is a string."""
    name, equals, value = text.partition("=")
    if not (name.isidentifier() and equals):
        raise argparse.ArgumentTypeError(f"must be NAME=VALUE, is {text}")
    try:
        return name, ast.literal_eval(value)
    except (SyntaxError, ValueError):
        return name, value


def make_tasks(options: argparse.Namespace) -> list[Task]:
    """Return the tasks that the options ask for."""
    methods = list(AGENTS) if options.method == "both" else [options.method]
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    return [
        Task(method, seed, options.steps, options.episodes, options.env, dict(options.set))
        for method in methods
        for seed in seeds
    ]


def check_env(task: Task) -> None:
    """Raise an error if the environment cannot be made or does not look like a cart-pole."""
    env = task.make_env()
    if env.observation_space.shape != (4,) or env.action_space != gym.spaces.Discrete(2):
        raise ValueError(
            f"{task.env_id} is not a cart-pole: expected 4 observations and 2 actions, "
            f"got {env.observation_space} and {env.action_space}"
        )
    env.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and evaluate the agents, and show the results.

    Returns:
        The exit status.
    """
    console = Console(highlight=False, markup=False)
    start = perf_counter()
    try:
        options = parse(arguments)
        tasks = make_tasks(options)
        runs = run_all(tasks, min(options.workers, len(tasks)), console)
        console.print(summary(runs))
        write_pictures(runs, options.output, console)
    except KeyboardInterrupt:
        console.print("Interrupted.")
        return 130
    console.print(f"Done in {perf_counter() - start:.0f} s.")
    return 0


def write_pictures(runs: list[Run], folder: Path, console: Console) -> None:
    """Draw the results and the best agent, and print the paths of the files."""
    folder.mkdir(parents=True, exist_ok=True)
    curves, animation = folder / "learning_curves.png", folder / "trained_agent.gif"
    draw_results(runs, curves)
    best = max(runs, key=lambda run: run.after)
    steps = animate(best, animation)
    agent = f"{TITLES[best.task.method]}, seed {best.task.seed}, {steps} steps"
    console.print(f"Learning curves: {curves}", soft_wrap=True)
    console.print(f"Best agent:      {animation} ({agent})", soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
