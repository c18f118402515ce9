# SPDX-License-Identifier: Apache-2.0
"""The master, as a unit finds and asks it.

What only asks a master needs no pipeline, so this page re-exports nothing. In the order of the flow:

    master_selection  which of the masters that were heard of is ours
    master_discovery  looks for the master while it does not answer
    client            what a unit can ask the master
    cell_cache        the master's cell, kept on disk
    assignment        what the master wants of a unit, and what the unit reports, as values
    outbox            the report that is sent next: latest-only
    command_ledger    the master's commands, and what became of them
    session           what holds from one registration to the next
    uplink            the exchange with the master, latest-only
"""
