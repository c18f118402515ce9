# SPDX-License-Identifier: Apache-2.0
"""A card image, grown, customised and shrunk: sound, small, and a unit when it is booted."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from qualification.machines.containers import NAMESPACES

CHECKOUT = Path(__file__).parents[2]
TOOLS = ("sfdisk", "mke2fs", "resize2fs", "unzip", "zstd", "losetup")

FREE_SHARE_MAX = 0.4
"""Of a file system that is as small as resize2fs dares to make it: 0.35, and a second pass gains nothing."""


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(900)
@pytest.mark.skipif(any(shutil.which(tool) is None for tool in TOOLS), reason=f"needs {', '.join(TOOLS)}")
def test_a_card_image_becomes_a_units_as_small_as_it_goes(roots: Path) -> None:
    command = [*NAMESPACES, sys.executable, "-m", "tests.deploy.imaging", str(roots)]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=880, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    # The partition table is whole, also its second copy, and the root file system still begins where firmware finds it.
    assert "No errors detected" in found["verify"]
    assert sorted(found["partitions"]) == [["APP", 65536], ["A_kernel", 2048]]
    assert found["free_share"] <= FREE_SHARE_MAX
    assert found["packed_bytes"] < 0.6 * found["image_bytes"]
    assert found["name"].startswith("cellwatch-")
