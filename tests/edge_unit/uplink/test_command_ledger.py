# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading

from edge_unit.uplink.command_ledger import CommandLedger
from shared.messages import DONE, MAX_COMMANDS, Command, Outcome


def commands(*ids: int) -> list[Command]:
    return [Command(id=each, verb="learn_background") for each in ids]


async def test_each_command_is_queued_once_up_to_the_limit() -> None:
    ledger = CommandLedger()
    ledger.accept(commands(1, 2))
    ledger.accept(commands(2, 3))
    assert [ledger.waiting.get_nowait().id for _ in range(3)] == [1, 2, 3]
    ledger.accept(commands(*range(1, MAX_COMMANDS + 9)))
    assert ledger.waiting.qsize() == MAX_COMMANDS


async def test_an_outcome_is_reported_until_the_master_has_it() -> None:
    ledger = CommandLedger()
    one, two = commands(1, 2)
    ledger.accept([one, two])
    ledger.finish(one)
    reported = ledger.ended()
    assert [(each.id, each.code) for each in reported] == [(1, DONE.code)]
    assert ledger.ended() == reported
    ledger.finish(two, Outcome("failed", "no board in view"))
    ledger.forget(reported)
    assert [(each.id, each.code) for each in ledger.ended()] == [(2, "failed")]


async def test_the_outcome_of_an_unknown_command_is_not_reported() -> None:
    ledger = CommandLedger()
    (one,) = commands(1)
    ledger.finish(one)
    assert ledger.ended() == ()
    ledger.accept([one])
    ledger.finish(one)
    ledger.clear()
    assert ledger.ended() == ()
    assert ledger.waiting.empty()


async def test_commands_are_finished_from_any_thread() -> None:
    ledger = CommandLedger()
    accepted = commands(*range(1, MAX_COMMANDS + 1))
    ledger.accept(accepted)
    ready = threading.Barrier(len(accepted))

    def finish(command: Command) -> None:
        ready.wait(10.0)
        ledger.finish(command)

    threads = [threading.Thread(target=finish, args=(command,)) for command in accepted]
    for thread in threads:
        thread.start()
    found: set[int] = set()
    while any(thread.is_alive() for thread in threads):
        reported = ledger.ended()
        found |= {each.id for each in reported}
        ledger.forget(reported)
    for thread in threads:
        thread.join()
    found |= {each.id for each in ledger.ended()}
    assert found == {command.id for command in accepted}
