# SPDX-License-Identifier: Apache-2.0
"""A real master and real units as processes on loopback, all of which end with the test."""

from __future__ import annotations

import json
import signal
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import httpx
import numpy as np
import yaml

START_S = 30.0
"""Time limit for a process to start on a busy machine, including the compilation of kernels."""

STOP_S = 2.0
"""Time limit to stop, on which a service manager relies."""

Found = TypeVar("Found")

CELL: dict[str, Any] = {"name": "bench", "box": {"min": [0.0, 0.0, 0.0], "max": [2.0, 2.0, 2.0]}}

WIDTH, HEIGHT, FOCAL_PX = 160, 120, 120.0
WALL_MM, PATCH_MM = 5000, 1500


def write_cell(folder: Path) -> Path:
    """Write a cell with an empty box."""
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(CELL))
    return path


def write_recording(folder: Path, focal_px: float = FOCAL_PX) -> Path:
    """Write a recording of a patch of half a metre, 1.5 m before the camera. All else is far outside the cell."""
    folder.mkdir()
    depth = np.full((HEIGHT, WIDTH), WALL_MM, np.uint16)
    half = round(20 * focal_px / FOCAL_PX)
    depth[HEIGHT // 2 - half : HEIGHT // 2 + half, WIDTH // 2 - half : WIDTH // 2 + half] = PATCH_MM
    np.savez(folder / "00.npz", depth=depth)
    k = [focal_px, 0.0, (WIDTH - 1) / 2, 0.0, focal_px, (HEIGHT - 1) / 2, 0.0, 0.0, 1.0]
    (folder / "camera_info.yaml").write_text(yaml.safe_dump({"width": WIDTH, "height": HEIGHT, "k": k}))
    return folder


def until(look: Callable[[], Found], what: str, timeout_s: float = START_S) -> Found:
    """Return the first true result of `look`. Fail after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while True:
        found = look()
        if found:
            return found
        assert time.monotonic() < deadline, f"{what}: not within {timeout_s:g} s, last {found!r}"
        time.sleep(0.01)


@dataclass
class Cluster:
    """Processes of one test. Leaving the context ends them all."""

    folder: Path
    cell: Path
    processes: list[subprocess.Popen[str]] = field(default_factory=list)
    port: int = 0
    url: str = "http://127.0.0.1:9"
    unit_token_file: str = ""
    verify: ssl.SSLContext | bool = True
    operator: httpx.Client = field(default_factory=lambda: httpx.Client(trust_env=False))

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.operator.close()
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.wait()
        if kind is not None:
            for log in sorted(self.folder.glob("*.log")):
                print(f"---- {log.name}\n{log.read_text()}")

    def start(self, name: str, *arguments: str, under: Sequence[str] = ()) -> subprocess.Popen[str]:
        """Start a process, as the last part of the command `under`. Its output goes to a log named after it."""
        with (self.folder / f"{name}.log").open("a") as log:
            process = subprocess.Popen(
                [*under, sys.executable, "-m", *arguments], stdout=log, stderr=subprocess.STDOUT, text=True
            )
        self.processes.append(process)
        return process

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def start_master(self, *options: str, under: Sequence[str] = ()) -> subprocess.Popen[str]:
        """Start a master; a restarted one listens at the same port. `under` may give it private mounts."""
        ready = self.folder / "ready.json"
        process = self.start(
            "master", "master_server", "--cell", str(self.cell), "--host", "127.0.0.1", "--port", str(self.port),
            "--state-dir", str(self.folder / "master"), "--ready-file", str(ready), *options,
            under=under,
        )  # fmt: skip
        root = f"/proc/{process.pid}/root" if under else ""

        def look() -> Any:
            assert process.poll() is None, self.log("master")
            return json.loads(ready.read_text()) if ready.exists() else None

        found = until(look, "the master")
        self.port, self.url = found["port"], found["url"]
        self.unit_token_file = root + found["unit_token_file"]
        self.operator.close()
        self.operator = httpx.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {Path(root + found['operator_token_file']).read_text().strip()}"},
            trust_env=False,
            verify=self.verify,
        )
        return process

    def start_unit(self, number: int, source: dict[str, Any], **more: Any) -> subprocess.Popen[str]:
        """Start unit `number`, at 127.0.0.(number + 1)."""
        config = {
            "source": source,
            "master_url": self.url,
            "token_file": self.unit_token_file,
            "state_dir": str(self.folder / f"unit{number}"),
            "source_address": f"127.0.0.{number + 1}",
            **more,
        }
        path = self.folder / f"unit{number}.yaml"
        path.write_text(yaml.safe_dump(config))
        return self.start(f"unit{number}", "edge_unit", "run", str(path))

    def get(self, path: str) -> Any:
        response = self.operator.get(path)
        assert response.status_code == 200, response.text
        return response.json()

    def put(self, path: str, body: Any) -> Any:
        response = self.operator.put(path, json=body)
        assert response.is_success, response.text
        return response.json() if response.content else None

    def states(self) -> dict[str, str]:
        """Return the state of each unit by its address."""
        return {row["ip"]: row["state"] for row in self.get("/units")}

    def until_live(self, count: int, timeout_s: float = START_S) -> None:
        until(lambda: list(self.states().values()) == ["live"] * count, f"{count} live units", timeout_s)


def stop(process: subprocess.Popen[str], number: signal.Signals) -> float:
    """Send a signal to a process, and return the seconds until it ended."""
    began = time.monotonic()
    process.send_signal(number)
    process.wait(START_S)
    return time.monotonic() - began
