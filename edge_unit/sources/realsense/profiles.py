# SPDX-License-Identifier: Apache-2.0
"""Which of the pictures that a camera offers comes nearest to the one that was asked for."""

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
        """How many a picture has."""
        return self.width * self.height

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at {self.fps} fps"


def choose(wanted: Profile, offered: Iterable[Profile]) -> Profile | None:
    """`wanted` where it is offered; else the largest picture no larger than it that comes at least as often.

    Where nothing comes so often (an old port, many cameras on a hub), the most frequent one, and of these the largest.
    None when nothing at all is offered. A rate counts for more than pixels: what moves is seen late otherwise.
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
