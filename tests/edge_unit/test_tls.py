# SPDX-License-Identifier: Apache-2.0
"""A unit's token goes to its own master only: servers that record what they get, and get nothing."""

from __future__ import annotations

import asyncio
import hashlib
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import trustme

from edge_unit.tls import normalised, tls_context
from edge_unit.uplink.client import MasterClient
from shared.errors import ConfigError, MasterRefused, MasterUnreachable

TOKEN = "secret-token-0123456789"


class Server:
    """Speaks TLS with one certificate, refuses everything, and records all bytes received."""

    def __init__(self, certificate: trustme.LeafCert) -> None:
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        certificate.configure_cert(self.context)
        pem = certificate.cert_chain_pems[0].bytes().decode()
        self.fingerprint = hashlib.sha256(ssl.PEM_cert_to_DER_cert(pem)).hexdigest()
        self.received = bytearray()
        self.url = ""

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(65536):
                self.received += data
                if data.endswith(b"\r\n\r\n"):
                    writer.write(b"HTTP/1.1 404 Not Found\r\ncontent-length: 0\r\n\r\n")
        except OSError:
            # A client that does not trust it closes the connection.
            pass
        finally:
            writer.close()

    @asynccontextmanager
    async def listening(self) -> AsyncIterator[Server]:
        server = await asyncio.start_server(self.serve, "127.0.0.1", 0, ssl=self.context)
        self.url = f"https://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        async with server:
            yield self


@pytest.fixture(scope="module")
def ours() -> trustme.CA:
    return trustme.CA()


@pytest.fixture
def ca_file(ours: trustme.CA, tmp_path: Path) -> Path:
    path = tmp_path / "ca.pem"
    ours.cert_pem.write_to_path(str(path))
    return path


async def ask(url: str, tls: ssl.SSLContext | None) -> None:
    async with MasterClient(url, lambda: TOKEN, tls=tls) as client:
        await client.robot(0, 2.0)


async def test_the_master_of_our_ca_gets_the_token(ours: trustme.CA, ca_file: Path) -> None:
    server = Server(ours.issue_cert("127.0.0.1"))
    async with server.listening():
        for tls in (tls_context(ca_file), tls_context(fingerprint=server.fingerprint)):
            server.received.clear()
            with pytest.raises(MasterRefused, match="404"):
                await ask(server.url, tls)
            assert TOKEN.encode() in server.received


async def test_the_right_certificate_of_another_ca_is_believed_by_its_fingerprint_only() -> None:
    server = Server(trustme.CA().issue_cert("elsewhere.example"))
    async with server.listening():
        with pytest.raises(MasterRefused, match="404"):
            await ask(server.url, tls_context(fingerprint=server.fingerprint))
        server.received.clear()
        with pytest.raises(MasterUnreachable):
            await ask(server.url, None)
        assert not server.received


@pytest.mark.parametrize("checked", ["ca", "fingerprint", "both"])
async def test_a_rogue_master_gets_not_one_byte(ours: trustme.CA, ca_file: Path, checked: str) -> None:
    expected = Server(ours.issue_cert("127.0.0.1")).fingerprint
    rogue = Server(trustme.CA().issue_cert("127.0.0.1"))
    tls = tls_context(ca_file if checked != "fingerprint" else None, expected if checked != "ca" else None)
    async with rogue.listening():
        with pytest.raises(MasterUnreachable, match=r"certificate|CERTIFICATE"):
            await ask(rogue.url, tls)
    assert not rogue.received


async def test_another_certificate_of_our_ca_is_not_believed(ours: trustme.CA, ca_file: Path) -> None:
    expected = Server(ours.issue_cert("127.0.0.1")).fingerprint
    another = Server(ours.issue_cert("127.0.0.1"))
    for tls in (tls_context(ca_file, expected), tls_context(fingerprint=expected)):
        async with another.listening():
            with pytest.raises(MasterUnreachable, match=f"sha256 is {another.fingerprint}, expected {expected}"):
                await ask(another.url, tls)
    assert not another.received


async def test_a_certificate_of_our_ca_for_another_host_is_not_believed(ours: trustme.CA, ca_file: Path) -> None:
    elsewhere = Server(ours.issue_cert("10.9.8.7"))
    async with elsewhere.listening():
        with pytest.raises(MasterUnreachable):
            await ask(elsewhere.url, tls_context(ca_file))
    assert not elsewhere.received


async def test_a_server_of_an_older_tls_gets_nothing(ours: trustme.CA, ca_file: Path) -> None:
    old = Server(ours.issue_cert("127.0.0.1"))
    with pytest.warns(DeprecationWarning, match="deprecated"):
        old.context.minimum_version, old.context.maximum_version = ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1
    async with old.listening():
        with pytest.raises(MasterUnreachable):
            await ask(old.url, tls_context(ca_file))
    assert not old.received


def test_a_master_without_tls_is_refused_if_its_certificate_must_be_checked(ca_file: Path) -> None:
    with pytest.raises(ConfigError, match="master_url: expected https"):
        MasterClient("http://127.0.0.1:1", lambda: TOKEN, tls=tls_context(ca_file))


def test_a_ca_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.pem: cannot be read"):
        tls_context(tmp_path / "gone.pem")
    (tmp_path / "ca.pem").write_text("hello")
    with pytest.raises(ConfigError, match=r"ca\.pem: expected certificates in PEM"):
        tls_context(tmp_path / "ca.pem")


def test_fingerprints_are_taken_as_openssl_writes_them() -> None:
    digits = "0123456789abcdef" * 4
    assert normalised(":".join(digits[i : i + 2] for i in range(0, 64, 2)).upper()) == digits
    for wrong in ("", digits[:-1], digits[:-1] + "g"):
        with pytest.raises(ValueError, match="hexadecimal digits of a sha256"):
            normalised(wrong)
