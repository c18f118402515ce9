# SPDX-License-Identifier: Apache-2.0
"""What outlives the master.

In the order of the flow:

    store          what must outlive the master, in one SQLite file
    startup_state  what a master starts with: its configuration or what was stored
"""

from master_server.persistence.startup_state import beginning
from master_server.persistence.store import Store, UnitRecord

__all__ = [
    "Store",
    "UnitRecord",
    "beginning",
]
