# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from master_server.cells import cell_loading, unpacking


def test_the_process_that_unpacks_finds_our_packages_and_those_only(tmp_path: Path) -> None:
    """Use its path alone: `-S` leaves out installed packages, so an editable checkout cannot replace it."""
    find = f"import importlib.util as u; print(u.find_spec({unpacking.__name__!r}).origin)"
    done = subprocess.run(
        [sys.executable, "-S", "-c", find],
        cwd=tmp_path,
        env={"PYTHONPATH": str(cell_loading.PLACE)},
        capture_output=True,
        text=True,
        timeout=30.0,
        check=True,
    )
    assert Path(done.stdout.strip()) == Path(unpacking.__file__).resolve()
