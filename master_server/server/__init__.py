# SPDX-License-Identifier: Apache-2.0
"""Bounded sockets in front of the application.

Only the command line uses them, so this page re-exports nothing. In the order of the flow:

    latest_only_websocket  a socket that keeps only the latest message for a slow reader
    connection_guard       bounds connections in number, time and size; TLS
"""
