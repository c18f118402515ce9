# SPDX-License-Identifier: Apache-2.0
"""The only place that reads the time; everything else is handed a number of nanoseconds."""

from __future__ import annotations

import time

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000


def monotonic_ns() -> int:
    """CLOCK_MONOTONIC in nanoseconds: never jumps, the same for all processes of one machine."""
    return time.monotonic_ns()


def wall_ns() -> int:
    """Nanoseconds since 1970 (UTC) for people and recordings; it may jump, so no age is ever taken from it."""
    return time.time_ns()


def stage_ns() -> int:
    """The finest counter there is, for timing the stages of a frame; its zero means nothing."""
    return time.perf_counter_ns()
