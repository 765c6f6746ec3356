"""Derivatives by and of elements of arrays, against the matrices of a linear model."""

import numpy as np
import pytest
import values_tools
from combinations import in_turn
from scipy.linalg import expm
from values_tools import LARGER, STEP, Env

import fmugym
from fmugym import ConfigError
from fmugym.control.linearization import derivatives, linearize, linearize_along

KINDS = pytest.mark.parametrize("kind", ["Directional", "Adjoint"])
SIZES = {name: LARGER[name] for name in "nmr"}
MATRICES = {name: np.array(LARGER[name], float) for name in "ABCD"}
GIVEN = {name: LARGER[name] for name in ("A", "B", "C", "D", "x_0")}
U = np.array([[0.5, -0.25], [1.0, 2.0], [-3.0, 0.0]], np.float32)


def made(folder, kind="Directional", **options):
    return values_tools.state_space_fmu(folder / f"{kind}.fmu", derivatives=kind, **options)


@in_turn({"kind": ["Directional", "Adjoint"], "interface": ["CoSimulation", "ModelExchange"]})
def test_the_matrices_come_out(tmp_path, kind, interface):
    fmu = fmugym.FMU(made(tmp_path, kind, interfaces=(interface,)), sizes=SIZES)
    model = linearize(fmu, at=GIVEN | {"u": [1.0, -2.0]})
    assert model.A.tolist() == LARGER["A"]
    assert model.B.tolist() == LARGER["B"]
    assert model.states == ("x[1]", "x[2]", "x[3]")
    assert model.derivatives == ("der(x)[1]", "der(x)[2]", "der(x)[3]")
    assert model.inputs == ("u[1]", "u[2]")
    assert model.x0.tolist() == LARGER["x_0"]
    assert model.u0.tolist() == [1.0, -2.0]
    wanted = MATRICES["A"] @ LARGER["x_0"] + MATRICES["B"] @ [1.0, -2.0]
    assert model.f == pytest.approx(wanted, rel=1e-15)


@KINDS
def test_some_elements(tmp_path, kind):
    fmu = fmugym.FMU(made(tmp_path, kind), sizes=SIZES)
    model = linearize(fmu, at=GIVEN, states=["x[3]", "x[1]"], inputs="u[2]")
    places = np.ix_([2, 0], [2, 0])
    assert model.A.tolist() == MATRICES["A"][places].tolist()
    assert model.B.tolist() == MATRICES["B"][[2, 0]][:, [1]].tolist()
    assert linearize(fmu, at=GIVEN, states="x").A.tolist() == LARGER["A"]


def test_wrong_names(tmp_path):
    path = made(tmp_path, fixed=True)
    with pytest.raises(ConfigError, match=r"'y\[1\]'.*state.*'x\[1\]', 'x\[2\]'"):
        linearize(path, states="y")
    with pytest.raises(ConfigError, match=r"x\[3\].*\(2,\)"):
        linearize(path, states="x[3]")
    with pytest.raises(ConfigError, match=r"'A'.*\(2, 2\).*\(3,\)"):
        linearize(path, at={"A": [1, 2, 3]})


def discrete():
    """The matrices of one step in which the inputs are constant."""
    block = np.zeros((5, 5))
    block[:3, :3], block[:3, 3:] = MATRICES["A"], MATRICES["B"]
    exact = expm(block * STEP)
    return exact[:3, :3], exact[:3, 3:]


@in_turn({"method": ["directional", "differences"], "options": [{}, {"isolation": "process"}]})
def test_along_a_trajectory(tmp_path, method, options, make_envs):
    path = made(tmp_path)

    def make():
        parameters = {"model_parameters": LARGER, "model_input_names": "u"}
        return Env(path, model_output_names=["y"], **parameters, **options)

    envs = make_envs(make, 2)
    envs.reset(seed=0)
    start = envs.save_state()[0]
    states = {"x": "x_0"} if method == "differences" else None
    found = linearize_along(envs, start, U, states=states, method=method)
    a, b = discrete()
    c, d = MATRICES["C"], MATRICES["D"]
    accuracy = {"rel": 1e-4, "abs": 1e-4} if method == "differences" else {"abs": 1e-6}
    for step in range(len(U)):
        assert found.A[step] == pytest.approx(a, **accuracy)
        assert found.B[step] == pytest.approx(b, **accuracy)
        assert found.C[step] == pytest.approx(c @ a, **accuracy)
        assert found.D[step] == pytest.approx(c @ b + d, **accuracy)
    x = np.array(LARGER["x_0"], float)
    for step, u in enumerate(U):
        assert found.x[step] == pytest.approx(x, abs=1e-7)
        x = a @ x + b @ u


def test_derivatives_of_a_rollout(tmp_path, make_envs):
    def make():
        parameters = {"model_parameters": LARGER, "model_input_names": "u"}
        return Env(made(tmp_path), model_output_names=["y", "x[2]"], **parameters)

    envs = make_envs(make, 2)
    envs.reset(seed=0)
    found = derivatives(envs, envs.save_state()[0], U)
    a, b = discrete()
    rows = np.vstack([MATRICES["C"], [[0, 1, 0]]])
    direct = np.vstack([MATRICES["D"], [[0, 0]]])
    for step in range(3):
        for action in range(3):
            wanted = np.zeros((2, 2))
            if action <= step:
                wanted = rows @ np.linalg.matrix_power(a, step - action) @ b
                wanted = wanted + direct * (action == step)
            assert found.by_actions[step, :, action] == pytest.approx(wanted, abs=1e-3)
