"""The search for the numbers of controllers, against optima that are known otherwise."""

from functools import partial

import numpy as np
import pytest

import fmugym
from fmugym.control import PID, Constant, Controller, Hysteresis, tune
from fmugym.control.candidate_evaluation import CandidateScores
from fmugym.control.linearization import linearize
from fmugym.control.tuning import candidate_search_of
from fmugym.environment.vector import FMUVectorEnv
from fmugym.envs import HouseEnv

WEIGHTS = (1.0, 0.1, 200.0)  # of angle, rate and torque


class Balance(fmugym.FMI2CSEnv):
    """A pendulum near its upright position, with the costs of a linear-quadratic regulator."""

    def __init__(self):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["theta", "theta_dot"],
            "model_parameters": {
                "q_0": np.pi,
                "theta_0": fmugym.Uniform(-0.01, 0.01),
                "theta_dot_0": fmugym.Uniform(-0.1, 0.1),
            },
            "bounds": {"tau": (-1, 1)},
            "time_step": 0.02,
            "max_episode_steps": 400,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self):
        return abs(self.out["theta"]) > 1

    def _reward_policy(self):
        theta, rate = self.previous_state
        angle, speed, torque = WEIGHTS
        costs = angle * theta**2 + speed * rate**2 + torque * self.inputs[0] ** 2
        return -1e4 * costs - 1e4 * self.done


class Feedback(Controller):
    """Feeds back angle and rate."""

    def __init__(self, angle, rate):
        self.gains = angle, rate

    def _decide(self, rows):
        return -self.gains[0] * rows[:, 0] - self.gains[1] * rows[:, 1]


def riccati_gain():
    """The best gains for the linear model, by scipy."""
    from scipy.linalg import solve_discrete_are
    from scipy.signal import cont2discrete

    model = linearize(fmugym.bundled_fmu("Pendulum"), at={"q_0": np.pi})
    a, b, *_ = cont2discrete((model.A, model.B, np.eye(2), np.zeros((2, 1))), 0.02)
    q, r = np.diag(WEIGHTS[:2]), np.array([[WEIGHTS[2]]])
    cost = solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a).ravel()


def test_it_finds_the_gains_of_the_riccati_equation():
    search = {"angle": fmugym.Uniform(0, 1), "rate": fmugym.LogUniform(0.001, 1)}
    found = tune(Feedback, Balance, search, candidates=16, episodes=3, rounds=30)
    assert list(found.parameters.values()) == pytest.approx(riccati_gain().tolist(), rel=0.03)
    assert len(found.returns) == 30
    assert found.mean_return == max(found.returns)


HOUSE_SEARCH = {
    "setpoint": fmugym.Uniform(20, 22),
    "kp": {"distribution": "log_uniform", "low": 0.05, "high": 5},
}


def tuned_house(**arguments):
    make = partial(PID, "T", ti=14400.0)
    few = {"candidates": 8, "episodes": 2, "rounds": 3, "most_steps": 200}
    return tune(make, HouseEnv, HOUSE_SEARCH, **{**few, **arguments})


def test_the_same_arguments_give_the_same_result():
    first, second, third = tuned_house(), tuned_house(), tuned_house(seed=1)
    assert first.parameters == second.parameters != third.parameters
    assert first.returns == second.returns
    assert 20 <= first.parameters["setpoint"] <= 22
    assert 0.05 <= first.parameters["kp"] <= 5


def test_what_follows_the_end_of_an_episode_does_not_count():
    """A pendulum without torque falls; its one reward of the end is -1e4 and less."""
    found = tune(lambda action: _Same(action), Balance, {"action": fmugym.Uniform(0, 0)}, **TINY)
    env = Balance()
    env.reset(seed=0)
    total, over = 0.0, False
    while not over:
        _, reward, terminated, truncated, _ = env.step(np.zeros(1, dtype=np.float32))
        total, over = total + reward, terminated or truncated
    env.close()
    assert found.mean_return == pytest.approx(total, rel=1e-9)


TINY = {"candidates": 8, "episodes": 1, "rounds": 1}


class _Same(Controller):
    def __init__(self, action):
        self.action = action

    def _decide(self, rows):
        return np.zeros(len(rows)) + self.action


@pytest.mark.parametrize("kind", [PID, Hysteresis])
def test_arrays_are_one_number_for_each_environment(kind):
    each = {"setpoint": [20.0, 21.0, 22.0]}
    each |= {"kp": [0.1, 0.5, 2.0], "ti": [3600.0, 7200.0, 1e5]} if kind is PID else {}
    each |= {"band": [0.1, 0.2, 0.3], "below": [0.5, 0.7, 1.0]} if kind is Hysteresis else {}
    envs = FMUVectorEnv(HouseEnv, 3)
    together = kind("T", **{name: np.array(values) for name, values in each.items()}).bind(envs)
    observations, _ = envs.reset(seed=3)
    rows = []
    for _ in range(60):
        rows.append(together.act(observations))
        observations, *_ = envs.step(rows[-1])
    envs.close()
    env = HouseEnv()
    for i in range(3):
        alone = kind("T", **{name: values[i] for name, values in each.items()}).bind(env)
        observation, _ = env.reset(seed=3 + i)
        for row in rows:
            action = alone.act(observation)
            assert action == row[i]
            observation, *_ = env.step(action)
    env.close()


class TestMistakes:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"candidates": 7}, "candidates .*at least 8, got 7"),
            ({"rounds": 0}, "rounds"),
            ({"episodes": 2.5}, "episodes"),
            ({"most_steps": -1}, "most_steps"),
            ({"seed": "1"}, "seed"),
        ],
    )
    def test_numbers(self, arguments, message):
        with pytest.raises(fmugym.ConfigError, match=message):
            tuned_house(**arguments)

    @pytest.mark.parametrize(
        ("search", "message"),
        [
            ({}, "at least one"),
            ({"kp": (0, 1)}, r"search\['kp'\].*Uniform or LogUniform"),
            ({"kp": fmugym.Normal(0, 1)}, r"search\['kp'\].*Normal"),
            ({"kp": fmugym.Uniform(0, 1), "tj": fmugym.Uniform(0, 1)}, "'tj'.*'ti'"),
            ([1], "search"),
        ],
    )
    def test_search(self, search, message):
        with pytest.raises(fmugym.ConfigError, match=message):
            tune(partial(PID, "T", 21.0), HouseEnv, search, **TINY)

    def test_a_controller_that_takes_no_arrays(self):
        with pytest.raises(fmugym.ConfigError, match="Box"):
            tune(Constant, HouseEnv, {"action": fmugym.Uniform(0, 1)}, **TINY)

    def test_an_error_of_the_controller_comes_out(self):
        class Wrong(_Same):
            def _decide(self, rows):
                raise ValueError("this is wrong")

        with pytest.raises(ValueError, match="this is wrong"):
            tune(Wrong, HouseEnv, {"action": fmugym.Uniform(0, 1)}, **TINY)

    def test_an_array_of_another_size(self, make_envs):
        envs = make_envs(HouseEnv, 3)
        for arguments in ({"kp": np.ones(2)}, {"kp": 1.0, "setpoint": np.ones(4)}):
            with pytest.raises(fmugym.ConfigError, match="numbers, but there are 3 environments"):
                PID(**{"of": "T", "setpoint": 21.0, **arguments}).bind(envs)
        with pytest.raises(fmugym.ConfigError, match="each kp"):
            PID("T", 21.0, kp=np.array([1.0, np.nan]))


class Deceptive:
    """Stands for an evaluator: a wide hill with its top in the middle, and a narrow higher one."""

    def play(self, make, places, seeds, has_moments=False):
        wide, narrow = (np.linalg.norm(places - top, axis=1) for top in (0.5, 0.85))
        returns = np.maximum(0.5 - wide, 1.0 - 3.0 * narrow)[:, None]
        nothing = np.zeros((*returns.shape, 1))
        return CandidateScores(returns, nothing, {}, nothing)


def test_it_looks_everywhere_at_first():
    ranges = dict.fromkeys("ab", fmugym.Uniform(0, 1))
    found = []
    for seed in range(20):
        candidate_search = candidate_search_of(
            None, ranges, (32, 8), 1, np.random.default_rng(seed)
        )
        for _ in range(20):
            candidate_search.play(Deceptive(), [0])
        found.append(candidate_search.lead[1] > 0.8)
    assert sum(found) >= 17
