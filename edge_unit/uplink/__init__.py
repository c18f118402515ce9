# SPDX-License-Identifier: Apache-2.0
"""The unit's connection to its master: discovery, registration and reports.

The package re-exports nothing, because a program that only sends requests to a master needs no pipeline. In the order
of the flow:

    master_selection  the choice of the unit's master among the announced ones
    master_discovery  the search for the master while it does not answer
    client            one method for each request to the master
    cell_cache        the master's cell, kept on disk
    assignment        the master's assignment and the unit's reports, as values
    outbox            the report that is sent next: latest-only
    command_ledger    the master's commands and their outcomes
    session           the state between two registrations
    uplink            the exchange with the master, latest-only
"""
