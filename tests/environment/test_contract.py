"""The contract of environments: laws that hold for every task, alone and in a vector environment.

``contract_cases.py`` has the tasks. Each law holds in every way of calling their hooks and in every
mode of autoreset. Episodes that nobody starts again are started by the tests.
"""

import copy
import itertools
import logging
from collections.abc import Mapping
from itertools import islice

import gymnasium as gym
import numpy as np
import pytest
from contract_cases import CASES
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array
from vector_tools import of_one, require_equal, require_same_infos
from ways import EXPRESSIONS, in_way

from fmugym.environment.vector import FMUVectorEnv
from fmugym.environment.vector.env_maker import make_with_pool

COUNT, STEPS = 3, 30
ALONE = "alone"
MODES = tuple(mode.name for mode in AutoresetMode)
DISABLED = AutoresetMode.DISABLED.name
READINGS = (
    *("action", "previous_action", "state", "previous_state", "inputs"),
    *("step_count", "done", "time", "variables", "parameters"),
)


def is_any(case):
    """Every case."""
    return True


def of_cases(wanted=is_any, *, in_all_modes=False, modes=MODES, alone=False):
    """Parametrize a law with cases, ways of calling their hooks, and modes of autoreset.

    Args:
        wanted: Whether the law is for a case.
        in_all_modes: Each way is tried in all modes. Otherwise, these take turns.
        modes: Of autoreset.
        alone: Whether single environments are tried, too.
    """
    turns, rows = itertools.cycle(modes), []
    for name, case in CASES.items():
        cells = [(ALONE, None)] if alone else []
        for way in case.ways:
            cells += [(way, mode) for mode in (modes if in_all_modes else [next(turns)])]
        if wanted(case):
            rows += [
                pytest.param(case, *cell, id="-".join(map(str, (name, *cell)))) for cell in cells
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


def actions_for(case, env, seed=1):
    """An action of each step, for a single environment or for many; some lead to faults."""
    steps = STEPS if isinstance(env, gym.vector.VectorEnv) else COUNT * STEPS
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


def going_on(env, actions, ended=False):
    """What an environment returns from now on, where episodes may have ended."""
    yield from started(env, ended)
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
    """Equal to the last bit, with the same types, keys and shapes.

    The text of a fault names an instance of the FMU, and its rate counts earlier episodes.
    """
    if isinstance(first, Mapping):
        assert first.keys() == second.keys()
        told = [name for name in first if name not in ("fault", "fault_rate")]
        first, second = (tuple(one[name] for name in told) for one in (first, second))
    if isinstance(first, (tuple, list)) or getattr(first, "dtype", None) == np.dtype("O"):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            require_same(one, other)
    elif first is None or isinstance(first, str):
        assert first == second
    else:
        require_equal(first, second)


def require_same_runs(first, second):
    """Two runs that return the same, and in which an episode ends."""
    ends = 0
    for one, other in zip(first, second, strict=True):
        require_same(one, other)
        ends += int(np.sum(one[2]) + np.sum(one[3])) if len(one) == 5 else 0
    assert ends > 0


def readings(env):
    """What attributes tell, of a single environment or of many."""
    read = getattr if isinstance(env, gym.Env) else type(env).get_attr
    return {name: taken(read(env, name)) for name in READINGS}


def taken(value):
    """A copy, also of mappings that show the present values."""
    if isinstance(value, Mapping):
        return {name: taken(part) for name, part in value.items()}
    return tuple(map(taken, value)) if isinstance(value, tuple) else copy.copy(value)


def of_space(space, observation):
    """An observation in the types of its space, as Gymnasium stores it."""
    return of_one(concatenate(space, [observation], create_empty_array(space, 1)), 0)


def close(first, second, rtol):
    """Whether readings are equal, but for how numbers of Python and of numpy are rounded."""
    if isinstance(first, Mapping):
        parts = [(first[name], second[name]) for name in first]
        return first.keys() == second.keys() and all(close(*pair, rtol) for pair in parts)
    if isinstance(first, tuple):
        pairs = zip(first, second, strict=True)
        return len(first) == len(second) and all(close(*pair, rtol) for pair in pairs)
    return np.allclose(first, second, rtol=rtol, atol=rtol, equal_nan=True)


def with_plain_faults(infos):
    """The infos of a step, in which a fault names no instance of the FMU and no numbers."""
    for one in (infos, infos.get("final_info", {})):
        if "fault" in one:
            texts = [text and text.split(": ", 1)[-1] for text in one["fault"]]
            plain = [text and text.partition("array(")[0] for text in texts]
            one["fault"] = np.array(plain, object)
    return infos


@of_cases(in_all_modes=True)
def test_each_environment_of_many_is_what_it_is_alone(case, way, mode, made, opened):
    """Gymnasium's ``SyncVectorEnv`` starts the episodes of the single ones."""
    ours = made(case, way, mode)
    theirs = opened(SyncVectorEnv([case.make] * COUNT, autoreset_mode=AutoresetMode[mode]))
    actions = actions_for(case, ours)
    rtol = 0.0 if way == EXPRESSIONS else case.rtol
    ends = faults = 0
    results = zip(played(ours, actions), played(theirs, actions), strict=True)
    for number, (mine, other) in enumerate(results):
        for one, its in zip(mine[:-1], other[:-1], strict=True):
            require_equal(one, its, rtol)
        for index in np.flatnonzero(other[-1].get("_final_obs", ())):
            last = other[-1]["final_obs"]
            last[index] = of_space(ours.single_observation_space, last[index])
        infos = with_plain_faults(mine[-1])
        if number == 0:
            assert ours.observation_space.contains(mine[0])
        require_same_infos(infos, with_plain_faults(other[-1]), rtol)
        if number % 5 == 4:  # and not always, because what nobody asks for is not computed
            assert close(readings(ours), readings(theirs), rtol)
            assert {type(flag) for flag in ours.get_attr("done")} == {bool}
        if len(mine) == 5:
            ends += int(np.sum(mine[2] | mine[3]))
            faults += np.count_nonzero(infos.get("final_info", infos).get("_fault", False))
    assert ends > 0
    assert (faults > 0) == case.has_faults
    for name in ("discards", "not_finite"):
        assert ours.health[name].tolist() == [env.health[name] for env in theirs.envs]


@of_cases(lambda case: case.can_save, alone=True)
def test_the_same_seed_repeats_everything(case, way, mode, made):
    """Also in the environment that has played before."""
    env, twin = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, env)
    for _ in played(twin, actions[:7], seed=8):
        pass
    require_same_runs(played(env, actions), played(twin, actions))


@of_cases(lambda case: case.draws, alone=True)
def test_another_seed_draws_something_else(case, way, mode, made):
    env = made(case, way, mode)
    first, other = (copy.deepcopy(env.reset(seed=seed)[-1]["drawn"]) for seed in (3, 103))
    assert first.keys() == other.keys()
    assert any(np.any(first[name] != other[name]) for name in first if name[0] != "_")


@of_cases(lambda case: case.can_save, alone=True)
def test_an_episode_goes_on_from_its_snapshot_as_it_did(case, way, mode, made):
    """In another environment that was never reset, and in the one that has gone on."""
    env, other = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, env)
    *_, last = islice(played(env, actions), 4)
    ended = np.array(last[2]) | np.array(last[3]) if len(last) == 5 else False
    snapshot = env.save_state()
    told = readings(env)
    went_on = copy.deepcopy(list(going_on(env, actions[4:], ended)))
    for one in (other, env):
        one.restore_state(snapshot)
        assert close(readings(one), told, 0.0)
        require_same_runs(going_on(one, actions[4:], ended), went_on)


@of_cases(lambda case: case.can_save and case.has_one_action, modes=[DISABLED])
def test_a_rollout_gives_what_steps_give(case, way, mode, made):
    """From the present episodes, which go on afterwards as if it had not been."""
    envs = made(case, way, mode)
    actions = actions_for(case, envs)
    *_, last = islice(played(envs, actions), 2)
    list(started(envs, last[2] | last[3]))
    snapshot = envs.save_state()
    found = envs.rollout(None, np.stack(actions[2:], axis=1))
    assert envs.save_state() == snapshot
    assert found.lengths.min() < len(actions) - 2
    for number, action in enumerate(actions[2:]):
        *result, _ = envs.step(action)
        for index in np.flatnonzero(found.lengths > number):
            rolled = tuple(of_one(of_one(part, index), number) for part in found[:4])
            require_same(rolled, tuple(of_one(part, index) for part in result))
        ended = result[2] | result[3]
        assert ended[found.lengths == number + 1].all() or number + 1 == len(actions) - 2
        list(started(envs, ended))


FAULTY = 1
"""The environment, and the step counted from zero."""


@of_cases(lambda case: case.usual is not None, in_all_modes=True)
def test_a_fault_ends_one_episode_and_no_other(case, way, mode, made):
    """The others are those of a run without the fault."""
    envs, twin = made(case, way, mode), made(case, way, mode)
    usual = [np.stack([case.usual] * COUNT) for _ in range(9)]
    given = copy.deepcopy(usual)
    given[FAULTY][FAULTY] = case.disturbing
    runs = (played(envs, given), played(twin, usual))
    runs = [[result for result in run if len(result) == 5] for run in runs]
    for result, undisturbed in zip(*runs, strict=True):
        for index in set(range(COUNT)) - {FAULTY}:
            require_same(of_one(result, index), of_one(undisturbed, index))
    _, rewards, *ends, infos = runs[0][FAULTY]
    config = envs.prototype.config
    policies = {"terminate": [True, False], "truncate": [False, True]}
    assert [flags[FAULTY] for flags in ends] == policies[config.on_fault]
    assert rewards[FAULTY] == config.fault_reward
    told = infos.get("final_info", infos)
    assert told["_fault"].tolist() == [index == FAULTY for index in range(COUNT)]


@of_cases(alone=True)
def test_what_a_caller_holds_does_not_change(case, way, mode, made):
    """Whether it is read at once or after all steps."""
    env, twin = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, env)
    kept = list(played(env, actions))
    require_same_runs(kept, [copy.deepcopy(result) for result in played(twin, actions)])


@of_cases(alone=True)
def test_what_a_caller_changes_does_not_come_back(case, way, mode, made):
    """Neither in actions nor in results, but a single environment returns arrays of its hooks."""
    careful, careless = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, careful)

    used = []

    def given():
        for action in actions:
            used.append(copy.deepcopy(action))
            yield used[-1]

    def spoiled():
        for result in played(careless, given()):
            yield copy.deepcopy(result)
            for array in arrays_of(used if way == ALONE else (result, used)):
                array[...] = None if array.dtype == object else 1

    require_same_runs(played(careful, actions), spoiled())
    assert close(readings(careful), readings(careless), 0.0)


def arrays_of(value):
    """All arrays of results."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, (tuple, list)):
        return [array for part in value for array in arrays_of(part)]
    return [value] if isinstance(value, np.ndarray) else []


@of_cases(modes=[DISABLED])
def test_a_reset_with_a_mask_leaves_the_others_as_they_are(case, way, mode, made):
    envs, twin = made(case, way, mode), made(case, way, mode)
    actions = actions_for(case, envs)
    *_, last = (list(islice(played(env, actions), 2))[-1] for env in (twin, envs))
    mask, others = np.array([False, True, False]), (0, 2)
    before = readings(envs)
    again, infos = envs.reset(options={"reset_mask": mask})
    assert infos.get("_drawn", mask).tolist() == mask.tolist()
    after = readings(envs)
    assert after["step_count"][1] == 0
    for index in others:
        require_equal(of_one(again, index), of_one(last[0], index))
        for name in READINGS:
            assert close(after[name][index], before[name][index], 0.0)
    ended = last[2] | last[3]
    for env in (envs, twin):
        list(started(env, ended & ~mask if env is envs else ended))
    for _ in range(2):
        one, other = envs.step(actions[2]), twin.step(actions[2])
        for index in others:
            require_same(of_one(one, index), of_one(other, index))
        for env, result in ((envs, one), (twin, other)):
            list(started(env, result[2] | result[3]))


@of_cases(modes=MODES, alone=True)
def test_worker_processes_change_nothing(case, way, mode, made, opened):
    """Not in the last bit."""
    here = made(case, way, mode)
    if way == ALONE:
        isolated = opened(make_with_pool(case.make, isolation="process"))
    else:
        isolated = made(case, way, mode, isolation="process", workers=2)
    actions = actions_for(case, here)
    require_same_runs(played(isolated, actions), played(here, actions))
    assert close(readings(isolated), readings(here), 0.0)
