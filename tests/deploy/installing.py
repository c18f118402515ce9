# SPDX-License-Identifier: Apache-2.0
"""Run `install.sh` on a running machine: a master, a unit beside it, an update of both, and a rollback. Print the
results.

Run by `test_install.py`, in namespaces of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import zipfile
from hashlib import sha256
from pathlib import Path
from typing import Any

import httpx

from qualification.machines.containers import Machine, MachineError, make_network, until

CHECKOUT = Path(__file__).parents[2]
IP = "10.77.0.1"
INSTALL_S = 300.0
LIVE_S = 180.0


def newer(wheels: Path, folder: Path) -> None:
    """Copy the wheels, with a Cellwatch of another version."""
    folder.mkdir()
    for file in wheels.iterdir():
        if not file.name.startswith("cellwatch-"):
            (folder / file.name).symlink_to(Path("/mnt/wheels") / file.name)
    before = next(wheels.glob("cellwatch-*.whl"))
    version = before.name.split("-")[1]
    after = folder / before.name.replace(version, "9.9.9")
    with zipfile.ZipFile(before) as old, zipfile.ZipFile(after, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename.endswith("dist-info/METADATA"):
                content = content.replace(f"\nVersion: {version}\n".encode(), b"\nVersion: 9.9.9\n")
            if entry.filename.endswith("dist-info/RECORD"):
                lines = content.decode().replace(f"cellwatch-{version}.", "cellwatch-9.9.9.").splitlines()
                content = "\n".join(line for line in lines if "METADATA" not in line).encode()
            new.writestr(entry.filename.replace(f"cellwatch-{version}.", "cellwatch-9.9.9."), content)
    (folder / "lock.txt").unlink()
    (folder / "about").unlink()
    (folder / "about").write_text((wheels / "about").read_text())
    others = [line for line in (wheels / "lock.txt").read_text().splitlines() if not line.startswith("cellwatch==")]
    ours = f"cellwatch==9.9.9 --hash=sha256:{sha256(after.read_bytes()).hexdigest()}"
    (folder / "lock.txt").write_text("\n".join([*others, ours]) + "\n")


class Board:
    """A machine that is already set up, with a checkout and wheels."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.operator: httpx.Client | None = None

    def install(self, *options: str) -> None:
        self.machine.run("/mnt/checkout/deploy/image/install.sh", *options, timeout_s=INSTALL_S)

    def row(self) -> dict[str, Any] | None:
        if self.operator is None:
            token = self.machine.run("cat", "/var/lib/cellwatch-master/operator.token").strip()
            self.operator = httpx.Client(
                base_url=f"http://{IP}:8420", headers={"Authorization": f"Bearer {token}"}, trust_env=False
            )
        try:
            rows = self.operator.get("/units").json()
        except httpx.HTTPError:
            return None
        return rows[0] if rows and rows[0]["state"] == "live" and rows[0]["voxels"] > 0 else None

    def live(self, version: str) -> dict[str, Any]:
        def right() -> dict[str, Any] | None:
            row = self.row()
            return row if row is not None and row["software"].endswith(version) else None

        try:
            row = until(right, f"a unit of version {version}, live", LIVE_S)
        except MachineError as error:
            raise MachineError(f"{error}: {self.row()}\n{self.machine.journal('edge-unit.service')}") from error
        assert row is not None
        return row


def rehearse(roots: Path, folder: Path) -> dict[str, Any]:
    """Follow docs/deploy.md as a person would."""
    make_network()
    root = folder / "root"
    root.mkdir()
    subprocess.run(["tar", "-C", str(root), "-xf", str(roots / "debian.tar")], check=True)
    newer(roots / "wheels", folder / "newer")
    config = folder / "unit.yaml"
    config.write_text((roots / "unit.yaml").read_text())
    release = roots / "unit" / "opt" / "cellwatch" / (roots / "unit" / "opt" / "cellwatch" / "current").readlink()
    places = {CHECKOUT: "checkout", roots / "wheels": "wheels", folder / "newer": "newer", config: "unit.yaml"}
    places[release / "kernels"] = "kernels"
    binds = tuple(f"{path}:/mnt/{name}" for path, name in places.items())
    found: dict[str, Any] = {}
    with Machine("board", root, IP, folder / "board", binds, volatile=False) as machine:
        machine.power_on()
        board = Board(machine)
        until(lambda: "running" in _state(machine) or "degraded" in _state(machine), "the boot", LIVE_S)
        board.install("--role", "master", "--wheelhouse", "/mnt/wheels", "--cell", "/mnt/checkout/assets/cells/demo")
        board.install(
            *("--wheelhouse", "/mnt/wheels", "--config", "/mnt/unit.yaml", "--without-camera"),
            *("--token", "/var/lib/cellwatch-master/unit.token", "--kernels", "/mnt/kernels"),
        )
        found["installed"] = board.live("0.1.0")
        before = machine.run("readlink", "/opt/cellwatch/current").strip()
        board.install("--wheelhouse", "/mnt/newer", "--without-camera", "--kernels", "/mnt/kernels")
        found["updated"] = board.live("9.9.9")
        found["releases"] = sorted(machine.run("ls", "/opt/cellwatch/releases").split())
        machine.run("ln", "-sfn", before, "/opt/cellwatch/current")
        machine.run("systemctl", "restart", "edge-unit")
        found["back"] = board.live("0.1.0")
        found["compiled"] = len(machine.run("find", "/var/cache/private", "-name", "*.nbc", "-type", "f").split())
        found["name"] = machine.run("hostname").strip()
        if board.operator is not None:
            board.operator.close()
    return found


def _state(machine: Machine) -> str:
    try:
        return machine.run("systemctl", "is-system-running", "--wait")
    except MachineError as error:
        return str(error)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        print(json.dumps(rehearse(Path(sys.argv[1]).resolve(), Path(scratch))))
