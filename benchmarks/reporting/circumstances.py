# SPDX-License-Identifier: Apache-2.0
"""Time, machine and commit of a measurement."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from shared.clock import NS_PER_S, wall_ns

PACKAGES = ("numpy", "numba", "trimesh", "fastapi", "uvicorn", "httpx", "open3d", "octomap-python", "embreex")

LOAD_BEFORE = os.getloadavg()[0]
"""Load of the machine in the minute before this process began, by other processes."""

MEASURED = (":!benchmarks/baseline", ":!benchmarks/plots", ":!benchmarks/REPORT.md")
"""Files that `make bench` itself rewrites. They do not count as a change of the source."""

GIT_S = 5.0
ROOT = Path(__file__).resolve().parents[2]


def circumstances() -> dict[str, Any]:
    """Return the circumstances of this run as plain values. `packages` are the installed ones."""
    return {
        "at": datetime.fromtimestamp(wall_ns() / NS_PER_S, timezone.utc).isoformat(timespec="seconds"),
        "source": revision(),
        "cpu": _cpu(),
        "cores": os.cpu_count() or 1,
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": _packages(),
        "load_average_before": round(LOAD_BEFORE, 2),
    }


def revision() -> str:
    """The commit, with `-dirty` where files differ from it; "unknown" outside of a checkout."""
    try:
        commit, changed = _git("rev-parse", "--short=10", "HEAD"), _git("status", "--porcelain", "--", ".", *MEASURED)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return f"{commit}-dirty" if changed else commit


def _git(*command: str) -> str:
    git = ("git", "-C", str(ROOT), *command)
    return subprocess.run(git, capture_output=True, text=True, timeout=GIT_S, check=True).stdout.strip()


def _cpu() -> str:
    models = [row.partition(":")[2].strip() for row in _cpuinfo() if row.startswith("model name")]
    return models[0] if models else platform.machine()


def _cpuinfo() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.exists() else []


def _packages() -> dict[str, str]:
    installed = {}
    for name in PACKAGES:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return installed
