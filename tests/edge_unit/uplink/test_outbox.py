# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import asyncio

import numpy as np
import pytest

from edge_unit.uplink import outbox as module
from edge_unit.uplink.assignment import Assignment, Delivery, Report
from edge_unit.uplink.outbox import HEARTBEAT_S, Outbox
from shared.cell import Cell
from shared.messages import Versions
from shared.settings import Settings
from tests.set_clock import START_NS, S, SetClock

CELL = Cell("cell", np.zeros(3), np.ones(3))
ASSIGNMENT = Assignment(1, Versions(), Settings(), CELL.lattice(0.05), CELL, None)
DELIVERY = Delivery(1, 2, 3)


class Sent:
    def __init__(self) -> None:
        self.reports: list[tuple[Report, Delivery | None]] = []
        self.clock = SetClock()
        self.outbox = Outbox(lambda report, delivery: self.reports.append((report, delivery)), self.clock)


def report() -> Report:
    return Report(ASSIGNMENT)


async def test_a_newer_report_replaces_an_unsent_one_and_both_are_notified() -> None:
    sent, old, new = Sent(), report(), report()
    sent.outbox.offer(old)
    sent.outbox.offer(new)
    assert sent.reports == [(old, None)]
    assert sent.outbox.take() is new
    assert sent.outbox.empty
    sent.outbox.sent(new, DELIVERY)
    assert sent.reports == [(old, None), (new, DELIVERY)]


async def test_a_report_that_failed_is_sent_again_unless_there_is_a_newer_one() -> None:
    sent, old, new = Sent(), report(), report()
    sent.outbox.put_back(old)
    assert sent.outbox.take() is old
    sent.outbox.offer(new)
    sent.outbox.put_back(old)
    assert sent.reports == [(old, None)]
    assert sent.outbox.take() is new
    sent.outbox.put_back(None)
    assert sent.outbox.empty


async def test_it_is_drained_after_the_last_report_and_not_while_one_replaces_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    warned: list[str] = []
    monkeypatch.setattr(module.logger, "warning", warned.append)
    sent = Sent()
    await sent.outbox.drained(5.0)
    sent.outbox.offer(report())
    waiting = asyncio.ensure_future(sent.outbox.drained(5.0))
    await asyncio.sleep(0)
    sent.outbox.offer(report())
    sent.outbox.settle()
    await asyncio.sleep(0)
    assert not waiting.done()
    sent.outbox.take()
    sent.outbox.settle()
    await waiting
    assert warned == []
    sent.outbox.offer(report())
    waiting = asyncio.ensure_future(sent.outbox.drained(5.0))
    await sent.clock.waited_for()
    assert sent.clock.step() == START_NS + 5 * S
    await waiting
    assert warned == ["the last frame did not reach the master"]
    sent.outbox.drop()
    await sent.outbox.drained(5.0)
    assert len(warned) == 1


async def test_it_wakes_for_a_report_and_for_the_heartbeat() -> None:
    sent = Sent()
    waiting = asyncio.ensure_future(sent.outbox.woken())
    await sent.clock.waited_for()
    assert sent.clock.step() == START_NS + round(HEARTBEAT_S * S)
    await waiting
    waiting = asyncio.ensure_future(sent.outbox.woken(heartbeat=False))
    await asyncio.sleep(0)
    assert sent.clock.due_ns() is None
    assert not waiting.done()
    sent.outbox.offer(report())
    await waiting
    # A report before the heartbeat cancels the wait for the heartbeat.
    waiting = asyncio.ensure_future(sent.outbox.woken())
    await sent.clock.waited_for()
    sent.outbox.offer(report())
    await waiting
    assert sent.clock.due_ns() is None
