# SPDX-License-Identifier: Apache-2.0
"""Every fault of `make faults`, through the same code: nothing unseen is called free, and nothing is lost."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from qualification.fault_site.watch import NOTICED_S_MAX, RECOVERED_S_MAX
from qualification.faults import FAULTS
from tests.missing import need_namespaces

pytestmark = pytest.mark.slow

BUSY_S = 1.0
"""Additional time because of other tests. The statements about the map hold on any machine, however busy."""


@pytest.fixture(scope="module", autouse=True)
def namespaces() -> None:
    need_namespaces()


def struck(name: str) -> dict[str, Any]:
    """Run one fault and return its row."""
    command = (sys.executable, "-m", "qualification.faults", name)
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.stdout, run.stderr
    (row,) = json.loads(run.stdout.splitlines()[-1])["faults"]
    return dict(row)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_no_unseen_place_is_called_free(fault: Any) -> None:
    row = struck(fault.name)
    assert not row["false_free"], row
    assert row["lost"] == 0, row
    assert row["answers"] > 20
    if fault.names is None:
        assert row["noticed_s"] is None
    else:
        assert row["noticed_s"] is not None, row
        assert row["noticed_s"] <= NOTICED_S_MAX + BUSY_S
        assert fault.names in row["told"]
    assert row["recovered_s"] is not None, row
    assert row["recovered_s"] <= RECOVERED_S_MAX + BUSY_S
