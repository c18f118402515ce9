# SPDX-License-Identifier: Apache-2.0
"""The master: all units post to it, and readers get from it where the obstacle voxels are.

It compiles nothing: it imports neither units nor `geometry`. In the order of the flow:

    logs          log lines: text or JSON, without secrets, bounded
    security/     tokens, access control, rate limits
    cells/        the watched cell: publication, unpacking, loading
    persistence/  the state that outlives the master
    core/         joints, coverage, merged map, units: the master without a network
    recording/    the state over time, written and played back
    config        the master's own configuration
    api/          the HTTP API
    viewer/       the 3-D view in a browser, for operators
    app           the web application, assembled
    server/       bounds on connections: number, time, size; TLS
    __main__      the command line
"""
