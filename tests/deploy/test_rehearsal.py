# SPDX-License-Identifier: Apache-2.0
"""Machines with systemd: three units from one read-only root file system that crash, stand still and lose power."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.machines import why_not

CHECKOUT = Path(__file__).parents[2]
ROOTS = Path(os.environ.get("CELLWATCH_ROOTS", CHECKOUT / "out" / "rehearsal"))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(why_not() is not None, reason=f"no machines can be run here: {why_not()}"),
    pytest.mark.skipif(
        not (ROOTS / "master" / "opt").exists(),
        reason="there are no root file systems: `deploy/image/rehearsal-roots out/rehearsal` makes them",
    ),
]


@pytest.mark.timeout(900)
def test_machines_come_back_by_themselves_whatever_befalls_them() -> None:
    command = [sys.executable, "-m", "benchmarks.rehearsal", "--roots", str(ROOTS), "--no-results"]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=880, check=False)
    assert done.stdout, done.stderr
    document = json.loads(done.stdout.splitlines()[-1])
    joined = document["join"]
    for count in ("machines_posting", "found_by_mdns", "distinct_names", "distinct_host_keys", "distinct_machine_ids"):
        assert joined[count] == 3, count
    # How soon is for `make rehearsal` on a quiet computer; here, that it happens at all, and without anyone's help.
    assert len(document["faults"]) == 8
    assert all(row["back_s"] <= 10 * row["back_s_max"] for row in document["faults"]), done.stdout
    assert document["stop_s"] <= 2.0
