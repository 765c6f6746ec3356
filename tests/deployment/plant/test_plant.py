"""Plants: an agent in the shadow of one, and an FMU that is one, by Modbus TCP."""

import asyncio
import datetime
import json
import re
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymodbus", reason="needs pymodbus, of the extra plant")

from letters import wide, with_wide_names
from plant_tools import (
    STEP,
    Line,
    changed,
    functions_in,
    house,
    played,
    watched,
)
from process_tools import wait_until
from pymodbus.client import ModbusTcpClient

import fmugym
from fmugym.cli.plant_commands import evaluate_log
from fmugym.control import MPC
from fmugym.deployment.plant import Server, connect
from fmugym.deployment.plant.feed import _time_of_year
from fmugym.deployment.plant.plant_server import environment
from fmugym.deployment.plant.polling import ConnectionLostError, Poller
from fmugym.deployment.plant.tags import read_plant
from fmugym.errors import ConfigError, SimulationError
from fmugym.lab import RealClock
from fmugym.records import RecordSeries
from fmugym.records.log_fit import fit_logs
from fmugym.records.plant_log import PlantLog, as_logged, play_log
from fmugym.records.players import action_of, policy_of, simulate
from fmugym.task import Task
from fmugym.task.series import read_data


@pytest.fixture
def server(clock):
    with Server(house(), "thermostat", clock=clock) as found:
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

    def test_an_action_is_the_median_of_its_readings(self, shadowed, monkeypatch):
        """It is on for two thirds of each step, and off when a step ends."""
        changed(monkeypatch, lambda values: {"u": (float(values["clock"][0] % STEP > 300.0),)})
        env = RecordSeries(shadowed(house()))
        played(env, 3)
        assert env.series["u"][1:].tolist() == [1.0] * 3

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
        assert functions_in(line.sent) == {1, 3, 4}

    def test_the_server_refuses_who_writes(self, server):
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


@pytest.fixture
def line(server, opened):
    return opened(Line(server.address))


def tags_with(**others):
    return dict(house().document["plant"]["tags"]) | others


class TestFaults:
    """Clear words, and nothing lost from the record."""

    def test_a_server_that_goes_and_comes_back(self, clock, line, tmp_path):
        task = house(stale_after="5min", hold="20min", timeout="1s")
        with watched(clock, line.address, task) as shadow:
            env = RecordSeries(shadow, path=tmp_path / "plant.csv")
            told = []
            env.reset(seed=0)
            for step in range(8):
                if step == 1:
                    clock.longest_wait = 0.1
                    line.cut()
                if step == 5:
                    clock.longest_wait = 3.0
                    line.mend()
                *_, info = env.step(np.float32([0.1 + 0.1 * step]))
                told.append((bool(info["missing"]), info.get("fault", "")))
            env.complete()
        assert [missing for missing, _ in told] == [False] + [True] * 4 + [False] * 3
        assert ["T, T_floor" in fault for _, fault in told] == [missing for missing, _ in told]
        assert re.search("connection|does not answer", told[4][1])
        series = env.series
        assert np.isnan(series["T"]).tolist() == [False] * 2 + [True] * 4 + [False] * 3
        assert len(set(series["proposed.u"][4:7].tolist())) == 1
        assert series.faults.keys() == {2, 3, 4, 5}
        assert np.all(np.diff(series["time"]) == STEP)
        text = (tmp_path / "plant.csv").read_text(encoding="utf-8")
        assert len(text.splitlines()) == 10

    @pytest.mark.parametrize("hold", [0, "1h"])
    def test_what_held_is_a_gap_of_the_log(self, shadowed, tmp_path, monkeypatch, hold):
        """An agent goes on with the last value; whoever reads the record finds nothing measured."""
        gone = []
        changed(monkeypatch, lambda values: {"T": (np.nan,)} if gone else {})
        task = house(stale_after="1min", hold=hold)
        shadow = shadowed(task, house())
        env, seen = RecordSeries(shadow, path=tmp_path / "plant.csv"), []
        env.reset(seed=0)
        for step in range(9):
            gone[:] = [True] * (step in (4, 5))
            observation, *_, info = env.step(np.float32([0.1 * step]))
            seen.append((float(observation[0]), info["missing"]))
        env.complete()
        assert [missing for _, missing in seen] == [("T",) * (k in (4, 5)) for k in range(9)]
        acted = [4 if k in (5, 6) and hold == 0 else k for k in range(9)]
        np.testing.assert_allclose(env.series["proposed.u"][1:], np.multiply(acted, 0.1), atol=1e-6)
        assert len({seen[k][0] for k in (3, 4, 5)}) == 1
        assert np.isnan(env.series["T"]).tolist() == [k in (5, 6) for k in range(10)]
        assert "holding 0 has no finite number" in env.series.faults[5]
        log = PlantLog.read(tmp_path / "plant.csv")
        found = play_log(log, lambda **more: fmugym.load(house(), physical=True, **more))
        assert [len(one) for one in found] == [4, 2]
        scores = evaluate_log(house(), log, {}, lambda steps: None)
        assert {tuple(one.steps) for one in scores} == {(4, 2)}
        pytest.importorskip("scipy", reason="needs SciPy: the extra identification")
        fit = fit_logs(lambda: fmugym.load(house(), physical=True), [log], {"UA": None}, wash_in=0)
        lengths = [len(one.time) for one in fit.comparison.trajectories]
        assert lengths == [5, 3]

    def test_a_server_that_is_started_anew(self, clock):
        with Server(house(), "thermostat", clock=clock) as first:
            line = Line(first.address)
            env = connect(house(timeout="1s"), line.address, physical=True, clock=clock)
            played(env, 1)
        clock.longest_wait = 0.1
        *_, info = env.step(np.float32([0.5]))
        assert "T, T_floor, power, u, clock: " in info["fault"]
        clock.longest_wait = 3.0
        with Server(house(), "thermostat", clock=clock, seed=1) as second:
            line.target = int(second.address.split(":")[1])
            for _ in range(2):
                *_, info = env.step(np.float32([0.5]))
            assert "T_floor" not in info.get("fault", "")
            env.close()
        line.close()

    def test_no_server(self, clock):
        task = house(timeout="0.2s")
        with (
            watched(clock, "127.0.0.1:9", task) as env,
            pytest.raises(SimulationError, match=r"T, T_floor, power, u, clock: .*connection"),
        ):
            env.reset()

    def test_a_tag_that_does_not_exist(self, shadowed):
        """It is asked for together with the clock, which has the registers before."""
        task = house(tags=tags_with(T_floor={"register": 104, "type": "int16"}))
        env, said = shadowed(task, house()), r"T_floor: holding 104 of unit 1: .*ILLEGAL_ADDRESS"
        with pytest.raises(ConfigError, match=said) as told:
            env.reset()
        assert "clock" not in str(told.value)

    def test_a_wrong_type(self, shadowed):
        wrong = {"register": 0, "type": "float64", "unit": "K", "word_order": "little"}
        env = shadowed(house(tags=tags_with(T=wrong)), house())
        with pytest.raises(ConfigError, match=r"T: got .*expected 10 to 30.*'type'"):
            env.reset()

    def test_a_clock_that_jumps(self, shadowed, monkeypatch):
        jump = [0.0]
        changed(monkeypatch, lambda values: {"clock": (values["clock"][0] + jump[0],)})
        env = shadowed(house())
        played(env, 1)
        before, jump[0] = float(env.unwrapped.time), 4 * 3600.0
        *_, truncated, info = env.step(np.float32([0.5]))
        assert truncated
        assert "clock has jumped by 14400 s" in info["fault"]
        env.reset()
        assert float(env.unwrapped.time) >= before + jump[0]
        *_, truncated, info = env.step(np.float32([0.5]))
        assert not truncated
        assert "fault" not in info

    def test_answers_that_are_two_seconds_late(self):
        """Values are older then, but ticks come in time."""
        clock = RealClock(300.0)
        task = house(poll="1min", stale_after="40min", timeout="5s")
        with Server(house(), "thermostat", clock=clock) as server, Line(server.address) as line:
            line.delay = 2.0 / 3.0  # there are three questions
            with watched(clock, line.address, task) as env:
                env.reset(seed=0)
                begin = clock.time()
                *_, info = env.step(np.float32([0.5]))
                assert clock.time() - begin < 1.5 * STEP
                assert "fault" not in info

    def test_a_late_answer_does_not_shift_the_record(self, monkeypatch):
        """The time that an answer tells is late; quicker ones tell by how much."""
        changed(monkeypatch, lambda values: {"T_mass": values["clock"]})
        tags = tags_with(T_mass={"register": 300, "type": "float64", "unit": "K"})
        given = {"agent": {"observations": ["T", "T_mass"]}, "tags": tags}
        task, clock = house(poll="10s", stale_after="40min", **given), RealClock(600.0)
        with Server(task, "thermostat", clock=clock) as server, Line(server.address) as line:
            line.delay = 0.25  # of each question, so that answers are 450 s late and more
            with watched(clock, line.address, task) as shadow:
                env = RecordSeries(shadow)
                env.reset(seed=0)
                line.delay = 0.0
                for _ in range(4):
                    env.step(np.float32([0.5]))
        off = env.series["T_mass"] - env.series["time"]
        np.testing.assert_allclose(off[-2:], 0.0, atol=200.0)

    def test_answers_that_are_too_late_leave_gaps(self):
        task, clock = house(poll="10s", stale_after="1h"), RealClock(600.0)
        with (
            Server(task, "thermostat", clock=clock) as server,
            Line(server.address) as line,
            watched(clock, line.address, task) as shadow,
        ):
            shadow.reset(seed=0)
            line.delay = 1.5  # of each question, so that answers are an hour late
            infos = [shadow.step(np.float32([0.5]))[-1] for _ in range(8)]
        assert infos[0]["missing"] == ()
        assert {"T", "T_floor"} <= {*infos[-1]["missing"]}
        assert "no answer has come in time" in infos[-1]["fault"]

    def test_two_clients(self, server, clock):
        with (
            watched(clock, server.address, house()) as one,
            watched(clock, server.address, house()) as other,
        ):
            first, second = RecordSeries(one), RecordSeries(other)
            first.reset(seed=0)
            second.reset(seed=0)
            for _ in range(3):
                first.step(np.float32([0.5]))
                second.step(np.float32([0.2]))
        assert set(first.series["time"]) & set(second.series["time"])
        _, here, there = np.intersect1d(
            first.series["time"], second.series["time"], return_indices=True
        )
        for name in ("T", "T_floor"):
            np.testing.assert_allclose(
                first.series[name][here], second.series[name][there], atol=0.1
            )


class Parting:
    """A client that loses its server, and whose goodbye nobody answers."""

    @asynccontextmanager
    async def connected(self):
        try:
            yield
        finally:
            await asyncio.sleep(1e6)

    async def read(self):
        raise ConnectionLostError("it is gone")


def test_a_loss_is_told_before_the_goodbye():
    poller = Poller(Parting(), RealClock(), interval=1.0, timeout=20.0)
    try:
        wait_until(lambda: poller.trouble("T") == "it is gone")
    finally:
        poller.stop()


SEEN = {
    "observations": ["T", "T_floor", "T_out", "price"],
    "forecast": {"of": ["T_out", "price"], "horizon": "4h", "step": "2h", "error": 0.1},
}


@pytest.mark.parametrize("name", ["u", "T_floor"])
def test_a_task_whose_tags_do_not_suffice(name):
    tags = tags_with()
    del tags[name]
    with pytest.raises(ConfigError, match=r"\[plant\] has no tag for '(u|T_w)'"):
        connect(house(tags=tags))


@pytest.mark.parametrize("address", ["10.0.0.5:modbus", ":502", "10.0.0.5:70000"])
def test_an_address_that_is_none(address):
    with pytest.raises(ConfigError, match=r"such as '10.0.0.5:502', got '.*" + address):
        connect(house(), address)


class TestData:
    @pytest.fixture
    def prices(self, tmp_path):
        path = tmp_path / "prices.csv"

        def write(hours, first=309 * 24):
            rows = [f"{3600 * hour},{hour - 300 * 24}" for hour in range(first, first + hours)]
            path.write_text("\n".join(["time,ct", *rows, ""]), encoding="utf-8")

        write(48)
        return path, write

    def task(self, prices, count=3, agent=SEEN, written=str, **plant):
        data = {
            "price": {"file": str(prices[0]), "column": "ct", "interpolation": "previous"},
            "T_out": {"register": 200, "count": count, "step": "2h", "unit": "K"},
        }
        data = {written(name): one for name, one in data.items()}
        return house(agent=agent, data=data, stale_after="5min", hold="5min", **plant)

    def test_is_refused_without_a_source(self, prices):
        data = {"price": self.task(prices).document["plant"]["data"]["price"]}
        with pytest.raises(ConfigError, match=r"sees 'T_out'.*\[plant.data\]"):
            connect(house(agent=SEEN, data=data))

    def test_names_that_look_the_same_are_refused(self, prices):
        task, twice = self.task(prices), [wide("T_out"), "T_out"]
        data = task.document["plant"]["data"] | {name: {"register": 200} for name in twice}
        tags = task.document["plant"]["tags"] | {wide("T"): {"register": 200}}
        for key, given in (("data", data), ("tags", tags)):
            with pytest.raises(ConfigError, match=rf"plant\.{key}: .*'T(_out)?'.* one name"):
                connect(house(agent=SEEN, **{"data": {}, key: given}))
        with pytest.raises(ConfigError, match=r"plant\.data\.T_uot: unknown data .*'T_out'"):
            connect(house(agent=SEEN, data={"T_uot": {"register": 200}}))

    def test_is_refused_if_a_tag_does_not_reach_far_enough(self, prices):
        with pytest.raises(ConfigError, match=r"T_out.* 14400 s ahead.*got 2 and 7200"):
            connect(self.task(prices, count=2))

    @pytest.mark.parametrize("written", [str, wide], ids=["own letters", "other letters"])
    def test_is_what_the_agent_sees(self, shadowed, prices, written):
        forecast = {**SEEN["forecast"], "of": [*map(written, SEEN["forecast"]["of"])]}
        agent = {"observations": [*map(written, SEEN["observations"])], "forecast": forecast}
        task = self.task(prices, agent=agent, written=written)
        year = fmugym.load(house(), physical=True)
        table = read_data(year.task.root.child("data").child("T_out"))
        year.close()
        env = shadowed(task)
        observation, _ = env.reset(seed=0)
        for _ in range(3):
            names = env.unwrapped.observation_names
            seen = dict(zip(names, observation.tolist(), strict=True))
            now = float(env.unwrapped.time)
            for name, ahead in (("", 0.0), ("[+7200 s]", 7200.0), ("[+14400 s]", 14400.0)):
                price = (now + ahead) // 3600 - 300 * 24
                assert seen[f"price{name}"] == pytest.approx(price)
                outside = np.interp(now + ahead, table.times, table.values)
                assert seen[f"T_out{name}"] == pytest.approx(outside, abs=0.15)
            observation, *_, info = env.step(np.float32([0.3]))
            assert "fault" not in info

    def test_is_in_the_record(self, shadowed, prices, tmp_path):
        """Prices and time of the record make its rewards, not those of the task."""
        task = self.task(prices)
        shadow = shadowed(task)
        env = RecordSeries(shadow, path=tmp_path / "plant.csv")
        simulate(env, action_of(env.unwrapped, "0.5"), 0, 6)
        env.complete()
        task.document["clock"] = {"from": "01-01", "to": "02-01"}
        log = PlantLog.read(tmp_path / "plant.csv")
        found = as_logged(task, log)
        (recording,) = play_log(log, lambda **more: fmugym.load(found, physical=True, **more))
        np.testing.assert_allclose(recording.rewards, env.series["reward"][1:], atol=1e-6)
        (recording,) = play_log(log, lambda **more: fmugym.load(task, physical=True, **more))
        assert abs(recording.rewards.sum() - env.series["reward"][1:].sum()) > 0.01

    def test_has_a_past(self, shadowed):
        seen = {"observations": ["T", "T_out"], "history": {"of": ["T_out"], "length": "30min"}}
        env = shadowed(house(agent=seen, data={"T_out": {"register": 200, "unit": "K"}}))
        for _ in range(2):
            rows = [env.reset(seed=0)[0]]
            rows += [env.step(np.float32([0.3]))[0] for _ in range(4)]
            now, before, earlier = np.array(rows).T[1:]
            assert len(set(now.tolist())) > 2
            np.testing.assert_allclose(before[1:], now[:-1], atol=1e-4)
            np.testing.assert_allclose(earlier[2:], now[:-2], atol=1e-4)

    def test_a_file_that_is_not_refreshed(self, shadowed, prices):
        task = self.task(prices)
        prices[1](5)
        env = shadowed(task)
        infos = played(env, 5)
        prices[1](24)
        *_, info = env.step(np.float32([0.3]))
        assert infos[0]["missing"] == ()
        assert infos[-1]["missing"] == ("price",)
        assert "prices.csv" in infos[-1]["fault"]
        assert "fault" not in info


class TestPredictions:
    def test_of_the_same_fmu_are_right(self, clock):
        tags = tags_with(T_mass={"register": 300, "type": "float64"})
        tags["T_floor"] = {"register": 310, "type": "float64"}
        seen = {"observations": ["T", "T_floor", "T_mass"]}
        task = house(agent=seen, tags=tags)
        with Server(task, "thermostat", clock=clock) as server:
            env = connect(task, server.address, physical=True, ahead=3 * STEP, clock=clock)
            info = played(env, 12)[-1]
            errors = {(one.name, one.ahead): one for one in env.errors()}
            env.close()
        assert set(info["predicted"]) == {"T", "T_floor", "T_mass", "power"}
        assert {ahead for _, ahead in errors} == {STEP, 2 * STEP, 3 * STEP}
        assert errors["T", STEP].number == 12
        assert errors["T", 3 * STEP].number == 10
        for ahead in (STEP, 2 * STEP, 3 * STEP):
            assert errors["T_mass", ahead].rms < 0.02
            assert errors["T_floor", ahead].rms < 3.0

    def test_tell_that_the_fmu_is_another(self, clock):
        leaky = house(parameters={"T_start": 20.0, "H_ve": 400.0})
        found = {}
        for name, task in (("same", house()), ("another", leaky)):
            with Server(task, "thermostat", clock=clock) as server:
                env = connect(house(), server.address, physical=True, ahead=4 * STEP, clock=clock)
                played(env, 16)
                found[name] = {(e.name, e.ahead): e for e in env.errors()}
                env.close()
        same, another = (found[name]["T", 4 * STEP] for name in ("same", "another"))
        assert another.rms > 3.0 * same.rms
        assert another.bias < -0.1


class TestMPC:
    def test_follows_what_acts_in_the_plant(self, clock):
        """The thermostat heats; of this reward, MPC makes no heat at all."""
        task = house(agent={"history": {"of": ["u"], "length": "30min"}})
        task.document["reward"] = "-power"
        with Server(house(), "thermostat", clock=clock) as server:
            env = watch(server, clock, task)
            controller = MPC("2h", candidates=64).bind(env.unwrapped)
            controller.reset()
            observation, _ = env.reset(seed=0)
            names = env.unwrapped.observation_names
            acted, copied = [], []
            action = controller.act(observation)
            for _ in range(8):
                observation, *_, info = env.step(action)
                assert info["proposed"]["u"] < 0.2  # the heat pump is off
                action = controller.act(observation)
                acted.append(dict(zip(names, observation.tolist(), strict=True)))
                (episode,) = controller._episodes
                copied.append(dict(zip(names, episode.seen[0].tolist(), strict=True)))
            controller.close()
            env.close()
        assert max(one["u[-900 s]"] for one in acted) == 1.0
        for name, off in (("u[-900 s]", 1e-6), ("hour", 1e-3), ("T", 1.5)):
            found, expected = ([one[name] for one in rows] for rows in (copied, acted))
            np.testing.assert_allclose(found, expected, atol=off, rtol=0)

    def test_corrects_nothing_by_a_value_that_holds(self, clock, monkeypatch):
        """A sensor fails: its last value is no reason to believe that the room stands still."""
        gone = []
        changed(monkeypatch, lambda values: {"T": (np.nan,)} if gone else {})
        task = house(agent={"observations": ["T", "T_floor", "gap"]}, stale_after="1min", hold="1d")
        task.document["expressions"]["gap"] = {"expr": "T_floor - T"}
        leaky = house(parameters={"T_start": 20.0, "H_ve": 400.0})
        offsets, errors = [], []
        with (
            Server(leaky, "thermostat", clock=clock) as server,
            watched(clock, server.address, task) as env,
        ):
            controller = MPC("1h", candidates=36).bind(env.unwrapped)
            controller.reset()
            observation, _ = env.reset(seed=0)
            for step in range(7):
                gone[:] = [True] * (2 <= step < 5)
                action = controller.act(observation)
                (episode,) = controller._episodes
                offsets.append(episode.observer.offsets[episode.observer.best])
                errors.append(episode.observer.errors[0])
                observation, *_ = env.step(action)
            controller.close()
        moved = np.diff(offsets, axis=0)[:, :2] != 0.0
        assert moved[:, 0].tolist() == [not 2 <= step < 5 for step in range(6)]
        assert moved[:, 1].all()
        grown = np.diff(errors, axis=0)[2:5]
        assert np.all(grown[:, [0, 2]] <= 0.0)


class TestServer:
    def test_tells_what_sensors_show(self, shadowed):
        task = house()
        task.document["variables"]["T"]["noise"] = 0.5
        shadow = shadowed(house(), task)
        env = RecordSeries(shadow)
        played(env, 10)
        assert np.diff(env.series["T"], 2).std() > 0.5
        assert np.diff(env.series["T_floor"], 2).std() < 5.0

    def test_tells_as_much_as_a_register_can_hold(self, clock):
        """Some 300 K are 3000 steps of 0.1 K; of 1 mK, there are more than 15 bits hold."""
        tags = tags_with(
            T_floor={"register": 30, "type": "uint16", "scale": 0.1, "unit": "K"},
            T={"register": 31, "type": "int16", "scale": 0.001, "unit": "K"},
        )
        with Server(house(tags=tags), "thermostat", clock=clock) as server:
            host, port = server.address.split(":")
            client = ModbusTcpClient(host, port=int(port))
            assert client.connect()
            floor, room = client.read_holding_registers(30, count=2).registers
            client.close()
        assert 2900 < floor < 3300
        assert room == 2**15 - 1

    def test_refuses_tags_that_share_registers(self, clock):
        tags = tags_with(T_floor={"register": 3, "type": "int16"})
        with pytest.raises(ConfigError, match=r"T_floor: it shares holding 3 with 'T'"):
            Server(house(tags=tags), "thermostat", clock=clock)

    def test_ends_after_its_steps(self, clock):
        with Server(house(), "random", clock=clock, steps=2) as server:
            assert not server.wait(0.0)
            clock.advance(3 * STEP)
            assert server.wait(20.0)


class TestCommands:
    @pytest.fixture
    def file(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        house().write(tmp_path / "house.toml")
        return "house.toml"

    def test_serve(self, file, ran):
        arguments = ["--controller", "thermostat", "--speed", "90000", "--steps", "3"]
        said = ran("serve", file, *arguments)
        assert re.search(r"house.toml at 127.0.0.1:\d+", said)
        reward = reference(3)["reward"].sum()
        assert f"seed 0: reward {reward:.6g}, cost" in said
        assert "in 3 steps (2700 s)" in said

    def test_simulate_plant(self, file, clock, monkeypatch, ran):
        monkeypatch.setattr("fmugym.cli.plant_commands.RealClock", lambda speed: clock)
        controller = "pid of=T setpoint=21 kp=0.5 ti=14400"
        with Server(house(), "thermostat", clock=clock) as server:
            given = ["--plant", server.address, "--ahead", "30min", "--steps", "6"]
            given += ["--controller", controller, "--output", "plant.csv"]
            said = ran("simulate", file, *given)
            out = ran("simulate", file, *given, "--json", "--force")
        assert re.search(r"error of T, .* 900 s ahead, .* 1800 s ahead", said)
        told = json.loads(out)
        assert told["episodes"][0]["steps"] == 6
        assert {one["ahead"] for one in told["predictions"]} == {900.0, 1800.0}
        log = PlantLog.read("plant.csv")
        others = "--controller", "thermostat", "--json"
        out = ran("evaluate", file, "--log", "plant.csv", *others)
        scores = {one["name"]: one for one in json.loads(out)["scores"]}
        written = Path("plant.csv").read_text(encoding="utf-8")
        Path("plant.csv").write_text(with_wide_names(written), encoding="utf-8")
        out = ran("evaluate", file, "--log", "plant.csv", *others)
        for one in json.loads(out)["scores"]:
            assert one["rewards"] == scores[one["name"]]["rewards"]
        assert [*scores][:3] == ["plant, measured", "actions of the plant", "proposed actions"]
        assert [*scores][3:] == ["thermostat"]
        assert {tuple(one["steps"]) for one in scores.values()} == {(6,)}
        measured = scores["plant, measured"]
        assert measured["mean_reward"] == pytest.approx(np.nansum(log.columns["reward"]), abs=1e-6)
        assert measured["mean_cost"] == pytest.approx(np.nansum(log.columns["cost"]), abs=1e-6)
        assert scores["proposed actions"]["rewards"] != scores["actions of the plant"]["rewards"]
        assert np.all((log.columns["proposed.u"][1:] >= 0) & (log.columns["proposed.u"][1:] <= 1))

    def test_a_task_without_a_plant(self, tmp_path, monkeypatch, refused):
        monkeypatch.chdir(tmp_path)
        task = house()
        del task.document["plant"]
        task.write(tmp_path / "house.toml")
        for command in (["simulate", "house.toml", "--plant"], ["serve", "house.toml"]):
            err = refused(*command)
            assert "[plant]" in err
        others = ["--scenario", "frost"]
        for command in (["simulate", "--plant"], ["evaluate", "--log", "plant.csv"]):
            err = refused(command[0], "house.toml", *command[1:], *others)
            assert "--scenario" in err
        assert "--modbus or --opcua" in refused("serve", "house.toml")

    @pytest.mark.parametrize("protocol", ["modbus", "opcua"])
    def test_serve_proposes_tags(self, protocol, shadowed, tmp_path, monkeypatch, refused, ran):
        """With what is printed, the task reads all that it needs: here 48 hours of prices."""
        if protocol == "opcua":
            pytest.importorskip("asyncua", reason="needs asyncua, of the extra plant")
        monkeypatch.chdir(tmp_path)
        ahead = {"of": [wide("price"), "T_out"], "horizon": "48h", "step": "30min"}
        task = house(agent={"forecast": ahead})
        del task.document["plant"]
        task.write(tmp_path / "house.toml")
        options = ["--speed", "90000", "--steps", "2"]
        out = ran("serve", "house.toml", f"--{protocol}", *options)
        said = out.partition("add this to the task:\n")[2]
        with Path("house.toml").open("a", encoding="utf-8") as file:
            file.write(said.partition("seed 0:")[0])
        pasted = Task.read("house.toml")
        assert set(pasted.document["plant"]["tags"]) == {"u", "T", "T_floor", "power"}
        assert pasted.document["plant"]["data"]["price"]["count"] == 97
        env = shadowed(pasted)
        observation, _ = env.reset(seed=0)
        names = env.unwrapped.observation_names
        seen = dict(zip(names, observation.tolist(), strict=True))
        table = read_data(pasted.root.child("data").child("price"))
        later = float(env.unwrapped.time) + 48 * 3600.0
        here = np.searchsorted(table.times, later % table.period, side="right") - 1
        assert seen["price[+172800 s]"] == pytest.approx(table.values[here], rel=1e-6)
        assert seen["T"] == pytest.approx(20.0, abs=1.5)
        other = {"modbus": "opcua", "opcua": "modbus"}[protocol]
        err = refused("serve", "house.toml", f"--{other}", *options)
        assert f"protocol '{protocol}', not '{other}'" in err

    def test_a_tag_of_no_variable(self, file, refused):
        text = Path(file).read_text()
        Path(file).write_text(text.replace("\nT = {register", "\nTt = {register"))
        err = refused("simulate", file, "--plant")
        assert "plant.tags.Tt: unknown variable of the task 'Tt'" in err


class TestClock:
    """Without a tag for it, the plant has the time of this machine."""

    @pytest.mark.parametrize(
        ("offset", "expected"),
        [(3600, "2023-07-01 13:00"), (-3600, "2023-07-01 11:00"), (0, "2023-07-01 12:00")],
    )
    def test_is_on_standard_time(self, offset, expected):
        now = datetime.datetime(2023, 7, 1, 12, tzinfo=datetime.UTC)
        since = datetime.datetime.fromisoformat(expected) - datetime.datetime(2023, 1, 1)
        assert _time_of_year(now, offset) == since.total_seconds()
        assert _time_of_year(now.replace(year=2024), offset) == since.total_seconds()

    def test_is_on_local_time_if_nothing_tells_the_standard_time(self):
        now = datetime.datetime(2023, 7, 1, 12, tzinfo=datetime.UTC)
        local = now.astimezone().replace(tzinfo=None) - datetime.datetime(2023, 1, 1)
        assert _time_of_year(now, None) == local.total_seconds()

    @pytest.mark.parametrize(("given", "offset"), [({"timezone": "+02:00"}, 7200), ({}, None)])
    def test_the_task_tells_the_standard_time(self, given, offset):
        task = house()
        env = environment(replace(task, document={**task.document, **given}))
        assert read_plant(env).standard == offset
        env.close()
