# SPDX-License-Identifier: Apache-2.0
"""The unit's side of the exchange with the master.

A program that only calls a master needs no pipeline, so this page re-exports nothing. In the order of the flow:

    master_selection  the choice among the masters that were discovered
    master_discovery  the search for a master that does not answer
    client            the calls of a unit to the master
    cell_cache        the master's cell, kept on disk
    assignment        the master's assignment and the unit's reports, as values
    outbox            the report that is sent next: latest-only
    command_ledger    the master's commands, and what became of them
    session           what holds from one registration to the next
    uplink            the exchange with the master, latest-only
"""
