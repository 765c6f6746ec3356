"""Episodes of the training are played again by a spare instance, and what follows from it."""

import logging
import sys
import time

import model_tools
import numpy as np
import pytest

import fmugym
from fmugym.pool import tape
from fmugym.pool.tape import Rehearsals
from fmugym.trial.known import known_verdict

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

STEP = 0.5
WAYS = {
    "native": {"backend": "native"},
    "isolated": {"backend": "native", "isolation": "process"},
}
all_ways = pytest.mark.parametrize("way", WAYS)


class TiringEnv(model_tools.GainEnv):
    def __init__(self, path, gain=1.0, **config):
        super().__init__(path, gain, logging.INFO, **{"time_step": STEP} | config)


@pytest.fixture(autouse=True)
def often(monkeypatch, tmp_path):
    """Rehearse after a few episodes, and let the trial cache what it finds."""
    monkeypatch.setattr(tape, "_FIRST_RESETS", 16)
    monkeypatch.setattr(tape, "_FIRST_STEPS", 32)
    monkeypatch.setattr(tape, "_SHARE", float("inf"))
    monkeypatch.delenv("FMUGYM_PROBE", raising=False)
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "cache"))


@pytest.fixture
def make_fmu(tmp_path):
    def make(token, states=None):
        able = "restore" in token if states is None else states
        return model_tools.model_fmu(
            tmp_path / "Tires.fmu",
            "tires",
            2,
            token,
            model_tools.GAIN_VARIABLES,
            flags=model_tools.STATES[2] if able else "",
        )

    return make


def play(env, episodes, steps=3):
    """Play episodes with an input of 1; returns the last outputs of each."""
    ends = []
    for _ in range(episodes):
        env.reset()
        for _ in range(steps):
            env.step(np.ones(1, np.float32))
        ends.append(float(env.state[0]))
    return ends


def warnings(caplog):
    found = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
    return [text for text in found if "begin anew" in text]


@all_ways
@pytest.mark.parametrize("token", ["reset", "restore"])
def test_a_method_that_tires_is_replaced(make_fmu, way, token, caplog):
    path = make_fmu(token)
    env = TiringEnv(path, **WAYS[way])
    assert env.reset_method == token
    ends = play(env, 500)
    (text,) = warnings(caplog)
    lower = "reset" if token == "restore" else "instance"
    assert f"Tires.fmu does not begin anew by the method {token!r}: y was" in text
    assert "1.0 after 1 steps, and 0.5 with a fresh instance" in text
    assert text.endswith(f"Episodes now begin by the method {lower!r}")
    assert set(ends[:50]) == {1.5}
    assert len(set(ends[50:150])) > 1
    assert set(ends[-50:]) == {1.5}
    assert env.reset_method == lower
    assert env.health["rehearsals"] >= 2
    env.close()
    again = TiringEnv(path, **WAYS[way])
    assert again.reset_method == lower
    again.close()
    verdict = known_verdict(fmugym.FMU(path))
    assert verdict.reset_method == lower
    assert f"in training, with the method {token!r}, y was 1.0" in verdict.reasons[-1]


def test_what_a_pool_cannot_do_is_left_to_later_environments(make_fmu, caplog):
    """Instances share the library, so it cannot be loaded anew for one of them."""
    path = make_fmu("stubborn instance")
    env = TiringEnv(path, **WAYS["native"])
    assert env.reset_method == "instance"
    play(env, 200)
    text = warnings(caplog)[-1]
    assert text.endswith("The episodes of later environments begin by the method 'library'")
    env.close()
    env = TiringEnv(path, **WAYS["native"])
    assert env.reset_method == "library"
    assert set(play(env, 100)) == {1.5}
    env.close()


@all_ways
def test_a_step_that_fails(make_fmu, way, caplog):
    env = TiringEnv(make_fmu("reset fails"), **WAYS[way])
    for _ in range(500):
        env.reset()
        env.step(np.ones(1, np.float32))
    (text,) = warnings(caplog)
    assert "step 1 returned Error, and Ok with a fresh instance" in text
    env.close()


@all_ways
def test_a_step_that_warns_is_no_reason(make_fmu, way, caplog):
    env = TiringEnv(make_fmu("reset warns"), **WAYS[way])
    assert set(play(env, 200)) == {1.5}
    assert env.health["rehearsals"] > 0
    assert warnings(caplog) == []
    assert env.reset_method == "reset"
    env.close()


@pytest.mark.parametrize("options", [{"threads": 1}, {"threads": 2}, {"isolation": "process"}])
def test_a_vector_environment(make_fmu, caplog, options):
    """With compiled hooks, too: the recording is made where the steps are done."""
    path = make_fmu("restore")
    envs = fmugym.FMUVectorEnv(lambda: TiringEnv(path, max_episode_steps=3), 4, **options)
    envs.reset(seed=0)
    ends = []
    for _ in range(1600):
        observations, _, _, truncated, _ = envs.step(np.ones((4, 1), np.float32))
        ends += observations[truncated, 0].tolist()
    assert len(warnings(caplog)) == 1
    assert set(ends[:200]) == {1.5}
    assert len(set(ends)) > 1
    assert set(ends[-200:]) == {1.5}
    assert envs.health["rehearsals"].tolist() == [envs.health["rehearsals"][0]] * 4
    envs.close()


@all_ways
def test_a_well_behaved_fmu_notices_nothing(make_fmu, way, caplog):
    """Drawn start values, moving inputs, states restored and snapshots of the caller."""
    gain = fmugym.Uniform(0.5, 1.5)
    results = []
    for rehearsals in (True, False):
        path = make_fmu("fine", states=True)
        env = TiringEnv(path, gain, rehearsals=rehearsals, **WAYS[way])
        env.reset(seed=3)
        ends = []
        for index in range(400):
            env.reset()
            for _ in range(1 + index % 70):
                env.step(env.action_space.low * np.sin(index).astype(np.float32))
            ends.append(env.state[0])
        results.append(ends)
        assert env.health["rehearsals"] == (3 if rehearsals else 0)
        env.close()
    assert results[0] == results[1]
    assert warnings(caplog) == []
    assert not [r for r in caplog.records if "differ" in r.getMessage()]


def test_noise_is_no_reason(make_fmu, caplog, monkeypatch):
    env = TiringEnv(make_fmu("restore noise"), **WAYS["native"])
    monkeypatch.setenv("TIRES_NOISE", "1")
    play(env, 100)
    assert warnings(caplog) == []
    assert "two fresh instances differ" in caplog.text
    assert env.reset_method == "restore"
    env.close()


class TestWhoRehearses:
    def count(self, path, **config):
        env = TiringEnv(path, **config)
        play(env, 40)
        count = env.health["rehearsals"]
        env.close()
        return count

    def test_config(self, make_fmu):
        path = make_fmu("fine")
        assert self.count(path) == 1
        assert self.count(path, rehearsals=False) == 0
        assert self.count(path, reset_method="reset") == 0
        assert self.count(path, probe_timeout=None) == 0
        assert self.count(path, max_instances=1) == 0
        assert self.count(path, max_instances=2) == 1
        with pytest.raises(fmugym.ConfigError, match="rehearsals"):
            TiringEnv(path, rehearsals="no")

    def test_bundled_fmus_do_not(self):
        env = fmugym.envs.CartPoleEnv()
        for _ in range(60):
            env.reset()
            env.step(0)
        assert env.health["rehearsals"] == 0
        env.close()


class CountedPool:
    """Stands in for a pool: its steps and resets take a fixed time, and each episode 100 steps."""

    num_instances = 8

    def __init__(self, step, reset=0.0):
        self.step, self.reset = step, reset
        self.steps = self.due_resets = self.due_steps = 0
        self.asked = 0

    def record(self, resets, steps):
        self.due_resets, self.due_steps = resets, steps

    def begin_by(self, method):
        raise AssertionError("every method is right here")

    def effort(self):
        self.asked += 1
        resets = self.steps // 100
        return tape.Effort(
            total=8 * (self.steps * self.step + resets * self.reset),
            episode=self.reset + tape.TAPE_ROWS * self.step,
            steps=self.steps,
        )

    def go_on(self):
        """Until a recording is done."""
        self.steps = 100 * max(self.steps // 100 + self.due_resets, -(-self.due_steps // 100))


@pytest.mark.parametrize("start", [0.015, 0.45])
@pytest.mark.parametrize(
    ("step", "reset"), [(5e-8, 1e-7), (1e-6, 0.0), (1e-5, 1e-3), (1e-2, 0.5), (1e-6, 200.0)]
)
def test_rehearsals_take_less_than_a_hundredth(monkeypatch, step, reset, start):
    """From the first one on, and however long the FMU's steps and resets take."""
    monkeypatch.undo()
    pool, now, cost = CountedPool(step, reset), [0.0], [start]
    taken = []

    def judge(recording, begin_by):
        taken.append(cost[0] + 2 * (reset + tape.TAPE_ROWS * step))
        cost[0] = 0.015
        now[0] += taken[-1]
        assert sum(taken) <= 0.01 * 8 * (pool.steps * step + pool.steps // 100 * reset)
        return True

    rehearsals = Rehearsals(pool, judge, clock=lambda: now[0])
    pool.record(*rehearsals.next())
    while len(taken) < 8:
        pool.go_on()
        rehearsals.receive(None)
    assert rehearsals.count == len(taken)
    assert pool.asked < 50  # rehearsals that are put off cost nothing either


def test_how_often_at_most(monkeypatch):
    """Even if steps take long, there are so many between two rehearsals."""
    monkeypatch.undo()
    pool = CountedPool(1e-3, 0.5)
    seen = []
    rehearsals = Rehearsals(pool, lambda *_: not seen.append(pool.steps), clock=lambda: 0.0)
    pool.record(*rehearsals.next())
    while len(seen) < 10:
        pool.go_on()
        rehearsals.receive(None)
    for count, steps in enumerate(seen, 1):
        assert count <= 1e-3 * 8 * steps / 100
        assert count * 2 * tape.TAPE_ROWS <= 1e-3 * 8 * steps
    assert 8 * seen[-1] < 11 * 2**26


@all_ways
@pytest.mark.parametrize("num_envs", [1, 4])
def test_a_rehearsal_is_put_off_until_it_is_earned(make_fmu, way, num_envs, monkeypatch):
    """The pool never claims more time than has passed, and rehearses as soon as this suffices."""
    path = make_fmu("fine")
    options = dict(WAYS[way])
    isolation = options.pop("isolation", None)
    monkeypatch.setattr(tape, "_SHARE", 1e-12)
    begin = time.perf_counter()
    envs = fmugym.FMUVectorEnv(
        lambda: TiringEnv(path, max_episode_steps=3, **options),
        num_envs,
        threads=1,
        isolation=isolation,
    )
    play_all(envs, 200)
    assert not envs.health["rehearsals"].any()
    effort = envs._pool.effort()
    assert 0.0 < effort.total < 2 * (time.perf_counter() - begin)
    assert effort.episode > 0.0
    assert effort.steps == envs.health["steps"][0]
    monkeypatch.setattr(tape, "_SHARE", float("inf"))
    play_all(envs, 8 * int(effort.steps))
    assert envs.health["rehearsals"].all()
    envs.close()


def play_all(envs, steps):
    envs.reset(seed=0)
    for _ in range(steps):
        envs.step(np.ones((envs.num_envs, 1), np.float32))


def test_a_spare_waits_for_a_seat(make_fmu, caplog):
    """Another environment has the last seat. Once it is free, rehearsals go on."""
    path = make_fmu("fine")
    env = TiringEnv(path, max_instances=2, **WAYS["native"])
    other = TiringEnv(path, max_instances=2, **WAYS["native"])
    play(env, 40)
    assert "no spare instance for now: Tires.fmu needs 1 more instance(s) for a reh" in caplog.text
    assert "repeats" not in caplog.text
    other.close()
    play(env, 100)
    assert "a fresh instance repeats 3 steps" in caplog.text
    env.close()


def test_a_spare_that_crashes(make_fmu, caplog):
    """The training has survived by luck; later environments do not depend on it."""
    path = make_fmu("crash")
    env = TiringEnv(path, **WAYS["native"])
    env.reset()
    env.step(np.full(1, 0.5, np.float32))
    play(env, 40)
    env.close()
    found = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert (
        len([text for text in found if "with signal SIGSEGV in a step when it played" in text]) == 1
    )
    env = TiringEnv(path, **WAYS["native"])
    assert type(env._pool).__name__ == "ProcessPool"
    env.close()
    assert "harms its process: in a rehearsal, a worker process ended with" in caplog.text
