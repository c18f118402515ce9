# SPDX-License-Identifier: Apache-2.0
"""Files of the project: those that git tracks, or all files if there is no git or no repository."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

NO_SOURCE = {".git", ".venv", "__pycache__", "build", "dist", "out", "state"}
"""Folders that runs leave. `.gitignore` names them, too; caches begin with a dot."""


def project_files(root: Path) -> list[Path]:
    """Return every file below `root` that belongs to the project."""
    if shutil.which("git") is not None and (root / ".git").exists():
        git = ("git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard")
        names = subprocess.run(git, capture_output=True, check=True, text=True).stdout.split("\0")
        return [root / name for name in names if name and (root / name).is_file()]
    return [file for file in sorted(root.rglob("*")) if file.is_file() and _is_source(file.relative_to(root))]


def _is_source(file: Path) -> bool:
    caches = any(part.startswith(".") and part.endswith("_cache") for part in file.parts)
    return not caches and not NO_SOURCE & set(file.parts) and not file.suffix.startswith((".pyc", ".nb"))
