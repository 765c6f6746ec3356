"""What a client reads of an experiment that runs, what it sets there, and what the cell allows."""

import numpy as np
import pytest
from combinations import in_turn
from lab_tools import experiment, ideal_lab, track

from fmugym.lab import CellType, LabError

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
        with ideal_lab(velocity_limit=5.0) as lab:
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

    def test_a_violation_ends_the_session_and_frees_the_cell(self, lab):
        client, token = experiment(lab, "DoubleIntegrator", initial_position=[6.2])
        client.set_torque(0.1, token)
        first = drive_on(lab, client, token)
        with pytest.raises(LabError) as second:
            client.set_torque(0.0, token)
        assert str(second.value) == str(first)
        assert client.stop_experiment(token) == ""
        client, token = experiment(lab)
        assert client.get_position(token) == 0.0

    def test_a_fault_of_the_model_ends_the_session(self):
        """Such damping is too much for it as soon as the arm moves."""
        with ideal_lab(parameters={CellType.SINGLE: {"b": 1e300}}) as lab:
            client, token = experiment(lab, initial_position=[1.0])
            lab.clock.advance(0.1)
            with pytest.raises(LabError, match="the cell failed: "):
                client.get_position(token)
            assert lab.running == []
