# SPDX-License-Identifier: Apache-2.0
"""The installation on a running machine as documented: master, unit, update, and rollback."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from qualification.machines.containers import NAMESPACES

CHECKOUT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(900)
def test_a_running_machine_becomes_master_and_unit_and_is_updated_and_taken_back(roots: Path) -> None:
    command = [*NAMESPACES, sys.executable, "-m", "tests.deploy.installing", str(roots)]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=880, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert [found[stage]["software"] for stage in ("installed", "updated", "back")] == [
        "edge-unit 0.1.0",
        "edge-unit 9.9.9",
        "edge-unit 0.1.0",
    ]
    assert [release.split("-")[0] for release in found["releases"]] == ["0.1.0", "9.9.9"]
    # The only slot is still that of this board, under its own address; its identity is its own.
    assert {found[stage]["id"] for stage in ("installed", "updated", "back")} == {found["installed"]["id"]}
    assert not found["name"].startswith("cellwatch-")
    assert found["compiled"] == 0
