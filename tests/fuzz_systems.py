"""Random systems: the C extension and Python give the same, bit by bit, whatever is called.

    python tests/fuzz_systems.py --count 400 --seed 0

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
from fmugym.pool import PoolSpec, has_native_pool
from fmugym.pool.bundle import SaveMethod
from fmugym.pool.local import local_pool
from fmugym.pool.spec import ResetMethod

LOG = logging.getLogger("fmugym.test")
NAMES = ("a", "b", "c", "d")
COUNT = 2
CALLS = 25
NO_STATES = 1
"""The version of FMI that cannot save states."""

RUNGS = (ResetMethod.RESTORE, ResetMethod.RESET, ResetMethod.INSTANCE)


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
    if rng.random() < 0.4:
        options |= {"error_tolerance": 10 ** rng.uniform(-4, 0), "min_step_size": 0.01}
    options["loops"] = rng.choice(("newton", "fixed_point"))
    return FMUSystem(parts, connections(rng, names), **options), versions


def spec_of(rng, fmu, versions):
    """What to set, read, and do at a reset."""
    inputs = [v for v in fmu.description.variables.values() if v.causality == "input"]
    outputs = [v for n, v in fmu.description.variables.items() if n[2:4] in {"y1", "y2", "t"}]
    outputs += [v for n, v in fmu.description.variables.items() if n.startswith("master.")]
    able, rungs = fmu.description.capabilities, ()
    if rng.random() < 0.6:
        rungs = tuple(rng.choice(RUNGS[v == NO_STATES :]) for v in versions)
    return PoolSpec(
        tuple(inputs),
        tuple(outputs),
        0.1,
        substeps=rng.choice((1, 1, 2)),
        fault_retries=rng.choice((0, 2)) if able.can_get_and_set_fmu_state else 0,
        reset_method=rng.choice(RUNGS) if not rungs else ResetMethod.INSTANCE,
        component_resets=rungs,
    )


class Twins:
    """The same pool in both engines."""

    def __init__(self, system, spec):
        able = system.as_fmu().description.capabilities
        self.can_serialize = able.can_serialize_fmu_state
        engines = (False, True) if has_native_pool() else (False, False)
        self.pools, self._saved = [], []
        try:
            for native in engines:
                pool = local_pool(system.as_fmu(), spec, COUNT, LOG, native=native)
                pool.save_by(lambda: SaveMethod.STATE)
                self.pools.append(pool)
        except BaseException:
            self.close()
            raise

    def close(self):
        for pool in self.pools:
            pool.close()

    def both(self, what, call):
        """Do the same with both, and compare."""
        found = [self._result(pool, call) for pool in self.pools]
        require(found[0] == found[1], f"{what}: {found[0][:2]!r} and {found[1][:2]!r}")

    def _result(self, pool, call):
        try:
            result = call(pool)
        except SimulationError:
            result = "refused"
        values = pool.outputs.tobytes(), pool.statuses.tobytes()
        told = result.tobytes() if isinstance(result, np.ndarray) else repr(result)
        return told, pool.statuses.tolist(), values


def reset(rng, twins, spec, starts):
    """Two sets of start values, so that some come again."""
    values = np.array([[rng.choice((0.5, -0.2)) for _ in range(COUNT)] for _ in starts])
    values = values.reshape(len(starts), COUNT)
    mask = rng.choice((None, np.array([True, False])))
    twins.both("reset", lambda pool: pool.reset(starts, values, mask) and None)


def step(rng, twins, spec, starts):
    rows = [[rng.uniform(-1, 1) for _ in range(COUNT)] for _ in spec.inputs]
    values = np.array(rows).reshape(len(spec.inputs), COUNT)
    twins.both("step", lambda pool: pool.step(values) and None)


def save(rng, twins, spec, starts):
    snapshots = {}

    def keep(pool):
        snapshots[id(pool)] = pool.save()

    twins.both("save", keep)
    twins.snapshots = snapshots


def restore(rng, twins, spec, starts):
    if len(getattr(twins, "snapshots", {})) == len(twins.pools):
        twins.both("restore", lambda pool: pool.restore(twins.snapshots[id(pool)]) and None)


def bundle(rng, twins, spec, starts):
    """Serialized states of one go to the other instance; those of both engines are alike."""
    one, other = np.array([0]), np.array([1])

    def move(pool):
        if twins.can_serialize and not pool.statuses.any():
            pool.restore_instances(pool.save_instances(one), np.array([0]), other)

    twins.both("bundle", move)


def write(rng, twins, spec, starts):
    """Inputs may be set between steps."""
    if spec.inputs:
        value = np.full((1, COUNT), rng.uniform(-1, 1))
        twins.both("write", lambda pool: pool.write(spec.inputs[:1], value))


def read(rng, twins, spec, starts):
    twins.both("read", lambda pool: pool.read(spec.outputs).copy())


def recycle(rng, twins, spec, starts):
    twins.both("recycle", lambda pool: pool.recycle())


ACTIONS = (*(step,) * 8, *(reset,) * 3, save, restore, restore, bundle, write, read, recycle)


def play(rng, system, versions):
    fmu = system.as_fmu()
    spec = spec_of(rng, fmu, versions)
    starts = tuple(fmu.variable(f"{n}.x1_0") for n in system.components if rng.random() < 0.5)
    with contextlib.closing(Twins(system, spec)) as twins:
        reset(rng, twins, spec, starts)
        for _ in range(CALLS):
            rng.choice(ACTIONS)(rng, twins, spec, starts)


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
