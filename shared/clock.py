# SPDX-License-Identifier: Apache-2.0
"""The only module that reads the clock; all other code takes times as arguments, in nanoseconds."""

from __future__ import annotations

import time

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000


def monotonic_ns() -> int:
    """Return CLOCK_MONOTONIC in nanoseconds. It never jumps and is the same for all processes of a machine."""
    return time.monotonic_ns()


def wall_ns() -> int:
    """Return nanoseconds since 1970 (UTC), for people and recordings. It may jump: never compute an age from it."""
    return time.time_ns()


def stage_ns() -> int:
    """Return the finest counter available, in nanoseconds, for timing the stages of a frame; its zero is arbitrary."""
    return time.perf_counter_ns()
