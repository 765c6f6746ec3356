"""Exported agents as FMUs: valid, and in a loop with the plant as the original."""

import ctypes
import dataclasses
import itertools
import shutil
import subprocess
import sys
import zipfile
from contextlib import contextmanager

import fmpy
import gymnasium
import numpy as np
import pytest
from combinations import in_turn
from export_tools import (
    TIMED,
    TIMES,
    acting,
    agent_named,
    differences,
    drawn_in,
    made,
    network_for,
    plant_of,
)
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu
from test_export import heating

import fmugym
from fmugym import ConfigError
from fmugym.deployment.export import agent_of, write_fmu
from fmugym.deployment.export.agent_fmu import PLATFORMS

pytestmark = pytest.mark.skipif(
    sys.platform == "win32" or not shutil.which("cc"), reason="needs a C compiler"
)
VERSIONS = ["2.0", "3.0"]


@pytest.fixture(params=VERSIONS, scope="module")
def version(request):
    return request.param


@pytest.fixture(scope="module")
def house(version, tmp_path_factory):
    """A house, its network, and the FMU of the agent."""
    env = made("House")
    network = network_for(env)
    agent = agent_of(env, network, name="heater", all_inputs=True)
    path = tmp_path_factory.mktemp("house") / "heater.fmu"
    yield env, network, write_fmu(agent, path, fmi_version=version)
    env.close()


class Slave:
    """An instance in FMPy, by the names of its variables."""

    def __init__(self, path, folder):
        description = fmpy.read_model_description(str(path))
        self.variables = {v.name: v for v in description.modelVariables}
        self.is_2 = description.fmiVersion == "2.0"
        made = FMU2Slave if self.is_2 else FMU3Slave
        self.fmu = made(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(path), unzipdir=str(folder)),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="controller",
        )
        self.fmu.instantiate()

    def start(self, **values):
        if self.is_2:
            self.fmu.setupExperiment(startTime=0.0)
            self.set(values)
            self.fmu.enterInitializationMode()
        else:
            self.set(values)
            self.fmu.enterInitializationMode(startTime=0.0)

    def begin(self, **values):
        self.start(**values)
        self.fmu.exitInitializationMode()

    def set(self, values):
        write = self.fmu.setReal if self.is_2 else self.fmu.setFloat64
        write([self.variables[name].valueReference for name in values], list(values.values()))

    def get(self, names):
        read = self.fmu.getReal if self.is_2 else self.fmu.getFloat64
        return np.array(read([self.variables[name].valueReference for name in names]))

    def step(self, time, size):
        self.fmu.doStep(time, size)


@contextmanager
def controller_of(path, folder):
    slave = Slave(path, folder / "controller")
    yield slave
    slave.fmu.terminate()
    slave.fmu.freeInstance()


class TestDescription:
    def test_fmpy_finds_no_mistake(self, house):
        assert validate_fmu(str(house[2])) == []

    def test_variables_are_those_of_the_plant(self, house):
        env, _, path = house
        own = fmugym.FMU(path).description
        plant = env.fmu.description.variables
        for name, causality in (("T_op", "input"), ("u", "output"), ("T_out", "output")):
            assert own.variables[name].causality == causality
            assert own.variables[name].unit == plant[name].unit
            assert own.variables[name].description == plant[name].description
        assert own.units["K"].dimension == env.fmu.description.units["K"].dimension
        assert own.variables["clock"].causality == "parameter"
        assert own.variables["clock"].variability == "tunable"
        assert own.step_size == 900

    def test_the_sources_are_in_it_and_compile_without_a_warning(self, house, tmp_path):
        with zipfile.ZipFile(house[2]) as archive:
            archive.extractall(tmp_path / "all")
        folder = tmp_path / "all" / "sources"
        flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wno-unused-parameter"]
        files = [path.name for path in folder.glob("*.c")]
        assert "heater.c" in files
        command = ["cc", *flags, "-fPIC", "-shared", "-I.", *files, "-o", "x.so", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")

    def test_the_same_agent_gives_the_same_bytes(self, house, version, tmp_path):
        env, network, path = house
        agent = agent_of(env, network, name="heater", all_inputs=True)
        other = write_fmu(agent, tmp_path / "other.fmu", fmi_version=version)
        assert other.read_bytes() == path.read_bytes()


def sampling(controller, logic):
    """A function that takes a sample with an FMU: from measurements to actions."""
    measured, written = ([v.name for v in part] for part in (logic.measurements, logic.inputs))
    times = itertools.count(0.0, logic.time_step)

    def step(values):
        controller.set(dict(zip(measured, values, strict=True)))
        controller.step(next(times), logic.time_step)
        return controller.get(written)

    return step


class TestClosedLoop:
    """The environment with its agent, and two FMUs in FMPy."""

    @in_turn({"env_id": ["CartPole", "Pendulum", "House"], "version": VERSIONS}, ["version"])
    def test_the_exported_agent_controls_the_plant(self, env_id, version, tmp_path):
        env = made(env_id)
        network = network_for(env)
        agent = agent_of(env, network, name="agent", all_inputs=True)
        path = write_fmu(agent, tmp_path / "agent.fmu", fmi_version=version)
        env.reset(seed=1)
        with plant_of(env, tmp_path) as plant, controller_of(path, tmp_path) as controller:
            controller.begin(**drawn_in(env, agent.logic))
            step = sampling(controller, agent.logic)
            _, worst, count = differences(env, acting(network), agent.logic, step, 300, plant)
        assert count > 5
        assert worst <= 1e-5
        env.close()

    @in_turn({"times": ["drawn", "after a warm-up"], "version": VERSIONS}, ["version"])
    def test_from_several_start_times(self, times, version, tmp_path, load):
        env = load(TIMED | TIMES[times])
        network = network_for(env, scaled=False)
        agent = agent_of(env, network, name="agent")
        path = write_fmu(agent, tmp_path / "agent.fmu", fmi_version=version)
        for seed in range(3):
            env.reset(seed=seed)
            with controller_of(path, tmp_path) as controller:
                assert controller.variables["start_time"].unit == "s"
                controller.begin(**drawn_in(env, agent.logic))
                step = sampling(controller, agent.logic)
                _, worst, _ = differences(env, acting(network), agent.logic, step, 60)
                assert worst <= 1e-5

    def test_in_the_simulation_of_fmpy(self, house, tmp_path):
        env, network, path = house
        observation, _ = env.reset(seed=2)
        rows, wanted = [], []
        for count in range(48):
            rows.append((count * 900.0, env.out["T_op"], env.out["T_w"]))
            observation, *_ = env.step(network.action(observation))
            wanted.append(env.inputs)
        signals = np.array(rows, dtype=[(name, float) for name in ("time", "T_op", "T_w")])
        result = fmpy.simulate_fmu(
            str(path),
            stop_time=48 * 900.0,
            step_size=900.0,
            output_interval=900.0,
            input=signals,
            start_values={"clock": env.variables["clock"]},
            validate=True,
        )
        for index, variable in enumerate(env.interface.inputs):
            assert result[variable.name][1:] == pytest.approx([w[index] for w in wanted], abs=1e-5)
            assert result[variable.name][0] == result[variable.name][1]  # known at the beginning


class TestSystems:
    """The exported agent and the plant as components of a system."""

    @in_turn({"task": ["history", "memory", "levels"], "version": VERSIONS}, ["version"])
    def test_the_agent_controls_the_plant(self, task, version, tmp_path):
        env = heating(task)
        network = network_for(env, scaled=False)
        agent = agent_of(env, network, name="agent")
        path = write_fmu(agent, tmp_path / "agent.fmu", fmi_version=version)
        system = fmugym.FMUSystem(
            {"agent": path, "plant": fmugym.bundled_fmu("House", "2.0")},
            ["plant.T_op -> agent.T_op", "agent.u -> plant.u"],
            step_size=900.0,
        )
        assert system.findings == ()
        observation, _ = env.reset(seed=0)
        together = Together(system, {"plant.T_m_0": env.parameters["T_m_0"]})
        together.reset()
        worst = 0.0
        for _ in range(96):
            action = network.action(observation)
            observation, *_ = env.step(int(action[0]) if task == "levels" else action)
            together.step(np.array([300.0]))  # the heat of people, as it is by default
            own = np.array([together.out["plant.T_op"], together.out["agent.u"]])
            worst = max(worst, np.abs(own - [env.out["T_op"], env.inputs[0]]).max())
        assert worst <= 1e-4
        together.close()
        env.close()


class Together(fmugym.FMUEnv):
    """A system in which an exported agent acts."""

    def __init__(self, system, parameters):
        config = {
            "model_input_names": ["plant.Q_int"],
            "model_output_names": ["plant.T_op", "agent.u"],
            "model_parameters": parameters,
            "time_step": 900.0,
        }
        super().__init__(system, config)

    def _is_done(self):
        return False


class TestSteps:
    def signal(self, time):
        return {"T_op": 293.0 + np.sin(time / 5000), "T_w": 300.0}

    def play(self, path, folder, sizes):
        """The outputs after each step."""
        with controller_of(path, folder) as controller:
            controller.begin()
            time, found = 0.0, {}
            for size in sizes:
                controller.set(self.signal(time))
                controller.step(time, size)
                time += size
                found[time] = controller.get(["u"])[0]
        return found

    def test_shorter_ones_hold_the_action(self, house, tmp_path):
        whole = self.play(house[2], tmp_path, [900.0] * 8)
        parts = self.play(house[2], tmp_path, [300.0] * 24)
        assert len(set(whole.values())) == 8
        for time, value in parts.items():
            assert value == whole[900.0 * np.ceil(time / 900)]

    def test_a_longer_one_takes_all_samples_in_it(self, house, tmp_path):
        env, network, _ = house
        agent = agent_of(env, network, all_inputs=True)
        long = self.play(house[2], tmp_path, [1800.0] * 2)
        assert agent.logic.time_step == 900
        assert list(long) == [1800.0, 3600.0]

    def test_rounded_times_add_no_sample(self, tmp_path, version):
        env = made("CloudPendulum")
        agent = agent_of(env, network_for(env), name="swing")  # it remembers its last action
        env.close()
        path = write_fmu(agent, tmp_path / "swing.fmu", fmi_version=version)
        with controller_of(path, tmp_path) as controller:
            controller.begin()
            found = []
            for count in range(200):
                controller.set({"q": np.sin(0.3 * count), "q_dot": np.cos(0.5 * count)})
                controller.step(count * 0.02, (count + 1) * 0.02 - count * 0.02)
                found.append(controller.get(["tau"])[0])
        assert len(set(found)) == 200


class TestStates:
    def test_go_back(self, house, version, tmp_path):
        with controller_of(house[2], tmp_path) as controller:
            controller.begin()
            fmu, state = controller.fmu, None
            runs = []
            for run in range(2):
                values = []
                for count in range(6):
                    if run == 0 and count == 2:
                        state = fmu.getFMUState()
                    if run == 1 and count < 2:
                        continue
                    if run == 1 and count == 2:
                        bytes_ = fmu.serializeFMUState(state)
                        fmu.setFMUState(fmu.deserializeFMUState(bytes_))
                    controller.set({"T_op": 290.0 + count, "T_w": 300.0 + count})
                    controller.step(count * 900.0, 900.0)
                    values.append(controller.get(["u", "T_out"]).tolist())
                runs.append(values[-4:])
            assert runs[0] == runs[1]

    def test_reset(self, house, tmp_path):
        with controller_of(house[2], tmp_path) as controller:
            runs = []
            for _ in range(2):
                controller.begin(clock=1e6)
                controller.set({"T_op": 291.0, "T_w": 301.0})
                controller.step(0.0, 900.0)
                runs.append(controller.get(["u", "T_out"]).tolist())
                controller.fmu.reset()
            controller.begin()
            controller.step(0.0, 900.0)
            assert runs[0] == runs[1] != controller.get(["u", "T_out"]).tolist()


class TestMistakes:
    def test_are_refused_by_the_fmu(self, house, tmp_path):
        with controller_of(house[2], tmp_path) as controller:
            controller.begin()
            with pytest.raises(Exception, match=r"(?i)error"):
                controller.set({"u": 1.0})
            controller.set({"T_op": np.nan})
            with pytest.raises(Exception, match=r"(?i)error"):
                controller.step(0.0, 900.0)

    def test_are_refused_by_the_writer(self, tmp_path):
        agent = agent_named()
        for arguments, fact in [
            ({"fmi_version": "1.0"}, "'1.0'"),
            ({"platforms": ["x86-linux"]}, "'x86_64-linux'"),
            ({"platforms": ["aarch64-linux"]}, "aarch64-linux"),
        ]:
            with pytest.raises(ConfigError, match=fact):
                write_fmu(agent, tmp_path / "agent.fmu", **arguments)
        (tmp_path / "agent.fmu").touch()
        with pytest.raises(FileExistsError, match=r"agent\.fmu"):
            write_fmu(agent, tmp_path / "agent.fmu")


@in_turn({"name": ["get", "agent", "controller"], "version": VERSIONS}, ["version"])
def test_names_of_agents_meet_no_others(name, version, tmp_path):
    path = write_fmu(agent_named(name), tmp_path / f"{name}.fmu", fmi_version=version)
    with controller_of(path, tmp_path) as controller:
        controller.begin()
        controller.step(0.0, 0.02)


class TestTypes:
    """Outputs have the types of the plant's inputs, so that they can be connected."""

    @pytest.mark.parametrize(
        ("type_", "named", "dtype"),
        [("Boolean", "Boolean", ctypes.c_bool), ("Integer", "Int32", ctypes.c_int32)],
    )
    def test_of_outputs(self, type_, named, dtype, version, tmp_path):
        agent = agent_named()
        (force,) = agent.logic.inputs
        force = dataclasses.replace(force, type=type_, minimum=-np.inf, maximum=np.inf)
        logic = dataclasses.replace(agent.logic, inputs=(force,))
        path = write_fmu(
            dataclasses.replace(agent, logic=logic), tmp_path / "a.fmu", fmi_version=version
        )
        assert validate_fmu(str(path)) == []
        with controller_of(path, tmp_path) as controller:
            controller.begin()
            controller.step(0.0, 0.02)
            reference = [controller.variables["f"].valueReference]
            read = getattr(controller.fmu, f"get{type_ if version == '2.0' else named}")
            (value,) = read(reference)
        assert value in ({0, 1} if type_ == "Boolean" else {-10, 10})


class TestInFmugym:
    """The exported agent is an FMU that fmugym loads, too."""

    def test_an_environment_of_the_controller(self, house, version, tmp_path):
        base = fmugym.FMI2CSEnv if version == "2.0" else fmugym.FMI3CSEnv

        class Controller(base):
            def _get_action_space(self):
                return gymnasium.spaces.Box(0, 400, (2,), np.float64)

            def _is_done(self):
                return False

        config = {
            "model_input_names": ["T_op", "T_w"],
            "model_output_names": ["u"],
            "model_parameters": {"clock": fmugym.Uniform(0, 1e6)},
            "time_step": 900.0,
        }
        env, _, path = house
        own = Controller(path, config)
        own.reset(seed=0)
        env.reset(seed=2)
        env.variables["clock"] = own.parameters["clock"]
        with controller_of(path, tmp_path) as slave:
            slave.begin(clock=own.parameters["clock"])
            for count in range(50):
                seen = 290.0 + 5 * np.sin(count), 300.0
                own.step(np.array(seen))
                slave.set(dict(zip(["T_op", "T_w"], seen, strict=True)))
                slave.step(count * 900.0, 900.0)
                assert own.state == tuple(slave.get(["u"]))
        snapshot = own.save_state()
        first = own.step(np.array([290.0, 300.0]))[0]
        own.restore_state(snapshot)
        assert own.step(np.array([290.0, 300.0]))[0] == first
        own.close()


@pytest.mark.exhaustive
def test_all_platforms(tmp_path):
    pytest.importorskip("ziglang", reason="needs ziglang: the extra 'windows'")
    env = made("Pendulum")
    agent = agent_of(env, network_for(env), name="swing")
    env.close()
    path = write_fmu(agent, tmp_path / "all.fmu", fmi_version="3.0", platforms=list(PLATFORMS))
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.startswith("binaries/")]
        begins = {name.split("/")[1]: archive.read(name)[:4] for name in names}
    assert begins == {
        "x86_64-linux": b"\x7fELF",
        "aarch64-linux": b"\x7fELF",
        "x86_64-windows": b"MZx\0",
        "x86_64-darwin": b"\xcf\xfa\xed\xfe",
        "aarch64-darwin": b"\xcf\xfa\xed\xfe",
    }
    assert validate_fmu(str(path)) == []
