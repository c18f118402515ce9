# SPDX-License-Identifier: Apache-2.0
"""`make demo`, and the README's pictures.

In the order of the flow:

    table            the live table of the demo
    show             the demo itself
    picture          the README's picture of the method
    window_pictures  the README's pictures of the operator's window
    __main__         the command line
"""
