# SPDX-License-Identifier: Apache-2.0
"""The master as HTTP: what is told to whom, in which words.

It is assembled by `master_server.app`; this page re-exports nothing. In the order of the flow:

    responses       what readers are told of the map
    map_stream      the map as it changes, for many listeners
    image_requests  what units are asked to show
    history         the last minutes in a few figures
    metrics         what a monitoring system reads
    services        what the routes of one application work with
    openapi         the API described, with examples for the cell that is watched
    routes/         each part of the API as HTTP
"""
