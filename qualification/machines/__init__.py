# SPDX-License-Identifier: Apache-2.0
"""Machines that boot, for `make rehearsal` and `make image-test`, and fresh ones, for `make fresh-machine`.

In the order of the flow:

    hanging_unit  the unit variant whose filter hangs on demand
    containers    machines that boot systemd from one read-only root file system
    image_parts   the image that arm64 boards boot in QEMU, built as a board's is
    arm64_boards  an arm64 board in QEMU
    fresh_debian  a Debian with only Python and make, and the commands of a new user there
"""
