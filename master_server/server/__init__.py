# SPDX-License-Identifier: Apache-2.0
"""Sockets held within bounds, in front of the application.

The command line alone uses them, so this page re-exports nothing. In the order of the flow:

    latest_only_websocket  a socket that keeps only the latest for who does not read
    connection_guard       sockets held within bounds: how many, how slow, TLS
"""
