# SPDX-License-Identifier: Apache-2.0
"""The pose monitor: detects a camera that was moved since its pose was found, or that is covered.

Real cameras differ from their own model (a percent of depth, a calibration that is a little off). So a frame is not
compared with the model alone, but with the usual fit of the same camera. The usual fit is kept on disk: a camera that
was knocked while its unit was off is reported, too. A person before the camera hides surfaces, but never makes one seem
farther away, and hides the same share from neighbouring poses.
"""

from __future__ import annotations

import hashlib
import logging
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_unit.pipeline import Misfit
from edge_unit.pipeline.pose_misfit import STEPS
from shared.clock import NS_PER_S
from shared.files import StateFile

logger = logging.getLogger(__name__)

PERIOD_S = 0.2
"""Time between two checks: `WINDOW` of them detect a knock within a second and a half."""

WINDOW = 8
"""Checks that are averaged: a knock of a limit's size and more is detected within 1.6 s."""

BASELINE_LOOKS = 20
"""Checks until the usual fit is known well enough: four seconds."""

BASELINE_LOOKS_MAX = 320
"""Checks that the usual fit averages at most: a minute, in which people come and go."""

TURN_LIMIT_RAD = np.radians(0.2)
SHIFT_LIMIT_M = 0.005
LIMITS = np.array([TURN_LIMIT_RAD] * 3 + [SHIFT_LIMIT_M] * 3)
"""On one axis. A knock by 1 degree or 20 mm, whatever its direction, is at least 0.58 degrees or 11.5 mm on one."""

RETURNED = 0.7
"""Part of a limit: a camera that came back this close is at its old pose again."""

SLOPE_NOISE = 2e-3
"""People who walk about change a slope by up to 1.3e-3. If the image hardly changes along an axis (before a bare plane,
for example), limits are wider."""

CURVATURE_MIN = 5e-4
"""With less, an axis cannot be judged."""

OFF_RAD = np.radians(0.6)
OFF_M = 0.02
OFF = np.array([OFF_RAD] * 3 + [OFF_M] * 3)
"""A pose that is off by more from the start is worth a warning: it uses up the margins."""

BEYOND_LIMIT = 0.01
"""Share of pixels, above the usual one, that are farther away than possible. Noise and edges: a tenth of that."""

STATIC_SHARE_MIN = 0.05
"""With a smaller share of pixels on known surfaces, the pose cannot be judged."""

CURVATURE_PART_MIN = 0.25
"""Part of an axis's usual curvature: with less, hardly any known surface is in view. A person who stands before the
camera leaves more than half."""

VALID_PART_MIN = 0.4
"""Part of the usual share of measured pixels: with less, the lens is covered or dazzled."""

FILE_NAME = "pose_monitor.json"
OLD_FILE_NAME = "stance.json"
"""The file's name in former versions; read if there is no file of the new name."""


@dataclass(frozen=True)
class Verdict:
    """Reasons to distrust the camera's view, and a warning about its pose; each is empty if there is none."""

    moved: str = ""
    blind: str = ""
    warning: str = ""

    @property
    def reason(self) -> str:
        """The reason to distrust the view, or an empty string."""
        return self.blind or self.moved


@dataclass(frozen=True, eq=False)
class _Fit:
    """The mean of several checks."""

    looks: int
    slope: NDArray[np.float64]
    curvature: NDArray[np.float64]
    valid_share: float
    beyond_share: float

    @classmethod
    def of(cls, checks: Iterable[Misfit]) -> _Fit:
        fit = _NOTHING
        for check in checks:
            fit = fit.with_check(check)
        return fit

    def with_check(self, check: Misfit) -> _Fit:
        """Return the mean with one more check."""
        share = 1.0 / (self.looks + 1)
        return _Fit(
            self.looks + 1,
            self.slope + share * (check.slope - self.slope),
            self.curvature + share * (check.curvature - self.curvature),
            self.valid_share + share * (check.valid_share - self.valid_share),
            self.beyond_share + share * (check.beyond_share - self.beyond_share),
        )


_NOTHING = _Fit(0, np.zeros(6), np.zeros(6), 0.0, 0.0)


class PoseMonitor:
    """Judges one camera: compares the fit of its frames to the known surfaces with their usual fit."""

    def __init__(self, state_dir: Path) -> None:
        self._file = StateFile(state_dir / FILE_NAME)
        self._old_file = StateFile(state_dir / OLD_FILE_NAME)
        self._is_old = not (state_dir / FILE_NAME).exists()
        self._unsaved: dict[str, Any] | None = None
        self._place = ""
        self._layer = -1
        self._checks: deque[Misfit] = deque(maxlen=WINDOW)
        self._gathered = _NOTHING
        self._usual: _Fit | None = None
        self._due_ns = 0
        self._verdict = Verdict()

    def begin(self, place: str) -> None:
        """Start to judge the camera at this place: a digest of its serial, profile and pose, see `place_of`."""
        if place == self._place:
            return
        self._place, self._layer = place, -1
        self._checks.clear()
        self._gathered = _NOTHING
        self._usual = (self._old_file if self._is_old else self._file).load(self._fit_of)
        self._verdict = Verdict()

    def due(self, captured_at_ns: int) -> bool:
        """Return True if the frame of this time should be checked."""
        return captured_at_ns >= self._due_ns or captured_at_ns < self._due_ns - round(PERIOD_S * NS_PER_S)

    def judge(self, misfit: Misfit, layer: int, captured_at_ns: int) -> Verdict:
        """Check a frame; `layer` changes with each change of the static layer (an object was moved, for example)."""
        self._due_ns = captured_at_ns + round(PERIOD_S * NS_PER_S)
        if layer != self._layer:
            # The usual fit must be found anew; until then the old one is used.
            self._layer = layer
            self._checks.clear()
            self._gathered = _NOTHING
        self._checks.append(misfit)
        if len(self._checks) == WINDOW:
            self._verdict = self._judged(_Fit.of(self._checks), misfit.static_share >= STATIC_SHARE_MIN)
        if not self._verdict.reason:
            self._gather(misfit)
        else:
            self._gathered = _NOTHING
        return self._verdict

    def watch(self, misfit: Misfit | None, layer: int, captured_at_ns: int) -> Verdict:
        """Judge a frame as `judge` does, if one was due; log each change of the verdict."""
        if misfit is None:
            return self._verdict
        before, verdict = self._verdict, self.judge(misfit, layer, captured_at_ns)
        if bool(verdict.reason) != bool(before.reason):
            logger.warning("%s", verdict.reason or "the camera is at its old pose again, and sees")
        return verdict

    @property
    def verdict(self) -> Verdict:
        """The last verdict."""
        return self._verdict

    @property
    def unsaved(self) -> bool:
        """True if there is something to `save`."""
        return self._unsaved is not None

    def save(self) -> None:
        """Store the usual fit for the next start; it takes as long as the disk does, so no frame should wait for it."""
        document, self._unsaved = self._unsaved, None
        if document is not None:
            self._file.save(document)
            self._is_old = False

    def _gather(self, check: Misfit) -> None:
        """Learn the usual fit; it is due to be stored whenever it rests on twice as many checks."""
        if self._gathered.looks == BASELINE_LOOKS_MAX:
            return
        self._gathered = fit = self._gathered.with_check(check)
        if fit.looks >= BASELINE_LOOKS:
            self._usual = fit
            if fit.looks % BASELINE_LOOKS == 0 and (fit.looks // BASELINE_LOOKS).bit_count() == 1:
                self._unsaved = self._document(fit)

    def _judged(self, fit: _Fit, is_known: bool) -> Verdict:
        usual = self._usual
        if usual is None:
            return Verdict()
        if fit.valid_share < VALID_PART_MIN * usual.valid_share:
            return Verdict(
                blind=f"only {fit.valid_share:.0%} of its pixels measure anything, {usual.valid_share:.0%} used to: "
                "the lens is covered or dazzled"
            )
        if not is_known:
            return Verdict()
        was_moved = bool(self._verdict.moved)
        part = RETURNED if was_moved else 1.0
        beyond_share = fit.beyond_share - usual.beyond_share
        if beyond_share > part * BEYOND_LIMIT:
            return Verdict(
                moved=f"{beyond_share:.1%} of what it sees is farther away than it can be: the camera was turned, "
                "or something known was taken away"
            )
        offset, limits = _offset(fit, usual, usual.curvature)
        worst = int(np.argmax(np.abs(offset) / limits))
        if abs(offset[worst]) > part * limits[worst]:
            return Verdict(
                moved=f"its image no longer fits: the camera seems {_words(offset, worst)} away from its old pose"
            )
        part_in_view = fit.curvature.sum() / max(usual.curvature.sum(), CURVATURE_MIN)
        if part_in_view < CURVATURE_PART_MIN and usual.curvature.sum() > 6.0 * CURVATURE_MIN:
            return Verdict(
                blind="hardly any known surface is in view: the camera was turned away, "
                "or something stands right before it"
            )
        off, _ = _offset(usual, _NOTHING, usual.curvature)
        worst = int(np.argmax(np.abs(off) / OFF))
        if abs(off[worst]) > OFF[worst]:
            return Verdict(warning=f"the pose seems {_words(off, worst)} off: refine it, or calibrate the camera")
        return Verdict()

    def _fit_of(self, document: Any) -> _Fit | None:
        if document["place"] != self._place:
            return None
        slope, curvature = (np.array(document[name], np.float64) for name in ("slope", "curvature"))
        if slope.shape != (6,) or curvature.shape != (6,):
            raise ValueError("expected six axes")
        looks, *shares = (float(document[name]) for name in ("looks", "valid_share", "beyond_share"))
        if not np.isfinite([*slope, *curvature, looks, *shares]).all():
            raise ValueError("expected finite numbers")
        return _Fit(int(looks), slope, curvature, *shares)

    def _document(self, fit: _Fit) -> dict[str, Any]:
        return {
            "place": self._place,
            "looks": fit.looks,
            "slope": fit.slope.tolist(),
            "curvature": fit.curvature.tolist(),
            "valid_share": fit.valid_share,
            "beyond_share": fit.beyond_share,
        }


def place_of(serial: str, profile: tuple[int, int], T_world_camera: NDArray[np.float64]) -> str:
    """Return a digest of a camera's serial, profile and pose."""
    digest = hashlib.sha256(f"{serial} {profile}".encode())
    digest.update(np.round(T_world_camera, 6).astype("<f8").tobytes())
    return digest.hexdigest()


def _offset(fit: _Fit, usual: _Fit, curvature: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the best fit's offset from the usual one on each axis (6,), and its limits: rad, and m."""
    gain = np.zeros(6)
    np.divide(0.5 * STEPS, curvature, out=gain, where=curvature > CURVATURE_MIN)
    return -gain * (fit.slope - usual.slope), np.maximum(LIMITS, SLOPE_NOISE * gain)


def _words(offset: NDArray[np.float64], axis: int) -> str:
    distance = abs(float(offset[axis]))
    return f"{np.degrees(distance):.1f} degrees" if axis < 3 else f"{1000.0 * distance:.0f} mm"
