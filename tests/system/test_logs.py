# SPDX-License-Identifier: Apache-2.0
"""The log of a real master during use and misuse: lines that can be collected, and never a token."""

from __future__ import annotations

import json
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tests.system.cluster import Cluster, write_cell

REFUSED = "some-other-token-0123456789"


@pytest.mark.patient
@pytest.mark.parametrize("level", ["INFO", "DEBUG"])
def test_no_line_holds_a_token(tmp_path: Path, level: str) -> None:
    with Cluster(tmp_path, write_cell(tmp_path)) as cluster:
        cluster.start_master("--log-format", "json", "--log-level", level)
        operator = cluster.operator.headers["Authorization"].removeprefix("Bearer ")
        unit = Path(cluster.unit_token_file).read_text().strip()
        url = cluster.url.replace("http", "ws") + "/stream"
        for token in (operator, unit, REFUSED):
            headers = {"Authorization": f"Bearer {token}"}
            for path in ("/voxels", "/metrics", "/gone", f"/{token}"):
                httpx.get(cluster.url + path, headers=headers, trust_env=False)
            httpx.post(cluster.url + "/update", headers=headers, content=b"?", trust_env=False)
            with pytest.raises(InvalidStatus):
                connect(f"{url}?token={token}", proxy=None)
            if token != REFUSED:
                offered = [Subprotocol("cellwatch"), Subprotocol(f"bearer.{token}")]
                with connect(url, subprotocols=offered, proxy=None) as reader:
                    reader.recv()
        log = cluster.log("master")
    for token in (operator, unit, REFUSED):
        assert token not in log
    lines = [json.loads(line) for line in log.splitlines() if not line.startswith("master-server: ")]
    assert all({"time", "level", "logger", "message"} <= line.keys() for line in lines)
    assert {"uvicorn.error", "master_server.api.routes.stream"} <= {line["logger"] for line in lines}
    refusals = [line for line in lines if line.get("event") == "refusal"]
    assert {(line["ip"], line["status"]) for line in refusals} >= {("127.0.0.1", 400), ("127.0.0.1", 401)}
    assert any("POST /update from 127.0.0.1 refused: 422" in line["message"] for line in refusals)
