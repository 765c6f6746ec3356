"""Derivatives of FMUs that have only a library for Windows."""

from functools import partial

import fmu_tools
import numpy as np
import pytest
import test_array_derivatives
from combinations import in_turn
from test_derivatives import HORIZON, Precise
from test_linearization import POINTS
from test_trajectories import STARTS, TORQUES, along
from wine_tools import building_for_windows, exchange_fmu, for_windows

import fmugym
from fmugym import SimulationError, bundled_fmu
from fmugym.control.linearization import linearize

PARTS = ("A", "B", "f", "x0", "u0")


@pytest.mark.usefixtures("wine")
class TestInWine:
    @in_turn({"model": list(POINTS), "version": ["2.0", "3.0"]})
    def test_linear_models_are_those_of_the_library_for_linux(self, tmp_path, model, version):
        path = bundled_fmu(model, version)
        ours, native = (
            linearize(one, at=POINTS[model]) for one in (for_windows(path, tmp_path), path)
        )
        assert (ours.states, ours.inputs) == (native.states, native.inputs)
        for part in PARTS:
            np.testing.assert_allclose(
                getattr(ours, part), getattr(native, part), rtol=1e-12, atol=1e-12
            )

    def test_of_some_states_and_no_inputs(self, tmp_path):
        path = for_windows(bundled_fmu("DoublePendulum"), tmp_path)
        all_ = linearize(path)
        some = linearize(path, states=["q2_dot", "q2"], inputs=[])
        assert some.A.tolist() == all_.A[np.ix_([3, 1], [3, 1])].tolist()
        assert some.B.shape == (2, 0)

    @pytest.mark.parametrize(
        ("version", "interface", "flags"),
        [
            (2, "ModelExchange", 'providesDirectionalDerivative="true"'),
            (3, "ModelExchange", 'providesDirectionalDerivatives="true"'),
            (3, "ModelExchange", 'providesAdjointDerivatives="true"'),
            (3, "CoSimulation", 'providesAdjointDerivatives="true"'),
        ],
    )
    def test_of_van_der_pol_by_its_equations(self, tmp_path, version, interface, flags):
        path = exchange_fmu(tmp_path / "m.fmu", "van_der_pol", version, (interface,), flags)
        model = linearize(path, at={"x1": 1.5, "x2": -0.5, "mu": 3.0})
        expected = [[0.0, 1.0], [2 * 3.0 * 1.5 * 0.5 - 1.0, 3.0 * (1.0 - 1.5**2)]]
        assert model.A.tolist() == expected
        assert model.f.tolist() == [-0.5, 3.0 * (1.0 - 1.5**2) * -0.5 - 1.5]
        assert linearize(path, states="x2").A.shape == (1, 1)

    @in_turn({"kind": ["Directional", "Adjoint"], "interface": ["CoSimulation", "ModelExchange"]})
    def test_of_arrays(self, tmp_path, kind, interface):
        with building_for_windows():
            test_array_derivatives.test_the_matrices_come_out(tmp_path, kind, interface)
            test_array_derivatives.test_some_elements(tmp_path, kind)

    def test_an_fmu_that_fails(self, tmp_path):
        probe = fmu_tools.probe_fmu(tmp_path, edits=fmu_tools.CLAIMING_DERIVATIVES)
        path = for_windows(probe, tmp_path)
        with pytest.raises(SimulationError, match="the derivative by 'sum' returned Error"):
            linearize(path, at={"label": "derived", "gain": 2.0})
        with pytest.raises(SimulationError, match="initialization returned Error"):
            linearize(path, at={"init_status": 3})

    @pytest.mark.parametrize("method", ["directional", "differences"])
    def test_along_a_trajectory(self, tmp_path, method):
        path = for_windows(bundled_fmu("Pendulum"), tmp_path)
        given = {"states": STARTS} if method == "differences" else {}
        ours = along(partial(Precise, fmu=path), method=method, **given)
        native = along(method=method, **given)
        assert ours.A.shape == (HORIZON, 2, 2)
        for part in "ABCDxy":
            np.testing.assert_allclose(
                getattr(ours, part), getattr(native, part), rtol=1e-6, atol=1e-9
            )

    def test_of_several_instances_at_their_own_inputs(self, tmp_path):
        """``along`` plays one; here each of three has a state and a torque of its own."""
        path = for_windows(bundled_fmu("Pendulum"), tmp_path)
        envs = fmugym.FMUVectorEnv(partial(Precise, fmu=path), 3, workers=2)
        envs.reset(seed=0)
        for _ in range(3):
            envs.step(TORQUES[:3])
        pool, fmu = envs.pool, envs.prototype.fmu
        slope = fmu.description.state_derivatives["theta_dot"]
        unknowns, knowns = (fmu.variable(slope),), (fmu.variable("theta"), fmu.variable("tau"))
        found = pool.differentiate(unknowns, knowns)
        angles = pool.read((fmu.variable("theta"),))[0]
        envs.close()
        assert found.shape == (1, 2, 3)
        assert len(set(angles)) == 3
        np.testing.assert_allclose(found[0, 0], 9.81 / 0.1 * np.cos(angles), rtol=1e-12)
        np.testing.assert_allclose(found[0, 1], 1 / (0.06 * 0.1**2), rtol=1e-12)
