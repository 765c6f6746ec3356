"""Plants by OPC UA: what Modbus has not, and the same as by Modbus."""

import asyncio

import numpy as np
import pytest

pytest.importorskip("asyncua", reason="needs asyncua, of the extra plant")

from asyncua import Client, ua
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from cryptography.x509.oid import ExtendedKeyUsageOID
from plant_tools import (
    STEP,
    Line,
    changed,
    house,
    played,
    watched,
)

from fmugym.deployment.plant import Server, connect
from fmugym.errors import ConfigError, SimulationError
from fmugym.records import RecordSeries

URI = "urn:fmugym:test"


@pytest.fixture
def server(clock):
    with Server(house("opcua"), "thermostat", clock=clock) as found:
        yield found


def test_records_the_same_as_by_modbus(server, clock):
    with Server(house("modbus"), "thermostat", clock=clock) as other:
        found = []
        for protocol, address in (("opcua", server.address), ("modbus", other.address)):
            with watched(clock, address, house(protocol)) as shadow:
                env = RecordSeries(shadow)
                assert not any("fault" in info for info in played(env, 4, 0.3))
                found.append(env.series)
    first, second = found
    assert first["T"].std() > 0.01
    slope = np.polyfit(first["time"], first["T"], 3)
    np.testing.assert_allclose(second["T"][0], np.polyval(slope, second["time"][0]), atol=0.5)
    np.testing.assert_allclose(first["proposed.u"][1:], 0.3, atol=1e-6)


def test_nobody_can_write(server, clock):
    async def write():
        async with Client(server.address) as client:
            node = client.get_node("ns=2;s=House.T")
            with pytest.raises(ua.UaStatusCodeError) as refused:
                await node.write_value(300.0)
            return refused.value

    assert "Bad" in type(asyncio.run(write())).__name__


def test_the_shadow_never_asks_to_write(server, clock, monkeypatch):
    asked = []

    async def write(_, given):
        """The server writes its own time to namespace 0."""
        asked.extend(one for one in given.NodesToWrite if one.NodeId.NamespaceIndex)
        return [ua.StatusCode()] * len(given.NodesToWrite)

    monkeypatch.setattr("asyncua.server.internal_session.InternalSession.write", write)
    with watched(clock, server.address, house("opcua")) as env:
        played(env, 1)
    assert not asked


def test_a_server_that_goes_and_comes_back(server, clock):
    line = Line(server.address)
    task = house("opcua", stale_after="5min", hold="10min", timeout="2s")
    with watched(clock, f"opc.tcp://{line.address}", task) as shadow:
        env = RecordSeries(shadow)
        env.reset(seed=0)
        for step in range(7):
            clock.longest_wait = 0.3 if step in (1, 2, 3) else 6.0
            if step == 1:
                line.cut()
            if step == 4:
                line.mend()
            *_, info = env.step(np.float32([0.3]))
    line.close()
    series = env.series
    assert not {2, 3, 4} - series.faults.keys()
    assert np.isnan(series["T"][2:5]).all()
    assert "fault" not in info
    assert not np.isnan(series["T"][-1])
    assert np.all(np.diff(series["time"]) == STEP)


def test_bad_quality(shadowed, monkeypatch):
    bad = []
    changed(monkeypatch, lambda values: {"T": (np.nan,)} if bad else {})
    env = shadowed(house("opcua", stale_after="2min"))
    played(env, 1)
    bad.append(True)
    *_, info = env.step(np.float32([0.4]))
    assert "T: node ns=2;s=House.T: BadSensorFailure" in info["fault"]
    assert info["missing"] == ("T",)


@pytest.mark.parametrize(
    ("node", "message"),
    [
        ("ns=2;s=House.T_flor", r"T_floor: node ns=2;s=House.T_flor: BadNodeIdUnknown"),
        ("i=2255", r"T_floor: node i=2255: expected a number, got"),
    ],
    ids=["a tag that does not exist", "a wrong type"],
)
def test_tags_that_are_refused(shadowed, node, message):
    tags = dict(house("opcua").document["plant"]["tags"]) | {"T_floor": node}
    env = shadowed(house("opcua", tags=tags), house("opcua"))
    with pytest.raises(ConfigError, match=message):
        env.reset()


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    found = {}
    for name in ("client", "other"):
        key, certificate = folder / f"{name}.pem", folder / f"{name}.der"
        use = [ExtendedKeyUsageOID.CLIENT_AUTH]
        names = {"commonName": name}
        making = setup_self_signed_certificate(key, certificate, URI, "localhost", use, names)
        asyncio.run(making)
        key.chmod(0o600)
        found[name] = {"certificate": str(certificate), "key": str(key)}
    return found


class TestEncryption:
    def task(self, keys, name="client", **plant):
        return house("opcua", encryption=True, **keys[name], **plant)

    def test_reads_by_an_encrypted_line(self, clock, keys, monkeypatch):
        monkeypatch.setenv("FMUGYM_PLANT_USER", "reader")
        monkeypatch.setenv("FMUGYM_PLANT_PASSWORD", "secret of the plant")
        with Server(self.task(keys), "thermostat", clock=clock) as server:
            line = Line(server.address)
            with watched(clock, f"opc.tcp://{line.address}", self.task(keys)) as env:
                (info,) = played(env, 1)
            line.close()
        assert "fault" not in info
        assert b"House.T" not in line.sent
        assert b"secret of the plant" not in line.sent

    def test_a_certificate_that_is_refused(self, shadowed, keys):
        task = self.task(keys, "other")
        env = shadowed(task, self.task(keys))
        with pytest.raises(SimulationError, match=r"refuses this client: BadCertificateUntrusted"):
            env.reset()

    def test_a_server_with_another_certificate(self, shadowed, keys):
        task = self.task(keys, server_certificate=keys["other"]["certificate"])
        env = shadowed(task, self.task(keys))
        with pytest.raises(SimulationError, match=r"its certificate is not that of '.*other.der'"):
            env.reset()

    def test_needs_a_certificate(self):
        with pytest.raises(ConfigError, match=r"'certificate' and 'key'.*encryption = false"):
            connect(house("opcua", encryption=True))

    def test_secrets_are_files_of_their_owner(self, keys, tmp_path):
        secret = tmp_path / "secret"
        secret.write_text("reader\npassword\n")
        secret.chmod(0o644)
        with pytest.raises(ConfigError, match=r"mode 644.*expected 600"):
            connect(house("opcua", credentials=str(secret)))

    def test_no_password_goes_over_an_open_line(self, monkeypatch):
        monkeypatch.setenv("FMUGYM_PLANT_USER", "reader")
        monkeypatch.setenv("FMUGYM_PLANT_PASSWORD", "secret of the plant")
        with pytest.raises(ConfigError, match="without encryption") as told:
            connect(house("opcua"))
        assert "secret of" not in str(told.value)

    def test_task_files_have_no_secrets(self):
        with pytest.raises(ConfigError, match=r"'password' is no key of \[plant\]: .*credentials"):
            house("opcua", password="x").root  # noqa: B018  (it is read when it is asked for)
