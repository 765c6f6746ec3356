"""The cart-poles of all packages, ready to be measured with the same actions."""

from __future__ import annotations

import math
import shutil
import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import c_limit
import fmpy
import gymnasium as gym
import numpy as np
import numpy.typing as npt
from fmpy.fmi2 import FMU2Slave
from gymnasium.vector import AutoresetMode
from measure import MissingError, Run, Sample, Stopwatch, repeated

import fmugym
from fmugym.pool.c_extension import require_engine

__all__ = [
    "FMUGYM",
    "GYMNASIUM",
    "c_limit_run",
    "environment_run",
    "envpool_run",
    "fmpy_run",
    "fmugym_vector",
    "require_native_pool",
    "vector_run",
]

FMUGYM, GYMNASIUM = "fmugym/CartPole-v0", "CartPole-v1"
STEPS = 64
"""Steps between two readings of the clock; this many different actions repeat."""

PARAMETERS = {"m_pole": 0.1, "max_step": 1.0, "theta_0": math.pi / 2}
"""Parameters of Gymnasium's plant that differ from the FMU's defaults, without the solver."""


def actions(num_envs: int) -> npt.NDArray[np.int64]:
    """Return random actions for ``STEPS`` steps."""
    return np.random.default_rng(0).integers(0, 2, (STEPS, num_envs))


def require_native_pool() -> None:
    """Refuse to measure FMPy by mistake.

    Raises:
        MissingError: If the C extension was not built.
    """
    try:
        require_engine("this benchmark")
    except fmugym.ConfigError:
        raise MissingError("not built") from None


# One environment


def environment_run(env: gym.Env[Any, Any], given: Sequence[Any] | None = None) -> Run:
    """Make a run of steps, with a reset after each episode.

    Args:
        env: The environment.
        given: The actions; None for those of a cart-pole.
    """
    chosen = actions(1)[:, 0].tolist() * 16 if given is None else given
    env.reset(seed=0)

    def block() -> None:
        for action in chosen:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return repeated(block, len(chosen))


def fmpy_run(stack: ExitStack) -> Run:
    """Make a run of FMPy's wrappers as documented: set, step, get; no reward, no episodes."""
    fmu, references = _fmpy_instance(stack)
    force, outputs = [references["f"]], [references[n] for n in ("x", "x_dot", "phi", "phi_dot")]
    forces = [20.0 * action - 10.0 for action in actions(1)[:, 0].tolist()] * 16

    def block() -> None:
        _fmpy_start(fmu, references)
        for index, value in enumerate(forces):
            fmu.setReal(force, [value])
            fmu.doStep(currentCommunicationPoint=0.02 * index, communicationStepSize=0.02)
            fmu.getReal(outputs)

    return repeated(block, len(forces))


def _fmpy_instance(stack: ExitStack) -> tuple[FMU2Slave, dict[str, int]]:
    path = str(fmugym.bundled_fmu("CartPole"))
    description, folder = fmpy.read_model_description(path), fmpy.extract(path)
    stack.callback(shutil.rmtree, folder, ignore_errors=True)
    fmu = FMU2Slave(
        guid=description.guid,
        modelIdentifier=description.coSimulation.modelIdentifier,
        unzipDirectory=folder,
    )
    fmu.instantiate()
    stack.callback(fmu.freeInstance)
    return fmu, {v.name: v.valueReference for v in description.modelVariables}


def _fmpy_start(fmu: FMU2Slave, references: dict[str, int]) -> None:
    fmu.reset()
    fmu.setReal([references[name] for name in PARAMETERS], list(PARAMETERS.values()))
    fmu.setInteger([references["solver"]], [1])
    fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()


# Many environments


def fmugym_vector(num_envs: int, **options: Any) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make a vector environment of this package.

    Raises:
        MissingError: If there is no native pool.
    """
    require_native_pool()
    return gym.make_vec(FMUGYM, num_envs, **options)


def vector_run(env: Any, chosen: Sequence[Any] | None = None) -> Run:
    """Make a run of steps of a vector environment in its autoreset mode.

    A step that only resets an environment, as in ``NEXT_STEP``, is not a transition and does not
    count. In ``DISABLED``, masked resets follow the steps. The clocks stand still while counting.

    Args:
        env: The vector environment.
        chosen: The actions of ``STEPS`` steps; None for those of a cart-pole.
    """
    mode = getattr(env, "metadata", {}).get("autoreset_mode", AutoresetMode.NEXT_STEP)
    block = _step_and_reset_block if mode is AutoresetMode.DISABLED else _step_block
    workers = [process.pid for process in getattr(env, "processes", ())]
    if chosen is None:
        chosen = list(actions(env.num_envs).astype(env.action_space.dtype))
    env.reset(seed=0) if workers else env.reset()
    resetting = 0

    def run(seconds: float) -> Sample:
        nonlocal resetting
        watch, done = Stopwatch(workers), 0
        while watch.wall < seconds:
            ends = block(env, chosen, watch)
            done += env.num_envs * STEPS
            if mode is AutoresetMode.NEXT_STEP:
                done -= sum(ends[:-1]) + resetting
                resetting = ends[-1]
        return watch.sample(done)

    return run


def _step_block(env: Any, chosen: Sequence[Any], watch: Stopwatch) -> list[int]:
    """Step once per action; return how many episodes each step has ended."""
    step, flags = env.step, []
    watch.start()
    for action in chosen:
        _, _, terminated, truncated, _ = step(action)
        flags.append((terminated, truncated))
    watch.stop()
    return [int(np.count_nonzero(one | other)) for one, other in flags]


def _step_and_reset_block(env: Any, chosen: Sequence[Any], watch: Stopwatch) -> list[int]:
    """Step once per action, and reset the environments whose episodes have ended."""
    step, reset = env.step, env.reset
    watch.start()
    for action in chosen:
        _, _, terminated, truncated, _ = step(action)
        ended = terminated | truncated
        if np.count_nonzero(ended):
            reset(options={"reset_mask": ended})
    watch.stop()
    return []


def envpool_run(stack: ExitStack, num_envs: int, threads: int) -> Run:
    """Make a run of EnvPool's cart-pole, which also resets in the next step.

    Raises:
        MissingError: If it is not installed.
    """
    try:
        import envpool
    except ImportError:
        raise MissingError("not installed") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        options = {"num_envs": num_envs, "num_threads": threads, "seed": 0}
        env = envpool.make(GYMNASIUM, env_type="gymnasium", **options)
        stack.callback(env.close)
        return vector_run(_EnvPool(env, num_envs))


class _EnvPool:
    """The attributes that ``vector_run`` needs."""

    def __init__(self, env: Any, num_envs: int) -> None:
        self.num_envs, self.reset, self.step = num_envs, env.reset, env.step
        self.action_space = gym.spaces.MultiDiscrete(np.full(num_envs, 2), dtype=np.int32)


def c_limit_run(num_envs: int, threads: int) -> Run:
    """Make a run of the C program that only steps the FMU.

    Raises:
        MissingError: If there is no compiler, or there are more threads than environments.
    """
    if threads > num_envs:
        raise MissingError("-")
    c_limit.build()

    def run(seconds: float) -> Sample:
        rates = c_limit.measure(c_limit.cart_pole(), num_envs, threads, seconds)
        return Sample(rates.wall * seconds, seconds, rates.wall * seconds / rates.cpu)

    return run
