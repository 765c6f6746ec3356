"""Plants: an agent in the shadow of one, and an FMU that is one, by Modbus TCP."""

import numpy as np
import pytest

pytest.importorskip("pymodbus", reason="needs pymodbus, of the extra plant")

from plant_tools import STEP, Line, LockStep, functions_in, house, nothing_left, player

import fmugym
from fmugym.episodes.simulation import action_of, policy_of, simulate
from fmugym.logs import PlantLog, play_log
from fmugym.plant import Server, connect
from fmugym.series import RecordSeries


@pytest.fixture(autouse=True)
def _nothing_left():
    with nothing_left():
        yield


@pytest.fixture
def clock():
    return LockStep()


@pytest.fixture
def server(clock):
    with Server(house(), player(), clock=clock) as found:
        yield found


def watch(server, clock, task=None, address=None):
    return connect(task or house(), address or server.address, physical=True, clock=clock)


def reference(steps):
    """The same house under the same thermostat, without a plant."""
    env = RecordSeries(fmugym.load(house(), physical=True))
    simulate(env, policy_of(env.unwrapped, "thermostat"), 0, steps)
    env.close()
    return env.series


class TestShadow:
    def test_records_what_the_plant_does(self, server, clock, tmp_path):
        env = RecordSeries(watch(server, clock), path=tmp_path / "plant.csv")
        env.reset(seed=0)
        for _ in range(12):
            _, _, terminated, truncated, info = env.step(np.float32([0.3]))
            assert not terminated
            assert not truncated
            assert "fault" not in info
        env.close()
        found, plain = env.series, reference(40)
        times = np.arange(len(plain)) * STEP
        begin = float(found["time"][0]) - 309 * 86400.0
        assert begin % STEP == 0
        for name, off in (("T", 0.03), ("T_floor", 0.3)):
            expected = np.interp(begin + np.arange(13) * STEP, times, plain[name])
            np.testing.assert_allclose(found[name], expected, atol=off)
        first = round(begin / STEP)
        np.testing.assert_allclose(found["u"][1:], plain["u"][first + 1 : first + 13], atol=1e-6)
        assert 0.0 < found["u"].mean() < 1.0
        np.testing.assert_allclose(found["proposed.u"][1:], 0.3, atol=1e-6)
        np.testing.assert_allclose(
            found["power"][1:], plain["power"][first + 1 : first + 13], atol=0.61
        )

    def test_its_record_is_a_log(self, server, clock, tmp_path):
        env = RecordSeries(watch(server, clock), path=tmp_path / "plant.csv")
        simulate(env, action_of(env.unwrapped, "0.5"), 0, 6)
        env.close()
        log = PlantLog.read(tmp_path / "plant.csv")
        assert log.units["T"] == "degC"
        assert log.inputs_before
        (recording,) = play_log(log, lambda **more: fmugym.load(house(), physical=True, **more))
        assert len(recording) == 6
        np.testing.assert_allclose(recording.rewards, env.series["reward"][1:], atol=1e-9)

    def test_writes_nothing(self, server, clock):
        line = Line(server.address)
        env = watch(server, clock, address=line.address)
        simulate(env, action_of(env.unwrapped, "0.5"), 0, 2)
        env.close()
        line.close()
        assert functions_in(line.sent) == {3, 4}

    def test_the_server_refuses_who_writes(self, server):
        from pymodbus.client import ModbusTcpClient

        host, port = server.address.split(":")
        client = ModbusTcpClient(host, port=int(port))
        assert client.connect()
        before = client.read_holding_registers(0, count=4).registers
        assert client.write_register(0, 1).exception_code == 1
        assert client.read_holding_registers(0, count=4).registers == before
        client.close()

    def test_fills_histories(self, server, clock):
        task = house(agent={"history": {"of": ["T", "u"], "length": "1h"}})
        env = RecordSeries(watch(server, clock, task))
        observation, _ = env.reset(seed=0)
        names = list(env.unwrapped.observation_names)
        past = [observation[names.index(f"T[-{900 * k} s]")] for k in range(1, 5)]
        assert len(set(past)) == 4
        time = float(env.series["time"][0]) - 309 * 86400.0
        plain = reference(12)
        expected = np.interp(
            [time - k * STEP for k in range(1, 5)], np.arange(13) * STEP, plain["T"]
        )
        np.testing.assert_allclose(past, expected, atol=0.03)
        acted = [observation[names.index(f"u[-{900 * k} s]")] for k in range(1, 5)]
        first = round(time / STEP)
        np.testing.assert_allclose(acted, plain["u"][first : first - 4 : -1], atol=1e-6)
        env.close()
