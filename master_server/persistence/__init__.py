# SPDX-License-Identifier: Apache-2.0
"""The state that outlives the master.

In the order of the flow:

    store          the stored state, in one SQLite file
    startup_state  the state at start: from the configuration or from the store
"""

from master_server.persistence.startup_state import startup_state
from master_server.persistence.store import Store, UnitRecord

__all__ = [
    "Store",
    "UnitRecord",
    "startup_state",
]
