"""FMUs that carry FMUs in their resources: FMPy's container."""

import copy

import exchange_tools
import fmpy
import numpy as np
import pytest
from fmpy.container_fmu import cli
from fmpy.container_fmu.config import Component, Configuration, Connection
from fmpy.model_description import CoSimulation, ModelDescription, ModelVariable
from fmu_tools import PlainEnv

STEP = 0.1
CONFIG = {
    "model_input_names": ["u"],
    "model_output_names": ["x1", "x2"],
    "model_parameters": {"k": 2.0},
    "bounds": {"u": (-1, 1)},
    "time_step": STEP,
}
WAYS = {
    "native": {"backend": "native"},
    "isolated": {"isolation": "process"},
}


def variable(name, causality, variability, start=None, version="2.0"):
    kinds = {"2.0": "Real", "3.0": "Float64"}
    kind = "input" if causality == "input" else "exact" if start is not None else "calculated"
    made = ModelVariable(name=name, valueReference=0, type=kinds[version], causality=causality)
    made.variability, made.start = variability, start
    made.initial = None if kind == "input" else kind
    return made


@pytest.fixture(scope="session", params=["2.0", "3.0"])
def container(tmp_path_factory, request):
    """Two FMUs of x' = u - k x in a row."""
    folder = tmp_path_factory.mktemp("container")
    parts = []
    for name in ("first", "second"):
        path = exchange_tools.exchange_fmu(
            folder / f"{name}.fmu", "dahlquist", 2, ("CoSimulation",)
        )
        parts.append(Component(name, path, fmpy.read_model_description(path, validate=False)))
    inner = [{v.name: v for v in part.modelDescription.modelVariables} for part in parts]
    version = request.param
    outer = [
        variable("time", "independent", "continuous", None, version),
        variable("u", "input", "continuous", "0", version),
        variable("x1", "output", "continuous", None, version),
        variable("x2", "output", "continuous", None, version),
        variable("k", "parameter", "fixed", "1", version),
    ]
    description = ModelDescription(
        fmiVersion=version, modelName="Container", instantiationToken="{container}"
    )
    description.guid = "{container}"
    description.modelVariables = outer
    description.coSimulation = CoSimulation(modelIdentifier="container_fmu")
    description.coSimulation.fixedInternalStepSize = STEP
    configuration = Configuration(
        parallelDoStep=False,
        modelDescription=description,
        components=parts,
        connections=[
            Connection(parts[0], [_with_new_type(inner[0]["x"])], parts[1], [inner[1]["u"]])
        ],
        variableMappings={},
    )
    configuration.variableMappings = _Mapping(
        [
            (outer[1], [(parts[0], inner[0]["u"])]),
            (outer[2], [(parts[0], inner[0]["x"])]),
            (outer[3], [(parts[1], inner[1]["x"])]),
            (outer[4], [(parts[0], inner[0]["k"]), (parts[1], inner[1]["k"])]),
        ]
    )
    work = folder / "work"
    work.mkdir()
    cli.create_container_fmu(configuration, work, folder / "container.fmu")
    return folder / "container.fmu"


def _with_new_type(variable):
    """With a type that the container knows; FMPy does not convert those of connections."""
    changed = copy.copy(variable)
    changed.type = "Float64"
    return changed


class _Mapping:
    """A dict whose keys need no hash, as FMPy's variables have none."""

    def __init__(self, pairs):
        self._pairs = pairs

    def items(self):
        return self._pairs


def by_hand(x, u, k=2.0):
    """Each step of the container is one of each part, with 100 Euler steps; then outputs move on.

    Args:
        x: The states of both parts, shape (2, n).
        u: The inputs, shape (n,).
    """
    factor = (1.0 - k * 1e-3) ** 100
    rests = np.array([u, x[0]]) / k
    return rests + (x - rests) * factor


@pytest.mark.parametrize("way", list(WAYS))
def test_single(container, way):
    env = PlainEnv(container, CONFIG, **WAYS[way])
    for _ in range(2):  # episodes
        x = np.array(env.reset(seed=1)[0], float).reshape(2, 1)
        for u in (1.0, 0.0, -1.0, 0.5):
            found = env.step(np.array([u], np.float32))[0]
            x = by_hand(x, np.array([u]))
            np.testing.assert_allclose(found, x[:, 0], rtol=1e-5)
    env.close()


@pytest.mark.parametrize("way", list(WAYS))
def test_vector(container, way, make_envs):
    envs = make_envs(lambda: PlainEnv(container, CONFIG, **WAYS[way]), num_envs=3)
    x = np.array(envs.reset(seed=1)[0], float).T
    for u in np.random.default_rng(1).uniform(-1, 1, (5, 3)).astype(np.float32):
        found = envs.step(u[:, None])[0]
        x = by_hand(x, u)
        np.testing.assert_allclose(found.T, x, rtol=1e-5, atol=1e-6)
