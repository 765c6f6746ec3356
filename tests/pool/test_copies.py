"""Snapshots of FMUs that can copy their state but not serialize it."""

import copy
import os
import pickle
import re
import signal

import fmu_tools
import numpy as np
import pytest
from combinations import in_turn
from hypothesis import settings
from hypothesis.stateful import run_state_machine_as_test
from test_snapshot_machine import Machine
from test_snapshots import ACTIONS, POOLS, Track, play, play_vector
from ways import in_way
from zoo_tools import resident_bytes

import fmugym
from fmugym import SimulationError
from fmugym.pool.states import SaveMethod

pytestmark = pytest.mark.usefixtures("trials")  # which find out that copies work

VERSIONS = ("2.0", "3.0")


@pytest.fixture(scope="module", name="paths")
def fixture_paths(tmp_path_factory):
    """The pendulum, which says that it cannot serialize, by version of FMI."""
    folder, paths = tmp_path_factory.mktemp("copying"), {}
    for version in VERSIONS:
        files = fmu_tools.read_fmu(fmugym.bundled_fmu("Pendulum", version))
        text = files["modelDescription.xml"].decode()
        text, count = re.subn(r'canSerializeFMU[sS]tate="true"', "", text)
        assert count == 1
        files["modelDescription.xml"] = text.encode()
        paths[version] = fmu_tools.write_fmu(folder / version / "Copying.fmu", files)
    return paths


@pytest.fixture(name="copying")
def fixture_copying(paths):
    """A class of environments of this FMU."""

    class Copying(Track):
        def __init__(self, fmi_version="2.0", backend=None, isolation=None, **changes):
            changes = {"max_episode_steps": 40} | changes
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(fmugym, "bundled_fmu", lambda _, version="2.0": paths[version])
                super().__init__(fmi_version, backend, isolation=isolation, **changes)

    return Copying


def begin(env, steps=10):
    env.reset(seed=7)
    for action in ACTIONS[:steps]:
        env.step(action)
    return env


def steps_of(env):
    """The communication steps that the FMU has done in all episodes."""
    return int(np.sum(env.health["steps"]))


@in_turn({"version": VERSIONS, "pool": list(POOLS)})
def test_restored_episodes_are_equal(copying, pool, version):
    options = POOLS[pool]
    with copying(version, **options) as env:
        snapshot = begin(env).save_state()
        assert snapshot.method is SaveMethod.COPY
        expected = play(env)
        for _ in range(3):
            env.restore_state(snapshot)
            assert play(env) == expected


@pytest.mark.parametrize("pool", POOLS)
def test_nothing_is_played_again(copying, pool):
    with copying(**POOLS[pool]) as env:
        snapshot = begin(env).save_state()
        env.restore_state(snapshot)
        before = steps_of(env)
        for _ in range(20):
            env.restore_state(snapshot)
        assert steps_of(env) == before


@pytest.mark.parametrize("pool", POOLS)
def test_other_environments_play_it_again(copying, pool):
    with copying() as env, copying(**POOLS[pool]) as other:
        snapshot = begin(env).save_state()
        expected = play(env)
        loaded = pickle.loads(pickle.dumps(snapshot))
        assert loaded.method is SaveMethod.REPLAY
        assert loaded == snapshot
        for one in (snapshot, loaded):
            other.restore_state(one)
            assert play(other) == expected


def test_in_a_vector_environment(copying, vector_of):
    envs = vector_of(copying, 4)
    begin(envs, 0)
    for action in ACTIONS[:6]:
        envs.step(np.repeat(action[None], 4, axis=0) * np.linspace(0.2, 1, 4)[:, None])
    snapshot = envs.save_state()
    assert snapshot.method is SaveMethod.COPY
    envs.restore_state(snapshot)
    before = steps_of(envs)
    envs.restore_state(snapshot[[3, 1]], [3, 1])
    envs.restore_state(snapshot)
    assert steps_of(envs) == before
    envs.restore_state(snapshot[2], [0, 2])  # environment 0 gets the episode of another one
    assert steps_of(envs) == before + 6
    first = play_vector(envs, 0)
    envs.restore_state(snapshot[2], [1, 3])
    assert play_vector(envs, 1) == first


def test_candidates_and_deep_copies(copying, vector_of):
    with copying() as env:
        snapshot = begin(env).save_state()
        envs = vector_of(copying, 8)
        actions = np.random.default_rng(0).uniform(-0.01, 0.01, (8, 5, 1)).astype(np.float32)
        found = envs.rollout(snapshot, actions)
        twin = copy.deepcopy(env)
        for step, action in enumerate(actions[3]):
            observation, reward, *_ = env.step(action)
            assert observation.tobytes() == found.observations[3, step].tobytes()
            assert reward == found.rewards[3, step]
            assert twin.step(action)[1] == reward
        twin.close()


def test_after_a_fault_it_is_played_again(copying, caplog):
    """A worker that has died has lost its copies."""
    with copying(isolation="process", on_fault="truncate") as env:
        snapshot = begin(env).save_state()
        expected = play(env)
        pool = env.pool
        os.kill(pool.processes()[0], signal.SIGKILL)
        with pytest.raises((SimulationError, AssertionError)):
            assert not env.step(ACTIONS[0])[3]
        env.restore_state(snapshot)
        assert play(env) == expected


@pytest.mark.parametrize("hooks", ["arrays", "one by one"])
def test_any_order(copying, hooks):
    body = {"make": copying, "make_many": staticmethod(in_way(hooks, copying))}
    machine = type("Own", (Machine,), body)
    limits = settings(max_examples=15, stateful_step_count=25, deadline=None)
    run_state_machine_as_test(machine, settings=limits)


def test_no_growth_over_many_snapshots(copying):
    with copying() as env:
        begin(env)
        kept = [env.save_state() for _ in range(10)]
        for round_ in range(21):
            if round_ == 1:
                before = resident_bytes()
            for _ in range(1000):
                kept[round_ % 10] = env.save_state()
                env.restore_state(kept[0])
        assert resident_bytes() - before < 2e6
