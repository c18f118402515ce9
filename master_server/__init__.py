# SPDX-License-Identifier: Apache-2.0
"""The master: every unit posts to it, and it tells anyone who asks where something unknown stands.

It compiles nothing: it imports neither units nor `geometry`. In the order of the flow:

    logs          lines of the log: text or JSON, without secrets, none without end
    security/     tokens, who may do what, how often
    cells/        the watched cell as it comes in and goes out
    persistence/  what outlives the master
    core/         joints, coverage, merged map, units: the master without a network
    recording/    what the master saw, written and played back
    config        the master's own configuration
    api/          the same as HTTP
    viewer/       the same in a browser, for operators
    app           the web application, assembled
    server/       sockets held within bounds: how many, how slow, TLS
    __main__      the command line
"""
