"""What a client reads of an experiment that runs, what it sets there, and what the cell allows."""

import numpy as np
import pytest
from combinations import in_turn
from lab_tools import experiment, track

from fmugym import ConfigError
from fmugym.lab import Lab, LabError, ManualClock
from fmugym.lab.disturbance import (
    StateDependentPositionDisturbance,
    StateDependentTorqueDisturbance,
    TimedPositionDisturbance,
    TimedTorqueDisturbance,
)

DOUBLES = ["DoublePendulum", "Acrobot", "Pendubot"]


class TestGetters:
    def test_float_for_one_actuator(self, single):
        client, token = single
        for get in (client.get_position, client.get_velocity, client.get_torque):
            assert type(get(token)) is float

    @pytest.mark.parametrize("kind", DOUBLES)
    def test_list_for_two(self, lab, kind):
        client, token = experiment(lab, kind)
        for get in (client.get_position, client.get_velocity, client.get_torque):
            values = get(token)
            assert type(values) is list
            assert [type(value) for value in values] == [float, float]

    def test_lists_are_the_callers_own(self, double):
        client, token = double
        client.get_position(token).clear()
        assert len(client.get_position(token)) == 2

    def test_actuator_info(self, lab, single):
        client, token = single
        (info,) = client.get_actuator_info(token)
        assert (info.torque_limit, info.velocity_limit) == (0.15, 50.0)
        client, token = experiment(lab, "Acrobot")
        shoulder, elbow = client.get_actuator_info(token)
        assert (shoulder.name, shoulder.torque_limit) == ("shoulder", 0.0)
        assert (elbow.name, elbow.torque_limit) == ("elbow", 0.15)
        assert "GL35" in str(info)

    def test_logs(self, single):
        client, token = single
        client.set_impedance_controller_params([0.5], [0.01], token)
        first, second = client.get_logs(token).splitlines()
        assert "SimplePendulum on cell 101, 30 s" in first
        assert "kp [0.5] N m/rad, kd [0.01] N m s/rad" in second


class TestSetters:
    @pytest.mark.parametrize("value", [0.02, [0.02], (0.02,), np.array([0.02]), np.float32(0.02)])
    def test_one_actuator_takes_many_forms(self, lab, single, value):
        client, token = single
        client.set_torque(value, token)
        lab.clock.advance(0.01)
        assert client.get_torque(token) == pytest.approx(0.02)

    def test_an_integer_is_a_number(self, single):
        client, token = single
        client.set_position(1, token)
        client.set_impedance_controller_params(0, 0, token)

    def test_none_leaves_a_joint_unchanged(self, lab, double):
        client, token = double
        client.set_torque([0.01, 0.02], token)
        client.set_torque([None, -0.02], token)
        lab.clock.advance(0.001)
        assert client.get_torque(token) == pytest.approx([0.01, -0.02])
        client.set_impedance_controller_params([0.1, None], [None, 0.01], token)
        assert "kp [0.1, 0.0] N m/rad, kd [0.0, 0.01]" in client.get_logs(token)

    @in_turn(
        {
            "value": [0.1, [0.1], [0.1, 0.1, 0.1], []],
            "setter": ["set_position", "set_velocity", "set_torque"],
        }
    )
    def test_wrong_length_for_two(self, double, setter, value):
        client, token = double
        with pytest.raises(RuntimeError, match=r"has \d entries.* 2 joints"):
            getattr(client, setter)(value, token)

    def test_wrong_length_for_one(self, single):
        client, token = single
        with pytest.raises(RuntimeError, match=r"has 2 entries.* 1 joints"):
            client.set_torque([0.1, 0.1], token)
        with pytest.raises(RuntimeError, match="kd has 2 entries"):
            client.set_impedance_controller_params([0.1], [0.1, 0.1], token)

    @pytest.mark.parametrize("value", [float("nan"), [float("inf")], "much", [[]], {"a": 1}])
    def test_not_a_number(self, single, value):
        client, token = single
        with pytest.raises(RuntimeError, match=r"must be|has 0 entries"):
            client.set_torque(value, token)

    def test_negative_gains(self, single):
        client, token = single
        with pytest.raises(RuntimeError, match="kp -1 is outside the limits"):
            client.set_impedance_controller_params(-1.0, 0.0, token)

    def test_clamped_to_the_limits(self, lab, single):
        client, token = single
        client.set_torque(-99.0, token)
        lab.clock.advance(0.01)
        assert client.get_torque(token) == -0.15

    def test_refused_beyond_the_limits(self):
        with Lab("ideal", clock=ManualClock(), clamp_setters=False) as lab:
            client, token = experiment(lab)
            with pytest.raises(RuntimeError, match=r"torque 0.2 is outside the limits of \+-0.15"):
                client.set_torque(0.2, token)
            with pytest.raises(RuntimeError, match="position -7 is outside the limits"):
                client.set_position(-7.0, token)
            with pytest.raises(RuntimeError, match="velocity 51 is outside the limits"):
                client.set_velocity(51.0, token)
            client.set_torque(0.15, token)

    @pytest.mark.parametrize(("kind", "passive"), [("Acrobot", 0), ("Pendubot", 1)])
    def test_passive_joints_get_no_torque(self, lab, kind, passive):
        client, token = experiment(lab, kind)
        client.set_torque([0.02, 0.02], token)
        lab.clock.advance(0.001)
        torque = client.get_torque(token)
        assert torque[passive] == 0.0
        assert torque[1 - passive] == 0.02


def drive_on(lab, client, token, duration=5.0):
    """Read until something is refused; returns the error."""
    with pytest.raises(LabError) as refused:
        track(lab, client, token, duration)
    return refused.value


class TestLimits:
    def test_position(self, lab):
        client, token = experiment(lab, "DoubleIntegrator", initial_position=[6.0])
        client.set_torque(0.01, token)
        text = str(drive_on(lab, client, token))
        kind, value, explanation = text.split(";", 2)
        assert kind == "PositionLimitViolation"
        assert float(value.removeprefix("value=")) == pytest.approx(2 * np.pi, abs=0.01)
        assert "Position Limit Violation" in explanation

    def test_velocity(self):
        with Lab("ideal", clock=ManualClock(), velocity_limit=5.0) as lab:
            client, token = experiment(lab, initial_position=[-3.0])
            text = str(drive_on(lab, client, token))
        assert text.startswith("VelocityLimitViolation;value=5.0")
        assert "Velocity Limit Violation" in text

    def test_torque_saturates(self, lab, single):
        client, token = single
        client.set_position(1.0, token)
        client.set_impedance_controller_params(100.0, 1.0, token)
        lab.clock.advance(0.001)
        assert client.get_torque(token) == 0.15

    def test_torque_beyond_the_limit_where_it_does_not_saturate(self):
        with Lab("ideal", clock=ManualClock(), saturate_torque=False) as lab:
            client, token = experiment(lab)
            client.set_position(1.0, token)
            client.set_impedance_controller_params(100.0, 0.0, token)
            text = str(drive_on(lab, client, token))
        assert text.startswith("TorqueLimitViolation;value=0.45;Torque Limit Violation")

    def test_a_violation_ends_the_session_and_frees_the_cell(self, lab):
        client, token = experiment(lab, "DoubleIntegrator", initial_position=[6.2], cell_id=102)
        client.set_torque(0.1, token)
        first = drive_on(lab, client, token)
        with pytest.raises(LabError) as second:
            client.set_torque(0.0, token)
        assert str(second.value) == str(first)
        assert client.stop_experiment(token) == ""
        client, token = experiment(lab, cell_id=102)
        assert client.get_position(token) == 0.0

    def test_a_fault_of_the_model_ends_the_session(self, lab):
        client, token = experiment(lab)
        cell = lab._bookings.cells[0]
        cell._pool.inputs[:] = 0.0
        cell.drive.torque[0] = float("nan")
        cell.drive._limits[0] = float("nan")
        lab.clock.advance(0.1)
        with pytest.raises(LabError, match="the cell failed: "):
            client.get_position(token)


class TestDisturbances:
    def test_torque_for_a_time(self, lab):
        push = TimedTorqueDisturbance(start_time=1.0, duration=0.2, torque=[0.02])
        client, token = experiment(lab, "DoubleIntegrator", disturbances=[push])
        lab.clock.advance(1.0)
        assert client.get_velocity(token) == 0.0
        lab.clock.advance(0.1)
        assert client.get_velocity(token) == pytest.approx(0.02 / 6e-4 * 0.1, rel=0.05)
        assert client.get_torque(token) == 0.0  # the motor does not feel it
        lab.clock.advance(0.1)
        speed = client.get_velocity(token)
        lab.clock.advance(0.1)
        assert 0.9 * speed < client.get_velocity(token) < speed  # friction only

    def test_preset(self, lab):
        client, token = experiment(lab, disturbances="default_simple_pendulum")
        track(lab, client, token, 4.9, 0.5)
        assert client.get_position(token) == pytest.approx(0.0, abs=1e-12)
        track(lab, client, token, 0.6, 0.2)
        assert abs(client.get_position(token)) > 0.1

    @pytest.mark.parametrize(
        ("pull", "begin", "duration", "expected"),
        [
            (TimedPositionDisturbance(0.5, [0.8], duration=1.0), 0.0, 1.4, 0.72),  # it sags
            (TimedPositionDisturbance(0.5, duration=1.0), 1.0, 1.4, 0.0),
            (StateDependentPositionDisturbance([0.0], [0.5], duration=1.0), 1.0, 1.1, 0.44),
        ],
        ids=["at a time", "to rest", "at a position"],
    )
    def test_pulls(self, lab, pull, begin, duration, expected):
        client, token = experiment(lab, initial_position=[begin], disturbances=pull)
        track(lab, client, token, duration, 0.1)
        assert client.get_position(token) == pytest.approx(expected, abs=0.05)

    def test_torque_at_a_position(self, lab):
        push = StateDependentTorqueDisturbance([0.0], 0.1, [0.05], tolerance=0.2, earliest=0.5)
        calm, quiet = experiment(lab, initial_position=[1.0])
        client, token = experiment(lab, initial_position=[1.0], disturbances=[push])
        for _ in range(20):
            lab.clock.advance(0.05)
            pair = client.get_velocity(token), calm.get_velocity(quiet)
        assert abs(pair[0] - pair[1]) > 1.0

    def test_pull_without_a_position(self, lab):
        pull = StateDependentPositionDisturbance([0.0, 0.0], duration=1.0)
        client, token = experiment(lab, "Acrobot", disturbances=[pull])
        track(lab, client, token, 0.5, 0.1)
        assert client.get_position(token) == pytest.approx([0.0, 0.0], abs=1e-6)

    @pytest.mark.parametrize(
        ("arguments", "word"),
        [
            (("soon", 1.0, [0.1]), "start_time"),
            ((0.0, float("nan"), [0.1]), "duration"),
            ((0.0, -1.0, [0.1]), "duration"),
            ((0.0, 1.0, 0.1), "torque"),
            ((0.0, 1.0, [None]), "torque"),
        ],
    )
    def test_arguments_that_make_no_sense(self, arguments, word):
        with pytest.raises(ConfigError, match=f"TimedTorqueDisturbance: {word}"):
            TimedTorqueDisturbance(*arguments)

    def test_one_of_the_users_own_that_fails(self, lab):
        class Unready:
            duration, torque, position = 1.0, (0.01,), None

            def is_due(self, time, position):
                raise ZeroDivisionError("not ready")

        client, token = experiment(lab, disturbances=Unready())
        lab.clock.advance(0.1)
        with pytest.raises(LabError, match="not ready"):
            client.get_position(token)
        experiment(lab, cell_id=101)

    def test_wrong_length(self, lab):
        with pytest.raises(LabError, match="torque has 2 entries for 1 joints"):
            experiment(lab, disturbances=[TimedTorqueDisturbance(0.0, 1.0, [0.1, 0.1])])
