"""Programs around the steps of pools that have no programs of their own.

The programs run in this process, on the arrays of such a pool, which may be memory that it shares
with others. A native pool runs them that has no FMU of its own.
"""

from __future__ import annotations

import logging
from typing import Any

from fmugym import _native
from fmugym.archive.variable import Variable
from fmugym.pool.base import Play, Pool, PoolSpec, available_processors
from fmugym.pool.form import form_of_listing, form_of_programs
from fmugym.pool.health import no_counts
from fmugym.pool.native import prepare

__all__ = ["play_around", "programs_for"]


def play_around(pool: Pool, spec: PoolSpec, variables: tuple[Variable, ...], *parts: Any) -> Play:
    """Prepare programs that run before and after the steps of a pool; see ``Pool.prepare_play``."""
    programs = programs_for(pool, spec)
    prepare(programs, _native.Access(form_of_listing(variables)), *parts)
    return Play(programs.check_actions, programs.play_before, programs.play_after)


def programs_for(pool: Pool, spec: PoolSpec) -> _native.Pool:
    """Make a native pool of no FMU that runs programs on the arrays of another pool.

    Args:
        pool: Its arrays are those that programs read and write.
        spec: What the pool does at each step.
    """
    count = pool.num_instances
    form = form_of_programs(spec, count, available_processors())
    own = pool.inputs, pool.outputs, pool.statuses, pool.observations, no_counts(count)
    return _native.Pool(form, own, _ignore)


def _ignore(index: int, status: int, category: str, message: str) -> None:
    """Receive the messages of FMUs, of which there are none."""
    logging.getLogger(__name__).debug("%d %d %s %s", index, status, category, message)
