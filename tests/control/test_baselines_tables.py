"""Controllers of several actions, on linear plants whose steps are known exactly."""

from typing import ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from scipy.linalg import expm
from system_tools import MATRICES, linear_fmu

import fmugym
from fmugym import FMUVectorEnv
from fmugym.control import MPC, PID, ControllerTable, Random, Signal, controller_of, tune
from fmugym.control.controller_parsing import search_of
from fmugym.control.controller_table import named_controllers, table_in, text_of

STEP = 0.25
A = np.array([[-1.0, 0.1], [0.6, -0.5]])
B = np.array([[1.0, 0.2], [-0.1, 0.8]])
"""Of two states that follow two inputs, each of them also the other one a little."""

CASCADE = np.array([[-1.0, 0.0], [0.4, -0.4]]), np.array([[1.0, 0.0], [0.0, 0.2]])
"""The first input moves the first state, which the second one follows."""


@pytest.fixture(scope="module")
def linear(tmp_path_factory):
    path = tmp_path_factory.mktemp("tables") / "linear.fmu"
    return linear_fmu(path)


def task(path, a=A, b=B, steps=80, low=(-1.0, -1.0), high=(1.0, 1.0), **keys):
    """Outputs are the states, which begin anywhere near 0."""
    matrices = dict(zip(MATRICES, (a, b, np.eye(2), np.zeros((2, 2))), strict=True))
    parameters = {
        f"{name}{i + 1}{j + 1}": float(matrix[i, j])
        for name, matrix in matrices.items()
        for i in range(2)
        for j in range(2)
    }
    begin = {"distribution": "uniform", "low": -1, "high": 1}
    return {
        "fmu": str(path),
        "time_step": STEP,
        "episode_length": steps * STEP,
        "parameters": parameters | {"x1_0": begin, "x2_0": begin},
        "variables": {
            **{f"u{i + 1}": {"min": low[i], "max": high[i]} for i in range(2)},
            **{f"y{i}": {"min": -50, "max": 50} for i in (1, 2)},
        },
        "agent": {"actions": ["u1", "u2"], "observations": ["y1", "y2"]},
        "reward": "-(y1 - 0.3)**2 - (y2 + 0.2)**2",
    } | keys


def discrete(a, b):
    """The exact step, by the exponential of a matrix."""
    whole = expm(np.block([[a, b], [np.zeros((2, 4))]]) * STEP)
    return whole[:2, :2], whole[:2, 2:]


def rounded(value):
    return float(np.float32(value))


def played(env, controller, seed, steps=80):
    """Observations, shape (steps + 1, 2), and actions, shape (steps, 2)."""
    controller.bind(env)
    seen, actions = [env.reset(seed=seed)[0]], []
    for _ in range(steps):
        actions.append(controller.act(seen[-1]))
        seen.append(env.step(actions[-1])[0])
    return np.array(seen, float), np.array(actions, float)


class Loop:
    """A PI controller of one value, written again; ``pushes`` tells who must not grow."""

    def __init__(self, kp, ti, low, high, offset=0.0):
        self.kp, self.ti, self.low, self.high, self.offset = kp, ti, low, high, offset
        self.integral = 0.0

    def parts(self, error):
        return self.offset + self.kp * error, self.kp * error * STEP / self.ti

    def wanted(self, error):
        return sum(self.parts(error)) + self.integral

    def act(self, error, pushes=0):
        """The limited action; with pushes = 1 the integral must not rise, with -1 not fall."""
        rest, growth = self.parts(error)
        wanted = rest + self.integral + growth
        is_beyond = (wanted > self.high and growth > 0) or (wanted < self.low and growth < 0)
        if not is_beyond and growth * pushes <= 0:
            self.integral += growth
        return min(max(rest + self.integral, self.low), self.high)


def test_two_loops_are_their_formulas(linear):
    """Beside the exact solution of the plant, with limits that some steps reach."""
    env = fmugym.load(task(linear))
    ad, bd = discrete(A, B)
    table = {"u2": "pid of=y2 setpoint=-0.2 kp=6 ti=4", "u1": "pid of=y1 setpoint=0.3 kp=8 ti=3"}
    for seed in range(3):
        seen, actions = played(env, controller_of(table), seed)
        loops, x = [Loop(8, 3, -1, 1), Loop(6, 4, -1, 1)], seen[0]
        for observed, action in zip(seen[1:], actions, strict=True):
            errors = 0.3 - rounded(x[0]), -0.2 - rounded(x[1])
            u = [rounded(loop.act(error)) for loop, error in zip(loops, errors, strict=True)]
            np.testing.assert_allclose(action, u, atol=1e-5)
            x = ad @ x + bd @ u
            np.testing.assert_allclose(observed, x, atol=1e-5)
        assert 1 <= np.count_nonzero(np.abs(actions) == 1) < actions.size / 2
        np.testing.assert_allclose(seen[-1], [0.3, -0.2], atol=0.05)
    env.close()


GOAL = {"goal": {"values": [1.5] * 60 + [0.2] * 100, "step": STEP, "interpolation": "previous"}}
OUTER = {"kp": 2.0, "ti": 2.0, "offset": 0.1}
SIGNAL = {"controller": "pid of=y2 setpoint=goal kp=2 ti=2 offset=0.1", "min": -30, "max": 30}
INNER = {"u1": "pid of=y1 setpoint=wish kp=4 ti=5", "u2": 0}


@pytest.mark.parametrize("gain", [4.0, -4.0])
def test_an_outer_integral_stops_while_the_inner_loop_saturates(linear, gain):
    """At first the goal is out of reach; the reference knows by the sign of the inner gain."""
    agent = {"actions": ["u1", "u2"], "observations": ["y1", "y2", "goal"]}
    a, b = CASCADE
    b = b * np.sign(gain)
    document = task(linear, a, b, steps=160, data=GOAL, agent=agent)
    env = fmugym.load(document)
    inner_text = f"pid of=y1 setpoint=wish kp={gain:g} ti=5"
    table = controller_of({"u2": 0, "wish": SIGNAL, "u1": inner_text})
    ad, bd = discrete(a, b)
    for seed in range(3):
        seen, actions = played(env, table, seed, 160)
        inner, outer, x = Loop(gain, 5, -1, 1), Loop(2, 2, -30, 30, 0.1), seen[0, :2]
        for row, (action, other) in zip(seen, actions, strict=False):
            x = rounded(x[0]), rounded(x[1])
            error = row[2] - x[1]
            rest, growth = outer.parts(error)
            grown = min(max(rest + outer.integral + growth, -30), 30)
            wanted = inner.wanted(grown - x[0])
            saturated = int(wanted > 1) - int(wanted < -1)
            wish = outer.act(error, saturated * np.sign(gain))
            u = rounded(inner.act(wish - x[0]))
            assert action == pytest.approx(u, abs=2e-5)
            assert other == 0
            x = ad @ row[:2] + bd @ [u, 0.0]
        assert 5 < np.count_nonzero(np.abs(actions[:, 0]) == 1) < 120
        assert np.abs(seen[-1, 1] - 0.2) < 0.01
        assert actions[59, 0] * np.sign(gain) > 0.9
        assert actions[60, 0] * np.sign(gain) == -1.0  # the goal is within reach again
    env.close()


def attached(table, low=(-1.0, -1.0), high=(1.0, 1.0)):
    """A table that acts on two actions and sees one value, without a plant."""
    space = spaces.Box(np.float32(low), np.float32(high))
    return table.attach(space, ("y",), ("u1", "u2"), 1.0, 1)


def test_an_integral_goes_on_while_one_reader_follows():
    """The signal rises by 10 in each step, until both inner loops are at their limits."""
    outer = Signal(PID("y", 10.0, 0.5, ti=0.5), -1e6, 1e6)
    readers = {"u1": PID("y", "wish", 1.0), "u2": PID("y", "wish", 0.02)}
    both, one = (
        attached(ControllerTable({"wish": outer, **readers, **more}))
        for more in ({}, {"u2": PID("y", 0.0, 1.0)})
    )
    for step in range(9):
        wish = 5.0 + 10.0 * min(step + 1, 4)  # 0.02 * 55 would be beyond the limit of 1
        assert both.act([[0.0]])[0].tolist() == pytest.approx([1.0, 0.02 * wish])
        assert one.act([[0.0]])[0].tolist() == [1.0, 0.0]
    assert one.act([[6.2]])[0].tolist() == pytest.approx([-0.5, -1.0])  # as in a first step


def test_limits_of_signals_hold_their_own_integrals():
    table = attached(
        ControllerTable(
            {"u1": PID("y", "wish", 0.1), "u2": 0, "wish": Signal(PID("y", 9, 1, 3), -2, 4)}
        )
    )
    for _ in range(5):
        assert table.act([[0.0]])[0].tolist() == pytest.approx([0.4, 0.0])
    first_step = 0.1 * (1.0 + 1.0 / 3.0 - 8.0)
    assert table.act([[8.0]])[0].tolist() == pytest.approx([first_step, 0.0])


def test_a_chain_of_three_stops_at_the_innermost_limit():
    """Two outer integrals; each growth would only push the action further beyond its limit."""
    chain = {
        "u1": PID("y", "inner", 1.0),
        "inner": Signal(PID("y", "outer", 1.0, ti=4.0), -99, 99),
        "outer": Signal(PID("y", 3.0, 1.0, ti=2.0), -99, 99),
        "u2": 0.5,
    }
    table = attached(ControllerTable(chain))
    for _ in range(20):
        assert table.act([[0.0]])[0].tolist() == [1.0, 0.5]
    for value in (1.3, 1.4):
        action = attached(ControllerTable(chain)).act([[value]])[0].tolist()
        assert abs(action[0]) < 1.0
        assert table.act([[value]])[0].tolist() == action
        table.reset()


def test_many_environments_equal_single_ones(linear):
    a, b = CASCADE
    agent = {"actions": ["u1", "u2"], "observations": ["y1", "y2", "goal"]}
    document = task(linear, a, b, data=GOAL, agent=agent)
    envs = FMUVectorEnv(lambda: fmugym.load(document), 3)
    table = controller_of({**INNER, "wish": SIGNAL}).bind(envs)
    observations, _ = envs.reset(seed=0)
    rows = []
    for _ in range(60):
        rows.append(table.act(observations))
        observations, *_ = envs.step(rows[-1])
    envs.close()
    env = fmugym.load(document)
    for seed in range(3):
        _, actions = played(env, controller_of({**INNER, "wish": SIGNAL}), seed, 60)
        np.testing.assert_array_equal(actions, np.array(rows)[:, seed])
    env.close()


def test_all_ranges_are_tuned_together(linear):
    """The best gain of each loop brings its value to 0 in one step, whatever it was."""
    a, b = np.diag([-1.0, -2.0]), np.eye(2)
    limits = {"low": (-50.0, -50.0), "high": (50.0, 50.0)}
    document = task(linear, a, b, steps=8, reward="-y1**2 - y2**2", **limits)
    search = search_of({f"u{i}": f"pid of=y{i} setpoint=0 kp=0.5..20" for i in (1, 2)})
    found = tune(
        search.make,
        lambda: fmugym.load(document),
        search.ranges,
        candidates=16,
        episodes=2,
        rounds=14,
    )
    ad, bd = discrete(a, b)
    wanted = {f"u{i + 1}.kp": ad[i, i] / bd[i, i] for i in range(2)}
    assert found.parameters == pytest.approx(wanted, rel=0.03)
    text = search.text(found.parameters)
    env = fmugym.load(document)
    seen, _ = played(env, controller_of(text), 5, 8)
    assert np.abs(seen[2:]).max() < 0.02
    env.close()


def test_plans_begin_with_a_table(linear):
    """With as few candidates as copies, those of the table are by far the best."""
    table = {"u1": "pid of=y1 setpoint=0.3 kp=2 ti=1", "u2": "pid of=y2 setpoint=-0.2 kp=2 ti=1"}
    document = task(linear, steps=16)
    totals = []
    for more in ({}, {"controllers": {"pi": table}}):
        env = fmugym.load(document | more)
        mpc = MPC(2.0, candidates=9, rounds=1, budget=None).bind(env)
        observation, total = env.reset(seed=3)[0], 0.0
        for _ in range(16):
            observation, reward, *_ = env.step(mpc.act(observation))
            total += reward
        totals.append(total)
        mpc.close()
        env.close()
    assert totals[1] > 0.8 * totals[0]  # both are negative


class TestTexts:
    TABLE: ClassVar = {
        "u1": "pid of=y1 'setpoint=wish + 0.5' kp=-2",
        "valve 2": 1,
        "wish": {"controller": 'pid of="y 2" setpoint=0 kp=1.5', "min": -1, "max": 2.5},
        "ü": -0.5,
    }

    def test_are_what_they_say(self):
        text = text_of(self.TABLE)
        assert "\n" not in text
        assert table_in(text) == self.TABLE == table_in(self.TABLE)

    def test_names_in_tables(self):
        known = {"cold": "pid of=y setpoint=3 kp=1", "half": 0.5}
        table = {
            "u1": "cold",
            "u2": "half",
            "u3": 2,
            "s": {"controller": "cold", "min": 0, "max": 1},
        }
        named = named_controllers(known | {"all": table})
        assert table_in(named["all"]) == {
            "u1": known["cold"],
            "u2": 0.5,
            "u3": 2,
            "s": {"controller": known["cold"], "min": 0, "max": 1},
        }
        with pytest.raises(fmugym.ConfigError, match="u1: 'all' is a table"):
            named_controllers(known | {"all": table, "both": {"u1": "all"}})
        with pytest.raises(fmugym.ConfigError, match=r"u1: .*'colt'.*'cold'"):
            named_controllers(known | {"all": {"u1": "colt"}})

    def test_ranges_of_all_entries(self):
        search = search_of(
            {
                "u1": "pid of=y1 setpoint=wish kp=-5..-0.5 ti=10..2000",
                "u2": "hysteresis of=y2 setpoint=0 band=0.5..1",
                "wish": {"controller": "pid of=y2 setpoint=1 kp=1..3", "min": 0, "max": 1},
                "u3": "schedule 06:00=1",
            }
        )
        assert list(search.ranges) == ["u1.kp", "u1.ti", "u2.band", "wish.kp"]
        given = {"u1.kp": 2.0, "u1.ti": 100.0, "u2.band": 0.75, "wish.kp": 2.0}
        found = table_in(search.text(given))
        assert found["u1"] == "pid of=y1 setpoint=wish kp=-2 ti=100"
        assert found["wish"]["controller"] == "pid of=y2 setpoint=1 kp=2"
        assert found["u3"] == "schedule 06:00=1"
        assert search.numbers(given)["u1.kp"] == -2.0
        made = search.make(**{name: np.array([value]) for name, value in given.items()})
        assert made.entries["u1"].kp.tolist() == [-2.0]
        assert search.at_an_end(given | {"wish.kp": 2.999}) == ["wish.kp"]


LOOP = "pid of=y1 setpoint=0 kp=1"
CIRCLE = {
    name: {"controller": f"pid of=y1 setpoint={of}+1 kp=1", "min": 0, "max": 1}
    for name, of in (("a", "b"), ("b", "c"), ("c", "a"))
}
MISTAKES = {
    "a circle": (
        {"u1": LOOP, "u2": LOOP, **CIRCLE},
        "circle: (a -> b -> c -> a|b -> c -> a -> b|c -> a -> b -> c)",
    ),
    "no limits": ({"u1": LOOP, "u2": LOOP, "wish": LOOP}, "'wish'.*'min' and 'max'"),
    "a misspelt action": ({"u1": LOOP, "u_2": LOOP}, "'u_2'.*'u2'"),
    "too few": ({"u1": LOOP}, "no controller of 'u2'.*u2 = 0"),
    "limits of an action": (
        {"u1": "pid of=y1 setpoint=u2 kp=1", "u2": CIRCLE["a"] | {"controller": LOOP}},
        "'u2' is an action",
    ),
    "an unread signal": ({"u1": LOOP, "u2": 0, "c": CIRCLE["c"]}, "reads the signal 'c'"),
    "a signal's name": (
        {"u1": "pid of=y1 setpoint=y2 kp=1", "u2": 0, "y2": CIRCLE["c"] | {"controller": LOOP}},
        "'y2'.*observation",
    ),
    "no number": ({"u1": LOOP, "u2": "3,4"}, "u2: .*'3,4'"),
    "a number that is none": ({"u1": LOOP, "u2": 7}, "u2: .*7"),
    "a plan": ({"u1": LOOP, "u2": "mpc horizon=2"}, "u2: .*MPC"),
    "a range": ({"u1": LOOP, "u2": "pid of=y1 setpoint=0 kp=1..2"}, "u2: .*range"),
    "an unknown name": ({"u1": LOOP, "u2": "pid of=y3 setpoint=0 kp=1"}, "u2: .*'y3'"),
    "no signal": ({"u1": LOOP, "u2": {"controller": LOOP, "min": 0}}, "u2: .*'max'"),
    "another key": ({"u1": LOOP, "u2": {"controler": LOOP}}, "'controler'.*'controller'"),
    "nothing": ({}, "entry"),
    "no TOML": ("{ u1 = 3, u2 }", "table.*u2"),
}


@pytest.mark.parametrize(("table", "message"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes(table, message):
    with pytest.raises(fmugym.ConfigError, match=message):
        controller_of(table).attach(
            spaces.Box(-np.ones(2, np.float32), np.ones(2, np.float32)),
            ("y1", "y2"),
            ("u1", "u2"),
            1.0,
            1,
        )


def test_what_no_entry_can_be():
    for entry in (Random(), "pid of=y setpoint=1 kp=1", ControllerTable({"u": 0}), None):
        with pytest.raises(fmugym.ConfigError, match="u1: expected a controller of one number"):
            ControllerTable({"u1": entry})


def test_actions_that_a_hook_makes_have_no_names(linear):
    class Mixed(fmugym.FMI2CSEnv):
        def _get_inputs(self):
            return self.action[::-1]

        def _is_done(self):
            return False

    class Plain(fmugym.FMI2CSEnv):
        def _is_done(self):
            return False

    config = {
        "model_input_names": ["u1", "u2"],
        "model_output_names": ["y1", "y2"],
        "time_step": STEP,
        "bounds": {"u1": (-1, 1), "u2": (-1, 1)},
    }
    table = controller_of({"u1": LOOP, "u2": 0.5})
    mixed, plain = (cls(linear, config) for cls in (Mixed, Plain))
    with pytest.raises(fmugym.ConfigError, match="no names"):
        table.bind(mixed)
    assert table.bind(plain).act(np.array([-0.25, 0.0])).tolist() == [0.25, 0.5]
    mixed.close()
    plain.close()
