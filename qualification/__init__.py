# SPDX-License-Identifier: Apache-2.0
"""Pass or fail against real processes: each command is one module here; its helpers are in the folder listed before it.

Each command prints its tables and marks, and writes them as JSON to `out/results/`. In the order of the flow:

    networks       namespaces, a cable that can be pulled, a proxy that delays, cuts and records
    source_faults  a RealSense source with camera failures
    fault_site/    the processes that `make faults` breaks, and the observers of the map
    faults         the map during failures of processes, clocks, networks and disks
    soak_site/     the events of `make soak`, and its counters
    soak           a long run with all failures: no wrong answer, no growth
    socket_site/   the network sockets that `make plug-and-play` plugs its units into
    plug_and_play  units are plugged in, moved, exchanged, knocked and covered
    machines/      machines that boot, and fresh ones
    boot           three units and a master as such machines: power on, failures, recovery
    image          two of them boot from one image and report to a master
    fresh_machine  both commands of the README on a machine with only Python, its venv and make
    window         the operator's window in a real browser, and the cost of viewers to the units
"""
