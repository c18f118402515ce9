# SPDX-License-Identifier: Apache-2.0
"""The camera that was here before, so that a unit that starts without it can tell the master which one is missing."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from pydantic import ValidationError

from edge_unit.sources.frame import CameraInfo
from shared.camera import Intrinsics

logger = logging.getLogger(__name__)

FILE_NAME = "camera.json"

MAX_FILE_BYTES = 10_000
"""Some ten times what is written."""


class CameraMemory:
    """One small file in the unit's state."""

    def __init__(self, state_dir: Path) -> None:
        self._path = state_dir / FILE_NAME

    def save(self, camera: CameraInfo) -> None:
        """Remember `camera`; where nothing can be written nothing is remembered, and a warning says so."""
        document = {"serial": camera.serial, "model": camera.model, "intrinsics": camera.intrinsics.model_dump()}
        written = self._path.with_suffix(".new")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            written.write_text(json.dumps(document), encoding="utf-8")
            written.replace(self._path)
        except OSError as error:
            logger.warning("%s: cannot be written: %s", self._path, error)

    def load(self) -> CameraInfo | None:
        """The camera that was remembered, or None; a damaged file is as good as none."""
        try:
            if self._path.stat().st_size > MAX_FILE_BYTES:
                raise ValueError(f"expected at most {MAX_FILE_BYTES} bytes")
            document = json.loads(self._path.read_text(encoding="utf-8"))
            intrinsics = Intrinsics.model_validate(document["intrinsics"])
            return CameraInfo(str(document["serial"]), str(document["model"]), intrinsics)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, ValidationError) as error:
            logger.warning("%s: passed over: %s", self._path, " ".join(str(error).split()))
            return None
