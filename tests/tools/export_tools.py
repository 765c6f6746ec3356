"""Tools of the tests of exported agents: networks made by hand, compiled agents, and plants."""

import ctypes
import itertools
import json
import shutil
import subprocess
import sys
from contextlib import closing, contextmanager
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from fmpy import extract, read_model_description
from fmpy.simulation import apply_start_values, instantiate_fmu
from gymnasium import spaces

from fmugym.deployment.export import (
    Activation,
    Layer,
    Network,
    Scaling,
    agent_of,
    write_c,
    write_onnx,
)

FLAGS = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", "-ffp-contract=off")
COMPILERS = {"C99": ["cc", "-std=c99"], "C++": ["c++", "-std=c++11", "-x", "c++"]}


def network_for(env, hidden=(16, 16), scaled=True, squashed=False, seed=0, activation="tanh"):
    """A network with random weights for the spaces of an environment."""
    rng = np.random.default_rng(seed)
    space = env.action_space
    count = int(np.prod(env.observation_space.shape))
    if isinstance(space, spaces.Box):
        last = int(np.prod(space.shape))
    else:
        last = int(np.sum(getattr(space, "nvec", getattr(space, "n", 0))))
    widths = [count, *hidden, last]
    layers = [
        Layer(
            (rng.normal(size=(b, a)) / np.sqrt(a)).astype(np.float32),
            (0.1 * rng.normal(size=b)).astype(np.float32),
            (Activation(activation),) if index < len(hidden) else (Activation("tanh"),) * squashed,
        )
        for index, (a, b) in enumerate(itertools.pairwise(widths))
    ]
    scaling = None
    if scaled:
        scaling = Scaling(rng.normal(size=count), rng.uniform(0.5, 2, count), np.full(count, 10.0))
    return Network(tuple(layers), space, scaling, squashed)


TIMED = {
    "fmu": {"bundled": "House"},
    "time_step": "15min",
    "variables": {"T": {"name": "T_op", "unit": "degC", "min": 10, "max": 30}},
    "data": {"price": {"values": [1, 3, 2, 5, 4], "step": "1h"}},
    "expressions": {"late": {"expr": "sin(time / 7200)", "min": -1, "max": 1}},
    "agent": {"actions": ["u"], "observations": ["T", "price", "late"], "normalize": True},
    "reward": "-abs(T - 21)",
}
"""A task that depends on the time."""

TIMES = {
    "drawn": {"start_time": {"distribution": "uniform", "low": 0, "high": 86400}},
    "listed": {"start_time": ["10h", "20h 45min", "01-15 06:30"]},
    "after a warm-up": {"start_time": ["10h", "20h"], "warm_up": "45min"},
    "constant": {"start_time": "90min", "warm_up": "45min"},
    "clock": {"clock": ["10h", "20h 45min", "01-15 06:30"]},
}
"""When its episodes begin."""


def made(env_id):
    """A registered environment without wrappers."""
    return gymnasium.make(f"fmugym/{env_id}-v0").unwrapped


def agent_named(name="agent", seed=0):
    """An agent of a cart-pole with random weights."""
    with closing(made("CartPole")) as env:
        return agent_of(env, network_for(env, seed=seed), name=name)


def differences(env, act, logic, step, steps, plant=None):
    """Let the exported agent act beside the environment's own one, until the episode ends.

    Args:
        env: An environment that has been reset. It may have a wrapper.
        act: The environment's agent: from an observation to an action.
        logic: What the exported agent measures and writes.
        step: The exported agent: from measurements to actions.
        steps: How many, at most.
        plant: What the exported agent controls; without it, it measures the environment.

    Returns:
        The largest differences of measurements and of inputs, and the number of steps.
    """
    outer, env = env, env.unwrapped
    measured, written = ([v.name for v in part] for part in (logic.measurements, logic.inputs))
    interface, worst = env.interface, np.zeros(2)
    observation = env._get_observation()
    for count in range(steps):
        seen = [env.out[name] for name in measured]
        own = plant.read(measured) if plant else seen
        actions = step(own)
        action = act(observation)
        if isinstance(outer.action_space, spaces.Discrete):
            action = int(np.ravel(action)[0])
        observation, _, terminated, truncated, _ = outer.step(action)
        inputs = dict(zip([v.name for v in interface.inputs], env.inputs, strict=True))
        pairs = (own, seen), (actions, [inputs[name] for name in written])
        worst = np.maximum(worst, [np.abs(np.subtract(*pair)).max() for pair in pairs])
        if plant:
            inputs |= dict(zip(written, actions, strict=True))
            plant.write(list(inputs), list(inputs.values()))
            plant.step(count * interface.time_step)
        if terminated or truncated:
            break
    return *worst, count + 1


def acting(network):
    """A network as an agent of an environment."""
    return lambda observation: network.action(np.ravel(observation))


def closed_loop(env, act, agent, folder, steps=1000, seed=0, language="C99"):
    """The ``differences`` in an episode with a plant in FMPy and the exported agent."""
    controller = exported(agent, folder, language)
    env.reset(seed=seed)
    controller.begin(**drawn_in(env.unwrapped, agent.logic))
    with plant_of(env.unwrapped, folder) as plant:
        return differences(env, act, agent.logic, controller.step, steps, plant)


def exported(agent, folder, language="C99"):
    """An agent in a language, which takes samples: ``COMPILERS`` has some, ``"ONNX"`` is one."""
    if language != "ONNX":
        return compiled(agent, folder, language)
    return Runner(write_onnx(agent, folder / "agent.onnx"))


def drawn_in(env, logic):
    """What the episode of an environment has drawn, as parameters of an exported agent."""
    values = {**env.parameters, **env.variables}
    return {one.name: values[one.name] for one in logic.parameters}


def compiled(agent, folder, language="C99"):
    """Write and compile an agent; the object takes samples."""
    if sys.platform == "win32" or shutil.which(COMPILERS[language][0]) is None:
        pytest.skip(f"needs a compiler of {language}: {COMPILERS[language][0]}")
    write_c(agent, folder)
    library = folder / f"{agent.name}-{language}.so"
    command = [*COMPILERS[language], *FLAGS, "-shared", "-fPIC", "-o", str(library)]
    done = subprocess.run(
        [*command, str(folder / f"{agent.name}.c"), "-lm"], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    return CompiledAgent(agent, ctypes.CDLL(str(library)))


def built(source, folder):
    """Compile a text and load it."""
    if sys.platform == "win32" or shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    (folder / "own.c").write_text(source)
    command = ["cc", "-std=c99", *FLAGS, "-shared", "-fPIC", "-o", "own.so", "own.c", "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return ctypes.CDLL(str(folder / "own.so"))


class CompiledAgent:
    """An agent in C, called as a controller would call it."""

    def __init__(self, agent, library):
        self.agent = agent
        self._init = library[f"{agent.name}_init"]
        self._step = library[f"{agent.name}_step"]
        self.memory = ctypes.create_string_buffer(8 + 16 * 8 * 4096)
        self._actions = (ctypes.c_double * len(agent.logic.inputs))()

    def begin(self, **parameters):
        """Begin an episode, with parameters set as a user of the struct would."""
        self._init(self.memory)
        assert all(one.dtype.itemsize == 8 for one in self.agent.logic.kept) or not parameters
        for parameter in self.agent.logic.parameters:
            if parameter.name in parameters:
                before = self.agent.logic.kept[: parameter.field]
                place = 8 + 8 * (sum(len(one.starts) for one in before) + parameter.element)
                value = ctypes.c_double.from_buffer(self.memory, place)
                assert value.value == parameter.start
                value.value = parameters[parameter.name]

    def step(self, measurements):
        """The actions, or None if the agent has refused the measurements."""
        numbers = (ctypes.c_double * len(measurements))(*measurements)
        if self._step(self.memory, numbers, self._actions):
            return None
        return list(self._actions)


class Runner:
    """Takes samples with ONNX Runtime, as a user would."""

    def __init__(self, path, count=1):
        runtime = pytest.importorskip("onnxruntime", reason="needs ONNX Runtime")
        self.session = runtime.InferenceSession(str(path))
        facts = self.session.get_modelmeta().custom_metadata_map
        self.facts = {name: json.loads(value) for name, value in facts.items()}
        types = {"tensor(double)": np.float64, "tensor(float)": np.float32}
        types["tensor(int64)"] = np.int64
        self._kinds = {one.name: types[one.type] for one in self.session.get_inputs()}
        self._count = count
        self.begin()

    def begin(self, **parameters):
        """Begin an episode."""
        self.memory = {
            name: np.repeat(np.array(start, self._kinds[name])[None], self._count, axis=0)
            for name, start in self.facts["memory"].items()
        }
        for name, value in parameters.items():
            self.memory[name][:] = value

    def steps(self, measurements):
        """The actions for measurements of shape (N, m)."""
        names = ["actions", *(f"next_{name}" for name in self.memory)]
        inputs = {"measurements": np.asarray(measurements, np.float64), **self.memory}
        actions, *memory = self.session.run(names, inputs)
        self.memory = dict(zip(self.memory, memory, strict=True))
        return actions

    def step(self, measurements):
        """The actions for those of one plant."""
        return self.steps([measurements])[0]


@contextmanager
def plant_of(env, tmp_path):
    """The FMU of an environment in FMPy, with the parameters of its episode."""
    folder = extract(str(env.fmu.path), unzipdir=str(tmp_path / "plant"))
    description = read_model_description(folder)
    variables = {v.name: v for v in description.modelVariables}
    slave = instantiate_fmu(folder, description, "CoSimulation")
    slave.setupExperiment(startTime=0.0)
    assert not apply_start_values(slave, description, dict(env.parameters))
    slave.enterInitializationMode()
    slave.exitInitializationMode()

    def read(names):
        return slave.getReal([variables[name].valueReference for name in names])

    def write(names, values):
        slave.setReal([variables[name].valueReference for name in names], values)

    def step(time):
        parts = env.config.substeps
        size = env.interface.time_step / parts
        for index in range(parts):
            slave.doStep(time + index * size, size)

    yield SimpleNamespace(read=read, write=write, step=step)
    slave.terminate()
    slave.freeInstance()


ACTIVATIONS = [
    *map(Activation, ["tanh", "relu", "sigmoid", "silu"]),
    Activation("leaky_relu", (0.02,)),
    Activation("elu", (0.7,)),
    Activation("softplus", (1.5, 20.0)),
    Activation("clamp", (-0.5, 0.25)),
]
"""Each kind of a layer's activation."""


def network_with(activation, env, squashed):
    """A network whose first layer has an activation."""
    first, *rest = network_for(env, squashed=squashed).layers
    layers = Layer(first.weights, first.bias, (activation,)), *rest
    return Network(layers, env.action_space, squashed=squashed)
