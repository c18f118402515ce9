# SPDX-License-Identifier: Apache-2.0
"""Detection of links that moved since they were drawn, and therefore must be drawn again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.kernels.jit import kernel

STILL, MOVED, KEPT_CHANGES = 0, 1, 2
"""Results of `settle`: no link moved; some links moved; the set of still links changed."""


class Stillness(NamedTuple):
    """Thresholds: a link that moved by at most `still_m` is still, and is kept after `kept_after` still drawings."""

    still_m: float
    kept_after: int


class Drawn(NamedTuple):
    """State of L drawn links.

    `poses` (L, 4, 4) and `padding_m` (L,) at which they were drawn, `still_for` (L,) the number of drawings since each
    moved, `is_kept` (L,) and `is_drawn` (L,) the links kept, and drawn now.
    """

    poses: NDArray[np.float64]
    padding_m: NDArray[np.float32]
    still_for: NDArray[np.int64]
    is_kept: NDArray[np.bool_]
    is_drawn: NDArray[np.bool_]


@kernel
def settle(
    poses: NDArray[np.float64],
    padding_m: NDArray[np.float32],
    reach_m: NDArray[np.float64],
    stillness: Stillness,
    anew: bool,
    drawn: Drawn,
) -> int:
    """Compare the `poses` (L, 4, 4) and the padding (L,) of links with those at which they were drawn.

    A link moved if a vertex at `reach_m` (L,) from its origin may have moved by more than `still_m`. If none moved,
    nothing changes, unless all must be drawn `anew`. Otherwise `still_for` (L,) counts the drawings since each moved.
    When a kept link moves, or another has been still for `kept_after` drawings, the kept links are chosen again.
    Out: `is_kept`; `is_drawn` for the others (L,); pose and padding of the links that are drawn now.
    """
    still_m, kept_after = Stillness(*stillness)
    drawn_poses, drawn_padding_m, still_for, is_kept, is_drawn = Drawn(*drawn)
    still_before = True
    for m in range(len(poses)):
        moved_m = abs(np.float64(padding_m[m]) - np.float64(drawn_padding_m[m]))
        for i in range(3):
            moved_m += abs(poses[m, i, 3] - drawn_poses[m, i, 3])
            for j in range(3):
                moved_m += abs(poses[m, i, j] - drawn_poses[m, i, j]) * reach_m[m]
        # NaN: never drawn.
        is_drawn[m] = not moved_m <= still_m
        still_before = still_before and not is_drawn[m]
    if still_before and not anew:
        return STILL
    found = MOVED
    for m in range(len(poses)):
        still_for[m] = 0 if is_drawn[m] else still_for[m] + 1
        if (is_kept[m] and is_drawn[m]) or (not is_kept[m] and still_for[m] >= kept_after):
            found = KEPT_CHANGES
    for m in range(len(poses)):
        if found == KEPT_CHANGES:
            is_kept[m] = still_for[m] >= kept_after
        is_drawn[m] = not is_kept[m]
        if is_drawn[m] or found == KEPT_CHANGES:
            drawn_poses[m] = poses[m]
            drawn_padding_m[m] = padding_m[m]
    return found
