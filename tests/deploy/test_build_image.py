# SPDX-License-Identifier: Apache-2.0
"""A card image, grown, customised and shrunk: sound, small, and a unit when it boots."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from qualification.machines.containers import NAMESPACES
from tests.missing import need_command

CHECKOUT = Path(__file__).parents[2]
TOOLS = {"sfdisk": "fdisk", "resize2fs": "e2fsprogs", "unzip": "unzip", "zstd": "zstd", "losetup": "mount"}

FREE_SHARE_MAX = 0.4
"""Free share of a file system that is as small as resize2fs can make it: 0.35. A second pass gains nothing."""


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(900)
def test_a_card_image_becomes_a_units_as_small_as_it_goes(roots: Path) -> None:
    for command, package in TOOLS.items():
        need_command(command, package)
    process = [*NAMESPACES, sys.executable, "-m", "tests.deploy.imaging", str(roots)]
    done = subprocess.run(process, cwd=CHECKOUT, capture_output=True, text=True, timeout=880, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    # The partition table is whole, with its second copy, and the root file system still begins at the sector that
    # firmware expects.
    assert "No errors detected" in found["verify"]
    assert sorted(found["partitions"]) == [["APP", 65536], ["A_kernel", 2048]]
    assert found["free_share"] <= FREE_SHARE_MAX
    assert found["packed_bytes"] < 0.6 * found["image_bytes"]
    assert found["name"].startswith("cellwatch-")
