# SPDX-License-Identifier: Apache-2.0
"""The profile that runs if the configured one is not offered."""

from __future__ import annotations

import pytest

from edge_unit.sources.realsense.profiles import Profile, choose

USB_3 = [
    *(Profile(1280, 720, fps) for fps in (6, 15, 30)),
    *(Profile(width, height, fps) for width, height in ((848, 480), (640, 480), (480, 270)) for fps in (6, 15, 30, 60)),
]
USB_2 = [  # of a D435 at a USB 2 port
    Profile(1280, 720, 6),
    *(Profile(640, 480, fps) for fps in (6, 15, 30)),
    *(Profile(480, 270, fps) for fps in (6, 15, 30, 60)),
]


@pytest.mark.parametrize(
    ("wanted", "offered", "chosen"),
    [
        (Profile(848, 480, 15), USB_3, Profile(848, 480, 15)),
        (Profile(848, 480, 15), USB_2, Profile(640, 480, 15)),
        (Profile(1280, 720, 30), USB_2, Profile(640, 480, 30)),
        (Profile(1280, 720, 6), USB_2, Profile(1280, 720, 6)),
        (Profile(424, 240, 15), USB_2, Profile(480, 270, 15)),  # nothing so small there: the nearest in rate
        (Profile(480, 270, 90), USB_2, Profile(480, 270, 60)),
        (Profile(848, 480, 15), [Profile(848, 480, 10), Profile(640, 480, 10)], Profile(848, 480, 10)),
        (Profile(848, 480, 20), USB_3, Profile(848, 480, 30)),
        (Profile(848, 480, 15), [], None),
    ],
)
def test_rate_counts_for_more_than_pixels(wanted: Profile, offered: list[Profile], chosen: Profile | None) -> None:
    assert choose(wanted, offered) == chosen
    assert choose(wanted, reversed(offered)) == chosen
