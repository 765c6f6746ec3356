"""``fmugym demo``: train a controller of the bundled cart-pole in seconds, and show it."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from fmugym.errors import ConfigError, plain
from fmugym.tools.options import Commands, add_command, add_json, check_numbers, say, say_result

__all__ = ["Generation", "LinearController", "Training", "add_demo"]

_ID: Final = "fmugym/CartPole-v0"
_STEPS: Final = 500
_SOLVED: Final = 475.0  # of 500, as Gymnasium has it
_FRAMES: Final = 5
_GAP: Final = 8  # pixels between the frames of a picture

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LinearController:
    """Pushes the cart to the right where a weighted sum of the observation is positive.

    Attributes:
        weights: Of position, velocity, angle and angular velocity; shape (4,), or (N, 4) for a
            controller of its own in each of N environments.
    """

    weights: Array

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """The action, 0 or 1, for an observation of shape (4,), or those of shape (N, 4)."""
        is_right: NDArray[np.bool_] = np.sum(observation * self.weights, axis=-1) > 0
        return is_right.astype(np.int64)


@dataclass(frozen=True)
class Generation:
    """What one round of the training has shown.

    Attributes:
        number: From 1 on.
        mean, best: Of the lengths of the candidates' episodes [steps].
        held_out: Mean length of other episodes with the mean of the best candidates [steps].
    """

    number: int
    mean: float
    best: float
    held_out: float

    @property
    def is_solved(self) -> bool:
        """Whether the held-out episodes have 475 of 500 steps in the mean."""
        return self.held_out >= _SOLVED


class Training:
    """The cross-entropy method over linear controllers, all candidates of a round at once.

    A round draws candidates from a normal distribution, lets each play an episode, and moves the
    distribution to the best of them. See Rubinstein and Kroese, "The Cross-Entropy Method" (2004).

    Args:
        seed: Of the candidates and of their episodes.
        candidates: In a round, each in an environment of its own.
        elites: How many of them make the next distribution.

    Attributes:
        controller: The present mean of the distribution.
        steps: Environment steps so far, held-out episodes included.
        seconds: Time so far [s].
    """

    def __init__(self, seed: int = 0, candidates: int = 64, elites: int = 8) -> None:
        self.controller = LinearController(np.zeros(4))
        self.steps = 0
        self.seconds = 0.0
        self._spread = np.ones(4)
        self._seed = seed
        self._elites = elites
        self._candidates = candidates
        self._rng = np.random.default_rng(seed)

    def rounds(self, most: int = 30) -> Iterator[Generation]:
        """Train until the task is solved, at most ``most`` rounds; yields what each has shown."""
        envs = gymnasium.make_vec(_ID, self._candidates)
        try:
            for number in range(1, most + 1):
                start = perf_counter()
                generation = self._round(envs, number)
                self.seconds += perf_counter() - start
                yield generation
                if generation.is_solved:
                    return
        finally:
            envs.close()

    def _round(self, envs: gymnasium.vector.VectorEnv[Any, Any, Any], number: int) -> Generation:
        shape = (self._candidates, 4)
        weights = self._rng.normal(self.controller.weights, self._spread, shape)
        lengths = self._play(envs, LinearController(weights), self._seed)
        best = weights[np.argsort(-lengths)[: self._elites]]
        self.controller = LinearController(best.mean(axis=0))
        self._spread = best.std(axis=0) + 0.05  # or the search would stop too soon
        held_out = self._play(envs, self.controller, self._seed + 1_000_000)
        return Generation(
            number, float(lengths.mean()), float(lengths.max()), float(held_out.mean())
        )

    def _play(
        self,
        envs: gymnasium.vector.VectorEnv[Any, Any, Any],
        controller: LinearController,
        seed: int,
    ) -> NDArray[np.int64]:
        """The lengths of the first episodes after a reset with this seed, of shape (N,)."""
        observations, _ = envs.reset(seed=seed)
        going_on = np.ones(self._candidates, bool)
        lengths = np.zeros(self._candidates, np.int64)
        while going_on.any():
            observations, _, terminated, truncated, _ = envs.step(controller.act(observations))
            lengths += going_on
            self.steps += self._candidates
            going_on &= ~(terminated | truncated)
        return lengths


def _show(controller: LinearController, seed: int) -> int:
    """Play an episode in a window.

    Returns:
        Its length [steps].

    Raises:
        ConfigError: If there is no display.
    """
    return sum(1 for _ in _episode(controller, seed, "human"))


def _write_picture(controllers: list[LinearController], seed: int, path: Path) -> None:
    """Write a PNG file with a row of frames from an episode of each controller.

    Raises:
        ConfigError: If its name has another ending.
        OSError: If it cannot be written.
    """
    import pygame

    if path.suffix.lower() != ".png":
        raise ConfigError(f"the picture's name must end with .png, not {path.name!r}")
    rows = [_row(controller, seed) for controller in controllers]
    picture = np.concatenate(rows)
    pygame.image.save(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), path)


def _row(controller: LinearController, seed: int) -> NDArray[np.uint8]:
    length = sum(1 for _ in _episode(controller, seed, None))
    chosen = set(np.linspace(0, length - 1, _FRAMES).astype(int).tolist())
    margin = ((_GAP // 2,) * 2, (_GAP // 2,) * 2, (0, 0))
    episode = enumerate(_episode(controller, seed, "rgb_array"))
    frames: list[Any] = [env.render() for step, env in episode if step in chosen]
    return np.concatenate([np.pad(frame[::2, ::2], margin) for frame in frames], axis=1)


def _episode(
    controller: LinearController, seed: int, render_mode: str | None
) -> Iterator[gymnasium.Env[Any, Any]]:
    """Yield the environment after each step of an episode."""
    env = gymnasium.make(_ID, render_mode=render_mode)
    try:
        observation, _ = env.reset(seed=seed)
        is_done = False
        while not is_done:
            observation, _, terminated, truncated, _ = env.step(controller.act(observation)[()])
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
    training = Training(arguments.seed)
    untrained, rounds = training.controller, []
    for one in training.rounds():
        rounds.append(one)
        if not arguments.json:
            say(
                f"round {one.number}: {one.mean:.0f} steps in the mean, {one.best:.0f} at best; "
                f"controller {one.held_out:.0f} of 500"
            )
    steps, seconds = training.steps, training.seconds
    facts = {"rounds": [asdict(one) for one in rounds], "steps": steps, "seconds": seconds}
    say_result(arguments, facts, f"{steps} steps of the cart-pole FMU in {seconds:.2f} s")
    _show_both(untrained, training.controller, arguments)
    return int(not rounds or not rounds[-1].is_solved)


def _show_both(
    untrained: LinearController, trained: LinearController, arguments: argparse.Namespace
) -> None:
    seed = arguments.seed + 2_000_000
    if arguments.output is not None:
        _write_picture([untrained, trained], seed, arguments.output)
        if not arguments.json:
            say(plain(f"{arguments.output}: an episode before the training, and one after it"))
        return
    if arguments.json:
        return
    try:
        say(f"before the training: {_show(untrained, seed)} steps")
        say(f"after the training: {_show(trained, seed)} steps")
    except ConfigError:
        say("There is no display for a window: --output demo.png writes a picture")
