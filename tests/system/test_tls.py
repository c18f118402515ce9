# SPDX-License-Identifier: Apache-2.0
"""A real master with TLS, and units that trust it or do not."""

from __future__ import annotations

import hashlib
import http.server
import json
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import httpx
import pytest
import trustme
import yaml
from websockets.sync.client import connect

from tests.system.cluster import Cluster, until, write_cell, write_recording


def write_certificates(folder: Path) -> Path:
    """A CA, and a certificate of it with its key."""
    ca = trustme.CA()
    certificate = ca.issue_cert("127.0.0.1")
    ca.cert_pem.write_to_path(str(folder / "ca.pem"))
    certificate.private_key_pem.write_to_path(str(folder / "key.pem"))
    certificate.cert_chain_pems[0].write_to_path(str(folder / "certificate.pem"))
    return folder


@contextmanager
def speaking_tls(folder: Path) -> Iterator[Cluster]:
    """A master with a certificate."""
    write_certificates(folder)
    with Cluster(folder, write_cell(folder)) as cluster:
        cluster.verify = ssl.create_default_context(cafile=folder / "ca.pem")
        files = ("--tls-certificate", str(folder / "certificate.pem"), "--tls-key", str(folder / "key.pem"))
        cluster.start_master(*files)
        yield cluster


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """One test's own."""
    with speaking_tls(tmp_path) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """One for all tests that leave it as it is."""
    with speaking_tls(tmp_path_factory.mktemp("lasting")) as cluster:
        yield cluster


def fingerprint(cluster: Cluster) -> str:
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert((cluster.folder / "certificate.pem").read_text())).hexdigest()


@pytest.mark.patient
def test_units_reach_their_master_over_tls(cluster: Cluster) -> None:
    assert cluster.url.startswith("https://")
    source = {"kind": "recorded", "folder": str(write_recording(cluster.folder / "frames")), "fps": 15, "loop": True}
    pose = {"xyz": [1.0, 1.0, 0.5]}
    cluster.start_unit(1, source, T_world_camera=pose, master_ca=str(cluster.folder / "ca.pem"))
    cluster.start_unit(2, {**source, "serial": "B"}, T_world_camera=pose, master_fingerprint=fingerprint(cluster))
    cluster.until_live(2)


@pytest.mark.patient
def test_readers_of_the_stream_hear_it_over_tls(lasting: Cluster) -> None:
    url = lasting.url.replace("http", "ws") + "/stream?encoding=json"
    headers = {"Authorization": lasting.operator.headers["Authorization"]}
    context = ssl.create_default_context(cafile=lasting.folder / "ca.pem")
    with connect(url, additional_headers=headers, ssl=context, proxy=None) as reader:
        assert [json.loads(reader.recv(timeout=30.0))["number"] for _ in range(3)] == [1, 2, 3]


@pytest.mark.patient
def test_doctor_speaks_tls(lasting: Cluster, tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "frames")
    config = tmp_path / "unit.yaml"

    def master_line(**trust: str) -> str:
        source = {"kind": "recorded", "folder": str(folder), "fps": 15, "loop": True}
        fields = {"source": source, "master_url": lasting.url, "token_file": lasting.unit_token_file, **trust}
        config.write_text(yaml.safe_dump(fields))
        command = [sys.executable, "-m", "edge_unit", "doctor", str(config), "--seconds", "0.2"]
        ended = subprocess.run(command, capture_output=True, text=True)
        return next(line for line in ended.stdout.splitlines() if line.split()[1] == "master")

    assert master_line(master_ca=str(lasting.folder / "ca.pem")).startswith("ok")
    assert "the certificate's sha256 is" in master_line(master_fingerprint="0" * 64)


@pytest.mark.patient
def test_the_fingerprint_to_copy_is_printed(lasting: Cluster) -> None:
    assert f"sha256 {fingerprint(lasting)}" in lasting.log("master")


@pytest.mark.patient
@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_tls_is_1_2_or_later(lasting: Cluster, version: ssl.TLSVersion) -> None:
    context = ssl.create_default_context(cafile=lasting.folder / "ca.pem")
    context.minimum_version = context.maximum_version = version
    assert httpx.get(f"{lasting.url}/healthz", verify=context).status_code == 200


@pytest.mark.patient
def test_older_tls_and_none_get_no_answer(lasting: Cluster) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.set_ciphers("ALL:@SECLEVEL=0")
    with pytest.warns(DeprecationWarning, match="deprecated"):
        context.minimum_version, context.maximum_version = ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1
    with socket.create_connection(("127.0.0.1", lasting.port)) as plain, pytest.raises((ssl.SSLError, OSError)):
        context.wrap_socket(plain)
    with pytest.raises(httpx.HTTPError):
        httpx.get(f"http://127.0.0.1:{lasting.port}/healthz")
    assert lasting.get("/healthz")["status"] == "ok"


class Rogue(http.server.BaseHTTPRequestHandler):
    """A server in the master's place, with a certificate of its own."""

    requests: ClassVar[list[str]] = []

    def do_POST(self) -> None:
        self.requests.append(self.requestline)
        self.send_error(404)

    def log_message(self, *_: object) -> None:
        return


def test_a_unit_sends_a_rogue_master_nothing_and_returns_to_its_own(cluster: Cluster) -> None:
    source = {"kind": "recorded", "folder": str(write_recording(cluster.folder / "frames")), "fps": 15, "loop": True}
    unit = cluster.start_unit(
        1, source, T_world_camera={"xyz": [1.0, 1.0, 0.5]}, master_fingerprint=fingerprint(cluster)
    )
    cluster.until_live(1)
    master = cluster.processes[0]
    master.terminate()
    master.wait()
    rogue = http.server.ThreadingHTTPServer(("127.0.0.1", cluster.port), Rogue)
    Rogue.requests.clear()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    trustme.CA().issue_cert("127.0.0.1").configure_cert(context)
    rogue.socket = context.wrap_socket(rogue.socket, server_side=True)
    thread = threading.Thread(target=rogue.serve_forever)
    thread.start()
    try:
        until(lambda: "the certificate's sha256 is" in cluster.log("unit1"), "the unit's distrust")
    finally:
        rogue.shutdown()
        rogue.server_close()
        thread.join()
    assert Rogue.requests == []
    assert unit.poll() is None
    files = (
        "--tls-certificate", str(cluster.folder / "certificate.pem"), "--tls-key", str(cluster.folder / "key.pem"),
    )  # fmt: skip
    cluster.start_master(*files)
    cluster.until_live(1)


@pytest.mark.patient
def test_a_unit_that_checks_does_not_even_start_with_a_plain_master(tmp_path: Path) -> None:
    config = tmp_path / "unit.yaml"
    fields = {
        "source": {"kind": "simulated"},
        "master_url": "http://127.0.0.1:1",
        "token": "secret-token-0123456789",
        "master_fingerprint": "0" * 64,
    }
    config.write_text(yaml.safe_dump(fields))
    ended = subprocess.run([sys.executable, "-m", "edge_unit", "run", str(config)], capture_output=True, text=True)
    assert ended.returncode == 1
    assert "expected https://" in ended.stderr


@pytest.mark.patient
@pytest.mark.parametrize(
    ("certificate", "key", "words"),
    [
        ("gone.pem", "key.pem", "tls_certificate"),
        ("certificate.pem", "gone.pem", "tls_key"),
        ("ca.pem", "key.pem", "expected a certificate and its key"),
        ("cell.yaml", "key.pem", "expected a certificate and its key"),
        ("certificate.pem", None, "expected tls_certificate and tls_key"),
    ],
)
def test_an_invalid_certificate_is_named(tmp_path: Path, certificate: str, key: str | None, words: str) -> None:
    folder, cell = write_certificates(tmp_path), write_cell(tmp_path)
    options = ["--tls-certificate", str(folder / certificate)] + (["--tls-key", str(folder / key)] if key else [])
    command = [sys.executable, "-m", "master_server", "--cell", str(cell), "--port", "0", *options]
    ended = subprocess.run([*command, "--state-dir", str(folder / "other")], capture_output=True, text=True)
    assert ended.returncode == 1
    assert words in ended.stderr
    assert "Traceback" not in ended.stderr
