"""The bundled FMUs: rebuilt, validated, and their states and derivatives tried through FMPy."""

import re
import sys
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

import fmugym
from fmugym.fmi.bundled import BUNDLED_FMUS, FMI_VERSIONS, MODELS, bundled_fmu

ROOT = Path(__file__).parents[2]
STATES = {
    "CartPole": ["x", "x_dot", "phi", "phi_dot"],
    "Pendulum": ["theta", "theta_dot"],
    "DoublePendulum": ["q1", "q1_dot", "q2", "q2_dot"],
    "House": ["T_m", "T_w", "E"],
}
DERIVATIVES = {
    "CartPole": ["x_dot", "x_ddot", "phi_dot", "phi_ddot"],
    "Pendulum": ["theta_dot", "theta_ddot"],
    "DoublePendulum": ["q1_dot", "q1_ddot", "q2_dot", "q2_ddot"],
    "House": ["der_T_m", "der_T_w", "P"],
}
START = {
    "CartPole": {"x_0": 0.1, "x_dot_0": -0.3, "phi_0": 0.4, "phi_dot_0": 0.7},
    "Pendulum": {"q_0": 1.2, "q_dot_0": -0.8, "c": 2e-3},
    "DoublePendulum": {"q1_0": 0.9, "q1_dot_0": -0.06, "q2_0": 1.3, "q2_dot_0": 0.04},
    "House": {"T_m_0": 291.0, "T_w_0": 309.0},
}
INPUTS = {
    "CartPole": {"f": 3.0},
    "Pendulum": {"tau": 0.02},
    "DoublePendulum": {"tau1": 0.05, "tau2": -0.02},
    "House": {"T_out": 270.0, "I_sol": 150.0, "Q_int": 400.0, "u": 0.6},
}


@pytest.mark.skipif(
    sys.platform == "win32", reason="the FMUs are built and released on Linux and macOS"
)
@pytest.mark.parametrize(("model", "version"), BUNDLED_FMUS)
def test_linux_libraries_are_rebuilt_byte_for_byte(model, version, tmp_path, monkeypatch):
    pytest.importorskip("ziglang", reason="needs the extra test, which brings the compiler")
    monkeypatch.syspath_prepend(str(ROOT / "resources"))
    from build_fmus import build_library

    library = build_library(model, version, "x86_64-linux", tmp_path)
    folder = "x86_64-linux" if version == "3.0" else "linux64"
    with zipfile.ZipFile(bundled_fmu(model, version)) as archive:
        committed = archive.read(f"binaries/{folder}/{model}.so")
    assert library.read_bytes() == committed


def c_sources(folder):
    """The C files below a folder; fmu.c is none, because it joins all others."""
    return [path for path in sorted(folder.glob("**/*.[ch]")) if path.name != "fmu.c"]


def test_c_sources_of_fmus_include_what_they_call():
    folder = ROOT / "resources" / "src"
    includes, defines = {}, {}
    for path in c_sources(folder):
        text = path.read_text()
        includes.setdefault(path.stem, set()).update(re.findall(r'#include "(\w+)\.h"', text))
        if path.suffix == ".c":
            names = re.findall(r"^(?!static)(?:\w+ )+\*?(\w+)\([^;]*?\) {$", text, re.M)
            defines[path.stem] = set(names)
    assert "report" in defines["log"]
    needs = {name: found & includes.keys() - {name} for name, found in includes.items()}
    for caller in defines:
        text = (folder / f"{caller}.c").read_text()
        for other in defines.keys() - {caller}:
            if any(re.search(rf"\b{name}\(", text) for name in defines[other] - {"emit_message"}):
                assert other in needs[caller], f"{caller}.c calls functions of {other}.c"


@pytest.mark.parametrize(("model", "version"), BUNDLED_FMUS)
def test_validation_finds_no_problem(model, version):
    assert validate_fmu(str(bundled_fmu(model, version))) == []


@pytest.mark.parametrize(("model", "version"), BUNDLED_FMUS)
def test_libraries_for_all_platforms(model, version):
    platforms = {
        "1.0": ("darwin64", "linux64", "win64"),
        "2.0": ("darwin64", "linux64", "win64"),
        "3.0": (
            "aarch64-darwin",
            "aarch64-linux",
            "x86_64-darwin",
            "x86_64-linux",
            "x86_64-windows",
        ),
    }
    assert fmugym.FMU(bundled_fmu(model, version)).platforms == platforms[version]


@pytest.mark.parametrize("model", MODELS)
def test_macos_library_is_for_both_processors(model):
    with zipfile.ZipFile(bundled_fmu(model, "2.0")) as archive:
        library = archive.read(f"binaries/darwin64/{model}.dylib")
    assert library[:4] == b"\xca\xfe\xba\xbe"  # a universal binary
    count = int.from_bytes(library[4:8], "big")
    kinds = {int.from_bytes(library[8 + 20 * i : 12 + 20 * i], "big") for i in range(count)}
    assert kinds == {0x01000007, 0x0100000C}  # x86-64 and arm64


@pytest.mark.parametrize("model", MODELS)
def test_descriptions_agree_between_the_versions(model):
    """Names, units, limits and start values; what FMI 1.0 cannot say is left out."""
    versions = [v for v in FMI_VERSIONS if (model, v) in BUNDLED_FMUS]
    described = [fmugym.FMU(bundled_fmu(model, v)).description for v in versions]

    def facts(variable):
        limits = variable.minimum, variable.maximum
        return variable.kind, variable.start, variable.unit, limits, variable.items

    first = {name: facts(v) for name, v in described[0].variables.items() if name != "time"}
    for other in described[1:]:
        assert {n: facts(v) for n, v in other.variables.items() if n != "time"} == first


class Driver:
    """An FMU driven through FMPy's own classes."""

    def __init__(self, model, version, tmp_path):
        self.model = model
        path = str(bundled_fmu(model, version))
        self.description = fmpy.read_model_description(path)
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        self.is_fmi3 = version == "3.0"
        self.fmu = (FMU3Slave if self.is_fmi3 else FMU2Slave)(
            guid=self.description.guid,
            modelIdentifier=model,
            unzipDirectory=str(fmpy.extract(path, tmp_path)),
            instanceName=model,
        )
        self.fmu.instantiate()
        self.set(START[model])
        if self.is_fmi3:
            self.fmu.enterInitializationMode()
        else:
            self.fmu.setupExperiment()
            self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        self.set(INPUTS[model])
        self.time = 0.0

    def set(self, values):
        references = [self.references[name] for name in values]
        (self.fmu.setFloat64 if self.is_fmi3 else self.fmu.setReal)(
            references, list(values.values())
        )

    def get(self, names):
        references = [self.references[name] for name in names]
        return np.array((self.fmu.getFloat64 if self.is_fmi3 else self.fmu.getReal)(references))

    def step(self, count=1):
        for _ in range(count):
            self.fmu.doStep(self.time, 0.01)
            self.time = round(self.time + 0.01, 10)
        return self.get(STATES[self.model])

    def derivative(self, unknowns, known):
        arguments = [self.references[n] for n in unknowns], [self.references[known]], [1.0]
        return np.array(self.fmu.getDirectionalDerivative(*arguments))


@pytest.fixture(params=[pair for pair in BUNDLED_FMUS if pair[1] != "1.0"], ids="-".join)
def driver(request, tmp_path):
    made = Driver(*request.param, tmp_path)
    yield made
    made.fmu.terminate()
    made.fmu.freeInstance()


def right_hand_side(model, state, inputs):
    """The derivatives, from the published equations in a form of their own."""
    equations = {
        "Pendulum": pendulum,
        "DoublePendulum": double_pendulum,
        "CartPole": cart_pole,
        "House": house,
    }
    return equations[model](state, *inputs)


def pendulum(state, tau):
    angle, velocity = state
    m, length, b, c, v_c, g = 0.06, 0.1, 4e-4, 2e-3, 0.05, 9.81
    moment = tau - b * velocity - c * np.tanh(velocity / v_c)
    return np.array([velocity, moment / (m * length**2) + g / length * np.sin(angle)])


def double_pendulum(state, tau1, tau2):
    q1, v1, q2, v2 = state
    p1, p2, p3, p6, p4, p5 = 7.466e-4, 1.489e-4, 2.160e-4, 2.122e-4, 0.09642, 0.03400
    matrix = [[p1 + 2 * p2 * np.cos(q2), p3 + p2 * np.cos(q2)], [p3 + p2 * np.cos(q2), p6]]
    coriolis = p2 * np.sin(q2) * np.array([-(2 * v1 * v2 + v2**2), v1**2])
    gravity = np.array([p4 * np.sin(q1), 0.0]) + p5 * np.sin(q1 + q2)
    v = np.array([v1, v2])
    friction = [3.20e-4, 1.31e-4] * v + [2.29e-3, 3.15e-3] * np.tanh(v / 0.05)
    a1, a2 = np.linalg.solve(matrix, [tau1, tau2] - coriolis - gravity - friction)
    return np.array([v1, a1, v2, a2])


def house(state, outside, solar, internal, load):
    """The balances of the two nodes without capacity as a linear system."""
    mass, water, _ = state
    ms, of_air, gains = 9.1 * 375, 3.45 * 675, internal / 2 + 8 * solar
    share = 375 / 675
    matrix = [[60 + of_air + 400, -of_air], [-of_air, ms + 40 + of_air]]
    to_surface = (1 - share - 40 / (9.1 * 675)) * gains
    heat = [60 * outside + 400 * water + internal / 2, ms * mass + 40 * outside + to_surface]
    air, surface = np.linalg.solve(matrix, heat)
    lift, power = water - outside, 3000 * load
    cop = 0.85 * (6.08 - 0.09 * lift + 0.0005 * lift**2)
    to_mass = (outside - mass) / (1 / 100 - 1 / ms) + ms * (surface - mass) + share * gains
    return np.array([to_mass / 24.75e6, (cop * power - 400 * (water - air)) / 2.5e6, power])


def cart_pole(state, f):
    _, v, phi, w = state
    rod = 900 * np.pi * 0.025**2
    mass, first = rod + 1.0, 0.5 * rod + 1.0
    second = rod * (1 / 3 + 0.025**2 / 4) + 1.0 + 0.001
    matrix = [[10.0 + mass, first * np.cos(phi)], [first * np.cos(phi), second]]
    forces = [f + first * w**2 * np.sin(phi), 9.81 * first * np.sin(phi)]
    x_ddot, phi_ddot = np.linalg.solve(matrix, forces)
    return np.array([v, x_ddot, w, phi_ddot])


def test_directional_derivatives_are_those_of_the_equations(driver):
    """Against central differences of the right-hand side above."""
    model = driver.model
    knowns = [*STATES[model], *INPUTS[model]]
    point = np.array([*driver.get(STATES[model]), *INPUTS[model].values()])
    count = len(STATES[model])

    def derivatives(point):
        return right_hand_side(model, point[:count], point[count:])

    assert driver.get(DERIVATIVES[model]) == pytest.approx(derivatives(point), rel=1e-9)
    for known, change in zip(knowns, 1e-6 * np.eye(len(knowns)), strict=True):
        slope = (derivatives(point + change) - derivatives(point - change)) / 2e-6
        assert driver.derivative(DERIVATIVES[model], known) == pytest.approx(
            slope, rel=1e-6, abs=1e-10 if model == "House" else 1e-4
        )


def test_directional_derivatives_after_steps(driver):
    """The same where a step has just been done and nothing was read since."""
    driver.step(3)
    state, inputs = driver.get(STATES[driver.model]), list(INPUTS[driver.model].values())
    known, change = STATES[driver.model][0], np.eye(len(state))[0] * 1e-6
    ahead, behind = (right_hand_side(driver.model, state + s * change, inputs) for s in (1, -1))
    assert driver.derivative(DERIVATIVES[driver.model], known) == pytest.approx(
        (ahead - behind) / 2e-6, rel=1e-6, abs=1e-4
    )


def test_outputs_answer_inputs_before_the_step(tmp_path):
    """The air of the house has no capacity, so it follows the ventilation at once."""
    driver = Driver("House", "3.0", tmp_path)
    before = driver.get(["T_air", "T_w"])
    driver.set({"T_out": 260.0, "u": 0.9})
    after = driver.get(["T_air", "T_w"])
    slope = driver.derivative(["T_air"], "T_out")
    assert slope[0] > 0.02
    assert after - before == pytest.approx([-10.0 * slope[0], 0.0])
    driver.fmu.terminate()
    driver.fmu.freeInstance()


def test_a_torque_beyond_its_limit_has_no_influence(tmp_path):
    driver = Driver("DoublePendulum", "3.0", tmp_path)
    driver.set({"tau1": 0.2, "tau2": 0.1})
    assert driver.derivative(["q1_ddot", "q2_ddot"], "tau1").tolist() == [0.0, 0.0]
    assert driver.derivative(["q2_ddot"], "tau2")[0] > 0
    driver.fmu.terminate()
    driver.fmu.freeInstance()


def test_outputs_follow_their_states(driver):
    pairs = {
        "CartPole": ("theta", "phi", -1.0),
        "Pendulum": ("q", "theta", 1.0),
        "DoublePendulum": ("q2", "q2", 1.0),
        "House": ("T_w", "T_w", 1.0),
    }
    output, state, factor = pairs[driver.model]
    assert driver.derivative([output], state).tolist() == [factor]


def test_the_double_pendulum_is_not_there_for_fmi_1():
    with pytest.raises(fmugym.ConfigError, match=r"no bundled DoublePendulum for FMI 1\.0, only"):
        bundled_fmu("DoublePendulum", 1.0)


def test_states_are_restored_and_serialized(driver):
    driver.step(5)
    saved, time = driver.fmu.getFMUState(), driver.time
    size = len(driver.fmu.serializeFMUState(saved))
    data = driver.fmu.serializeFMUState(saved)
    after = driver.step(20)
    driver.fmu.setFMUState(saved)
    driver.time = time
    assert driver.step(20).tolist() == after.tolist()
    revived = driver.fmu.deserializeFMUState(data)
    driver.fmu.setFMUState(revived)
    driver.time = time
    assert driver.step(20).tolist() == after.tolist()
    for state in (saved, revived):
        driver.fmu.freeFMUState(state)
    assert 0 < size < 2000
