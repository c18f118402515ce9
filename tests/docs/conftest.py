# SPDX-License-Identifier: Apache-2.0
"""A real master with the demo cell, for what the pages and the examples ask of one."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from simulation.world.world import DEMO_CELL
from tests.system.cluster import Cluster


@pytest.fixture(scope="module")
def master(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A master at a free port of loopback; its state is in the folder `master` of the cluster's."""
    with Cluster(tmp_path_factory.mktemp("cluster"), DEMO_CELL) as cluster:
        cluster.start_master()
        yield cluster
