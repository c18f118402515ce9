# SPDX-License-Identifier: Apache-2.0
"""Pass or fail against real processes: each command is one module here, its helpers are in the folder listed before it.

Each prints its tables and marks, and leaves them as JSON in `out/results/`. In the order of the flow:

    networks       namespaces, a cable that can be pulled, a proxy that is slow, cuts and remembers
    source_faults  what a RealSense source does when the camera makes trouble
    fault_site/    what `make faults` breaks, and who watches the map meanwhile
    faults         what the map says while processes, clocks, networks and disks fail
    soak_site/     what `make soak` lets happen, and what it counts
    soak           for as long as is wished: no answer wrong, nothing grows
    socket_site/   where `make plug-and-play` plugs its units in
    plug_and_play  units are plugged in, moved, exchanged, knocked and covered
    machines/      machines that boot, and fresh ones
    boot           three units and a master as such machines: switched on, failing, coming back
    image          two of them boot from one image and report to a master
    fresh_machine  both commands of the README where there are only Python, its venv and make
    window         the operator's window in a real browser, and what those who look cost the units
"""
