# SPDX-License-Identifier: Apache-2.0
"""`make demo`, and the README's pictures.

In the order of the flow:

    table            the demo's live table
    show             the demo itself
    picture          the README's picture
    window_pictures  the README's pictures of the operator's window
    __main__         the command line
"""
