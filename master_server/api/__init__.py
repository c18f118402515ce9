# SPDX-License-Identifier: Apache-2.0
"""The HTTP API of the master.

It is assembled by `master_server.app`; this page re-exports nothing. In the order of the flow:

    responses       the answers to readers of the map
    map_stream      the map as it changes, for many listeners
    image_requests  requests for a unit's images
    history         a few figures over the last minutes
    metrics         the series for a monitoring system
    services        the objects that the routes of one application use
    openapi         the description of the API, with examples for the watched cell
    routes/         each part of the API as HTTP
"""
