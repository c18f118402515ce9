# SPDX-License-Identifier: Apache-2.0
"""A unit, an operator and a robot that talk to a master: requests and answers byte by byte, recorded for each version.

Recorded conversations stand in `tests/shared/golden`, one folder a version of the contract. They are never recorded
anew: units of that version say the same for as long as they run.
"""

from __future__ import annotations

import base64
import itertools
import json
import secrets
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from master_server.app import make_app
from master_server.core import Master
from master_server.persistence import Store
from master_server.security import Access
from shared.cell import Cell
from shared.settings import Settings
from shared.wire import MEDIA_TYPE, unpack

GOLDEN = Path(__file__).parent.parent / "shared" / "golden"
UNIT, OPERATOR = "unit-token-0123456789", "operator-token-0123456789"
IP = "10.0.0.1"
BEGIN_NS = 10_000_000_000_000_000
STEP_NS = 40_000_000
"""Of the master's clock, between two requests."""

OF_NEWER_UNITS = ("a newer minor is refused", "a newer major is refused")
"""Steps in which somebody came who speaks a newer contract than the master did."""


@dataclass(frozen=True)
class Step:
    """One request and its answer; bodies are as they travelled."""

    name: str
    method: str
    path: str
    token: str
    body: bytes
    status: int
    answer: bytes

    @property
    def is_units(self) -> bool:
        """Return True if a unit sent it, and not an operator, a robot or a reader."""
        return self.token == UNIT

    def document(self) -> dict[str, Any]:
        """As it is kept: in hexadecimal what is binary."""
        binary = self.is_units
        return {
            "name": self.name,
            "method": self.method,
            "path": self.path,
            "by": "unit" if self.is_units else "operator",
            "body": self.body.hex() if binary else self.body.decode(),
            "status": self.status,
            "answer": self.answer.hex() if binary and self.status < 400 else self.answer.decode(),
        }

    @classmethod
    def of(cls, kept: dict[str, Any]) -> Step:
        """The step that was kept."""
        binary = kept["by"] == "unit"
        is_answer_binary = binary and kept["status"] < 400
        return cls(
            kept["name"],
            kept["method"],
            kept["path"],
            UNIT if binary else OPERATOR,
            bytes.fromhex(kept["body"]) if binary else kept["body"].encode(),
            kept["status"],
            bytes.fromhex(kept["answer"]) if is_answer_binary else kept["answer"].encode(),
        )


def versions() -> list[str]:
    """Every recorded version of the contract, oldest first."""
    return sorted(
        (folder.name for folder in GOLDEN.iterdir()), key=lambda name: [int(part) for part in name.split(".")]
    )


def recorded(version: str) -> list[Step]:
    """The conversation of this version of the contract."""
    return [Step.of(kept) for kept in json.loads((GOLDEN / version / "conversation.json").read_text())]


def keep(version: str, steps: list[Step]) -> None:
    """Keep a conversation that no version before had.

    Raises:
        FileExistsError: it has been recorded before.
    """
    folder = GOLDEN / version
    folder.mkdir(exist_ok=True)
    with (folder / "conversation.json").open("x") as file:
        file.write(json.dumps([step.document() for step in steps], indent=1, ensure_ascii=False) + "\n")


def recorded_cell(version: str) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The document of the cell of that conversation, and its meshes by sha256."""
    kept = json.loads((GOLDEN / version / "cell.json").read_text())
    return kept["document"], {sha256: base64.b64decode(data) for sha256, data in kept["meshes"].items()}


class Table:
    """A master of a recorded cell; its clock and its dice are those of the conversation."""

    def __init__(self, version: str, monkeypatch: pytest.MonkeyPatch, store: Store | None = None) -> None:
        self.now_ns = BEGIN_NS
        dice = itertools.count(1000)
        monkeypatch.setattr(secrets, "randbits", lambda _: next(dice))
        document, meshes = recorded_cell(version)
        cell = Cell.from_document(document, meshes)
        self.master = Master(cell, Settings()) if store is None else Master(cell, Settings(), store)
        self.app = make_app(self.master, Access(UNIT.encode(), OPERATOR.encode()))
        for name, module in list(sys.modules.items()):
            if name.startswith("master_server.") and hasattr(module, "monotonic_ns"):
                monkeypatch.setattr(module, "monotonic_ns", lambda: self.now_ns)

    async def say(self, name: str, method: str, path: str, token: str, body: bytes) -> Step:
        """One request, and what is answered."""
        self.now_ns += STEP_NS
        media_type = MEDIA_TYPE if token == UNIT else "application/json"
        headers = {"Authorization": f"Bearer {token}", "Content-Type": media_type, "Accept": media_type}
        transport = httpx.ASGITransport(app=self.app, client=(IP, 40_000))
        async with httpx.AsyncClient(transport=transport, base_url="http://master") as client:
            response = await client.request(method, path, headers=headers, content=body)
        return Step(name, method, path, token, body, response.status_code, response.content)

    async def replay(self, steps: list[Step]) -> list[Step]:
        """Say all of it again but what was asked by newer units; that stays as it was."""
        said = []
        for step in steps:
            if step.name in OF_NEWER_UNITS:
                self.now_ns += STEP_NS
                said.append(step)
            else:
                said.append(await self.say(step.name, step.method, step.path, step.token, step.body))
        return said


def plain(step: Step) -> Any:
    """The values of an answer."""
    if not step.answer:
        return None
    return unpack(step.answer, 2**20) if step.is_units and step.status < 400 else json.loads(step.answer)
