# SPDX-License-Identifier: Apache-2.0
"""A real master as a child process, and what it says as soon as it can be asked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from shared.errors import MasterUnreachable
from simulation.fleet.processes import Child, ChildNotReady, Processes, until_written

READY_S = 30.0
"""For a master to be there on a busy machine."""


@dataclass(frozen=True, eq=False)
class RunningMaster:
    """Where it listens, and the files with the tokens that it takes."""

    child: Child
    url: str
    port: int
    pid: int
    unit_token_file: Path
    operator_token_file: Path

    @property
    def unit_token(self) -> str:
        """As units send it."""
        return self.unit_token_file.read_text(encoding="ascii").strip()

    @property
    def as_operator(self) -> dict[str, str]:
        """The header of whoever may change anything."""
        return {"Authorization": f"Bearer {self.operator_token_file.read_text(encoding='ascii').strip()}"}


async def start_master(
    processes: Processes,
    cell: Path,
    state_dir: Path,
    *options: str,
    name: str = "master",
    module: str = "master_server",
    host: str = "127.0.0.1",
    port: int = 0,
    variables: Mapping[str, str] | None = None,
    ready_s: float = READY_S,
) -> RunningMaster:
    """Start one of this cell, at a free port unless one is named, and wait until it can be asked.

    `options` are more of its command line, `variables` of its environment; `module` is what is run in its place.

    Raises:
        MasterUnreachable: it ended instead, or was not ready within `ready_s`.
    """
    ready_file = state_dir.with_suffix(".ready")
    ready_file.unlink(missing_ok=True)
    child = await processes.start(
        name,
        module,
        *("--cell", str(cell), "--host", host, "--port", str(port)),
        *("--state-dir", str(state_dir), "--ready-file", str(ready_file), *options),
        variables=variables,
    )
    try:
        ready = json.loads(await until_written(child, ready_file, ready_s))
    except ChildNotReady as error:
        raise MasterUnreachable(str(error)) from error
    return RunningMaster(
        child,
        ready["url"],
        ready["port"],
        ready["pid"],
        Path(ready["unit_token_file"]),
        Path(ready["operator_token_file"]),
    )
