# SPDX-License-Identifier: Apache-2.0
"""Convert a card image laid out like NVIDIA's to a unit's by `build-image --base`, boot it, and print the results.

Run by `test_build_image.py`, in namespaces of its own.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from qualification.machines.containers import Machine, MachineError, make_network, until

CHECKOUT = Path(__file__).parents[2]
BOOT_S = 180.0

SECTOR_BYTES = 512
ROOT_SECTOR = 65536
LAYOUT = f"label: gpt\n1: start={ROOT_SECTOR}, name=APP\n2: start=2048, size=8192, name=A_kernel\n"
"""The root file system is the first by its number and the last by its position."""

FREE_MB = 600
"""Free space of a card image."""


def run(*command: str) -> str:
    """Run a command and return its output."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise MachineError(f"{' '.join(command)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


def card_image(roots: Path, folder: Path) -> Path:
    """Make a zip with the image of a card that holds a bare Debian."""
    root = folder / "bare"
    root.mkdir()
    run("tar", "-C", str(root), "-xf", str(roots / "debian.tar"))
    size_mb = int(run("du", "-sm", str(root)).split()[0]) + FREE_MB
    image = folder / "card.img"
    with image.open("wb") as file:
        file.truncate(size_mb * 1024 * 1024)
    subprocess.run(["sfdisk", "-q", str(image)], input=LAYOUT, text=True, check=True)
    # The second copy of the partition table lies behind it.
    blocks_4k = (size_mb - 1) * 256 - ROOT_SECTOR // 8
    offset = f"offset={ROOT_SECTOR * SECTOR_BYTES}"
    made = ("mke2fs", "-q", "-t", "ext4", "-b", "4096", "-L", "APP", "-E", offset, "-d", str(root))
    run(*made, str(image), str(blocks_4k))
    packed = folder / "card.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.write(image, "sd-blob.img")
    image.unlink()
    run("rm", "-rf", str(root))
    return packed


def build(roots: Path, folder: Path) -> dict[str, Any]:
    """Build the unit's image, inspect its partition table and file system, and boot it. Return the findings."""
    make_network()
    release = roots / "unit" / "opt" / "cellwatch" / (roots / "unit" / "opt" / "cellwatch" / "current").readlink()
    packed = folder / "unit.img.zst"
    run(
        *(str(CHECKOUT / "deploy/image/build-image"), "--base", str(card_image(roots, folder))),
        *("--out", str(packed), "--compress", "zstd", "--", "--wheelhouse", str(roots / "wheels"), "--without-camera"),
        *("--token", str(roots / "unit.token"), "--config", str(roots / "unit.yaml"), "--cell"),
        *(str(CHECKOUT / "assets/cells/demo"), "--kernels", str(release / "kernels")),
    )
    image = folder / "unit.img"
    run("zstd", "-q", "-d", str(packed), "-o", str(image))
    found: dict[str, Any] = {"image_bytes": image.stat().st_size, "packed_bytes": packed.stat().st_size}
    found["verify"] = run("sfdisk", "--verify", str(image)).strip()
    partitions = json.loads(run("sfdisk", "-J", str(image)))["partitiontable"]["partitions"]
    found["partitions"] = [(part["name"], part["start"]) for part in partitions]
    app = next(part for part in partitions if part["name"] == "APP")
    limits = ("--offset", str(app["start"] * SECTOR_BYTES), "--sizelimit", str(app["size"] * SECTOR_BYTES))
    with ExitStack() as stack:
        device = run("losetup", "--find", "--show", *limits, str(image)).strip()
        stack.callback(run, "losetup", "--detach", device)
        run("e2fsck", "-fn", device)
        header = run("dumpe2fs", "-h", device)
        counts = dict(re.findall(r"^(Block count|Free blocks): *(\d+)", header, re.MULTILINE))
        found["free_share"] = int(counts["Free blocks"]) / int(counts["Block count"])
        mounted = folder / "mounted"
        mounted.mkdir()
        run("mount", "-o", "ro", device, str(mounted))
        stack.callback(run, "umount", str(mounted))
        with Machine("card", mounted, "10.77.0.11", folder / "card") as machine:
            machine.power_on()
            until(lambda: active(machine), "the unit's service", BOOT_S)
            found["name"] = machine.run("hostname").strip()
            until(lambda: "no master is announced" in machine.journal("edge-unit.service"), "its search", BOOT_S)
    return found


def active(machine: Machine) -> bool:
    """Return True if the unit's service has reported that it is ready."""
    try:
        return machine.show("edge-unit.service", "ActiveState") == "active"
    except MachineError:
        return False


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        print(json.dumps(build(Path(sys.argv[1]).resolve(), Path(scratch))))
