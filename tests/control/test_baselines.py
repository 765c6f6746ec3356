"""Controllers that need no training, on plants and against formulas."""

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import fmugym
from fmugym.control import LQR, PID, Constant, Hysteresis, Random, Schedule, controller_of
from fmugym.control.linearization import linearize
from fmugym.environment.vector import FMUVectorEnv


class Pendulum(fmugym.FMI2CSEnv):
    """Starts near the top; the default observation."""

    def __init__(self, angle=0.05):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["theta", "theta_dot"],
            "model_parameters": {"q_0": np.pi, "theta_0": fmugym.Uniform(-angle, angle)},
            "bounds": {"tau": (-0.05, 0.05)},
            "time_step": 0.02,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)

    def _is_done(self):
        return abs(self.out["theta"]) > 1


class House(fmugym.FMI2CSEnv):
    """A frosty day; the heat pump is the action."""

    def __init__(self, discrete=False):
        self._discrete = discrete
        config = {
            "model_input_names": "u",
            "model_output_names": ["T_air", "T_w"],
            "model_parameters": {"T_out": 268.15, "T_w_0": fmugym.Uniform(300, 308)},
            "time_step": 900.0,
        }
        super().__init__(fmugym.bundled_fmu("House"), config)

    def _is_done(self):
        return False

    def _get_action_space(self):
        return gym.spaces.Discrete(2) if self._discrete else super()._get_action_space()


def run(env, controller, steps, seed=0):
    """Observations and actions of an episode, shapes (steps, k) and (steps, m)."""
    observation, info = env.reset(seed=seed)
    observations, actions = [], []
    for _ in range(steps):
        actions.append(np.atleast_1d(controller.act(observation, info)))
        assert env.action_space.contains(controller_action(env, actions[-1]))
        observation, _, _, _, info = env.step(controller_action(env, actions[-1]))
        observations.append(observation)
    return np.array(observations), np.array(actions)


def controller_action(env, action):
    return int(action.item()) if isinstance(env.action_space, gym.spaces.Discrete) else action


@pytest.fixture
def house(opened):
    return opened(House())


@pytest.fixture
def pendulum(opened):
    return opened(Pendulum())


class TestPID:
    def test_holds_a_house_at_its_set_point(self, house):
        controller = PID("T_air", 294.15, kp=0.4, ti=4 * 3600).bind(house)
        observations, actions = run(house, controller, 6 * 96)
        assert np.abs(observations[-96:, 0] - 294.15).max() < 0.3
        assert 0.2 < actions.mean() < 0.9

    def test_a_proportional_controller_leaves_an_error(self, house):
        observations, _ = run(house, PID("T_air", 294.15, kp=0.4).bind(house), 4 * 96)
        assert 0.5 < 294.15 - observations[-96:, 0].mean() < 3

    def test_is_its_formula(self, house):
        """Written again for one environment, with limits that the first steps reach."""
        kp, ti, td, offset = -0.8, 1800.0, 60.0, 0.3
        controller = PID("T_w", "T_air", kp=kp, ti=ti, td=td, offset=offset).bind(house)
        integral, last, limited = 0.0, None, 0
        rng = np.random.default_rng(1)
        for water in 295 + np.cumsum(rng.normal(0, 0.5, 60)):
            action = controller.act(np.array([295.0, water]))
            slope = 0 if last is None else (water - last) / 900
            error, last = 295 - water, water
            rest = offset + kp * (error - td * slope)
            growth = kp * error * 900 / ti
            total = rest + integral + growth
            if not (total > 1 and growth > 0) and not (total < 0 and growth < 0):
                integral += growth
            limited += not 0 <= total <= 1
            assert action == pytest.approx(min(max(rest + integral, 0), 1), abs=1e-6)
        assert 5 < limited < 55

    def test_does_not_wind_up(self, house):
        """After hours in which the house cannot get warm, the pump stops within a step."""
        controller = PID("T_air", 300.0, kp=0.2, ti=600.0).bind(house)
        for _ in range(500):
            assert controller.act(np.array([280.0, 300.0])) == 1
        assert controller.act(np.array([301.0, 300.0])) < 1
        assert controller.act(np.array([306.0, 300.0])) == 0


def test_signals_may_be_expressions(house):
    rows = np.random.default_rng(0).uniform(280, 310, (50, 2))
    mean = Hysteresis("(T_air + T_w) / 2", "T_w - 3", 0.5).bind(house)
    found = [mean.act(row).item() for row in rows]
    plain = Hysteresis("T_air", 0.0, 0.5).bind(house)
    both = np.stack([rows.mean(axis=1) - (rows[:, 1] - 3), rows[:, 1]], axis=-1)
    assert found == [plain.act(row).item() for row in both]
    assert set(found) == {0.0, 1.0}
    with pytest.raises(fmugym.ConfigError, match=r"setpoint: .*'T_wall'.*'T_w'"):
        PID("T_air", "T_wall - 3", 1.0).bind(house)


def test_a_thermostat_switches_at_its_band(house):
    observations, actions = run(house, Hysteresis("T_air", 293.15, 0.5).bind(house), 6 * 96)
    tail = observations[96:, 0]
    assert 292 < tail.min() < 292.7
    assert 293.6 < tail.max() < 295
    assert set(actions.ravel()) == {0.0, 1.0}
    assert 2 <= np.count_nonzero(np.diff(actions[96:, 0])) < 240


def test_a_thermostat_of_a_switch():
    env = House(discrete=True)
    controller = Hysteresis("T_air", 293.15, 0.2).bind(env)
    action = controller.act(np.array([290.0, 300.0]))
    assert action == 1
    assert env.action_space.contains(action)
    run(env, controller, 20)
    env.close()


class TestLQR:
    @pytest.fixture
    def model(self):
        return linearize(fmugym.bundled_fmu("Pendulum"), at={"q_0": np.pi})

    def test_balances_a_pendulum(self, pendulum, model):
        controller = LQR(model, [1.0, 0.1], [100.0]).bind(pendulum)
        observations, _ = run(pendulum, controller, 300)
        assert np.abs(observations[-50:]).max() < 1e-3

    def test_its_gain_is_the_limit_of_the_riccati_recursion(self, pendulum, model):
        """Backwards from a horizon, with the model's exact step by a power series."""
        controller = LQR(model, [1.0, 0.1], [100.0]).bind(pendulum)
        a, b = step_of(model.A, model.B, pendulum.config.time_step)
        q, r = np.diag([1.0, 0.1]), np.array([[100.0]])
        cost = q
        for _ in range(3000):
            gain = np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a)
            cost = q + a.T @ cost @ (a - b @ gain)
        assert controller.gain == pytest.approx(gain, rel=1e-9)
        assert np.abs(np.linalg.eigvals(a - b @ gain)).max() < 1

    def test_names_of_the_states(self, pendulum, model):
        swapped = LQR(model, [1.0, 0.1], [1.0], of=["b", "a"]).bind(pendulum, names=["a", "b"])
        usual = LQR(model, [1.0, 0.1], [1.0]).bind(pendulum)
        assert swapped.act([2e-4, 1e-4]) == usual.act([1e-4, 2e-4])
        with pytest.raises(fmugym.ConfigError, match=r"'thta'.*'theta'"):
            LQR(model, [1, 1], [1], of=["thta", "theta_dot"]).bind(pendulum)

    @pytest.mark.parametrize(
        ("q", "r", "of", "message"),
        [
            ([1.0], [1.0], None, "q must have 2 weights"),
            ([1.0, 1.0], np.eye(2), None, "r must have 1 weights"),
            ([1.0, 1.0], [1.0], ["theta"], "2 states, but of names 1"),
        ],
    )
    def test_mistakes(self, model, q, r, of, message):
        with pytest.raises(fmugym.ConfigError, match=message):
            LQR(model, q, r, of=of)

    def test_without_a_regulator(self, pendulum, model):
        with pytest.raises(fmugym.ConfigError, match="no regulator stabilizes"):
            LQR(replace(model, B=0 * model.B), [1.0, 1.0], [1.0]).bind(pendulum)


def step_of(a, b, time_step):
    """The exact step of x' = A x + B u with constant u, summed up as a series."""
    n, m = b.shape
    joined = np.zeros((n + m, n + m))
    joined[:n, :n], joined[:n, n:] = a * time_step, b * time_step
    total, term = np.eye(n + m), np.eye(n + m)
    for k in range(1, 40):
        term = term @ joined / k
        total = total + term
    return total[:n, :n], total[:n, n:]


class TestFeedforward:
    def test_a_schedule_follows_the_clock(self, house):
        controller = Schedule({"06:00": 0.8, "22:00": 0.3}, start="05:00").bind(house)
        actions = [controller.act(np.zeros(2)).item() for _ in range(2 * 96)]
        hours = (5 + np.arange(2 * 96) / 4) % 24
        expected = np.where((hours >= 6) & (hours < 22), 0.8, 0.3)
        assert actions == pytest.approx(expected.tolist(), abs=1e-7)
        controller.reset()
        assert controller.act(np.zeros(2)) == pytest.approx(0.3)

    def test_constant_and_random(self, house):
        for action in ([0.25], [0.3], 0.3):
            assert Constant(action).bind(house).act(np.zeros(2)) == pytest.approx(action)
        samples = [Random(seed).bind(house).act(np.zeros(2)).item() for seed in (1, 1, 2)]
        assert samples[0] == samples[1] != samples[2]
        for action in ([1, 2], [1.5], "full"):
            with pytest.raises(fmugym.ConfigError, match=r"the action .* is not in Box"):
                Constant(action).bind(house)

    @pytest.mark.parametrize("time", ["6", "24:00", "06:60", "06:00:61", "noon", ""])
    def test_times_that_are_none(self, time):
        with pytest.raises(fmugym.ConfigError, match="expected a time of day"):
            Schedule({time: 1.0})

    def test_an_empty_schedule(self):
        with pytest.raises(fmugym.ConfigError, match="at least one time"):
            Schedule({})


@pytest.mark.parametrize(
    "controller",
    [
        PID("T_air", 294.15, kp=0.4, ti=7200.0, td=60.0),
        Hysteresis("T_air", 293.15, 0.3),
        Schedule({"06:00": 0.8, "22:00": 0.3}),
    ],
    ids=["pid", "hysteresis", "schedule"],
)
def test_many_environments_are_controlled_as_single_ones(controller):
    envs = FMUVectorEnv(House, 3)
    controller.bind(envs)
    observations, _ = envs.reset(seed=7)
    together = []
    for _ in range(50):
        together.append(controller.act(observations))
        observations, *_ = envs.step(together[-1])
    envs.close()
    for i in range(3):
        env = House()
        _, alone = run(env, controller.bind(env), 50, seed=7 + i)
        assert np.array_equal(np.array(together)[:, i], alone)
        env.close()


def test_episodes_begin_where_the_mask_says(make_envs):
    envs = make_envs(House, 2)
    controller = PID("T_air", 294.0, kp=0.05, ti=900.0).bind(envs)
    rows = np.array([[293.0, 300.0], [293.0, 300.0]])
    for _ in range(3):
        controller.act(rows)
    controller.reset(np.array([True, False]))
    first, second = controller.act(rows).ravel()
    assert first < second


class TestMistakes:
    def test_acting_before_binding(self):
        with pytest.raises(fmugym.ConfigError, match=r"call PID.bind\(env\) before act"):
            PID("T_air", 1.0, kp=1).act(np.zeros(2))

    def test_an_unknown_name(self, house):
        with pytest.raises(fmugym.ConfigError, match=r"observation in of.*'T_ar'.*'T_air'"):
            PID("T_ar", 1.0, kp=1).bind(house)
        with pytest.raises(fmugym.ConfigError, match="observation in setpoint"):
            Hysteresis("T_air", "T_set", 1.0).bind(house)

    def test_an_observation_of_another_shape(self, house):
        controller = Constant([0.5]).bind(house)
        with pytest.raises(fmugym.ConfigError, match=r"shape \(2,\), got one of shape \(3,\)"):
            controller.act(np.zeros(3))

    def test_observations_without_names(self):
        class Unnamed(fmugym.envs.PendulumEnv):
            def _get_observation(self):
                return super()._get_observation()

        env = Unnamed()
        with pytest.raises(
            fmugym.ConfigError,
            match=r"have no names.*'fmugym new .*Pendulum.fmu --output .*give bind",
        ):
            Constant([0.0]).bind(env)
        Constant([0.0]).bind(env, names=["cos", "sin", "rate"]).act(np.zeros(3))
        env.close()

    def test_two_actions(self):
        class Two(fmugym.FMI2CSEnv):
            def _is_done(self):
                return False

        config = {
            "model_input_names": ["tau1", "tau2"],
            "model_output_names": ["q1"],
            "time_step": 0.02,
        }
        env = Two(fmugym.bundled_fmu("DoublePendulum"), config)
        with pytest.raises(fmugym.ConfigError, match="PID gives one number"):
            PID("q1", 0.0, kp=1.0).bind(env)
        env.close()

    @pytest.mark.parametrize(
        "arguments", [{"kp": math.nan}, {"kp": 1, "ti": 0}, {"kp": 1, "td": -1}, {"kp": "1 W"}]
    )
    def test_numbers_of_a_pid(self, arguments):
        with pytest.raises(fmugym.ConfigError):
            PID("T_air", 0.0, **arguments)


class TestTexts:
    def test_a_text_makes_a_controller(self, house):
        made = controller_of("pid of=T_air setpoint=294.15 kp=0.4 ti=7200").bind(house)
        usual = PID("T_air", 294.15, kp=0.4, ti=7200.0).bind(house)
        for temperature in (290.0, 293.0, 296.0):
            observation = np.array([temperature, 300.0])
            assert made.act(observation) == usual.act(observation)
        assert controller_of("hysteresis of=T_air setpoint=T_w band=1").setpoint == "T_w"
        schedule = controller_of("schedule 06:00=0.8 22:00=0.3").bind(house)
        assert schedule.act(np.zeros(2)) == pytest.approx(0.3)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "expected a controller and its arguments"),
            ("pid 'of=T", "expected a controller and its arguments"),
            ("pid T", "expected an argument such as 'kp=0.5', got 'T'"),
            ("pid of=T setpoint=1", "PID needs the argument 'kp'"),
            ("pid of=T setpoint=1 kp=high", "kp"),
            ("schedule", "at least one time"),
        ],
    )
    def test_mistakes(self, text, message):
        with pytest.raises(fmugym.ConfigError, match=message):
            controller_of(text)
