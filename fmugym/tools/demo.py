"""``fmugym demo``: train a controller of the bundled cart-pole in seconds, and show it."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from fmugym.baselines.arena import Arena
from fmugym.baselines.cma import CMA
from fmugym.envs import CartPoleEnv
from fmugym.episodes.evaluation import HELD_OUT_SEED
from fmugym.errors import ConfigError, plain
from fmugym.search.policy import Agent
from fmugym.tools.options import Commands, add_command, add_json, check_numbers, say, say_result

__all__ = ["Round", "add_demo", "arena_of_demo", "train"]

_ID: Final = "fmugym/CartPole-v0"
_STEPS: Final = 500
_SOLVED: Final = 475.0  # of 500, as Gymnasium has it
_CANDIDATES: Final = 64
_ROUNDS: Final = 30
_FRAMES: Final = 5
_GAP: Final = 8  # pixels between the frames of a picture

_UNTRAINED: Final = Agent("linear", None, observed=4, acting=2, weights=np.zeros(10))
"""Takes the action whose weighted sum of the observation is the largest one."""


@dataclass(frozen=True)
class Round:
    """What one round of the training has shown.

    Attributes:
        number: From 1 on.
        mean, best: Of the lengths of the candidates' episodes [steps].
        held_out: Mean length of other episodes with the mean of the search [steps].
    """

    number: int
    mean: float
    best: float
    held_out: float

    @property
    def is_solved(self) -> bool:
        """Whether the held-out episodes have 475 of 500 steps in the mean."""
        return self.held_out >= _SOLVED


def arena_of_demo() -> Arena:
    """Many cart-poles, to be closed, in which policies play."""
    return Arena(CartPoleEnv, most_steps=_STEPS)


def train(arena: Arena, seed: int, most: int = _ROUNDS) -> Iterator[tuple[Agent, Round]]:
    """Search the weights of a linear policy as ``fmugym train`` does, until the task is solved.

    Args:
        arena: Where the candidates play: all of a round the same episode.
        seed: Of the candidates and of their episodes.
        most: The largest number of rounds.

    Yields:
        The policy with the mean of the search after each round, and what the round has shown.
    """
    cma = CMA(_UNTRAINED.weights, 1.0, _CANDIDATES, np.random.default_rng(seed))
    others = range(HELD_OUT_SEED + seed, HELD_OUT_SEED + seed + _CANDIDATES)
    for number in range(1, most + 1):
        outcome = arena.play(_UNTRAINED, cma.ask(), [seed])
        cma.tell(np.array(outcome.order))
        agent, lengths = _UNTRAINED.with_numbers(cma.mean), outcome.returns
        held_out = float(agent.play(arena, others).returns.mean())
        one = Round(number, float(lengths.mean()), float(lengths.max()), held_out)
        yield agent, one
        if one.is_solved:
            return


def _show(agent: Agent, seed: int) -> int:
    """Play an episode in a window.

    Returns:
        Its length [steps].

    Raises:
        ConfigError: If there is no display.
    """
    return sum(1 for _ in _episode(agent, seed, "human"))


def _write_picture(agents: list[Agent], seed: int, path: Path) -> None:
    """Write a PNG file with a row of frames from an episode of each agent.

    Raises:
        ConfigError: If its name has another ending.
        OSError: If it cannot be written.
    """
    import pygame

    if path.suffix.lower() != ".png":
        raise ConfigError(f"the picture's name must end with .png, not {path.name!r}")
    rows = [_row(agent, seed) for agent in agents]
    picture = np.concatenate(rows)
    pygame.image.save(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), path)


def _row(agent: Agent, seed: int) -> NDArray[np.uint8]:
    length = sum(1 for _ in _episode(agent, seed, None))
    chosen = set(np.linspace(0, length - 1, _FRAMES).astype(int).tolist())
    margin = ((_GAP // 2,) * 2, (_GAP // 2,) * 2, (0, 0))
    episode = enumerate(_episode(agent, seed, "rgb_array"))
    frames: list[Any] = [env.render() for step, env in episode if step in chosen]
    return np.concatenate([np.pad(frame[::2, ::2], margin) for frame in frames], axis=1)


def _episode(agent: Agent, seed: int, render_mode: str | None) -> Iterator[gymnasium.Env[Any, Any]]:
    """Yield the environment after each step of an episode."""
    env = gymnasium.make(_ID, render_mode=render_mode)
    try:
        policy = agent.policy().bind(env)
        observation, _ = env.reset(seed=seed)
        is_done = False
        while not is_done:
            observation, _, terminated, truncated, _ = env.step(policy.act(observation))
            yield env
            is_done = bool(terminated or truncated)
    finally:
        env.close()


def add_demo(commands: Commands) -> None:
    """Add ``demo``."""
    text = "train a controller of the bundled cart-pole in seconds, and show it in a window"
    command = add_command(commands, "demo", _demo, text)
    command.add_argument("--seed", type=int, default=0, help="default 0")
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new PNG file, instead of the window"
    )
    add_json(command)


def _demo(arguments: argparse.Namespace) -> int:
    check_numbers(arguments)
    found = list[tuple[Agent, Round]]()
    with closing(arena_of_demo()) as arena:
        for agent, one in train(arena, arguments.seed):
            found.append((agent, one))
            if not arguments.json:
                say(
                    f"round {one.number}: {one.mean:.0f} steps in the mean, {one.best:.0f} at "
                    f"best; controller {one.held_out:.0f} of 500"
                )
    steps, seconds = arena.steps, arena.seconds
    facts = {"rounds": [asdict(one) for _, one in found], "steps": steps, "seconds": seconds}
    say_result(arguments, facts, f"{steps} steps of the cart-pole FMU in {seconds:.2f} s")
    agent, last = found[-1]
    _show_both(agent, arguments)
    return int(not last.is_solved)


def _show_both(trained: Agent, arguments: argparse.Namespace) -> None:
    seed = arguments.seed + 2_000_000
    if arguments.output is not None:
        _write_picture([_UNTRAINED, trained], seed, arguments.output)
        if not arguments.json:
            say(plain(f"{arguments.output}: an episode before the training, and one after it"))
        return
    if arguments.json:
        return
    try:
        say(f"before the training: {_show(_UNTRAINED, seed)} steps")
        say(f"after the training: {_show(trained, seed)} steps")
    except ConfigError:
        say("There is no display for a window: --output demo.png writes a picture")
