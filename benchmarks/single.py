"""Measure the steps per second of one environment, of Gymnasium's own and of FMPy's wrappers."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import cart_poles
import gymnasium as gym
from cart_poles import FMUGYM, GYMNASIUM
from measure import Effort, Run, Sample, by_turns, cpu_rate, make_runs, ratio, wall_rate
from tables import Table, duration, rate, times

__all__ = ["tables"]

TITLE = "One environment (a cart-pole, resets included)"
HEADER = ["configuration", "one step", "steps/s", "steps/CPU-s", "of Gymnasium", "of FMPy"]
FMPY, BASE = "FMPy's wrappers in a loop", "Gymnasium CartPole-v1, gym.make"


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    with ExitStack() as stack:
        runs, missing = make_runs(_makers(stack))
        samples = by_turns(runs, effort)
    table = Table(TITLE, HEADER)
    for name in samples:
        _add(table, name, samples)
    table.rows += [[name, why, *[""] * (len(HEADER) - 2)] for name, why in missing.items()]
    return [table]


def _makers(stack: ExitStack) -> dict[str, Callable[[], Run]]:
    def environment(env_id: str, bare: bool) -> Run:
        if env_id == FMUGYM:
            cart_poles.require_native_pool()
        env = gym.make(env_id)
        stack.callback(env.close)
        return cart_poles.environment_run(env.unwrapped if bare else env)

    return {
        "fmugym CartPole-v0, gym.make": lambda: environment(FMUGYM, False),
        "fmugym CartPole-v0, bare class": lambda: environment(FMUGYM, True),
        BASE: lambda: environment(GYMNASIUM, False),
        "Gymnasium CartPole-v1, bare class": lambda: environment(GYMNASIUM, True),
        FMPY: lambda: cart_poles.fmpy_run(stack),
    }


def _add(table: Table, name: str, samples: dict[str, list[Sample]]) -> None:
    own = samples[name]
    wall, cpu = wall_rate(own), cpu_rate(own)
    gymnasium, fmpy = ratio(own, samples[BASE]), ratio(own, samples[FMPY])
    cells = [duration(1 / wall), rate(wall), rate(cpu), times(gymnasium), times(fmpy)]
    table.rows.append([name, *cells])
    data = {"configuration": name, "steps_per_s": wall, "steps_per_cpu_s": cpu}
    table.data.append(data | {"of_gymnasium": gymnasium, "of_fmpy": fmpy})
