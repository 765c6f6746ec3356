"""Rigs in the place of FMU instances: the pool of them, and environments over it."""

import contextlib
import gc
import logging
import re
import threading
import time

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_tools import run_side_by_side
from ways import in_way

import fmugym
from fmugym import ConfigError, FMI2CSEnv, FMUVectorEnv, SimulationError
from fmugym.fmi import Status
from fmugym.pool import Paced
from fmugym.pool.rig import rig_pool as backend_module
from fmugym.pool.rig.clocks import ManualClock

PENDULUM = fmugym.bundled_fmu("Pendulum")
OMEGA = 3.0  # rad/s


class Oscillator:
    """q'' = -OMEGA^2 q + tau in closed form; tau is held over a step of 0.1 s."""

    def __init__(self, as_list=False):
        self.as_list = as_list
        self.calls, self.threads = [], set()

    def note(self, call):
        self.calls.append(call)
        self.threads.add(threading.current_thread())

    def outputs(self):
        named = {"q_dot": self.q_dot, "q": self.q, "more": 1.0}
        return [self.q, self.q_dot] if self.as_list else named

    def reset(self, start_values):
        self.note("reset")
        self.q, self.q_dot = start_values["q_0"], 0.0
        return self.outputs()

    def step(self, inputs):
        self.note("step")
        centre = inputs["tau"] / OMEGA**2
        angle, z = OMEGA * 0.1, complex(self.q - centre, -self.q_dot / OMEGA)
        z *= complex(np.cos(angle), np.sin(angle))
        self.q, self.q_dot = z.real + centre, -z.imag * OMEGA
        return self.outputs(), Status.OK

    def stop(self):
        self.note("stop")


class Held(Oscillator):
    """Can hold as well."""

    def __init__(self, as_list=False):
        super().__init__(as_list)
        self.has_held = threading.Event()

    def hold(self):
        self.note("hold")
        self.has_held.set()


class RigEnv(FMI2CSEnv):
    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(self, backend, render_mode=None, **config):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": 0.5},
            "bounds": {"q": (-4.0, 4.0), "q_dot": (-20.0, 20.0), "tau": (-1.0, 1.0)},
            "time_step": 0.1,
            **config,
        }
        super().__init__(PENDULUM, config, render_mode=render_mode, backend=backend)

    def _is_done(self):
        return abs(self.state[0]) > 2.0

    def _get_scene(self):
        return fmugym.rendering.PendulumScene(1.0)

    def _get_frame(self):
        return fmugym.rendering.PendulumFrame(self.state[0], self.inputs[0])


@pytest.fixture
def make(opened):
    """Make environments over rigs that are closed after the test."""
    return lambda backend, **config: opened(RigEnv(backend, **config))


def push(torque):
    return np.array([torque], np.float32)


@in_turn({"kind": [Oscillator, Held], "as_list": [False, True]})
def test_a_rig_stands_in_for_the_fmu(make, kind, as_list):
    """A free oscillation is a cosine, whichever way the rig gives its outputs."""
    env = make(kind(as_list))
    observation, _ = env.reset(seed=0)
    for k in range(30):
        np.testing.assert_allclose(observation[0], 0.5 * np.cos(0.1 * OMEGA * k), atol=1e-6)
        observation, reward, terminated, truncated, info = env.step(push(0.0))
        assert (reward, terminated, truncated, info) == (1.0, False, False, {})


def test_start_values_and_inputs_reach_the_rig_by_name(make):
    rig = Oscillator()
    seen = []
    rig.step = lambda inputs: (seen.append(dict(inputs)) or rig.outputs(), 0)
    rig.reset = lambda start: (seen.append(dict(start)), Oscillator.reset(rig, start))[1]
    env = make(rig, model_parameters={"q_0": 0.3, "body": "uniform_rod"})
    env.reset(options={"model_parameters": {"b": 0.25}})
    env.step(push(0.5))
    assert seen == [{"q_0": 0.3, "body": 2.0, "b": 0.25}, {"tau": 0.5}]


def test_hooks_limits_and_pictures_are_as_with_an_fmu(make):
    env = make(
        Oscillator(),
        max_episode_steps=3,
        render_mode="rgb_array",
        model_output_names=["q"],
        monitor_names=["q_dot"],
        bounds={"q": (-4.0, 4.0), "tau": (-1.0, 1.0)},
    )
    env.reset()
    assert env.render().shape == (400, 600, 3)
    assert env.out["q_dot"] == 0.0
    ends = [env.step(push(0.0))[3] for _ in range(3)]
    assert ends == [False, False, True]
    env.reset(options={"model_parameters": {"q_0": 3.0}})
    *_, terminated, _, _ = env.step(push(0.0))
    assert terminated
    assert env.read_variables("q") == {"q": env.state[0]}
    with pytest.raises(SimulationError, match="'b' cannot be read from a backend"):
        env.read_variables("b")


class Failing(Held):
    """Does once what it is told instead of a step."""

    def __init__(self, answer):
        super().__init__()
        self.answer = answer

    def step(self, inputs):
        if len(self.calls) < 3:
            return super().step(inputs)
        self.calls.append("failing")
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (OSError("cable out"), "Failing.step: OSError: cable out"),
        (({"q": np.nan, "q_dot": 0.0}, 0), "Failing.step: the outputs are not finite: q = nan"),
        (({"q": 0.0}, 0), "Failing.step: the outputs lack 'q_dot'"),
        (([1.0, 2.0, 3.0], 0), r"there are 3 outputs, expected 2 \(q, q_dot\)"),
        ((["much", 2.0], 0), "could not convert string to float"),
        (([1.0, 2.0], Status.DISCARD), "it returned the status DISCARD"),
        (([1.0, 2.0], 17), "17 is not a valid Status"),
        ({"q": 0.0, "q_dot": 0.0}, "expected outputs and a status"),
    ],
)
def test_what_a_rig_does_wrong_is_a_fault(make, answer, reason, caplog):
    rig = Failing(answer)
    env = make(rig, fault_reward=-5.0)
    env.reset()
    for _ in range(2):
        good, *_ = env.step(push(0.0))
    with caplog.at_level(logging.WARNING):
        observation, reward, terminated, truncated, info = env.step(push(0.0))
    np.testing.assert_array_equal(observation, good)
    assert (reward, terminated, truncated) == (-5.0, False, True)
    assert info["fault"].startswith("Failing.step: ")
    assert re.search(reason, info["fault"])
    assert rig.calls == ["reset", "step", "step", "failing", "hold"]
    rig.calls.clear()
    env.reset()
    assert env.step(push(0.0))[4] == {}


def test_without_a_safe_action_a_rig_is_stopped_at_a_fault(make):
    rig = Oscillator()
    env = make(rig, on_fault="terminate")
    env.reset()
    rig.q = np.inf
    assert env.step(push(0.0))[2]
    assert rig.calls == ["reset", "step", "stop"]


def test_a_rig_may_end_the_episode(make):
    env = make(Failing(({"q": 0.1, "q_dot": 0.2}, Status.TERMINATED)))
    env.reset()
    for _ in range(3):
        observation, _, terminated, truncated, info = env.step(push(0.0))
    assert (terminated, truncated) == (True, False)
    assert info == {"fmu_terminated": True}
    np.testing.assert_allclose(observation, [0.1, 0.2])


def test_a_start_that_fails_is_stopped(make):
    rig = Held()
    rig.reset = lambda start_values: 1 / 0
    env = make(rig)
    with pytest.raises(SimulationError, match="ZeroDivisionError: division by zero"):
        env.reset()
    assert rig.calls == ["stop"]


class Hasty(RigEnv):
    """Its hook fails at the second step."""

    def _is_done(self):
        return self.step_count == 2 and 1 / 0


@pytest.mark.parametrize("kind", [Oscillator, Held])
def test_an_exception_in_a_hook_stops_the_rig(kind):
    rig = kind()
    env = Hasty(rig)
    env.reset()
    env.step(push(0.0))
    with pytest.raises(ZeroDivisionError):
        env.step(push(0.0))
    assert rig.calls == ["reset", "step", "step", "stop"]
    with pytest.raises(SimulationError, match="after the end of the episode"):
        env.step(push(0.0))
    env.reset()
    env.close()
    assert rig.calls[4:] == ["reset", "stop"]


@pytest.mark.parametrize("kind", [Oscillator, Held])
@pytest.mark.parametrize("call", ["reset", "step"])
def test_an_interrupt_passes_after_a_stop(make, kind, call):
    rig = kind()
    env = make(rig)
    env.reset()
    rig.calls.clear()

    def interrupt(_):
        raise KeyboardInterrupt

    setattr(rig, call, interrupt)
    with pytest.raises(KeyboardInterrupt):
        env.reset() if call == "reset" else env.step(push(0.0))
    assert rig.calls == ["stop"]


def test_raising_faults_stop_the_rig(make):
    rig = Failing(OSError("cable out"))
    env = make(rig, on_fault="raise")
    env.reset()
    for _ in range(2):
        env.step(push(0.0))
    with pytest.raises(SimulationError, match="cable out"):
        env.step(push(0.0))
    assert rig.calls[-2:] == ["hold", "stop"]


@pytest.mark.parametrize("kind", [Oscillator, Held])
def test_nothing_is_left_behind(kind, temp_root):
    before = set(threading.enumerate())
    rigs = [kind() for _ in range(3)]
    for forget in (False, True):
        env = FMUVectorEnv(lambda: RigEnv(rigs), 3)
        env.reset()
        env.step(np.zeros((3, 1), np.float32))
        if not forget:
            env.close()
            env.close()
        del env
        gc.collect()
        for rig in rigs:
            assert rig.calls[-1] == "stop"
    assert set(filter(threading.Thread.is_alive, threading.enumerate())) <= before
    assert list(temp_root.iterdir()) == []


def test_its_own_thread_may_close_a_pool():
    """As a finalizer does that happens to be called there."""

    class Closing(Held):
        def step(self, inputs):
            result = super().step(inputs)
            pool.close()
            return result

    rig = Closing()
    env = RigEnv(rig)
    env.reset()
    pool = env.pool
    with contextlib.suppress(SimulationError):  # it is closed
        env.step(push(0.0))
    assert rig.calls == ["reset", "step", "stop"]
    assert threading.main_thread() not in rig.threads
    env.close()


def test_a_failing_stop_is_logged(make, caplog):
    rig = Oscillator()
    rig.stop = lambda: 1 / 0
    env = make(rig)
    env.reset()
    env.close()
    assert "Oscillator.stop failed: division by zero" in caplog.text


class Group:
    """What makes rigs that share something."""

    def __init__(self, fails=None):
        self.fails, self.calls = fails, []

    def __call__(self, count):
        self.rigs = [Oscillator() for _ in range(count)]
        return self.rigs

    def open(self):
        self.calls.append("open")
        if self.fails == "open":
            raise OSError("no power")

    def close(self):
        self.calls.append("close")
        if self.fails == "close":
            raise OSError("no answer")


def test_what_rigs_share_is_opened_and_closed(make):
    group = Group()
    env = make(group)
    assert group.calls == []
    env.reset()
    env.close()
    assert group.calls == ["open", "close"]
    assert group.rigs[0].calls == ["reset", "stop"]


def test_what_a_rig_opens_and_closes_is_its_own_affair(make):
    rig = Oscillator()
    rig.open = rig.close = lambda: 1 / 0
    make(rig).reset()


@pytest.mark.parametrize("fails", ["open", "close"])
def test_what_rigs_share_fails(make, fails, caplog):
    group = Group(fails)
    env = make(group)
    if fails == "open":
        with pytest.raises(SimulationError, match="OSError: no power"):
            env.reset()
        assert group.rigs[0].calls == []
    else:
        env.reset()
        env.close()
        assert "closing what the backends share failed: no answer" in caplog.text


def test_a_stop_that_takes_too_long_is_not_waited_for(make, monkeypatch, caplog):
    monkeypatch.setattr(backend_module, "_LONGEST_STOP", 0.01)
    rig, gate = Held(), threading.Event()
    rig.stop = gate.wait
    env = make(rig)
    env.reset()
    env.close()
    gate.set()
    assert "a backend has not come to its stop within 0.01 s" in caplog.text


@pytest.mark.parametrize(
    ("config", "text"),
    [
        ({"fault_retries": 1}, "a backend's steps cannot be repeated"),
        ({"substeps": 5, "samplings": {"q": "mean"}}, "samplings"),
    ],
)
def test_what_no_rig_can_do(config, text):
    with pytest.raises(ConfigError, match=text):
        RigEnv(Oscillator(), **config)


@pytest.mark.parametrize(
    ("backend", "text"),
    [
        (object(), "a backend needs the methods reset, step and stop"),
        ([Oscillator(), Oscillator()], "1 backends are needed, got 2"),
        (lambda count: [], "1 backends are needed, got 0"),
        ("fpu", "unknown backend 'fpu'; did you mean 'fm(py|u)'"),
    ],
)
def test_what_is_no_backend(backend, text):
    with pytest.raises(ConfigError, match=text):
        RigEnv(backend)


def test_a_name_chooses_how_the_fmu_is_stepped():
    env = RigEnv("fmpy")
    assert not env.pool.is_real
    env.close()


# Several rigs.


class TestVector:
    def test_rigs_step_at_the_same_time(self, make_envs):
        """Each step waits for all the others: one after another they would never get past."""
        gate = threading.Barrier(3, timeout=10)

        class Waiting(Oscillator):
            def step(self, inputs):
                gate.wait()
                return super().step(inputs)

        rigs = [Waiting() for _ in range(3)]
        env = make_envs(lambda: RigEnv(rigs), 3)
        env.reset()
        *_, infos = env.step(np.zeros((3, 1), np.float32))
        assert "fault" not in infos
        assert len(set.union(*(rig.threads for rig in rigs))) == 3

    def test_no_rig_moves_before_the_first_reset(self):
        rigs = [Oscillator(), Oscillator()]
        env = FMUVectorEnv(lambda: RigEnv(rigs), 2)
        assert [rig.calls for rig in rigs] == [[], []]
        env.close()
        assert [rig.calls for rig in rigs] == [[], []]

    def test_a_fault_of_one_is_no_affair_of_the_others(self, make_envs):
        rigs = [Oscillator(), Failing(OSError("cable out")), Oscillator()]
        env = make_envs(lambda: RigEnv(rigs), 3)
        env.reset()
        for _ in range(3):
            *_, truncated, infos = env.step(np.zeros((3, 1), np.float32))
        assert truncated.tolist() == [False, True, False]
        assert "cable out" in infos["fault"][1]
        rigs[1].answer = ({"q": 0.0, "q_dot": 0.0}, 0)
        *_, truncated, infos = env.step(np.zeros((3, 1), np.float32))
        assert not truncated.any()
        assert [rig.calls.count("reset") for rig in rigs] == [1, 2, 1]

    def test_an_interrupt_stops_all(self):
        rigs = [Oscillator(), Failing(KeyboardInterrupt()), Oscillator()]
        env = FMUVectorEnv(lambda: RigEnv(rigs), 3)
        env.reset()
        for _ in range(2):
            env.step(np.zeros((3, 1), np.float32))
        with pytest.raises(KeyboardInterrupt):
            env.step(np.zeros((3, 1), np.float32))
        assert [rig.calls[-1] for rig in rigs] == ["stop"] * 3
        env.close()
        assert [rig.calls.count("stop") for rig in rigs] == [1] * 3

    def test_registered_classes_take_rigs(self):
        fmugym.register("test/Rig-v0", RigEnv)
        env = gym.make("test/Rig-v0", backend=Oscillator())
        env.reset()
        env.close()
        env = gym.make_vec("test/Rig-v0", num_envs=2, backend=[Oscillator(), Oscillator()])
        assert env.reset()[0].shape == (2, 2)
        env.close()
        del gym.registry["test/Rig-v0"]


@in_turn({"hooks": ["arrays", "one by one"], "mode": list(AutoresetMode)})
def test_hooks_of_several_real_plants(hooks, mode):
    """Programs run around the steps of the rigs; each way gives what single environments do."""
    config = {"model_parameters": {"q_0": fmugym.Uniform(0.5, 2.0)}, "max_episode_steps": 7}

    def made_at_once(count):
        return (Held(as_list=True) for _ in range(count))

    ours = FMUVectorEnv(
        in_way(hooks, lambda: RigEnv(made_at_once, **config)), 3, autoreset_mode=mode
    )
    assert ours.task.way == hooks
    theirs = SyncVectorEnv([lambda: RigEnv(Oscillator(), **config)] * 3, autoreset_mode=mode)
    assert run_side_by_side(ours, theirs, 40) > 9


def test_warm_up_with_the_inputs_at_their_start_values(make):
    rig = Oscillator()
    observation, _ = make(rig, warm_up=0.3).reset()
    np.testing.assert_allclose(observation[0], 0.5 * np.cos(0.3 * OMEGA), atol=1e-6)
    assert rig.calls == ["reset", "step", "step", "step"]


# Real time, on a clock that stands still.


class TestPacing:
    def make(self, rig, **options):
        clock = ManualClock()
        return clock, RigEnv(Paced(rig, clock, **options))

    def test_steps_wait_for_their_ticks(self):
        clock, env = self.make(Oscillator())
        _, info = env.reset()
        assert info["deadline_misses"] == 0
        for k in range(1, 6):
            clock.advance(0.03)  # the policy thinks
            *_, info = env.step(push(0.0))
            assert clock.time() == pytest.approx(0.1 * k)
            assert info == {"sample_age": 0.0, "deadline_misses": 0, "worst_lateness": 0.0}
        env.close()

    def test_what_is_late_shifts_the_schedule(self):
        clock, env = self.make(Oscillator())
        env.reset()
        times, infos = [], []
        for thought in (0.0, 0.25, 0.0, 0.0, 0.105, 0.0):
            clock.advance(thought)
            infos.append(env.step(push(0.0))[4])
            times.append(clock.time())
        # No burst after 0.25 s; the 5 ms are less than a tenth of a period and shift nothing.
        assert times == pytest.approx([0.1, 0.35, 0.45, 0.55, 0.655, 0.75])
        assert [info["deadline_misses"] for info in infos] == [0, 1, 1, 1, 1, 1]
        assert infos[-1]["worst_lateness"] == pytest.approx(0.15)
        _, info = env.reset()
        assert (info["deadline_misses"], info["worst_lateness"]) == (0, 0.0)
        env.close()

    def test_the_age_of_samples(self):
        clock = ManualClock()

        class Slow(Oscillator):
            def step(self, inputs):
                result = super().step(inputs)
                clock.advance(0.004)
                return result

        env = RigEnv(Paced(Slow(), clock))
        env.reset()
        assert env.step(push(0.0))[4]["sample_age"] == pytest.approx(0.004)
        rig = Slow()
        rig.sample_time = 0.2
        stamped = RigEnv(Paced(rig, clock))
        stamped.reset()
        *_, info = stamped.step(push(0.0))
        assert info["sample_age"] == pytest.approx(clock.time() - 0.2)
        env.close()
        stamped.close()

    @pytest.mark.parametrize("hooks", ["arrays", "one by one"])
    def test_info_of_several(self, hooks, make_envs):
        clock = ManualClock()
        rigs = Paced([Oscillator(), Oscillator()], clock)
        env = make_envs(in_way(hooks, lambda: RigEnv(rigs)), 2)
        env.reset()
        clock.advance(0.5)
        *_, infos = env.step(np.zeros((2, 1), np.float32))
        assert infos["deadline_misses"].tolist() == [1, 1]
        assert infos["worst_lateness"] == pytest.approx([0.4, 0.4])
        assert infos["_sample_age"].all()

    def test_while_nobody_steps_a_rig_holds(self):
        """The thread looks at the clock, which only the test moves."""
        rig = Held()
        clock, env = self.make(rig, hold_after=0.02)
        env.reset()
        assert not rig.has_held.wait(0.1)
        for _ in range(3):
            rig.has_held.clear()
            clock.advance(0.03)
            assert rig.has_held.wait(10)
        env.step(push(0.0))
        env.close()
        assert rig.calls == ["reset", "hold", "hold", "hold", "step", "stop"]

    def test_it_holds_in_real_time(self):
        rig = Held()
        env = RigEnv(Paced(rig, hold_after=0.01))
        env.reset()
        for _ in range(3):
            rig.has_held.clear()
            assert rig.has_held.wait(10)
        assert "fault" not in env.step(push(0.0))[4]
        env.close()

    def test_a_hold_that_fails_is_no_end(self):
        rig = Held()
        rig.hold = lambda: (rig.has_held.set(), 1 / 0)
        clock, env = self.make(rig, hold_after=0.02)
        env.reset()
        clock.advance(1.0)
        assert rig.has_held.wait(10)
        assert "fault" not in env.step(push(0.0))[4]
        env.close()

    def test_nothing_holds_before_the_start_and_after_the_stop(self):
        rig = Held()
        clock, env = self.make(rig, hold_after=0.01)
        clock.advance(1.0)
        assert not rig.has_held.wait(0.05)
        env.reset()
        env.pool.halt()
        clock.advance(1.0)
        assert not rig.has_held.wait(0.05)
        env.close()

    def test_an_interrupt_while_waiting(self, monkeypatch):
        rig = Held()
        clock, env = self.make(rig)
        env.reset()

        def interrupt(seconds):
            raise KeyboardInterrupt

        monkeypatch.setattr(clock, "sleep", interrupt)
        with pytest.raises(KeyboardInterrupt):
            env.step(push(0.0))
        assert rig.calls == ["reset", "stop"]
        env.close()

    def test_a_negative_time_until_a_hold(self):
        with pytest.raises(ConfigError, match="hold_after must be positive"):
            Paced(Held(), hold_after=0.0)

    def test_real_time_by_default(self):
        rig = Oscillator()
        env = RigEnv(Paced(rig), time_step=0.02)
        env.reset()
        begin = time.perf_counter()
        for _ in range(5):
            *_, info = env.step(push(0.0))
        assert time.perf_counter() - begin >= 0.09
        assert info["sample_age"] >= 0.0
        env.close()
