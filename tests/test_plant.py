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


class TestFaults:
    """Clear words, and nothing lost from the record."""

    @pytest.fixture()
    def line(self, server):
        found = Line(server.address)
        yield found
        found.close()

    def test_a_server_that_goes_and_comes_back(self, server, clock, line, tmp_path):
        clock.patience = 0.2
        task = house(stale_after="5min", hold="20min")
        env = RecordSeries(watch(server, clock, task, line.address), path=tmp_path / "plant.csv")
        policy, told = held_by(env), []
        observation, _ = env.reset(seed=0)
        for step in range(8):
            (line.cut if step == 1 else line.mend if step == 5 else str)()
            observation, *_, info = env.step(policy(observation))
            told.append((info["missing"], info.get("fault", "")))
        env.close()
        assert [bool(missing) for missing, _ in told] == [False] * 2 + [True] * 3 + [False] * 3
        assert ["T: " in fault for _, fault in told] == [False] + [True] * 4 + [False] * 3
        assert "connection" in told[2][1]
        series = env.series
        assert len(series) == 9
        assert np.isnan(series["T"]).tolist() == [False] * 3 + [True] * 3 + [False] * 3
        assert len(set(series["proposed.u"][4:6].tolist())) == 1
        assert series.faults.keys() == {2, 3, 4, 5}
        text = (tmp_path / "plant.csv").read_text(encoding="utf-8")
        assert len(text.splitlines()) == 10

    def test_a_server_that_is_started_anew(self, clock, tmp_path):
        with Server(house(), player(), clock=clock) as first:
            line = Line(first.address)
            env = watch(first, clock, address=line.address)
            env.reset(seed=0)
            env.step(np.float32([0.5]))
        clock.patience = 0.2
        *_, info = env.step(np.float32([0.5]))
        assert "T: " in info["fault"]
        with Server(house(), player(), clock=clock, seed=1) as second:
            line.target = int(second.address.split(":")[1])
            for _ in range(2):
                *_, info = env.step(np.float32([0.5]))
            assert "T: " not in info.get("fault", "")
            env.close()
        line.close()

    def test_no_server(self, clock):
        with watch_at("127.0.0.1:9", clock, house(timeout="0.2s")) as env:
            with pytest.raises(SimulationError, match=r"127.0.0.1.*T: .*connection"):
                env.reset()

    def test_a_tag_that_does_not_exist(self, server, clock):
        tags = dict(house().document["plant"]["tags"])
        tags["T_floor"] = {"register": 900, "type": "int16"}
        with watch_at(server.address, clock, house(tags=tags)) as env:
            with pytest.raises(ConfigError, match=r"T_floor: holding 900 of unit 1.*no such") as e:
                env.reset()
        assert "power" not in str(e.value)

    def test_a_wrong_type(self, server, clock):
        tags = dict(house().document["plant"]["tags"])
        tags["T"] = {"register": 0, "type": "float64", "unit": "K", "word_order": "little"}
        with watch_at(server.address, clock, house(tags=tags)) as env:
            with pytest.raises(ConfigError, match=r"T: .*expected.*10.*30.*'type'"):
                env.reset()

    def test_a_clock_that_jumps(self, server, clock, monkeypatch):
        env = watch(server, clock)
        env.reset(seed=0)
        env.step(np.float32([0.5]))
        before = float(env.unwrapped.time)
        original = server_time(server, monkeypatch, 4 * 3600.0)
        *_, truncated, info = env.step(np.float32([0.5]))
        assert truncated
        assert "clock has jumped by 14400 s" in info["fault"]
        env.reset()
        assert float(env.unwrapped.time) >= before + 4 * 3600.0
        *_, truncated, info = env.step(np.float32([0.5]))
        assert not truncated
        assert original is not None
        env.close()

    def test_answers_that_are_late(self, server, line):
        """Two seconds on a line: values are old, and nothing waits for them but who asks."""
        clock = RealClock(60.0)
        task = house(poll="10s", stale_after="10min")
        with Server(house(), player(), clock=clock) as late:
            line.target, line.delay = int(late.address.split(":")[1]), 0.5
            env = watch(late, clock, task, line.address)
            env.reset(seed=0)
            begin = clock.time()
            for _ in range(1):
                *_, info = env.step(np.float32([0.5]))
            assert clock.time() - begin == pytest.approx(STEP, rel=0.2)
            assert "fault" not in info
            env.close()

    def test_two_clients(self, server, clock):
        first, second = (RecordSeries(watch(server, clock)) for _ in range(2))
        first.reset(seed=0)
        second.reset(seed=0)
        for _ in range(3):
            first.step(np.float32([0.5]))
            second.step(np.float32([0.2]))
        first.close()
        second.close()
        for name in ("T", "u", "power"):
            np.testing.assert_allclose(first.series[name], second.series[name], atol=0.62)
