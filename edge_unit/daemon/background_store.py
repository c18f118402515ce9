# SPDX-License-Identifier: Apache-2.0
"""The background model on disk, with the camera, profile and pose that it belongs to."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge_unit.pipeline import BackgroundModel
from edge_unit.sources.frame import CameraInfo
from shared.errors import InputError
from shared.files import StateFile
from shared.transforms import Transform

logger = logging.getLogger(__name__)

SAME_POSE = 1e-6
"""Poses travel as text and as binary; beyond this (m, and entries of a rotation) the camera was moved."""


@dataclass(frozen=True)
class Place:
    """The key of a background model: one camera, in one profile, at one pose."""

    camera: CameraInfo
    T_world_camera: Transform

    def label(self) -> dict[str, Any]:
        """Return the key as plain numbers and text."""
        return {
            "serial": self.camera.serial,
            "intrinsics": self.camera.intrinsics.model_dump(mode="json"),
            "T_world_camera": self.T_world_camera.tolist(),
        }

    def fits(self, label: Any) -> bool:
        """Return True if a label was made for this place."""
        mine = self.label()
        try:
            pose = np.asarray(label["T_world_camera"], dtype=np.float64)
            return (
                label["serial"] == mine["serial"]
                and label["intrinsics"] == mine["intrinsics"]
                and bool(np.allclose(pose, self.T_world_camera, rtol=0.0, atol=SAME_POSE))
            )
        except (KeyError, TypeError, ValueError):
            return False


class BackgroundStore:
    """One folder with one background model: images as npz, and a label with their place and digest."""

    def __init__(self, folder: Path) -> None:
        self._images = folder / "background.npz"
        self._label = StateFile(folder / "background.json")

    def load(self, place: Place) -> BackgroundModel | None:
        """Return the background model of this place; None if there is none, or it is damaged or of another place."""
        label = self._label.load(dict)
        if label is None:
            return None
        if not place.fits(label):
            logger.info("the background in %s belongs to another camera, profile or pose: not used", self._images)
            return None
        try:
            if _sha256(self._images) != label.get("sha256"):
                logger.warning("the background in %s is damaged: not used, learn it anew", self._images)
                return None
            return BackgroundModel.load(self._images)
        except (OSError, InputError) as error:
            logger.warning("the background cannot be used: %s", error)
            return None

    def save(self, place: Place, reference: BackgroundModel) -> None:
        """Store a background model; the label, written last, holds the images' digest: half a write is void."""
        try:
            self._images.parent.mkdir(parents=True, exist_ok=True)
            reference.save(self._images)
            label = {**place.label(), "sha256": _sha256(self._images), "frames": reference.frames}
        except OSError as error:
            logger.warning("the background cannot be kept in %s: %s", self._images.parent, error)
        else:
            self._label.save(label)

    def drop(self) -> None:
        """Remove it from disk.

        Raises:
            OSError: it cannot be removed.
        """
        self._label.drop()
        self._images.unlink(missing_ok=True)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
