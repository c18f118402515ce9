# SPDX-License-Identifier: Apache-2.0
"""While a unit runs: are the joints later than `joint_delay_s` says?

Now and then a frame is kept, a few thousand of its depths, until joints from well after it are known; then it is
looked at. Nothing is changed by itself: the operator is told what to set.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from edge_unit.joints.delay_estimation import DELAYS_S, MOTION_SPAN_S, DelayEstimate, DelayLook, estimate_delay
from edge_unit.joints.history import EXTRAPOLATION_MAX_S, JointHistory
from edge_unit.pipeline import DepthPipeline
from shared.clock import NS_PER_S
from shared.errors import InputError

PERIOD_NS = NS_PER_S // 2
"""Between two looks, each of which costs the time of a few frames."""

LOOKS_MAX = 96
"""The last three quarters of a minute in which the robot moved."""

OFF_S = 0.015
OFF_SIGMAS = 4.0
"""Off by more than both is worth a warning: at 1 m/s it takes 15 of the 20 mm that the padding leaves for all but the
camera's halo."""

_DELAYS_NS = np.rint(DELAYS_S * NS_PER_S).astype(np.int64)
_HALF_SPAN_NS = round(0.5 * MOTION_SPAN_S * NS_PER_S)


class DelayWatch:
    """Gathers looks at one camera's frames. Times are by the master's clock."""

    def __init__(self) -> None:
        self._made_for: tuple[object, ...] = ()
        self._look: DelayLook | None = None
        self._kept: tuple[int, NDArray[np.float32]] | None = None
        self._due_ns = 0
        self._misfits: deque[NDArray[np.float64]] = deque(maxlen=LOOKS_MAX)
        self._estimate: DelayEstimate | None = None

    def due(self, at_ns: int) -> bool:
        """Whether the frame that was captured at `at_ns` should be kept; also after a clock that went back."""
        return not self._due_ns - 2 * PERIOD_NS <= at_ns < self._due_ns

    def keep(self, pipeline: DepthPipeline, depth: NDArray[np.uint16], at_ns: int) -> None:
        """Keep a frame (H, W) that is due; all is begun anew when what is known besides the joints changed."""
        robot = pipeline.cell.robot
        if robot is None:
            return
        made_for = pipeline, robot, pipeline.static_version
        if self._look is None or made_for != self._made_for:
            self._look = DelayLook(
                pipeline.intrinsics, pipeline.T_world_camera, robot, pipeline.expected_depth(None), pipeline.settings
            )
            self._made_for, self._estimate = made_for, None
            self._misfits.clear()
        self._kept = at_ns, self._look.thinned(depth)
        self._due_ns = at_ns + PERIOD_NS

    def joints(self, history: JointHistory) -> list[NDArray[np.float64]] | None:
        """The joints with which the kept frame is to be looked at; None while they are not known, or when none is."""
        if self._kept is None or self._look is None or history.newest_ns < self._kept[0] + int(_DELAYS_NS[-1]):
            return None
        at_ns = self._kept[0]
        found = [
            history.at(at_ns + int(offset_ns), 0, EXTRAPOLATION_MAX_S)
            for offset_ns in (-_HALF_SPAN_NS, _HALF_SPAN_NS, *_DELAYS_NS)
        ]
        positions = [each.positions for each in found if each is not None]
        if len(positions) < len(found) or not self._look.moves(*positions[:2]):
            self._kept = None
            return None
        return positions[2:]

    def look(self, joints: list[NDArray[np.float64]]) -> None:
        """Look at the kept frame with what `joints` gave."""
        assert self._kept is not None
        assert self._look is not None
        self._misfits.append(self._look.misfits(self._kept[1], joints))
        self._kept = None
        try:
            self._estimate = estimate_delay(self._misfits)
        except InputError:
            # Too few as yet, or the camera does not see the robot: then there is nothing to tell.
            self._estimate = None

    def warning(self, joint_delay_s: float) -> str | None:
        """What to set instead, where `joint_delay_s` is clearly off."""
        found = self._estimate
        if found is None:
            return None
        off_s = found.delay_s - joint_delay_s
        if abs(off_s) <= max(OFF_S, OFF_SIGMAS * found.uncertainty_s):
            return None
        words = "later" if off_s > 0.0 else "earlier"
        return (
            f"the robot's joints seem {1e3 * abs(off_s):.0f} ms {words} than joint_delay_s says: "
            f"set it to {found.delay_s:.3f} (it is {joint_delay_s:.3f})"
        )
