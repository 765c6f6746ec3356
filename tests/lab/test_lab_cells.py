"""The cells: their motion, their drives, and their readings."""

import math

import numpy as np
import pytest
from lab_tools import AT_ONCE, experiment, ideal_lab, track
from scipy.integrate import solve_ivp

from fmugym import ConfigError
from fmugym.lab import CellType, Lab, LabError, ManualClock, Options

WEIGHT = 0.06 * 9.81 * 0.1  # N m
INERTIA = 0.06 * 0.1**2  # kg m^2
ENCODER_STEP = 2 * math.pi / 2**17  # rad
LAG = 0.00375  # s


def make_lab(**arguments):
    return Lab(**{"clock": ManualClock(), "seed": 7, **arguments})


def free_fall(angle, times, friction=0.0):
    """Reference by scipy: angles and angular velocities of the published single pendulum."""

    def derivative(_, state):
        q, v = state
        torque = WEIGHT * math.sin(q) + 4e-4 * v + friction * math.tanh(v / 0.05)
        return v, -torque / INERTIA

    return solve_ivp(
        derivative, (0, times[-1]), (angle, 0.0), t_eval=times, rtol=1e-10, atol=1e-12
    ).y


class TestMotion:
    def test_free_fall_is_that_of_the_equation(self, lab):
        client, token = experiment(lab, initial_position=[2.0])
        swing = track(lab, client, token, 3.0)
        reference, _ = free_fall(2.0, np.arange(151) * 0.02)
        assert swing == pytest.approx(reference, abs=1e-6)

    def test_cells_move_between_calls_however_few(self, lab):
        often, first = experiment(lab, initial_position=[1.0])
        seldom, second = experiment(lab, initial_position=[1.0])
        for _ in range(150):
            lab.clock.advance(0.01)
            often.get_velocity(first)
        assert often.get_position(first) == seldom.get_position(second)

    def test_double_integrator_has_no_weight(self, lab):
        client, token = experiment(lab, "DoubleIntegrator", initial_position=[1.0])
        lab.clock.advance(1.0)
        assert client.get_position(token) == pytest.approx(1.0, abs=1e-12)

    def test_a_session_begins_anew(self, lab):
        client, token = experiment(lab)
        client.set_impedance_controller_params(1.0, 0.01, token)
        client.set_torque(0.1, token)
        lab.clock.advance(0.2)
        client.stop_experiment(token)
        client, token = experiment(lab)
        lab.clock.advance(0.5)
        assert (client.get_position(token), client.get_velocity(token)) == pytest.approx((0, 0))

    def test_parameters_of_the_plant(self):
        with ideal_lab(parameters={CellType.SINGLE: {"b": 0.0, "l": 0.4}}) as lab:
            client, token = experiment(lab, initial_position=[0.01])
            swing = track(lab, client, token, 1.5, 0.05)
        times = np.arange(31) * 0.05
        assert swing == pytest.approx(0.01 * np.cos(np.sqrt(9.81 / 0.4) * times), abs=1e-5)

    def test_unknown_parameter(self):
        with pytest.raises(ConfigError, match="mass"):
            ideal_lab(parameters={CellType.SINGLE: {"mass": 1.0}})

    def test_parameters_that_the_plant_refuses(self):
        with ideal_lab(parameters={CellType.SINGLE: {"m": -1.0}}) as lab:
            with pytest.raises(LabError, match="m, l and v_c must be positive"):
                experiment(lab)
            assert experiment(lab, "Acrobot")
            assert lab.clock.time() == 0.0


class TestDrive:
    def test_stiffness_balances_the_weight(self, lab):
        client, token = experiment(lab)
        client.set_position([1.0], token)
        client.set_impedance_controller_params([0.1], [0.01], token)
        track(lab, client, token, 5.0, 0.5)
        q, torque = client.get_position(token), client.get_torque(token)
        assert torque == pytest.approx(0.1 * (1.0 - q), abs=1e-6)
        assert torque == pytest.approx(WEIGHT * math.sin(q), abs=1e-6)

    def test_damping_follows_a_velocity(self, lab):
        client, token = experiment(lab, "DoubleIntegrator")
        client.set_impedance_controller_params(0.0, 0.05, token)
        client.set_velocity(3.0, token)
        track(lab, client, token, 1.0, 0.5)
        assert client.get_velocity(token) == pytest.approx(3.0 * 0.05 / 0.0504, rel=1e-4)

    def test_torque_is_fed_forward(self, lab):
        client, token = experiment(lab, initial_position=[math.pi / 2])
        client.set_torque(WEIGHT, token)
        track(lab, client, token, 1.0, 0.5)
        assert client.get_position(token) == pytest.approx(math.pi / 2, abs=1e-6)

    def test_spring_gains_no_energy(self):
        plant = {CellType.SINGLE: {"b": 0.0}}
        with ideal_lab(parameters=plant) as lab:
            client, token = experiment(lab, "DoubleIntegrator", initial_position=[0.2])
            client.set_impedance_controller_params(0.5, 0.0, token)
            swing = track(lab, client, token, 10.0, 0.001)
        assert max(swing[-500:]) == pytest.approx(0.2, rel=0.01)

    def test_step_of_the_drive_hardly_matters(self):
        swings = []
        for step in (5e-4, 2.5e-5):  # the default, and the 40 kHz of the hardware
            with ideal_lab(drive_step=step) as lab:
                client, token = experiment(lab)
                client.set_position(1.0, token)
                client.set_impedance_controller_params(0.3, 0.003, token)
                swings.append(track(lab, client, token, 1.0))
        assert swings[0] == pytest.approx(swings[1], abs=2e-3)
        assert max(swings[0]) > 1.0


class TestStartPosition:
    @pytest.mark.parametrize(
        ("asked", "measured"),
        [(0.6, 0.468), (1.0, 0.787), (1.4, 1.119), (1.9, 1.587), (2.4, 2.133)],
    )
    def test_hardware_sags_as_the_real_double_pendulum_did(self, asked, measured):
        with make_lab() as lab:
            client, token = experiment(lab, "DoublePendulum", initial_position=[asked, 0.0])
            assert client.get_position(token)[0] == pytest.approx(measured, abs=0.012)

    @pytest.mark.parametrize("asked", [-2.0, 0.5, 1.0, 2.0])
    def test_single_pendulum_sags_by_its_own_weight(self, asked):
        with make_lab(coulomb_friction=(0.0, 0.0)) as lab:
            client, token = experiment(lab, initial_position=[asked])
            q = client.get_position(token)
        assert abs(q) < abs(asked)
        assert 0.43 * (asked - q) == pytest.approx(WEIGHT * math.sin(q), abs=1e-4)

    def test_homing_takes_its_time(self):
        with make_lab(**AT_ONCE) as lab:
            experiment(lab, preparation_time=0.5)
            assert lab.clock.time() == pytest.approx(1.5)


@pytest.fixture(name="readings")
def fixture_readings():
    """Position, velocity and torque of a hardware cell that hangs, one row a new sample."""
    rows = []
    with make_lab(**AT_ONCE) as lab:
        client, token = experiment(lab)
        for _ in range(10_000):
            lab.clock.advance(0.002)
            rows.append([getattr(client, f"get_{what}")(token) for what in NAMES])
    return np.array(rows).T


NAMES = ("position", "velocity", "torque")


class TestReadings:
    def test_noise_at_rest(self, readings):
        _, velocity, torque = readings
        assert velocity.std() == pytest.approx(0.04, rel=0.05)
        assert torque.std() == pytest.approx(4e-4, rel=0.05)
        assert velocity.mean() == pytest.approx(0.0, abs=0.002)
        assert abs(np.corrcoef(velocity[1:], velocity[:-1])[0, 1]) < 0.05

    def test_elbow_has_the_worse_sensor(self):
        rows, angles = [], []
        with make_lab(**AT_ONCE) as lab:
            client, token = experiment(lab, "DoublePendulum", initial_position=[1.0, 0.0])
            for _ in range(3000):
                lab.clock.advance(0.005)
                rows.append(client.get_velocity(token))
                angles.append(client.get_position(token)[1])
        assert np.std(rows[-1000:], axis=0) == pytest.approx([0.04, 0.3], rel=0.1)
        assert np.allclose(np.remainder(np.divide(angles, 3.835e-4) + 0.5, 1.0), 0.5, atol=0.1)

    def test_position_is_quantized(self):
        with make_lab() as lab:
            client, token = experiment(lab, initial_position=[1.5])
            swing = np.array(track(lab, client, token, 2.0))
        assert pytest.approx(4.794e-5, rel=1e-4) == ENCODER_STEP
        assert np.allclose(swing / ENCODER_STEP, np.rint(swing / ENCODER_STEP), atol=1e-6)
        assert len(set(swing)) > 50

    def test_share_of_stale_repeats_is_the_measured_one(self):
        """In the public swings of 10 s, 44.1 to 44.7 % of the rows at 1 kHz repeat the last."""
        with make_lab(**AT_ONCE) as lab:
            client, token = experiment(lab)
            velocity = track(lab, client, token, 10.0, 0.001, "get_velocity")
        assert np.mean(np.diff(velocity) == 0.0) == pytest.approx(0.445, abs=0.015)

    def test_new_samples_come_after_one_or_two_milliseconds(self):
        with make_lab(**AT_ONCE) as lab:
            client, token = experiment(lab)
            velocity = track(lab, client, token, 5.0, 0.0005, "get_velocity")
        gaps = np.diff(np.flatnonzero(np.diff(velocity)))
        assert set(gaps) == {2, 4}
        assert np.mean(gaps == 2) == pytest.approx(0.2, abs=0.03)

    def test_velocity_lags(self):
        with ideal_lab(velocity_lag=LAG) as lab:
            client, token = experiment(lab, "DoubleIntegrator")
            client.set_torque(0.006, token)
            lab.clock.advance(0.2)
            velocity = client.get_velocity(token)
        reference = 0.006 / 4e-4 * (1 - math.exp(-4e-4 / INERTIA * (0.2 - LAG)))
        assert velocity == pytest.approx(reference, abs=0.003)  # 0.038 less than it is


class TestFriction:
    def test_each_hardware_cell_draws_its_own(self):
        """Each falls differently, and none as if it had less or more friction than there is."""
        assert Options.coulomb_friction == (1.7e-3, 3.9e-3)
        with ideal_lab(coulomb_friction=Options.coulomb_friction) as lab:
            running = [experiment(lab, initial_position=[1.5]) for _ in range(4)]
            lab.clock.advance(1.0)
            fallen = [client.get_position(token) for client, token in running]
        least, most = (
            free_fall(1.5, [0.0, 1.0], friction)[0][-1] for friction in Options.coulomb_friction
        )
        assert len(set(fallen)) == 4
        assert least <= min(fallen) < max(fallen) <= most

    def test_swing_dies_as_the_equation_says(self):
        with ideal_lab(coulomb_friction=(2e-3, 2e-3)) as lab:
            client, token = experiment(lab, initial_position=[1.5])
            swing = track(lab, client, token, 3.0)
        reference, _ = free_fall(1.5, np.arange(151) * 0.02, friction=2e-3)
        assert swing == pytest.approx(reference, abs=2e-4)
        assert max(swing[-30:]) < 0.3


class TestNetwork:
    def test_call_times(self):
        with make_lab() as lab:
            client, token = experiment(lab, length=60.0)
            times = {"get": [], "set": []}
            for _ in range(6000):
                begin = lab.clock.time()
                client.get_position(token)
                middle = lab.clock.time()
                client.set_torque(0.0, token)
                times["get"].append(1e3 * (middle - begin))
                times["set"].append(1e3 * (lab.clock.time() - middle))
        assert 0.21 < np.median(times["get"]) < 0.25  # ms, as in public logs
        assert 0.5 < np.percentile(times["get"], 99) < 1.3
        assert 0.31 < np.median(times["set"]) < 0.35
        assert 0.8 < np.percentile(times["set"], 99) < 1.9
        both = np.array(times["get"] + times["set"])
        assert np.mean(both > 10.0) == pytest.approx(0.002, abs=0.0015)
        assert both.max() < 55.0


class TestSeeds:
    def test_equal_seeds_give_equal_readings(self):
        readings = {}
        for seed in (1, 1, 2):
            with make_lab(seed=seed) as lab:
                client, token = experiment(lab, initial_position=[1.0])
                swing = track(lab, client, token, 1.0, getter="get_velocity")
            readings.setdefault(seed, []).append(swing)
        assert readings[1][0] == readings[1][1]
        assert readings[1][0] != readings[2][0]
