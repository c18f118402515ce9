# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks.load_generator.wide_master`: a master with a raised limit of units."""

from __future__ import annotations

import sys

import master_server.core.units
from master_server.__main__ import main
from master_server.core.merged_map import MAX_WITNESSES

if __name__ == "__main__":
    master_server.core.units.MAX_UNITS = MAX_WITNESSES
    sys.exit(main())
