"""The FMU instance of an environment, in a pool of its own or in one of N."""

from __future__ import annotations

from fmugym.pool import Pool

__all__ = ["Instance"]


class Instance:
    """FMU instance of an environment: its rows and calls in a pool.

    Args:
        pool: A pool of one; or one of N, whose vector environment then steps it.

    Attributes:
        pool: As given.
        step: Steps it; returns whether it failed.
        halt: Lets a plant that stands in for the FMU stop.
        inputs, outputs: The rows that the pool reads and writes, shapes (m,) and (k,).
        observation: The outputs in float32, which the pool writes in the same pass.
        tells: Whether the pool adds to the info of a step.
    """

    __slots__ = ("halt", "inputs", "observation", "outputs", "pool", "step", "tells")

    def __init__(self, pool: Pool) -> None:
        self.pool, self.step, self.halt = pool, pool.step_own, pool.halt
        self.inputs, self.outputs = pool.inputs[:, 0], pool.outputs[:, 0]
        self.observation, self.tells = pool.observations[0], bool(pool.info())
