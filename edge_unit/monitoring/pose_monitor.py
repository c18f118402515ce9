# SPDX-License-Identifier: Apache-2.0
"""Does the camera still stand where it stood when its pose was found, and does it still see?

Cameras differ from their own model (a percent of depth, a calibration that is a little off), so a frame is not held
against the model alone but against how the same camera fitted it before. That is kept on disk: a camera that was
knocked while its unit was off is told, too. A person before the camera hides surfaces, but never makes one seem
farther away, and hides as much from one place as from the next.
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
"""Between two looks: with `WINDOW` of them a knock is told within a second and a half."""

WINDOW = 8
"""Looks that are averaged: a knock of a limit's size and more is told within 1.6 s."""

BASELINE_LOOKS = 20
"""Looks until the usual fit is known well enough: four seconds."""

BASELINE_LOOKS_MAX = 320
"""Looks over which it is averaged in the end: a minute, in which people come and go."""

TURN_LIMIT_RAD = np.radians(0.2)
SHIFT_LIMIT_M = 0.005
LIMITS = np.array([TURN_LIMIT_RAD] * 3 + [SHIFT_LIMIT_M] * 3)
"""On one axis. A knock by 1 degree or 20 mm, whatever its direction, is at least 0.58 degrees or 11.5 mm on one."""

RETURNED = 0.7
"""Of a limit: a camera that came back this close is where it was."""

SLOPE_NOISE = 2e-3
"""People who walk about change a slope by up to 1.3e-3: where what is seen hardly changes along an axis, before a bare
plane, say, limits are wider."""

CURVATURE_MIN = 5e-4
"""With less, nothing can be told about an axis."""

OFF_RAD = np.radians(0.6)
OFF_M = 0.02
OFF = np.array([OFF_RAD] * 3 + [OFF_M] * 3)
"""A pose that seems wrong by more from the beginning is worth a warning: margins are spent on it."""

BEYOND_LIMIT = 0.01
"""More of the picture than usual that is farther away than it can be. Noise and edges: a tenth of that."""

STATIC_SHARE_MIN = 0.05
"""With fewer pixels before known surfaces there is nothing to tell by."""

CURVATURE_PART_MIN = 0.25
"""Of what used to tell an axis: with less, hardly anything known is in view any more. Someone who stands before the
camera leaves more than half."""

VALID_PART_MIN = 0.4
"""Of the share of pixels that is usually measured: with less, the lens is covered or dazzled."""

FILE_NAME = "stance.json"


@dataclass(frozen=True)
class Verdict:
    """Why the camera's view is not to be trusted, or what is worse than it need be; empty when there is nothing."""

    moved: str = ""
    blind: str = ""
    warning: str = ""

    @property
    def reason(self) -> str:
        """Whichever there is."""
        return self.blind or self.moved


@dataclass(frozen=True, eq=False)
class _Fit:
    """The mean of several looks."""

    looks: int
    slope: NDArray[np.float64]
    curvature: NDArray[np.float64]
    valid_share: float
    beyond_share: float

    @classmethod
    def of(cls, looks: Iterable[Misfit]) -> _Fit:
        fit = _NOTHING
        for look in looks:
            fit = fit.with_look(look)
        return fit

    def with_look(self, look: Misfit) -> _Fit:
        """The mean of one look more."""
        share = 1.0 / (self.looks + 1)
        return _Fit(
            self.looks + 1,
            self.slope + share * (look.slope - self.slope),
            self.curvature + share * (look.curvature - self.curvature),
            self.valid_share + share * (look.valid_share - self.valid_share),
            self.beyond_share + share * (look.beyond_share - self.beyond_share),
        )


_NOTHING = _Fit(0, np.zeros(6), np.zeros(6), 0.0, 0.0)


class PoseMonitor:
    """Judges one camera by how its frames fit what is known, against how they used to."""

    def __init__(self, state_dir: Path) -> None:
        self._file = StateFile(state_dir / FILE_NAME)
        self._unsaved: dict[str, Any] | None = None
        self._place = ""
        self._layer = -1
        self._looks: deque[Misfit] = deque(maxlen=WINDOW)
        self._gathered = _NOTHING
        self._usual: _Fit | None = None
        self._due_ns = 0
        self._verdict = Verdict()

    def begin(self, place: str) -> None:
        """The camera has this place from now on: a digest of its serial, profile and pose, see `place_of`."""
        if place == self._place:
            return
        self._place, self._layer = place, -1
        self._looks.clear()
        self._gathered = _NOTHING
        self._usual = self._file.load(self._fit_of)
        self._verdict = Verdict()

    def due(self, captured_at_ns: int) -> bool:
        """Whether the frame of this time should be looked at."""
        return captured_at_ns >= self._due_ns or captured_at_ns < self._due_ns - round(PERIOD_S * NS_PER_S)

    def judge(self, misfit: Misfit, layer: int, captured_at_ns: int) -> Verdict:
        """Look at a frame; `layer` changes with each change of the static layer (an object was moved, say)."""
        self._due_ns = captured_at_ns + round(PERIOD_S * NS_PER_S)
        if layer != self._layer:
            # What the usual fit is must be found anew; until it is, the old one holds as far as it can.
            self._layer = layer
            self._looks.clear()
            self._gathered = _NOTHING
        self._looks.append(misfit)
        if len(self._looks) == WINDOW:
            self._verdict = self._judged(_Fit.of(self._looks), misfit.static_share >= STATIC_SHARE_MIN)
        if not self._verdict.reason:
            self._gather(misfit)
        else:
            self._gathered = _NOTHING
        return self._verdict

    def watch(self, misfit: Misfit | None, layer: int, captured_at_ns: int) -> Verdict:
        """Judge a frame, as `judge` does, where it was due; the log tells when the verdict changes."""
        if misfit is None:
            return self._verdict
        before, verdict = self._verdict, self.judge(misfit, layer, captured_at_ns)
        if bool(verdict.reason) != bool(before.reason):
            logger.warning("%s", verdict.reason or "the camera stands where it stood, and sees")
        return verdict

    @property
    def verdict(self) -> Verdict:
        """The last one."""
        return self._verdict

    @property
    def unsaved(self) -> bool:
        """Whether there is something to `save`."""
        return self._unsaved is not None

    def save(self) -> None:
        """Keep the usual fit for the next start; no frame should wait for it, for it takes as long as the disk does."""
        document, self._unsaved = self._unsaved, None
        if document is not None:
            self._file.save(document)

    def _gather(self, look: Misfit) -> None:
        """Learn the usual fit; it is to be kept whenever it rests on twice as many looks."""
        if self._gathered.looks == BASELINE_LOOKS_MAX:
            return
        self._gathered = fit = self._gathered.with_look(look)
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
                moved=f"what it sees fits no more: the camera seems {_words(offset, worst)} away from where it was"
            )
        part_in_view = fit.curvature.sum() / max(usual.curvature.sum(), CURVATURE_MIN)
        if part_in_view < CURVATURE_PART_MIN and usual.curvature.sum() > 6.0 * CURVATURE_MIN:
            return Verdict(
                blind="hardly anything that it should see is in view: it was turned away, "
                "or something stands right before it"
            )
        off, _ = _offset(usual, _NOTHING, usual.curvature)
        worst = int(np.argmax(np.abs(off) / OFF))
        if abs(off[worst]) > OFF[worst]:
            return Verdict(warning=f"the pose seems {_words(off, worst)} off: have it refined, or calibrate")
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
    """A digest of which camera stands where."""
    digest = hashlib.sha256(f"{serial} {profile}".encode())
    digest.update(np.round(T_world_camera, 6).astype("<f8").tobytes())
    return digest.hexdigest()


def _offset(fit: _Fit, usual: _Fit, curvature: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where on each axis (6,) the fit is best, seen from the usual, and how far is too far: rad, and m."""
    gain = np.zeros(6)
    np.divide(0.5 * STEPS, curvature, out=gain, where=curvature > CURVATURE_MIN)
    return -gain * (fit.slope - usual.slope), np.maximum(LIMITS, SLOPE_NOISE * gain)


def _words(offset: NDArray[np.float64], axis: int) -> str:
    distance = abs(float(offset[axis]))
    return f"{np.degrees(distance):.1f} degrees" if axis < 3 else f"{1000.0 * distance:.0f} mm"
