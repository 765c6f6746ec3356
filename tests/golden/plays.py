"""Plays of environments: what a step and a reset give, as rows of plain numbers.

A row is a dict of quantities: observation, reward, terminated, truncated and info. An info holds
numbers by name; in the place of a text, such as the reason of a fault, is the word ``"text"``. That
of a vector environment is a list with one info for each environment, in which Gymnasium's masks
(``_drawn``) are applied. So a row does not depend on the form of Gymnasium's dicts and arrays.
"""

from contextlib import closing

import numpy as np
from gymnasium import spaces

import fmugym

NUM_ENVS = 5
MODES = ("next_step", "same_step", "disabled")


def plain(value):
    """Numbers of any form: a number, a list, or a dict of these."""
    if isinstance(value, dict):
        return {str(name): plain(value[name]) for name in sorted(value, key=str)}
    if isinstance(value, str):
        return "text"
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [plain(one) for one in value]
    return (np.asarray(value, np.float64) + 0.0).tolist()  # a zero has no sign


def of_each(infos, count=NUM_ENVS):
    """The info of each environment of a vector environment."""
    return [_of_one(infos, index) for index in range(count)]


def _of_one(infos, index):
    found = {}
    for name, value in infos.items():
        mask = infos.get(f"_{name}")
        if name.startswith("_") or (mask is not None and not mask[index]):
            continue
        found[name] = _of_one(value, index) if isinstance(value, dict) else plain(value[index])
    return found


def reset_row(observation, info):
    """The row of a reset."""
    return {"observation": plain(observation), "info": info}


def step_row(observation, reward, terminated, truncated, info):
    """The row of a step."""
    names = ("observation", "reward", "terminated", "truncated")
    values = map(plain, (observation, reward, terminated, truncated))
    return {**dict(zip(names, values, strict=True)), "info": info}


def failure_row(error):
    """The row of a call that has raised an error of the package: its class."""
    assert isinstance(error, fmugym.FMUGymError)
    return {"error": type(error).__name__}


def action_in(space, rng):
    """A random action; its numbers are numpy's, not those of Gymnasium's sampling."""
    if isinstance(space, spaces.Discrete):
        return space.start + rng.integers(space.n)
    if isinstance(space, spaces.MultiDiscrete):
        return rng.integers(space.nvec)
    if isinstance(space, spaces.MultiBinary):
        return rng.integers(0, 2, space.shape, dtype=np.int8)
    return rng.uniform(space.low, space.high).astype(space.dtype)


def actions_in(space, rng, count=NUM_ENVS):
    """Random actions of a vector environment."""
    return np.stack([action_in(space, rng) for _ in range(count)])


def single(env, seeds=(5, None), steps=25, options=None):
    """Play an episode for each seed, of so many steps at most.

    Args:
        env: The environment, which is closed afterwards.
        seeds: For ``reset``.
        steps: The largest number of steps of an episode.
        options: Those of each reset.
    """
    rng = np.random.default_rng(3)
    with closing(env):
        for seed in seeds:
            observation, info = env.reset(seed=seed, options=options)
            yield reset_row(observation, plain(info))
            for _ in range(steps):
                try:
                    *result, info = env.step(action_in(env.action_space, rng))
                except fmugym.FMUGymError as error:
                    yield failure_row(error)
                    break
                yield step_row(*result, plain(info))
                if result[2] or result[3]:
                    break


def vector(envs, seed=7, steps=22, options=None):
    """Play steps of a vector environment, two of which are reset in the fourth step.

    In the mode ``disabled``, environments whose episodes have ended are reset at once. After an
    error, all are.
    """
    rng = np.random.default_rng(3)
    space = envs.single_action_space
    with closing(envs):
        yield _reset_row_of(envs.reset(seed=seed, options=options))
        for count in range(steps):
            if count == 3:
                yield _masked(envs, np.arange(NUM_ENVS) % 2 == 1)
            try:
                *result, infos = envs.step(actions_in(space, rng))
            except fmugym.FMUGymError as error:
                yield failure_row(error)
                yield _reset_row_of(envs.reset())
                continue
            yield step_row(*result, of_each(infos))
            ended = result[2] | result[3]
            if ended.any() and envs.metadata["autoreset_mode"].name == "DISABLED":
                yield _masked(envs, ended)


def _reset_row_of(result):
    return reset_row(result[0], of_each(result[1]))


def _masked(envs, mask):
    return _reset_row_of(envs.reset(options={"reset_mask": mask}))


def labelled(label, rows):
    """The same rows with the name of a scene, where a case has several."""
    return [{"scene": label, **row} for row in rows]
