"""The contract of environments: laws that hold for every task, alone and in a vector environment.

``contract_cases.py`` has the tasks. Each law holds in every way of calling their hooks and in every
mode of autoreset. Episodes that nobody starts again are started by the tests.
"""

import copy
import logging
from collections.abc import Mapping
from itertools import islice, product

import gymnasium as gym
import numpy as np
import pytest
from contract_cases import CASES
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_tools import require_equal, require_same_infos
from ways import EXPRESSIONS, in_way

from fmugym.environment.vector import FMUVectorEnv

COUNT, STEPS = 3, 30
ALONE = "alone"
MODES = tuple(mode.name for mode in AutoresetMode)
DISABLED = AutoresetMode.DISABLED.name
READINGS = (
    *("action", "previous_action", "state", "previous_state", "inputs"),
    *("step_count", "done", "time", "variables", "parameters"),
)


def of_cases(*modes, alone=False, **wanted):
    """Parametrize a law with cases, ways of calling their hooks, and modes of autoreset.

    Args:
        modes: Those in which each way is tried.
        alone: Whether single environments are tried, too.
        wanted: What cases must have, by the names of attributes of ``Case``.
    """
    rows = []
    for name, case in CASES.items():
        if all(getattr(case, attribute) == value for attribute, value in wanted.items()):
            cells = [(ALONE, None)] if alone else []
            cells += product(case.ways, modes)
            rows += [
                pytest.param(case, way, mode, id="-".join(filter(None, (name, way, mode))))
                for way, mode in cells
            ]
    return pytest.mark.parametrize(("case", "way", "mode"), rows)


@pytest.fixture(autouse=True)
def quiet():
    """Faults are logged as warnings, of which there are many here."""
    logging.disable(logging.WARNING)
    yield
    logging.disable(logging.NOTSET)


@pytest.fixture(name="made")
def fixture_made(opened):
    """Make environments of cases that are closed after the test."""

    def make(case, way, mode, **options):
        if way == ALONE:
            return opened(case.make())
        make = in_way(None if way == EXPRESSIONS else way, case.make)
        envs = opened(FMUVectorEnv(make, COUNT, autoreset_mode=mode, **options))
        assert envs.task.way == way
        return envs

    return make


def actions_for(case, env, steps=STEPS, seed=1):
    """An action of each step, for a single environment or for many; some lead to faults."""
    env.action_space.seed(seed)
    actions = [env.action_space.sample() for _ in range(steps)]
    if case.usual is None:
        return actions
    rng = np.random.default_rng(seed)
    shape = np.shape(actions)[: np.ndim(actions) - np.ndim(case.usual)]
    is_wrong = (rng.random(shape) < 0.15)[(...,) + (None,) * np.ndim(case.usual)]
    varied = case.usual * (rng.integers(1, 4, shape) / 2)[(...,) + (None,) * np.ndim(case.usual)]
    chosen = np.where(is_wrong, case.disturbing, varied)
    return list(chosen.astype(np.asarray(case.usual).dtype))


def started(env, ended):
    """Start episodes again that do not start by themselves, as the results of a reset."""
    if not np.any(ended):
        return
    if isinstance(env, gym.Env):
        yield env.reset()
    elif env.metadata["autoreset_mode"] is AutoresetMode.DISABLED:
        yield env.reset(options={"reset_mask": ended})


def going_on(env, actions):
    """What an environment returns from now on."""
    for action in actions:
        result = env.step(action)
        ended = np.array(result[2]) | np.array(result[3])
        yield result
        yield from started(env, ended)


def played(env, actions, seed=3):
    """The same from a reset on."""
    yield env.reset(seed=seed)
    yield from going_on(env, actions)


def require_same(first, second):
    """Equal to the last bit, with the same types, keys and shapes."""
    if isinstance(first, Mapping):
        assert list(first) == list(second)
        first, second = tuple(first.values()), tuple(second.values())
    if isinstance(first, tuple) or getattr(first, "dtype", None) == object:
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            require_same(one, other)
    else:
        require_equal(first, second)


def require_same_runs(first, second):
    """Two runs that return the same, and in which an episode ends."""
    ends = 0
    for one, other in zip(first, second, strict=True):
        require_same(one, other)
        ends += int(np.sum(one[2]) + np.sum(one[3])) if len(one) == 5 else 0
    assert ends > 0


def of_one(value, index):
    """The part of results that belongs to one of many environments."""
    if isinstance(value, Mapping):
        masks = {name: value.get(f"_{name}") for name in value if not name.startswith("_")}
        told = (name for name, mask in masks.items() if mask is None or mask[index])
        return {name: of_one(value[name], index) for name in told}
    if isinstance(value, tuple):
        return tuple(of_one(part, index) for part in value)
    return value[index]


def readings(envs):
    """What attributes of the environments tell."""
    return {name: envs.get_attr(name) for name in READINGS}


def close(first, second, rtol):
    """Whether readings are equal, but for how numbers of Python and of numpy are rounded."""
    if isinstance(first, Mapping):
        parts = [(first[name], second[name]) for name in first]
        return first.keys() == second.keys() and all(close(*pair, rtol) for pair in parts)
    if isinstance(first, tuple):
        pairs = zip(first, second, strict=True)
        return len(first) == len(second) and all(close(*pair, rtol) for pair in pairs)
    return np.allclose(first, second, rtol=rtol, atol=rtol, equal_nan=True)


def without_instances(infos):
    """The infos of a step, without the name of the instance of the FMU in the text of a fault."""
    for one in (infos, infos.get("final_info", {})):
        if "fault" in one:
            texts = [text and text.split(": ", 1)[-1] for text in one["fault"]]
            one["fault"] = np.array(texts, object)
    return infos


@of_cases(*MODES)
def test_each_environment_of_many_is_what_it_is_alone(case, way, mode, made, opened):
    """Gymnasium's ``SyncVectorEnv`` starts the episodes of the single ones."""
    ours = made(case, way, mode)
    theirs = opened(SyncVectorEnv([case.make] * COUNT, autoreset_mode=AutoresetMode[mode]))
    actions = actions_for(case, ours)
    ends = faults = 0
    results = zip(played(ours, actions), played(theirs, actions), strict=True)
    for number, (mine, other) in enumerate(results):
        for one, its in zip(mine[:-1], other[:-1], strict=True):
            require_equal(one, its, case.rtol)
        infos = without_instances(mine[-1])
        require_same_infos(infos, without_instances(other[-1]), case.rtol)
        if number % 5 == 4:  # and not always, because what nobody asks for is not computed
            assert close(readings(ours), readings(theirs), case.rtol)
        if len(mine) == 5:
            ends += int(np.sum(mine[2] | mine[3]))
            faults += np.count_nonzero(infos.get("final_info", infos).get("_fault", False))
    assert ends > COUNT
    assert (faults > 0) == case.has_faults
    for name in ("discards", "not_finite"):
        assert ours.health[name].tolist() == [env.health[name] for env in theirs.envs]


@of_cases(*MODES, alone=True)
def test_the_same_seed_repeats_everything(case, way, mode, made):
    """Also in the environment that has played before."""
    env, twin = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, env)
    for _ in played(twin, actions[:7], seed=8):
        pass
    require_same_runs(played(env, actions), played(twin, actions))


@of_cases(MODES[0], alone=True, draws=True)
def test_another_seed_draws_something_else(case, way, mode, made):
    env = made(case, way, mode)
    first, other = (copy.deepcopy(env.reset(seed=seed)[-1]["drawn"]) for seed in (3, 103))
    assert first.keys() == other.keys()
    assert any(np.any(first[name] != other[name]) for name in first if name[0] != "_")


@of_cases(*MODES, alone=True, can_save=True)
def test_an_episode_goes_on_from_its_snapshot_as_it_did(case, way, mode, made):
    """In another environment that was never reset, and in the one that has gone on."""
    env, other = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, env)
    steps = played(env, actions)
    list(islice(steps, 5))
    snapshot = env.save_state()
    went_on = copy.deepcopy(list(going_on(env, actions[5:])))
    other.restore_state(snapshot)
    require_same_runs(going_on(other, actions[5:]), went_on)
    env.restore_state(snapshot)
    require_same_runs(going_on(env, actions[5:]), went_on)


@of_cases(DISABLED, can_save=True)
def test_a_rollout_gives_what_steps_give(case, way, mode, made, opened):
    """From the present episodes, which go on afterwards as if it had not been."""
    envs, single = made(case, way, mode), opened(case.make())
    actions = actions_for(case, envs)
    list(islice(played(envs, actions), 2))
    snapshot = envs.save_state()
    candidates = [[of_one(step, index) for step in actions[2:]] for index in range(COUNT)]
    if isinstance(actions[0], Mapping):
        pytest.skip("rollouts take actions that make one array")
    found = envs.rollout(None, np.array(candidates))
    assert envs.save_state() == snapshot
    for index, candidate in enumerate(candidates):
        single.restore_state(snapshot[index])
        length = 0
        over = False
        while not over:
            observation, *numbers, _ = single.step(candidate[length])
            require_equal(of_one(of_one(found.observations, index), length), observation, case.rtol)
            told = found.rewards, found.terminated, found.truncated
            assert close(tuple(part[index, length] for part in told), tuple(numbers), case.rtol)
            length += 1
            over = any(numbers[1:])
        assert found.lengths[index] == length


def disturbed(actions, case, number, index=1):
    """Actions of which one leads to a fault of one environment."""
    given = [np.array(action) for action in actions]
    given[number][index] = case.disturbing
    return given


FAULTY_STEP = 2


def has_usual(case):
    """Whether an action of the case leads to a fault."""
    return case.usual is not None


DISTURBED = {name: case for name, case in CASES.items() if has_usual(case)}


@pytest.mark.parametrize(
    ("case", "way", "mode"),
    [
        pytest.param(case, way, mode, id=f"{name}-{way}-{mode}")
        for name, case in DISTURBED.items()
        for way, mode in product(case.ways, MODES)
    ],
)
def test_a_fault_ends_one_episode_and_no_other(case, way, mode, made):
    """The others are those of a run without the fault; the one has its last good observation."""
    envs, twin = made(case, way, mode), made(case, way, mode)
    usual = [np.stack([case.usual] * COUNT)] * 9
    given = disturbed(usual, case, FAULTY_STEP)
    others = [0, 2]
    before = None
    with_fault, without = played(envs, given), played(twin, usual)
    for number, (result, undisturbed) in enumerate(zip(with_fault, without, strict=False), -1):
        for index in others:
            require_same(of_one(result, index), of_one(undisturbed, index))
        if number == FAULTY_STEP:
            break
        before = result[0]
    policy = envs.prototype.config.on_fault
    assert [bool(flag[1]) for flag in result[2:4]] == [policy == "terminate", policy == "truncate"]
    told = result[4].get("final_info", result[4])
    assert told["_fault"].tolist() == [False, True, False]
    last = result[4]["final_obs"] if "final_obs" in result[4] else result[0]
    require_equal(of_one(last, 1), of_one(before, 1))
    assert result[1][1] == envs.prototype.config.fault_reward


@of_cases(*MODES, alone=True)
def test_what_a_caller_holds_does_not_change(case, way, mode, made):
    """Whether it is read at once or after all steps."""
    env, twin = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, env)
    kept = list(played(env, actions))
    require_same_runs(kept, [copy.deepcopy(result) for result in played(twin, actions)])


@of_cases(*MODES, alone=True)
def test_what_a_caller_changes_does_not_come_back(case, way, mode, made):
    """Neither in results nor in actions."""
    careful, careless = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, careful)

    def spoiling():
        given = [copy.deepcopy(action) for action in actions]
        for number, result in enumerate(played(careless, given)):
            yield copy.deepcopy(result)
            for array in arrays_of((result, given[:number])):
                if array.flags.writeable:
                    array[...] = None if array.dtype == object else 1

    require_same_runs(played(careful, actions), spoiling())


def arrays_of(value):
    """All arrays of results."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, (tuple, list)):
        return [array for part in value for array in arrays_of(part)]
    return [value] if isinstance(value, np.ndarray) else []


@of_cases(DISABLED)
def test_a_reset_with_a_mask_leaves_the_others_as_they_are(case, way, mode, made):
    envs, twin = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, envs, 8)
    results = [list(islice(played(env, actions), 2)) for env in (envs, twin)]
    seen = results[0][-1][0]
    before = readings(envs)
    mask = np.array([False, True, False])
    again, infos = envs.reset(options={"reset_mask": mask})
    assert infos.get("_drawn", mask).tolist() == mask.tolist()
    after = readings(envs)
    for index in (0, 2):
        require_equal(of_one(again, index), of_one(seen, index))
        assert close(of_one(after, index), of_one(before, index), 0.0)
    assert after["step_count"][1] == 0
    steps = 0
    for action in actions[2:]:
        one, other = envs.step(action), twin.step(action)
        for index in (0, 2):
            require_same(of_one(one, index), of_one(other, index))
        steps += 1
        if np.any([flag for result in (one, other) for flag in result[2:4]]):
            break
    assert steps > 0
