# SPDX-License-Identifier: Apache-2.0
"""Choice of the offered profile that is closest to the configured one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


class Profile(NamedTuple):
    """Columns, rows and frames a second."""

    width: int
    height: int
    fps: int

    @property
    def pixels(self) -> int:
        """Number of pixels of an image."""
        return self.width * self.height

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at {self.fps} fps"


def choose(wanted: Profile, offered: Iterable[Profile]) -> Profile | None:
    """Return `wanted` if it is offered; else the largest image no larger than it that comes at least as often.

    If no profile is as frequent (an old port, many cameras on a hub), it is the most frequent one, and of these the
    largest. None if nothing is offered. Rate counts for more than pixels: at a low rate, motion is seen late.
    """
    profiles = set(offered)
    if wanted in profiles:
        return wanted
    smallest = min((p.pixels for p in profiles), default=0)
    fitting = [p for p in profiles if p.pixels <= max(wanted.pixels, smallest)]
    often = [p for p in fitting if p.fps >= wanted.fps]
    if often:
        return max(often, key=lambda p: (p.pixels, -p.fps, p.width))
    return max(fitting, key=lambda p: (p.fps, p.pixels, p.width), default=None)
