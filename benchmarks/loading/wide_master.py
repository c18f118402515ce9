# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks.loading.wide_master`: a master that takes more units than it should, to see where it bends."""

from __future__ import annotations

import sys

import master_server.registry
from master_server.__main__ import main
from master_server.merge import MAX_WITNESSES

if __name__ == "__main__":
    master_server.registry.MAX_UNITS = MAX_WITNESSES
    sys.exit(main())
