# SPDX-License-Identifier: Apache-2.0
"""The viewer for operators: the cell in a browser, at the master's own port under `/viewer/`.

viser draws it in its own process. The master starts that process for the first browser, and it ends some time after the
last one has left. It listens on loopback only, has none of the master's tokens, and is reached only through the
master. In the order of the flow:

    sessions   access to the viewer: links that work once, and cookies
    messages   the messages between the master and that process
    channel    sends them over a socket pair
    snapshot   the master's state for one refresh of the viewer
    host       that process, started and served by the master
    proxy      the page and its WebSocket as HTTP
    scene      draws the cell
    panel      the table, plots and controls beside it
    window     the process itself
"""
