# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import random

import pytest

from shared.timebase import DRIFT_PPM_MAX, RESOLUTION_NS, ClockOffset, Exchange

MS = 1_000_000
S = 1_000_000_000


def exchange(at_ns: int, offset_ns: int, there_ns: int, back_ns: int, between_ns: int = 0) -> Exchange:
    """Return an exchange that the unit starts at `at_ns`."""
    received_ns = at_ns + there_ns + offset_ns
    return Exchange(at_ns, received_ns, received_ns + between_ns, at_ns + there_ns + between_ns + back_ns)


def test_equal_delays_give_the_exact_offset() -> None:
    one = exchange(5 * S, 1234 * S, 3 * MS, 3 * MS, between_ns=MS)
    assert one.offset_ns == 1234 * S
    assert one.uncertainty_ns == 3 * MS + RESOLUTION_NS


def test_the_true_offset_lies_within_the_uncertainty_for_any_delays() -> None:
    rng = random.Random(1)
    for _ in range(1000):
        offset_ns = rng.randrange(-(10**15), 10**15)
        one = exchange(
            rng.randrange(10**15), offset_ns, rng.randrange(300 * MS), rng.randrange(300 * MS), rng.randrange(MS)
        )
        assert abs(one.offset_ns - offset_ns) <= one.uncertainty_ns


def test_the_shortest_trip_wins() -> None:
    clock = ClockOffset()
    rng = random.Random(2)
    for step in range(500):
        there_ns = 100_000 if step == 100 else rng.randrange(2 * MS, 200 * MS)
        clock.add(exchange(step * 66 * MS, 7 * S, there_ns, 100_000 if step == 100 else 2 * MS))
    assert abs(clock.offset_ns - 7 * S) <= 1000
    assert clock.jumps == 0


def test_the_estimate_follows_a_drifting_clock() -> None:
    clock = ClockOffset()
    drift_ppm = 60
    for step in range(20_000):
        at_ns = step * 66 * MS
        offset_ns = 7 * S + at_ns * drift_ppm // 1_000_000
        clock.add(exchange(at_ns, offset_ns, 500_000, 400_000))
        assert abs(clock.offset_ns - offset_ns) <= clock.uncertainty_ns(at_ns)
        assert clock.uncertainty_ns(at_ns) < 2 * MS
    assert clock.jumps == 0


def test_uncertainty_grows_without_exchanges() -> None:
    clock = ClockOffset()
    clock.add(exchange(0, 0, MS, MS))
    assert clock.uncertainty_ns(100 * S) == pytest.approx(MS + 100 * S * DRIFT_PPM_MAX / 1e6, rel=0.01)


@pytest.mark.parametrize("jump_ns", [3600 * S, -3600 * S, 50 * MS])
def test_a_jump_is_detected_at_once(jump_ns: int) -> None:
    clock = ClockOffset()
    for step in range(100):
        clock.add(exchange(step * 66 * MS, 0, MS, MS))
    clock.add(exchange(10 * S, jump_ns, 5 * MS, 5 * MS))
    assert clock.offset_ns == jump_ns
    assert clock.jumps == 1


def test_an_impossible_exchange_is_ignored() -> None:
    clock = ClockOffset()
    clock.add(Exchange(10, 0, 0, 5))
    clock.add(Exchange(0, 10, 5, 20))
    assert not clock.known
    with pytest.raises(LookupError):
        _ = clock.offset_ns
    with pytest.raises(LookupError):
        clock.uncertainty_ns(0)
