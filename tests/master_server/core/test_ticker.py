# SPDX-License-Identifier: Apache-2.0
"""Changes by time alone: the clock notices them, reads do not."""

from __future__ import annotations

import logging

import annotated_types
import pytest

from master_server.core import Ticker
from master_server.core.ticker import TICK_NS
from master_server.core.units import COMMAND_EXPIRES_S
from shared.clock import NS_PER_S
from shared.settings import Settings
from tests.master_server.fakes import MS, START_NS, S, joined, master, sees_all
from tests.set_clock import SetClock


def states(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if getattr(record, "event", "") == "state"]


def test_a_tick_comes_well_within_the_shortest_age_that_is_trusted() -> None:
    (shortest,) = (
        one.ge for one in Settings.model_fields["stale_after_s"].metadata if isinstance(one, annotated_types.Ge)
    )
    assert isinstance(shortest, float)
    assert shortest * NS_PER_S >= 2 * TICK_NS


def test_states_are_logged_in_time_without_requests(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    clock, one = SetClock(), master(stale_after_s=0.05)
    joined(one).update(START_NS, seen=sees_all(one), age_ns=MS)
    ticker = Ticker(one, clock)
    ticker.start()
    clock.go_to(START_NS + 49 * MS)
    assert [line.split(": ", 1)[1] for line in states(caplog)] == ["live"]
    clock.go_to(START_NS + 49 * MS + TICK_NS)
    _, stale = states(caplog)
    assert stale.startswith("unit 1 (10.0.0.1): live → stale: its last")
    clock.go_to(START_NS + S)
    assert len(states(caplog)) == 2
    ticker.stop()
    assert clock.due_ns() is None


def test_a_command_that_is_not_answered_ends_by_itself(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    clock, one = SetClock(), master()
    unit = joined(one)
    one.send_command(unit.initialized.id, "calibrate", START_NS)
    clock.now = START_NS + round(COMMAND_EXPIRES_S * S) - MS
    Ticker(one, clock).start()
    assert one.registry.get(unit.initialized.id).commands
    clock.step()
    assert not one.registry.get(unit.initialized.id).commands
    assert any("calibrate: the unit did not answer within 600 s" in record.getMessage() for record in caplog.records)


def test_a_fault_costs_one_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, one = SetClock(), master()
    ticked: list[int] = []
    Ticker(one, clock).start()

    def faulty(now_ns: int) -> None:
        ticked.append(now_ns)
        raise RuntimeError("once")

    monkeypatch.setattr(one, "tick", faulty)
    with pytest.raises(RuntimeError, match="once"):
        clock.step()
    monkeypatch.setattr(one, "tick", ticked.append)
    clock.step()
    assert ticked == [START_NS + TICK_NS, START_NS + 2 * TICK_NS]
