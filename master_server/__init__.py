# SPDX-License-Identifier: Apache-2.0
"""The master: every unit posts to it, and it tells anyone who asks where something unknown stands.

In the order of the flow:

    logs         lines of the log: text or JSON, without secrets, none without end
    tokens       the files of the two tokens
    access       who may do what: two tokens
    limits       how much one address may ask for
    published    the cell as it is given to units and operators
    unpacking    a cell's folder as a zip becomes a document and its meshes
    cell_loading a new cell is read while units go on
    store        what must outlive the master, in one SQLite file
    beginning    what a master begins with: its configuration or what was stored
    robot        the robot's joints, as a short history
    coverage     what the units look through, united
    merge        the units' voxels, merged (Algorithm 9)
    registry     the units' slots and how far each can be trusted (Algorithm 8)
    pictures     what units are asked to show
    master       all of that held together, without a network
    readable     what those ask of who only read: a master, or a recording of one
    answers      what readers are told of it
    stream       the map as it changes, for many listeners
    metrics      what a monitoring system reads
    history      the last minutes in a few figures
    recording_format  what a recording holds, and a moment to be recorded
    foxglove     such a moment in the schemas that Foxglove shows
    recording_file    one file of a recording
    recording    files one after another, in a thread that nothing waits for
    recorded     a recording opened for reading
    timeline     the files of one recording as one
    replay       a recording that answers as the master did
    config       the master's own configuration
    routes/      the same as HTTP
    viewer/      the same in a browser, for operators
    description  the API described, with examples for the cell that is watched
    app          the web application, assembled
    websocket    a socket that keeps nothing for who does not read
    connections  sockets held within bounds: how many, how slow, TLS
    __main__     the command line
"""
