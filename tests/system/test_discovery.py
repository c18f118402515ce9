# SPDX-License-Identifier: Apache-2.0
"""Units with only a token find their master, on private networks with real processes."""

from __future__ import annotations

import hashlib
import signal
import ssl
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import trustme
import yaml

from shared.messages import CONTRACT_VERSION
from tests.missing import need_namespaces
from tests.system.cluster import CELL, Cluster, stop, until, write_recording
from tests.system.lan import Host, Lan

pytestmark = pytest.mark.slow

TOKEN = "a-token-for-every-unit-here"

PORT = 8420

MOVED_S = 8.0
"""Time until a master at a new address is found: 2 s until it is missed, its probing, a busy machine."""

LATE_S = 30.0
"""A unit that gets its address after the start retries every few seconds; the rest is for a busy machine."""


@pytest.fixture(scope="module", autouse=True)
def namespaces() -> None:
    need_namespaces()


class Site(Cluster):
    """Masters and units on hosts of one network."""

    lan: Lan

    def master(self, name: str, host: Host, cell: str = "bench", *options: str) -> subprocess.Popen[str]:
        """Start a master of a cell of this name; all have the same token."""
        state, document = self.folder / name, self.folder / f"{name}.yaml"
        state.mkdir(exist_ok=True)
        (state / "unit.token").write_text(TOKEN)
        document.write_text(yaml.safe_dump({**CELL, "name": cell}))
        return self.start(
            name, "master_server", "--cell", str(document), "--port", str(PORT), "--state-dir", str(state),
            "--public-reads", *options, under=host.under,
        )  # fmt: skip

    def unit(self, name: str, host: Host, **more: Any) -> subprocess.Popen[str]:
        """Start a unit that knows its token and the pose of its camera."""
        folder = self.folder / "frames"
        if not folder.exists():
            write_recording(folder)
        config = {
            "source": {"kind": "recorded", "folder": str(folder), "fps": 15, "loop": True, "serial": name},
            "token": TOKEN,
            "state_dir": str(self.folder / f"{name}-state"),
            "T_world_camera": {"xyz": [1.0, 1.0, 0.5]},
            **more,
        }
        path = self.folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump(config))
        return self.start(name, "edge_unit", "run", str(path), under=host.under)

    def until_said(self, name: str, *words: str, timeout_s: float = 60.0) -> None:
        """Wait until the log of a process has all these words in this order."""

        def said() -> bool:
            rest = self.log(name)
            for part in words:
                _, found, rest = rest.partition(part)
                if not found:
                    return False
            return True

        until(said, f"{name}: {words}", timeout_s)


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with Lan() as lan, Site(tmp_path, tmp_path / "cell.yaml") as site:
        site.lan = lan
        yield site


def live(host: Host, address: str) -> dict[str, tuple[str, str]]:
    """Return phase and state of each unit by its IP, as reported by the master at `address`."""
    rows = host.get(f"http://{address}:{PORT}/units") or []
    return {row["ip"]: (row["phase"], row["state"]) for row in rows}


def test_a_unit_finds_its_master_and_follows_it_to_another_address(site: Site) -> None:
    desk, board = site.lan.host("10.78.0.1"), site.lan.host("10.78.0.2")
    site.unit("unit", board)
    site.until_said("unit", "searching: ")
    site.master("master", desk)
    until(lambda: live(board, "10.78.0.1") == {"10.78.0.2": ("live", "live")}, "a live unit", 60.0)
    site.until_said("unit", "searching → registering: at http://10.78.0.1:8420, announced as 'bench at ")
    site.until_said("unit", "registering → fetching: unit 1, cell bench", "fetching → live: ")
    began = time.monotonic()
    desk.drop("10.78.0.1")
    desk.add("10.78.0.50")
    moved = ("live → searching: ", "searching → registering: at http://10.78.0.50:8420", "fetching → live: ")
    site.until_said("unit", *moved, timeout_s=MOVED_S)
    left_s = MOVED_S - (time.monotonic() - began)
    until(lambda: live(board, "10.78.0.50") == {"10.78.0.2": ("live", "live")}, "a live unit", left_s)
    # Few lines, and one for the lost master.
    assert len(site.log("unit").splitlines()) < 30


def test_a_restarted_unit_returns_without_looking(site: Site) -> None:
    desk, board = site.lan.host("10.78.0.1"), site.lan.host("10.78.0.2")
    site.master("master", desk)
    unit = site.unit("unit", board)
    site.until_said("unit", "fetching → live: ")
    stop(unit, signal.SIGTERM)
    site.unit("unit", board)
    site.until_said("unit", "stopped", "registering: at http://10.78.0.1:8420, as before", "fetching → live: ")


def test_a_network_that_comes_up_late_is_used(site: Site) -> None:
    desk, board = site.lan.host("10.78.0.1"), site.lan.host(plugged=False)
    site.master("master", desk)
    site.unit("unit", board)
    site.until_said("unit", "searching: ")
    site.lan.plug(board)
    site.until_said("unit", "no master is announced on this network")
    board.add("10.78.0.2")
    until(lambda: live(desk, "10.78.0.1") == {"10.78.0.2": ("live", "live")}, "a live unit", LATE_S)


def test_a_master_whose_network_comes_up_late_is_found(site: Site) -> None:
    desk, board = site.lan.host(plugged=False), site.lan.host("10.78.0.2")
    site.master("master", desk)
    site.unit("unit", board)
    site.until_said("master", "announced as ", "at 127.0.0.1 port 8420")
    site.lan.plug(desk)
    desk.add("10.78.0.1")
    until(lambda: live(board, "10.78.0.1") == {"10.78.0.2": ("live", "live")}, "a live unit", 30.0)


def test_of_two_masters_the_one_of_its_cell_is_taken_and_no_other_ever(site: Site) -> None:
    one, two = site.lan.host("10.78.0.1"), site.lan.host("10.78.0.3")
    undecided, decided = site.lan.host("10.78.0.4"), site.lan.host("10.78.0.5")
    ours = site.master("ours", one, "welding")
    site.master("theirs", two, "painting")
    for name in ("ours", "theirs"):
        site.until_said(name, "announced as ")
    site.unit("undecided", undecided)
    site.unit("decided", decided, cell="welding")
    until(lambda: live(decided, "10.78.0.1") == {"10.78.0.5": ("live", "live")}, "a live unit", 60.0)
    site.until_said("undecided", "2 masters are suitable, choose one by cell or master_url: ", "painting", "welding")
    ours.kill()
    site.until_said("decided", "live → searching: ", "none of the announced masters is suitable: ")
    site.until_said("undecided", "masters of several cells were announced (painting, welding)")
    assert live(decided, "10.78.0.3") == {}
    site.master("ours", one, "welding")
    until(lambda: live(decided, "10.78.0.1") == {"10.78.0.5": ("live", "live")}, "a live unit", 30.0)
    assert live(decided, "10.78.0.3") == {}


def test_two_masters_of_one_cell_are_distinguished(site: Site) -> None:
    one, two, board = site.lan.host("10.78.0.1"), site.lan.host("10.78.0.3"), site.lan.host("10.78.0.2")
    first, second = site.master("first", one), site.master("second", two)
    for name in ("first", "second"):
        site.until_said(name, "announced as ")
    site.unit("unit", board)
    for address in ("10.78.0.1", "10.78.0.3"):
        site.until_said("unit", "2 masters are suitable", f"http://{address}:8420")
    stop(first, signal.SIGTERM)
    until(lambda: live(board, "10.78.0.3") == {"10.78.0.2": ("live", "live")}, "a live unit", 30.0)
    # An impostor: the same cell at another address.
    site.master("first", one)
    site.until_said("first", "stopped", "announced as ")
    second.kill()
    until(lambda: live(board, "10.78.0.1") == {"10.78.0.2": ("live", "live")}, "a live unit", 30.0)


@pytest.mark.parametrize("claimed", ["", "its own", "ours"])
def test_a_rogue_master_gets_no_token(site: Site, claimed: str) -> None:
    ca = trustme.CA()
    certificate = ca.issue_cert("10.78.0.1")
    certificate.private_key_pem.write_to_path(str(site.folder / "key.pem"))
    certificate.cert_chain_pems[0].write_to_path(str(site.folder / "certificate.pem"))
    pin = hashlib.sha256(ssl.PEM_cert_to_DER_cert((site.folder / "certificate.pem").read_text())).hexdigest()
    desk, thief, board = site.lan.host("10.78.0.1"), site.lan.host("10.78.0.66"), site.lan.host("10.78.0.2")
    fingerprint = {"": "", "its own": "00" * 32, "ours": pin}[claimed]
    site.start("rogue", "tests.system.rogue_master", "bench", str(CONTRACT_VERSION), fingerprint, under=thief.under)
    site.unit("unit", board, master_fingerprint=pin)
    site.until_said("unit", "none of the announced masters is suitable: ", "10.78.0.66")
    files = (
        "--tls-certificate", str(site.folder / "certificate.pem"), "--tls-key", str(site.folder / "key.pem"),
    )  # fmt: skip
    site.master("master", desk, "bench", *files)
    site.until_said("unit", "registering: at https://10.78.0.1:8420", "fetching → live: ")
    assert "was told b'" not in site.log("rogue").replace("was told b''", "")


@pytest.mark.parametrize("address", ["10.78.0.1", None])
def test_a_master_on_the_same_board_is_found(site: Site, address: str | None) -> None:
    board = site.lan.host(address)
    site.master("master", board)
    site.unit("unit", board)
    ip = address or "127.0.0.1"
    until(lambda: live(board, ip) == {ip: ("live", "live")}, "a live unit", 60.0)


def test_doctor_prints_its_findings_and_its_choice(site: Site) -> None:
    desk, other, board = site.lan.host("10.78.0.1"), site.lan.host("10.78.0.3"), site.lan.host("10.78.0.2")
    site.master("ours", desk, "welding")
    site.master("theirs", other, "painting")
    for name in ("ours", "theirs"):
        site.until_said(name, "announced as ")
    unit = site.unit("unit", board, cell="welding")
    site.until_said("unit", "fetching → live: ")
    stop(unit, signal.SIGTERM)
    path = str(site.folder / "unit.yaml")
    doctor = site.start("doctor", "edge_unit", "doctor", path, "--seconds", "0.2", under=board.under)
    doctor.wait(60.0)
    lines = site.log("doctor").splitlines()
    found = [line for line in lines if line.split()[1] == "network"]
    assert any("welding, http://10.78.0.1:8420)" in line and "does not" not in line for line in found), lines
    assert any("painting" in line and "it does not watch cell welding" in line for line in found), lines
    assert any(line.split()[1] == "master" and "http://10.78.0.1:8420 (as before)" in line for line in lines), lines
