"""Environments whose FMUs run in worker processes: what kills, wakes and interrupts these."""

import os
import signal
from pathlib import Path

import exchange_tools
import numpy as np
import pytest
from process_tools import FaultyEnv, faulty_fmu, linux_only, start_values, wait_until
from test_single_expressions import (
    require_same_steps,
    same,
)
from vector_tools import (
    CART_POLE,
    Drawing,
    require_equal,
)
from ways import in_python, in_way

import fmugym
from fmugym import ConfigError, FMUVectorEnv, SimulationError, _native
from fmugym.pool.engine import Answer, Request, request_listing
from fmugym.pool.native_pool import programs_for
from fmugym.pool.pool_form import form_of_listing
from fmugym.pool.processes.process_pool import ProcessPool


@pytest.fixture(name="make")
def fixture_make(opened):
    def make(cls, num_envs=5, hooks="arrays", workers=2, **options):
        if workers:
            options |= {"isolation": "process", "workers": workers}
        envs = opened(FMUVectorEnv(in_way(hooks, cls), num_envs, **options))
        assert isinstance(envs.pool, ProcessPool) == bool(workers)
        return envs

    return make


class Short(Drawing):
    """Ends often, and begins elsewhere in each episode."""

    def __init__(self):
        super().__init__(max_episode_steps=7)


def test_a_process_that_is_killed(make):
    """The episodes of its block end, and the next step starts them again."""
    isolated, here = make(Short, 4), make(Short, 4, workers=None)
    actions = np.full((4, 1), 0.005, np.float32)
    for envs in (isolated, here):
        envs.reset(seed=2)
        envs.step(actions)
    os.kill(isolated.pool.processes()[0], signal.SIGKILL)
    found, wanted = (envs.step(actions) for envs in (isolated, here))
    assert found[3].tolist() == [True, True, False, False]
    assert "SIGKILL" in found[4]["fault"][0]
    require_equal(found[0][2:], wanted[0][2:])
    found = isolated.step(actions)
    assert not found[3].any()
    assert found[4]["_drawn"].tolist() == [True, True, False, False]
    wanted = here.step(actions)
    require_equal(found[0][2:], wanted[0][2:])
    assert isolated.get_attr("step_count")[0] == 0


def test_faults_are_those_of_hooks_on_arrays(make, tmp_path):
    path = faulty_fmu(tmp_path)
    results = []
    for hooks in ("arrays", "one by one"):
        envs = make(lambda: FaultyEnv(path, "crash", call_timeout=20.0), 3, hooks, workers=3)
        envs.set_attr("fault", [start_values("crash")["fault"], 0, 0])
        envs.reset(seed=0)
        rows = [envs.step(np.ones((3, 1))) for _ in range(6)]
        results.append(rows)
    for compiled, array in zip(*results, strict=True):
        for ours, theirs in zip(compiled[:4], array[:4], strict=True):
            require_equal(ours, theirs)
        faults = [row[4].get("fault", [None])[0] for row in (compiled, array)]
        assert [f and "SIGSEGV" in f for f in faults] in ([True, True], [None, None])


class Free(fmugym.FMUEnv):
    """An FMU whose memory is watched."""

    def __init__(self, path):
        config = {"model_input_names": "u", "model_output_names": "x", "bounds": {"u": (-1, 1)}}
        super().__init__(path, config | {"time_step": 0.1, "max_episode_steps": 3})

    def _is_done(self):
        return self.out["x"] > 1e9


@pytest.mark.parametrize("workers", [None, 2])
def test_actions_of_another_type_in_a_step_that_resets(make, tmp_path, workers):
    """The C code refuses them, and gets them converted."""
    path = exchange_tools.exchange_fmu(tmp_path / "m.fmu", "dahlquist", 2, ("CoSimulation",))
    envs = make(lambda: Free(path), 4, workers=workers)
    rows = []
    for dtype in (np.float32, np.float64):
        envs.reset(seed=0)
        rows.append([envs.step(np.full((4, 1), 0.5, dtype))[0] for _ in range(9)])
    np.testing.assert_array_equal(*rows)


def test_refused_actions_change_nothing(make):
    envs = make(CART_POLE, 3)
    envs.reset(seed=0)
    envs.step([0, 1, 0])
    snapshot = envs.save_state()
    expected = envs.step([1, 1, 0])
    envs.restore_state(snapshot)
    with pytest.raises(ConfigError):
        envs.step([0, 2, 1])
    require_equal(envs.step([1, 1, 0])[0], expected[0])


def test_a_pool_without_a_library_steps_nothing(make):
    """Whatever is asked of the native pool that runs the programs, nothing crashes."""
    envs = make(Short, 3)
    envs.reset(seed=0)
    around = programs_for(envs.pool, envs.prototype.pool_spec)
    actions = np.zeros((3, 1), np.float32)
    for name, given in (
        ("play", (actions, False)),
        ("play_before", (actions,)),
        ("play_after", ()),
    ):
        with pytest.raises(ValueError, match="not prepared"):
            getattr(around, name)(*given)
    before = envs.pool.outputs.copy()
    assert around.step(None) == 3
    nothing = _native.access(form_of_listing(()))
    assert around.reset(nothing, np.zeros((0, 3)), None) == 3
    code, answer = around.ask(Request.READ, request_listing((), 2))
    assert code == Answer.TROUBLE
    assert answer[:8] == bytes(8)
    np.testing.assert_array_equal(envs.pool.outputs, before)
    around.close()
    with pytest.raises(SimulationError, match="closed"):
        around.step(None)


@pytest.fixture(name="cart")
def fixture_cart():
    env = fmugym.envs.CartPoleEnv(isolation="process")
    env.reset(seed=0)
    env.step(0)
    yield env
    env.close()


def test_a_process_of_a_single_environment_that_is_killed(cart):
    """The episode is cut short; the next ones are as without a worker."""
    other = in_python(fmugym.envs.CartPoleEnv())
    other.reset(seed=0)
    before = other.step(0)
    os.kill(cart.pool.processes()[0], signal.SIGKILL)
    observation, _, terminated, truncated, info = cart.step(1)
    assert (terminated, truncated) == (False, True)
    assert "SIGKILL" in info["fault"]
    assert same(observation, before[0])
    for env in (cart, other):
        env.reset(seed=3)
    require_same_steps(cart, other, 1, 0, 0, 1)
    assert cart.health["deaths"] == 1


@linux_only
def test_a_worker_that_sleeps_is_woken(cart):
    """It watches for the next message for 40 us only."""
    (pid,) = cart.pool.processes()

    def sleeps():
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "S"

    with in_python(fmugym.envs.CartPoleEnv()) as other:
        other.reset(seed=0)
        other.step(0)
        for _ in range(3):
            wait_until(sleeps)
            require_same_steps(cart, other, 1)


def test_interrupts_in_a_step_end_the_episode(cart):
    env = cart

    def ring(*_):
        raise KeyboardInterrupt

    usual = signal.signal(signal.SIGALRM, ring)
    try:
        os.kill(env.pool.processes()[0], signal.SIGSTOP)
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(KeyboardInterrupt):
            env.step(1)
    finally:
        signal.signal(signal.SIGALRM, usual)
    assert (env.step_count, env.action, env.previous_action) == (1, 1, 0)
    with pytest.warns(UserWarning, match="after the end of the episode"):
        env.step(1)
    env.reset(seed=0)
    assert env.step(1)[1] == 1.0
