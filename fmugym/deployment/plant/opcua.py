"""OPC UA: a client that only reads, and a server that cannot be written to.

User names and passwords do not stand in task files.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from asyncua import Client, Server, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.cert_gen import setup_self_signed_certificate
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties, load_certificate
from cryptography import x509

from fmugym.checks import check_path, require_regular
from fmugym.deployment.plant.polling import CertificateError, TagReading, Values
from fmugym.deployment.plant.tags import Plant, Tag
from fmugym.errors import ConfigError, shown

__all__ = ["OPCUAClient", "credentials", "require_secret", "serve_opcua"]

_USER: Final = "FMUGYM_PLANT_USER"
_PASSWORD: Final = "FMUGYM_PLANT_PASSWORD"
_OTHERS: Final = 0o077


def require_secret(path: Path) -> None:
    """Refuse a file that others may read.

    Raises:
        ConfigError: If they may, or there is none.
    """
    try:
        require_regular(path)
        mode = path.stat().st_mode & 0o777
    except OSError as error:
        raise ConfigError(f"{shown(str(path))} cannot be read: {error.strerror}") from None
    if os.name == "posix" and mode & _OTHERS:
        raise ConfigError(
            f"{shown(str(path))} has mode {mode:o}, so that others may read it, expected 600: "
            f"chmod 600 {path}"
        )


def credentials(given: str | None) -> tuple[str, str] | None:
    """The user and the password for a plant; None for none.

    Args:
        given: A file with a line for each; None for environment variables.

    Raises:
        ConfigError: If others may read the file, or one of both is missing.
    """
    if given is None:
        found = [os.environ.get(name) for name in (_USER, _PASSWORD)]
        where = f"the environment variables {_USER} and {_PASSWORD}"
    else:
        path = check_path("credentials", given)
        require_secret(path)
        found = [*path.read_text(encoding="utf-8").splitlines(), None, None][:2]
        where = f"the lines of {shown(str(path))}"
    if found == [None, None] and given is None:
        return None
    user, password = found
    if not user or password is None:
        raise ConfigError(f"expected a user and a password in {where}")
    return user, password


logging.getLogger("asyncua").addHandler(logging.NullHandler())


class OPCUAClient:
    """Reads the tags of a plant; see ``TagClient``."""

    def __init__(self, plant: Plant) -> None:
        self._plant, self._tags = plant, list(plant.tags.values())
        self._address = plant.address if "://" in plant.address else f"opc.tcp://{plant.address}"
        with plant.entry.placing():
            self._user = credentials(plant["credentials"])
            self._keys = _keys_of(plant)
            if self._user is not None and self._keys is None:
                raise ConfigError("without encryption, everybody on the line reads the password")
        self._nodes = [_node_id(tag) for tag in self._tags]

    @asynccontextmanager
    async def connected(self) -> AsyncIterator[None]:
        """See ``TagClient``."""
        self._client = Client(self._address, timeout=self._plant["timeout"])
        if self._user is not None:
            self._client.set_user(self._user[0])
            self._client.set_password(self._user[1])
        try:
            if self._keys is not None:
                await self._secure(*self._keys)
            await self._client.connect()
            yield
        finally:
            with suppress(Exception):  # there may be nobody to say goodbye to
                await self._client.disconnect()

    async def _secure(self, certificate: Path, key: Path) -> None:
        for one in (await _certificate_in(certificate)).extensions:
            if isinstance(one.value, x509.SubjectAlternativeName):  # the application it is for
                for uri in one.value.get_values_for_type(x509.UniformResourceIdentifier)[:1]:
                    self._client.application_uri = uri
        pinned = self._plant["server_certificate"]
        if pinned is not None:
            text = f"its certificate is not that of {shown(pinned)}"
            only = await _only(pinned, partial(CertificateError, text))
            self._client.certificate_validator = only
        await self._client.set_security(
            SecurityPolicyBasic256Sha256, _content(certificate), _content(key)
        )

    async def read(self) -> dict[str, TagReading]:
        """See ``TagClient``."""
        read = self._client.uaclient.read_attributes
        told = await read(self._nodes, ua.AttributeIds.Value)
        pairs = zip(self._tags, told, strict=True)
        return {tag.name: self._answer(tag, one) for tag, one in pairs}

    @staticmethod
    def _answer(tag: Tag, told: Any) -> TagReading:
        node, status = tag.address["node"], told.StatusCode
        if status is not None and not status.is_good():
            return TagReading((), f"node {node}: {status.name}")
        value = None if told.Value is None else told.Value.Value
        numbers: list[Any] = list(value) if isinstance(value, list | tuple) else [value]
        if not all(isinstance(one, bool | int | float) for one in numbers):
            return TagReading((), f"node {node}: expected a number, got {shown(value)}")
        if len(numbers) != tag.count:
            return TagReading((), f"node {node}: expected {tag.count} numbers, got {len(numbers)}")
        return TagReading.of(tag, f"node {node}", numbers)


def _node_id(tag: Tag) -> Any:
    try:
        return ua.NodeId.from_string(tag.address["node"])
    except ua.UaError:
        text = shown(tag.address["node"])
        raise tag.entry.error(
            f"expected the id of a node, such as 'ns=2;s=House.T', got {text}"
        ) from None


def _keys_of(plant: Plant) -> tuple[Path, Path] | None:
    """The certificate and the key of the client; None if nothing is encrypted."""
    if not plant["encryption"]:
        return None
    paths = [plant["certificate"], plant["key"]]
    if None in paths:
        raise ConfigError(
            "OPC UA is encrypted: give this client's 'certificate' and 'key', or say "
            "encryption = false, with which everybody on the line reads along"
        )
    certificate, key = (check_path("a certificate", path) for path in paths)
    require_secret(key)
    return certificate, key


async def _only(
    path: str, refusal: Callable[[], Exception]
) -> Callable[[Any, Any], Awaitable[None]]:
    """Make a validator that accepts only the certificate in a file."""
    known = await _certificate_in(Path(path))

    async def validate(certificate: Any, description: Any) -> None:
        if certificate != known:
            raise refusal()

    return validate


def _content(path: Path) -> Any:
    """Content of a file, read at once: the library leaves files open when a poller is stopped."""
    require_regular(path)
    return CertProperties(path.read_bytes(), path.suffix.removeprefix("."))


async def _certificate_in(path: Path) -> Any:
    found = _content(path)
    return await load_certificate(found.path_or_content, found.extension)


# The server.


@asynccontextmanager
async def serve_opcua(plant: Plant, port: int, values: Values) -> AsyncIterator[str]:
    """Serve tags on the loopback; see ``serve_modbus``.

    Where the plant encrypts, the server makes a certificate of its own. It takes no other client
    than the one whose certificate the plant names, if it names one.
    """
    server = Server()
    await server.init()
    server.set_server_name("fmugym")
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    if plant["encryption"]:
        await _certify(server, plant["certificate"])
    for tag in plant.tags.values():
        await _add(server, tag, values)
    async with server:
        yield f"opc.tcp://127.0.0.1:{server.bserver.port}"


async def _certify(server: Server, trusted: str | None) -> None:
    """Encrypt with a new certificate, and take no other client than a given one."""
    uri, use = "urn:fmugym:server", [x509.oid.ExtendedKeyUsageOID.SERVER_AUTH]
    with TemporaryDirectory() as folder:
        key, certificate = Path(folder, "key.pem"), Path(folder, "certificate.der")
        names = {"commonName": "fmugym"}
        await setup_self_signed_certificate(key, certificate, uri, "localhost", use, names)
        await server.load_certificate(str(certificate))
        await server.load_private_key(str(key))
    await server.set_application_uri(uri)
    server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
    if trusted is not None:
        untrusted = partial(ServiceError, ua.StatusCodes.BadCertificateUntrusted)
        server.set_certificate_validator(await _only(trusted, untrusted))


async def _add(server: Server, tag: Tag, values: Values) -> None:
    """Add the node of a tag, whose value is found when somebody reads it."""
    node = _node_id(tag)
    while node.NamespaceIndex >= len(await server.get_namespace_array()):
        await server.register_namespace(f"urn:fmugym:{len(await server.get_namespace_array())}")
    start = [0.0] * tag.count if tag.count > 1 else 0.0
    await server.nodes.objects.add_variable(node, tag.name, start, ua.VariantType.Double)

    def look(_: Any, attribute: Any) -> Any:
        raw = [tag.conversion.inverse(value) for value in values()[tag.name]]
        value = ua.Variant(raw if tag.count > 1 else raw[0], ua.VariantType.Double)
        if all(map(math.isfinite, raw)):
            return ua.DataValue(value)
        return ua.DataValue(value, ua.StatusCode(ua.StatusCodes.BadSensorFailure))

    server.set_attribute_value_callback(node, look)
