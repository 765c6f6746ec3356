"""``fmugym demo`` trains a controller that also balances Gymnasium's own cart-pole."""

import os
import subprocess
import sys
from contextlib import closing

import gymnasium
import pygame
import pytest

from fmugym.tools.demo import arena_of_demo, train


def trained(seed, most=30):
    with closing(arena_of_demo()) as arena:
        return [*train(arena, seed, most)]


def length(env, controller, seed):
    observation, _ = env.reset(seed=seed)
    steps, is_done = 0, False
    while not is_done:
        observation, _, terminated, truncated, _ = env.step(int(controller.act(observation)))
        is_done = terminated or truncated
        steps += 1
    return steps


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_it_learns_balances_gymnasiums_cart_pole(seed):
    agent, last = trained(seed)[-1]
    assert last.is_solved
    with gymnasium.make("fmugym/CartPole-v0") as own, gymnasium.make("CartPole-v1") as env:
        policy = agent.policy().bind(own)
        lengths = [length(env, policy, 7_000 + episode) for episode in range(10)]
    assert sum(lengths) / 10 >= 450


def test_the_same_seed_learns_the_same():
    one, other = ([shown for _, shown in trained(3)] for _ in range(2))
    assert one == other


def test_it_gives_up_after_the_most_rounds():
    assert len(trained(0, most=1)) == 1


def test_without_a_display_it_writes_a_picture(tmp_path, refused, ran):
    path = tmp_path / "demo.png"
    assert "of 500" in ran("demo", "--output", path)
    width, height = pygame.image.load(path).get_size()
    assert width > 2 * height
    assert "demo.png" in refused("demo", "--output", path)
    assert "demo.jpg" in refused("demo", "--output", tmp_path / "demo.jpg")


@pytest.mark.skipif(sys.platform != "linux", reason="takes the display away as X11 has it")
def test_no_display_is_no_error():
    env = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    done = subprocess.run(
        [sys.executable, "-m", "fmugym", "demo"],
        env=env | {"SDL_VIDEODRIVER": "x11"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0
    assert "--output" in done.stdout
