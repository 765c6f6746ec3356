"""Residual policies, whose network adds to the action of a controller."""

from contextlib import closing

import numpy as np

import fmugym
from fmugym.control import PID, controller_of
from fmugym.environment.vector import FMUVectorEnv
from fmugym.training.residual import Residual

KP, TI, HIGH, DT = 0.01, 0.4, 0.05, 0.05
TEXT = f"pid of=q setpoint=goal kp={KP} ti={TI} td=0.1"
GOAL = {"distribution": "uniform", "low": -2, "high": 2}
TASK = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": DT,
    "episode_length": "2s",
    "variables": {
        "tau": {"min": -HIGH, "max": HIGH},
        "q": {"nominal": 1},
        "q_dot": {"nominal": 1},
    },
    "setpoints": {"goal": {"value": GOAL, "min": -2, "max": 2}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot", "goal"], "normalize": "nominal"},
    "parameters": {"q_0": {"distribution": "uniform", "low": -1, "high": 1}},
    "controllers": {
        "pi": TEXT,
        "wide": TEXT.replace("0.4", "0.1..1"),
        "mpc": "mpc horizon=1s",
    },
    "reward": "-abs(q - goal)",
}


class Reference:
    """The PID controller of the task, whose integral stops while the sum is at a limit."""

    def __init__(self, goal, scale):
        self.goal, self.scale, self.integral, self.last = goal, scale, 0.0, None

    def action(self, q, part):
        error = self.goal - q
        change = 0.0 if self.last is None else q - self.last
        rest = KP * (error - 0.1 * change / DT)
        growth = KP * error * DT / TI
        wanted = rest + self.integral + growth
        base = min(max(wanted, -HIGH), HIGH)
        total = base + self.scale * 2 * HIGH * part
        stops = abs(wanted) > HIGH or abs(total) > HIGH
        told = (
            rest + self.integral + (0.0 if abs(wanted) > HIGH and wanted * growth > 0 else growth)
        )
        told = min(max(told, -HIGH), HIGH)
        total = told + self.scale * 2 * HIGH * part
        if not (stops and (wanted if abs(wanted) > HIGH else total) * growth > 0):
            self.integral += growth
        self.last = q
        return told / HIGH, min(max(total, -HIGH), HIGH)


def physical():
    return fmugym.load(TASK, physical=True)


def test_what_is_added_counts_for_the_integral():
    """Steps in turn: free, the sum at a limit, the controller itself at one, and back."""
    rng = np.random.default_rng(0)
    with closing(FMUVectorEnv(physical, 2)) as envs:
        observations, _ = envs.reset(seed=3)
        residual = Residual(controller_of(TEXT), 0.5).bind(envs)
        references = [Reference(float(goal), 0.5) for goal in observations[:, 2]]
        has_limited = 0
        for _ in range(39):
            parts = rng.uniform(-1, 1, (2, 1))
            seen = residual.seen(observations)
            actions = residual.actions(parts)
            pairs = [
                reference.action(float(row[0]), float(part))
                for reference, row, (part,) in zip(references, observations, parts, strict=True)
            ]
            told, own = np.array(pairs).T
            np.testing.assert_allclose(seen[:, 3], told, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(actions[:, 0], own, rtol=1e-5, atol=1e-7)
            has_limited += int((np.abs(own) == HIGH).sum())
            observations, *_ = envs.step(actions)
        assert 5 < has_limited < 70


def test_a_pid_without_anything_added_is_as_before():
    """Zeros are nothing, to the last bit."""
    with closing(physical()) as env:
        for seed in range(3):
            plain, told = (PID("q", "goal", KP, TI, 0.1).bind(env) for _ in range(2))
            observation, _ = env.reset(seed=seed)
            for _ in range(40):
                first, second = plain.act(observation), told.act(observation)
                told.add(np.zeros((1, 1)))
                assert first == second
                observation, *_ = env.step(first)
