# SPDX-License-Identifier: Apache-2.0
"""What machines are made from; `.ci/run` has it made before the tests, which fetch nothing."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from qualification.machines.containers import why_not

CHECKOUT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def roots() -> Path:
    """Root file systems of a unit and a master, with Debian and the wheels that they were made from."""
    if (reason := why_not()) is not None:
        pytest.skip(f"no machines can be run here: {reason}")
    folder = Path(os.environ.get("CELLWATCH_ROOTS", CHECKOUT / "out" / "rehearsal"))
    if not (folder / "master" / "opt").exists():
        pytest.skip("there are no root file systems: `deploy/image/rehearsal-roots out/rehearsal` makes them")
    return folder
