# SPDX-License-Identifier: Apache-2.0
"""A real master as a child process, and its address and tokens as soon as it answers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from shared.errors import MasterUnreachable
from simulation.fleet.processes import Child, ChildNotReady, Processes, until_written

READY_S = 30.0
"""Timeout for the start of a master on a busy machine."""


@dataclass(frozen=True, eq=False)
class RunningMaster:
    """Address of a running master, and the files with its tokens."""

    child: Child
    url: str
    port: int
    pid: int
    unit_token_file: Path
    operator_token_file: Path

    @property
    def unit_token(self) -> str:
        """Token that units send."""
        return self.unit_token_file.read_text(encoding="ascii").strip()

    @property
    def as_operator(self) -> dict[str, str]:
        """HTTP header of an operator."""
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
    """Start a master of `cell` and wait until it answers. Port 0 is a free port.

    `options` are added to its command line, `variables` to its environment. `module` replaces the master's own.

    Raises:
        MasterUnreachable: the master ended, or was not ready within `ready_s`.
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
