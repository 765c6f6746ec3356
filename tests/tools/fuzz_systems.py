"""Random systems: each does what it does alone, bit by bit, whatever is called.

    python tests/tools/fuzz_systems.py --count 400 --seed 0

A case connects one to four FMUs of linear equations (``zoo/linear.c``) of all FMI versions at
random: masters, loops, steps per component, estimates of errors, gains, reset methods by component,
FMUs that discard steps, fail, or ask for the end. Then it resets, steps, saves, restores, writes
and reads in random order. See ``fuzz_driver.py``. ``sanitize.py`` runs this, too.
"""

import contextlib
import logging
import sys
import tempfile
from pathlib import Path

import numpy as np
from fuzz_driver import Case, main, require
from system_tools import MATRICES, linear_fmu

from fmugym import Component, Connection, FMUSystem, SimulationError
from fmugym.pool import PoolSpec
from fmugym.pool.native_pool import NativePool
from fmugym.pool.pool_spec import ResetMethod
from fmugym.pool.states import SaveMethod

LOG = logging.getLogger("fmugym.test")
NAMES = ("a", "b", "c", "d")
COUNT = 2
CALLS = 25
NO_STATES = 1
"""The version of FMI that cannot save states."""

METHODS = (ResetMethod.RESTORE, ResetMethod.RESET, ResetMethod.INSTANCE)


def component(rng, path, faults):
    """An FMU with random equations, which mostly do not grow."""
    starts = {f"x{i}_0": rng.uniform(-1, 1) for i in (1, 2)}
    for letter in MATRICES:
        size = {"a": 1.0, "b": 1.0, "c": 1.0, "d": rng.choice((0.0, 0.3))}[letter]
        for i, j in np.ndindex(2, 2):
            own = -1.5 if letter == "a" and i == j else 0.0
            starts[f"{letter}{i + 1}{j + 1}"] = own + size * rng.uniform(-1, 1)
    if faults:
        starts["limit"] = rng.choice((0.0, 0.03, 0.06))
        starts["status"] = float(rng.choice((0, 0, 1, 2, 3)))
        starts["fails"] = rng.uniform(0.1, 0.8)
    feedthrough = rng.choice((None, False)) if not starts["d11"] else None
    return Component(path, starts, steps=rng.choice((1, 1, 2, 3)), feedthrough=feedthrough)


def connections(rng, names):
    """Some inputs are driven, some come from outside."""
    found = []
    for target in names:
        for i in (1, 2):
            if rng.random() < 0.6:
                source = f"{rng.choice(names)}.y{rng.choice((1, 2))}"
                gain, offset = rng.choice((1.0, rng.uniform(-0.5, 0.5))), rng.choice((0.0, 0.1))
                found.append(Connection(source, f"{target}.u{i}", gain or 1.0, offset))
            elif rng.random() < 0.3:
                found.append(Connection("go", f"{target}.u{i}", rng.uniform(0.1, 2.0)))
    return found


def make_system(rng, fmus):
    """A random system, and the FMI versions of its components."""
    versions = [rng.choice((1, 2, 2, 2, 3)) for _ in range(rng.randint(1, 4))]
    names, faults = NAMES[: len(versions)], rng.random() < 0.4
    parts = {n: component(rng, fmus[v], faults) for n, v in zip(names, versions, strict=True)}
    options = {"master": rng.choice(("jacobi", "gauss_seidel"))}
    return FMUSystem(parts, connections(rng, names), **options), versions


def spec_of(rng, fmu, versions):
    """What to set, read, and do at a reset."""
    inputs = [v for v in fmu.description.variables.values() if v.causality == "input"]
    outputs = [v for n, v in fmu.description.variables.items() if n[2:4] in {"y1", "y2", "t"}]
    outputs += [v for n, v in fmu.description.variables.items() if n.startswith("master.")]
    able, methods = fmu.description.capabilities, ()
    if rng.random() < 0.6:
        methods = tuple(rng.choice(METHODS[v == NO_STATES :]) for v in versions)
    return PoolSpec(
        tuple(inputs),
        tuple(outputs),
        0.1,
        substeps=rng.choice((1, 1, 2)),
        fault_retries=rng.choice((0, 2)) if able.can_get_and_set_fmu_state else 0,
        reset_method=rng.choice(METHODS) if not methods else ResetMethod.INSTANCE,
        component_resets=methods,
    )


class Pools:
    """Systems that step together, and pools of one in which each does the same alone."""

    def __init__(self, system, spec):
        able = system.as_fmu().description.capabilities
        self.can_save = able.can_get_and_set_fmu_state
        self.can_serialize = able.can_serialize_fmu_state
        self.pools, self.snapshots = [], None
        try:
            for count in (COUNT, *[1] * COUNT):
                pool = NativePool(system.as_fmu(), spec, count, LOG)
                pool.save_by(lambda: SaveMethod.STATE)
                self.pools.append(pool)
        except BaseException:
            self.close()
            raise

    def close(self):
        for pool in self.pools:
            pool.close()

    @property
    def sound(self):
        """Whether none has failed."""
        return not self.pools[0].statuses.any()

    def all(self, what, call):
        """Do the same with all, and compare; the call gets a pool and the columns of its own."""
        together, *alone = self.pools
        call(together, slice(None))
        for index, pool in enumerate(alone):
            call(pool, slice(index, index + 1))
            self._compare(what, index)

    def each(self, what, call):
        """Do it with one after the other; the call gets a pool and a mask."""
        together, *alone = self.pools
        for index, pool in enumerate(alone):
            told = _told(call, together, np.arange(COUNT) == index)
            own = _told(call, pool, None)
            require(told == own, f"{what}: {told} and {own}")
            self._compare(what, index)

    def _compare(self, what, index):
        together, own = self.pools[0], self.pools[1 + index]
        expected = together.outputs[:, index].tolist(), together.statuses[index]
        found = own.outputs[:, 0].tolist(), own.statuses[0]
        require(repr(found) == repr(expected), f"{what}: {found} and {expected}")


def _told(call, pool, mask):
    try:
        call(pool, mask)
    except SimulationError:
        return "refused"
    return "done"


def reset(rng, pools, spec, starts):
    """Two sets of start values, so that some come again."""
    values = np.array([[rng.choice((0.5, -0.2)) for _ in range(COUNT)] for _ in starts])
    values = values.reshape(len(starts), COUNT)
    mask = rng.choice((np.array([True, True]), np.array([True, False])))
    pools.all("reset", lambda pool, own: pool.reset(starts, values[:, own], mask[own]))


def step(rng, pools, spec, starts):
    rows = [[rng.uniform(-1, 1) for _ in range(COUNT)] for _ in spec.inputs]
    values = np.array(rows).reshape(len(spec.inputs), COUNT)
    pools.all("step", lambda pool, own: pool.step(values[:, own]))


def save(rng, pools, spec, starts):
    if pools.sound and pools.can_save:
        pools.snapshots = [pool.save() for pool in pools.pools]


def restore(rng, pools, spec, starts):
    if pools.snapshots:
        snapshot_of = dict(zip(pools.pools, pools.snapshots, strict=True))
        pools.each("restore", lambda pool, mask: pool.restore(snapshot_of[pool], mask))


def bundle(rng, pools, spec, starts):
    """The serialized state of the first goes to the second, alone to another pool."""
    if pools.sound and pools.can_serialize:
        together, first, second = pools.pools
        zero, one = np.array([0]), np.array([1])
        together.restore_instances(together.save_instances(zero), zero, one)
        second.restore_instances(first.save_instances(zero), zero, zero)


def write(rng, pools, spec, starts):
    """Inputs may be set between steps."""
    if spec.inputs and pools.sound:
        value = np.full((1, COUNT), rng.uniform(-1, 1))
        pools.all("write", lambda pool, own: pool.write(spec.inputs[:1], value[:, own]))


def read(rng, pools, spec, starts):
    if pools.sound:
        together, *alone = (pool.read(spec.outputs) for pool in pools.pools)
        require(np.hstack(alone).tolist() == together.tolist(), f"read: {alone} and {together}")


ACTIONS = (*(step,) * 8, *(reset,) * 3, save, restore, restore, bundle, write, read)


def play(rng, system, versions):
    fmu = system.as_fmu()
    spec = spec_of(rng, fmu, versions)
    starts = tuple(fmu.variable(f"{n}.x1_0") for n in system.components if rng.random() < 0.5)
    with contextlib.closing(Pools(system, spec)) as pools:
        pools.all("reset", lambda pool, _: pool.reset((), np.zeros((0, pool.num_instances))))
        for _ in range(CALLS):
            rng.choice(ACTIONS)(rng, pools, spec, starts)


@contextlib.contextmanager
def program():
    """See ``fuzz_driver.run``."""
    with tempfile.TemporaryDirectory() as folder:
        fmus = {v: linear_fmu(Path(folder) / f"linear{v}.fmu", v) for v in (1, 2, 3)}

        def make(rng, own):
            def run():
                play(rng, *make_system(rng, fmus))

            return Case(run)

        yield make


if __name__ == "__main__":
    sys.exit(main(program, __doc__, 400))
