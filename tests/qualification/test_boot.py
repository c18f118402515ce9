# SPDX-License-Identifier: Apache-2.0
"""Machines with systemd: three units from one read-only root file system that crash, hang and lose power."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(1500)
def test_machines_come_back_by_themselves_whatever_befalls_them(roots: Path) -> None:
    command = [sys.executable, "-m", "qualification.boot", "--roots", str(roots), "--no-results"]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=1450, check=False)
    assert done.stdout.endswith("}\n"), done.stderr + done.stdout
    document = json.loads(done.stdout.splitlines()[-1])
    # Times are tested by `make rehearsal` on a quiet computer. This test requires recovery without help, at any time.
    assert document["switch_on"]["compiled"] == 0
    joined = document["join"]
    for count in ("machines_posting", "found_by_mdns", "distinct_names", "distinct_host_keys", "distinct_machine_ids"):
        assert joined[count] == 3, count
    assert len(document["faults"]) == 8
    assert all(row["back_s"] <= 10 * row["back_s_max"] for row in document["faults"]), done.stdout
    assert document["stop_s"] <= 2.0
