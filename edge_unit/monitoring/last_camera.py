# SPDX-License-Identifier: Apache-2.0
"""The camera of the last run: a unit that starts without it can tell the master which one is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_unit.sources.frame import CameraInfo
from shared.camera import Intrinsics
from shared.files import StateFile

FILE_NAME = "camera.json"


class CameraMemory:
    """One small file in the unit's state folder."""

    def __init__(self, state_dir: Path) -> None:
        self._file = StateFile(state_dir / FILE_NAME)

    def save(self, camera: CameraInfo) -> None:
        """Store `camera`; if the file cannot be written, log a warning."""
        self._file.save({"serial": camera.serial, "model": camera.model, "intrinsics": camera.intrinsics.model_dump()})

    def load(self) -> CameraInfo | None:
        """Return the stored camera; None without a file, or with a damaged one."""
        return self._file.load(_camera_of)


def _camera_of(document: Any) -> CameraInfo:
    intrinsics = Intrinsics.model_validate(document["intrinsics"])
    return CameraInfo(str(document["serial"]), str(document["model"]), intrinsics)
