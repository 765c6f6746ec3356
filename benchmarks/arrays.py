"""Measure what a step of a vector environment adds to the FMUs' step and to hooks on arrays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
from cart_poles import require_native_pool
from gate_rows import CartPoleOnArrays
from gymnasium.vector import AutoresetMode
from measure import Effort, Run, by_turns, repeated
from tables import Table

import fmugym

__all__ = ["tables"]

TITLE = "A step with hooks on arrays, and the same FMUs and hooks called by hand, in us"
HEADER = ["autoreset mode", "environments", "step", "by hand", "added"]
SIZES = (1, 8, 64, 256, 1024)
STEPS = 100
"""Between two resets: no episode reaches its limit."""


class Endless(CartPoleOnArrays):
    """A cart-pole whose episodes go on: its hooks are the same, with other limits."""

    vectorized = True

    def _is_done(self) -> Any:
        x, _, phi, _ = self.state
        return (np.abs(x) > 1e6) | (np.abs(phi) > 1e6)


def tables(effort: Effort) -> list[Table]:
    """Measure each mode and size, by the fastest turns: other work does not slow these down."""
    sizes = SIZES[:2] if effort.quick else SIZES
    return [Table(TITLE, HEADER, [_row(m, n, effort) for m in AutoresetMode for n in sizes])]


def _row(mode: AutoresetMode, size: int, effort: Effort) -> list[str]:
    require_native_pool()
    with ExitStack() as stack:
        samples = by_turns(dict(_runs(stack, mode, size)), effort)
    step, by_hand = (min(one.wall / one.count for one in own) * 1e6 for own in samples.values())
    return [mode.name, str(size), *(f"{time:.1f}" for time in (step, by_hand, step - by_hand))]


def _runs(stack: ExitStack, mode: AutoresetMode, size: int) -> Iterator[tuple[str, Run]]:
    env = fmugym.FMUVectorEnv(Endless, size, autoreset_mode=mode)
    stack.callback(env.close)
    actions, pool, one = env.action_space.sample(), env.pool, env.prototype

    def steps() -> None:
        for _ in range(STEPS):
            env.step(actions)

    def by_hand() -> None:
        for _ in range(STEPS):
            one._get_inputs()
            pool.step()
            one._is_done()
            one._reward_policy()
            one.state.T.astype(np.float32)  # the observations

    for name, block in (("step", steps), ("by hand", by_hand)):
        yield name, repeated(block, STEPS, prepare=env.reset)
