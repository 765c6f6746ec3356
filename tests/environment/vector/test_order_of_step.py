"""The step of a native pool in one call equals the step of its parts, over every kind of pool."""

import numpy as np
import pytest
from fmu_tools import probe_config
from vector_tools import require_equal, require_same_infos

from fmugym import Choice, FMI2CSEnv, SimulationError, Uniform, bundled_fmu
from fmugym.envs import CartPoleEnv, HouseEnv

COUNT, STEPS = 5, 120
PENDULUM = {
    "model_input_names": "tau",
    "model_output_names": ["theta", "theta_dot"],
    "model_parameters": {"theta_0": Uniform(-3.0, 3.0), "theta_dot_0": Uniform(-1.0, 1.0)},
    "episode_variables": {"limit": Uniform(1.0, 4.0)},
    "bounds": {"tau": (-2, 2)},
    "time_step": 0.05,
    "max_episode_steps": 25,
    "memory": {"swung": {"start": 0.0, "update": "swung + abs(theta_dot) * 0.05"}},
    "terminated": "swung > limit",
    "reward": "-theta**2 + 0.1 * previous(theta)",
    "info": {"swung": "swung"},
}


def pendulum(**keys):
    return FMI2CSEnv(bundled_fmu("Pendulum"), PENDULUM | keys)


SAMPLED = "observations and infos of a task file"
TASKS = {
    "draws and a limit": lambda _: CartPoleEnv(),
    SAMPLED: lambda _: HouseEnv(),
    "memory and staggered ends": lambda _: pendulum(),
    "a warm-up": lambda _: pendulum(warm_up=0.2),
    "rewards that are not finite, cut short": lambda _: pendulum(
        reward="log(abs(theta_dot) - 0.2)", on_fault="truncate"
    ),
    "rewards that are not finite, with an end": lambda _: pendulum(
        reward="log(abs(theta_dot) - 0.2)", on_fault="terminate", fault_reward=-7.0
    ),
    "an FMU that fails as the limit is reached": lambda probe: FMI2CSEnv(
        probe(),
        probe_config(
            model_parameters={"fault": 3, "fault_step": Choice([3, 4, 6, 9])},
            terminated=False,
            max_episode_steps=6,
        ),
    ),
    "an FMU that asks to stop": lambda probe: FMI2CSEnv(
        probe(),
        probe_config(
            model_parameters={"fault": 6, "fault_step": Choice([2, 3, 5])}, terminated=False
        ),
    ),
}


OTHERS = {"x_0": 0.01, "T_m_0": 290.0, "theta_0": 2.0, "fault": 0}
"""Values of the parameter that some resets set."""


def composed(envs):
    """Let a native pool step as all others do, of its parts: it adds no offsets by itself."""
    envs.task.offsets = np.zeros(len(envs.pool.outputs))


POOLS = {
    "native": ({}, composed),
    "processes": ({"isolation": "process", "workers": 2}, None),
    "rig": ({"backend": "fmpy"}, None),
}


def without_names(infos):
    """The infos of a step, but for who tells of a fault: FMPy's class or the instance."""
    for one in (infos, infos.get("final_info", {})):
        if "fault" in one:
            texts = [text and text.split(": ", 1)[-1] for text in one["fault"]]
            one["fault"] = np.array(texts, object)
    return infos


def told(envs):
    """All results of an episode after another, with resets of some by options in between."""
    rng = np.random.default_rng(4)
    names = [*envs.prototype.config.model_parameters][:1]
    yield envs.reset(seed=2)
    for step in range(STEPS):
        envs.action_space.seed(step)
        result = envs.step(envs.action_space.sample())
        yield result
        waits = envs.metadata["autoreset_mode"].name == "DISABLED"
        ended = result[2] | result[3]
        if waits and ended.any():
            yield envs.reset(options={"reset_mask": ended.copy()})
        elif not waits and step % 40 == 30:
            mask = rng.random(COUNT) < 0.5
            mask[step % COUNT] = True
            values = {"model_parameters": {name: OTHERS[name] for name in names}}
            yield envs.reset(options={"reset_mask": mask, **values})


@pytest.mark.parametrize("mode", ["next_step", "same_step", "disabled"])
@pytest.mark.parametrize(
    ("task", "pool"),
    [
        (task, pool)
        for task in TASKS
        for pool in POOLS
        if (task, pool) != (SAMPLED, "rig")  # FMPy's own classes take no means
    ],
)
def test_one_call_and_its_parts_give_the_same(task, pool, mode, make_envs, probe):
    options, change = POOLS[pool]

    def make():
        return TASKS[task](probe)

    options = {"max_episode_steps": 9} | options
    ours = make_envs(make, COUNT, autoreset_mode=mode, max_episode_steps=9)
    assert ours.task.way == "expressions"
    assert ours.pool.plays_alone
    theirs = make_envs(make, COUNT, autoreset_mode=mode, **options)
    if change is not None:
        change(theirs)
    ends = 0
    for one, other in zip(told(ours), told(theirs), strict=True):
        for left, right in zip(one[:-1], other[:-1], strict=True):
            require_equal(left, right)
        require_same_infos(without_names(one[-1]), without_names(other[-1]))
        require_equal(ours.get_attr("previous_state"), theirs.get_attr("previous_state"))
        require_equal(ours.get_attr("step_count"), theirs.get_attr("step_count"))
        ends += int((one[2] | one[3]).sum()) if len(one) == 5 else 0
    assert ends > 2 * COUNT


@pytest.mark.parametrize("pool", POOLS)
def test_a_reset_of_one_leaves_the_ends_of_others(pool, make_envs):
    """Also one with options, which no pool does by itself."""
    options = {"max_episode_steps": 1, "autoreset_mode": "disabled"} | POOLS[pool][0]
    envs = make_envs(CartPoleEnv, 3, **options)
    envs.reset(seed=1)
    assert envs.step(np.zeros(3, int))[3].all()
    first = np.array([True, False, False])
    envs.reset(options={"reset_mask": first, "model_parameters": {"x_0": 0.01}})
    with pytest.raises(SimulationError, match="environment 1 has ended"):
        envs.step(np.zeros(3, int))
