"""Plants on the loopback: a house, a clock that waits for who reads, and a bad line between."""

import asyncio
import struct
import threading
import time
import tomllib
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

import fmugym
from fmugym.deployment.plant import connect
from fmugym.deployment.plant.plant_server import _Twin
from fmugym.deployment.plant.polling import BackgroundLoop
from fmugym.lab import ManualClock
from fmugym.task import Task

HOUSE = Path(fmugym.__file__).parent / "envs" / "house.toml"
STEP = 900.0

TAGS = {
    "modbus": {
        "T": {"register": 0, "type": "float64", "unit": "K"},
        "T_floor": {"register": 4, "kind": "input", "type": "int16", "scale": 0.01},
        "power": {"register": 20, "word_order": "little", "unit": "W"},
        "u": {"register": 19, "kind": "coil", "unit_id": 7},
    },
    "opcua": {
        "T": {"node": "ns=2;s=House.T", "unit": "K"},
        "T_floor": "ns=2;s=House.T_floor",
        "power": {"node": "ns=2;s=House.power", "unit": "W"},
        "u": "ns=2;i=4",
    },
}
CLOCKS = {"modbus": {"register": 100, "type": "float64"}, "opcua": "ns=2;s=Clock"}
ADDRESSES = {"modbus": "127.0.0.1:1", "opcua": "opc.tcp://127.0.0.1:1"}


def house(protocol="modbus", agent=(), parameters=(("T_start", 20.0),), **plant):
    """The house as a plant; its agent sees no data."""
    document = tomllib.loads(HOUSE.read_text(encoding="utf-8"))
    for one in document["data"].values():
        one["file"] = str(HOUSE.with_name(one["file"]))
    seen = {"actions": ["u"], "observations": ["T", "T_floor", "T_set", "hour"]}
    given = {"protocol": protocol, "address": ADDRESSES[protocol], "tags": TAGS[protocol]}
    given |= {"clock": CLOCKS[protocol], "poll": "1min", "timeout": "20s", **plant}
    if protocol == "opcua":
        given.setdefault("encryption", False)
    document["variables"]["T_mass"] = {"name": "T_m", "unit": "degC"}
    document |= {"agent": seen | dict(agent), "plant": given, "clock": "11-06"}
    document["parameters"] = dict(parameters)
    return Task.from_dict(document)


class LockStep(ManualClock):
    """Time that moves on in tenths of a step, each when every poller has read anew.

    So the readings are the same on a busy machine. A poller that has no answer is not waited for.
    """

    speed = 6000.0
    longest_wait = 3.0

    def __init__(self):
        super().__init__()
        self.asked, self.told = {}, threading.Condition()

    def time(self):
        thread = threading.current_thread()
        if thread.name == "plant":
            with self.told:
                self.asked[thread] = self.asked.get(thread, 0) + 1
                self.told.notify_all()
        return super().time()

    def sleep(self, seconds):
        for _ in range(10 if seconds > 0 else 0):
            self.advance(seconds / 10)
            with self.told:
                before = dict(self.asked)
                self.told.wait_for(partial(self._have_read, before), self.longest_wait)

    def _have_read(self, before):
        """Whether each has asked the time for a whole round that has begun since then."""
        return all(self.asked[t] >= n + 4 for t, n in before.items() if t.is_alive())


class Line:
    """A TCP connection to a server that can be cut, and that delays answers."""

    def __init__(self, address):
        self.host, port = address.removeprefix("opc.tcp://").split(":")
        self.target, self.is_up, self.delay, self.sent = int(port), True, 0.0, b""
        self.ready, self.writers = threading.Event(), set()
        self.background = BackgroundLoop(self.run, "line")
        assert self.ready.wait(20)

    async def run(self):
        server = await asyncio.start_server(self.meet, self.host, 0)
        self.address = f"{self.host}:{server.sockets[0].getsockname()[1]}"
        self.ready.set()
        try:
            await asyncio.sleep(1e6)
        finally:
            server.close()
            self._hang_up()

    def _hang_up(self):
        for writer in self.writers:
            writer.transport.abort()

    async def meet(self, reader, writer):
        if not self.is_up:
            writer.transport.abort()
            return
        there, back = await asyncio.open_connection(self.host, self.target)
        self.writers |= {writer, back}
        await asyncio.gather(self.pump(reader, back, True), self.pump(there, writer, False))

    async def pump(self, reader, writer, is_question):
        try:
            while data := await reader.read(65536):
                if is_question:
                    self.sent += data
                elif self.delay:
                    await asyncio.sleep(self.delay)
                writer.write(data)
        except OSError:
            pass
        finally:
            writer.close()

    def cut(self):
        self.is_up = False
        self.background._loop.call_soon_threadsafe(self._hang_up)

    def mend(self):
        self.is_up = True

    def close(self):
        self.background.stop()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()


def functions_in(sent):
    """The function codes of Modbus in what a client has sent."""
    codes = set()
    while sent:
        _, _, length, _, code = struct.unpack(">HHHBB", sent[:8])
        codes.add(code)
        sent = sent[6 + length :]
    return codes


@contextmanager
def watched(clock, address, task):
    """An environment in the shadow of a plant."""
    env = connect(task, address, physical=True, clock=clock)
    try:
        yield env
    finally:
        env.close()


def played(env, steps, action=0.5):
    """Begin an episode, and return what some steps tell."""
    env.reset(seed=0)
    return [env.step(np.float32([action]))[-1] for _ in range(steps)]


def changed(monkeypatch, change):
    """Let servers tell other values: ``change`` takes those by the names of tags."""
    original = _Twin.values
    monkeypatch.setattr(_Twin, "values", lambda twin: original(twin) | change(original(twin)))


@contextmanager
def nothing_left():
    """Fail if a thread is left behind."""
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 5
    while (left := set(threading.enumerate()) - before) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not left
