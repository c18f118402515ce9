# SPDX-License-Identifier: Apache-2.0
"""The delay monitor: warns while a unit runs if the joints' delay differs from `joint_delay_s`.

From time to time a few thousand depths of a frame are kept until joints from well after the frame are known. Then they
are compared with the robot, in a background thread. The unit changes nothing itself: it tells the operator the value.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from edge_unit.joints.delay_estimation import DELAYS_S, MOTION_SPAN_S, DelayComparison, DelayEstimate, estimate_delay
from edge_unit.joints.history import EXTRAPOLATION_MAX_S, JointHistory
from edge_unit.pipeline import DepthPipeline
from shared.clock import NS_PER_S
from shared.errors import InputError

PERIOD_NS = NS_PER_S // 2
"""Time between two comparisons; each takes a core for the time of a few frames."""

LOOKS_MAX = 96
"""Three quarters of a minute of motion."""

OFF_S = 0.015
OFF_SIGMAS = 4.0
"""A delay that is off by more than both is worth a warning: at 1 m/s it takes 15 of the 20 mm that the padding leaves
for all but the camera's halo."""

_DELAYS_NS = np.rint(DELAYS_S * NS_PER_S).astype(np.int64)
_HALF_SPAN_NS = round(0.5 * MOTION_SPAN_S * NS_PER_S)


class _Comparisons:
    """Comparisons of frames with the same static surfaces: the data of the thread, and nothing else."""

    def __init__(self, comparison: DelayComparison) -> None:
        self.comparison = comparison
        self.estimate: DelayEstimate | None = None
        self._misfits: deque[NDArray[np.float64]] = deque(maxlen=LOOKS_MAX)

    def add(self, thinned_m: NDArray[np.float32], joints: list[NDArray[np.float64]]) -> None:
        """Compare a frame; joints (n,) at each of the delays."""
        self._misfits.append(self.comparison.misfits(thinned_m, joints))
        try:
            self.estimate = estimate_delay(self._misfits)
        except InputError:
            # Too few frames yet, or the camera does not see the robot: then there is no estimate.
            self.estimate = None


class DelayMonitor:
    """Collects comparisons of one camera's frames. Times are by the master's clock.

    Use it from one thread, except for the callables that `next_comparison` returns: they may run in another thread.
    """

    def __init__(self) -> None:
        self._made_for: tuple[object, ...] = ()
        self._comparisons: _Comparisons | None = None
        self._kept: tuple[int, NDArray[np.float32]] | None = None
        self._due_ns = 0
        self._is_comparing = False

    def due(self, at_ns: int) -> bool:
        """Return True if the frame captured at `at_ns` should be kept; also after a clock that went back."""
        return not self._due_ns - 2 * PERIOD_NS <= at_ns < self._due_ns

    def keep(self, pipeline: DepthPipeline, depth: NDArray[np.uint16], at_ns: int) -> None:
        """Keep a copy of a frame (H, W) that is due; after a change of the static surfaces or the robot, start anew."""
        robot = pipeline.cell.robot
        if robot is None:
            return
        made_for = pipeline, robot, pipeline.static_version
        if self._comparisons is None or made_for != self._made_for:
            self._comparisons = _Comparisons(
                DelayComparison(
                    pipeline.intrinsics,
                    pipeline.T_world_camera,
                    robot,
                    pipeline.expected_depth(None),
                    pipeline.settings,
                )
            )
            self._made_for = made_for
        self._kept = at_ns, self._comparisons.comparison.thinned(depth)
        self._due_ns = at_ns + PERIOD_NS

    def next_comparison(self, history: JointHistory) -> Callable[[], None] | None:
        """Return the comparison of the kept frame, to be called once; it touches neither the pipeline nor `history`.

        None while joints from after the frame are not known, no frame is kept, the robot did not move, or the previous
        comparison is still running.
        """
        kept, comparisons = self._kept, self._comparisons
        if (
            kept is None
            or comparisons is None
            or self._is_comparing
            or history.newest_ns < kept[0] + int(_DELAYS_NS[-1])
        ):
            return None
        self._kept = None
        found = [
            history.at(kept[0] + int(offset_ns), 0, EXTRAPOLATION_MAX_S)
            for offset_ns in (-_HALF_SPAN_NS, _HALF_SPAN_NS, *_DELAYS_NS)
        ]
        positions = [each.positions for each in found if each is not None]
        if len(positions) < len(found) or not comparisons.comparison.moves(*positions[:2]):
            return None
        self._is_comparing = True
        return partial(self._compare, comparisons, kept[1], positions[2:])

    def _compare(
        self, comparisons: _Comparisons, thinned_m: NDArray[np.float32], joints: list[NDArray[np.float64]]
    ) -> None:
        try:
            comparisons.add(thinned_m, joints)
        finally:
            self._is_comparing = False

    def warning(self, joint_delay_s: float) -> str | None:
        """Return the value to set instead of `joint_delay_s` if that is clearly wrong, else None."""
        found = None if self._comparisons is None else self._comparisons.estimate
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
