# SPDX-License-Identifier: Apache-2.0
"""The operator's window: the cell in a browser, at the master's own port under `/viewer/`.

It is drawn by viser in a process of its own, which the master starts when someone looks and which ends when nobody
does any more; that process listens on loopback only, has none of the master's tokens, and is reached through the
master alone. In the order of the flow:

    sessions   who may look, and who may change something: links that work once, and cookies
    messages   what the master and that process say to each other
    channel    the same as bytes
    snapshot   what one look at the master tells
    host       that process, started and served by the master
    proxy      the page and its socket as HTTP
    scene      the cell, drawn
    panel      the table, plots and controls beside it
    window     the process itself
"""
