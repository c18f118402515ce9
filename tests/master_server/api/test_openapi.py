# SPDX-License-Identifier: Apache-2.0
"""The API description is true: every example works, and every route documents its refusals."""

from __future__ import annotations

import re
from base64 import b64decode
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import msgpack
import pytest

from master_server.app import make_app
from master_server.core import Master
from master_server.recording.recorder import Recorder, RecordingConfig
from master_server.security import Access
from shared.cell import Cell
from shared.settings import Settings
from shared.wire import MEDIA_TYPE, ROWS, decode_update_answer
from simulation.world.world import DEMO_CELL
from tests.master_server.test_app import MSGPACK, OPERATOR, UNIT, Desk

ERRORS = {"$ref": "#/components/schemas/ErrorAnswer"}
OPEN = {"/healthz"}
BINARY = {"application/zip", "image/png"}


def fresh(folder: Path) -> Desk:
    """A master of the demo cell, with its robot and its objects, that can record."""
    master = Master(Cell.load(DEMO_CELL), Settings())
    return Desk(
        make_app(
            master,
            Access(UNIT.encode(), OPERATOR.encode()),
            Recorder(master, RecordingConfig(free_bytes_min=0), folder),
        )
    )


def schema() -> dict[str, Any]:
    found: dict[str, Any] = fresh(Path()).app.openapi()
    return found


SCHEMA = schema()
OPERATIONS = [
    (method, path, operation) for path, methods in SCHEMA["paths"].items() for method, operation in methods.items()
]
NAMES = [f"{method.upper()} {path}" for method, path, _ in OPERATIONS]


def bodies(operation: dict[str, Any]) -> list[tuple[str, Any]]:
    """Return media type and value of each example; a single empty one for a route without a body."""
    content = operation.get("requestBody", {}).get("content", {})
    return [
        (kind, example["value"]) for kind, of in content.items() for example in of.get("examples", {}).values()
    ] or [("", None)]


EXAMPLES = [
    pytest.param(method, path, operation, *body, id=f"{method.upper()} {path} {number}")
    for method, path, operation in OPERATIONS
    for number, body in enumerate(bodies(operation))
]


def as_sent(kind: str, value: Any, registered: dict[str, Any]) -> dict[str, Any]:
    if kind == MEDIA_TYPE:
        # The session is not known beforehand.
        value = {**value, "keys": b64decode(value["keys"]), "session": registered["session"]}
        return {"content": msgpack.packb(value), "headers": MSGPACK}
    return {} if value is None else {"json": value}


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return fresh(tmp_path)


@pytest.fixture
async def fresh_desk(desk: Desk) -> AsyncIterator[Desk]:
    yield desk
    await desk.app.services.recorder.stop()


@pytest.mark.parametrize(("method", "path", "operation", "kind", "value"), EXAMPLES)
async def test_every_example_works_as_it_is(
    method: str, path: str, operation: dict[str, Any], kind: str, value: Any, fresh_desk: Desk
) -> None:
    initialize = SCHEMA["paths"]["/initialize"]["post"]
    registered = await fresh_desk.call("POST", "/initialize", UNIT, json=bodies(initialize)[0][1])
    assert registered.status_code == 200, registered.text
    query = {}
    for parameter in operation.get("parameters", ()):
        assert "example" in parameter, parameter["name"]
        if parameter["in"] == "path":
            path = path.replace(f"{{{parameter['name']}}}", str(parameter["example"]))
        else:
            query[parameter["name"]] = parameter["example"]
    of_units = path in ("/initialize", "/update") or (method == "put" and "/images/" in path)
    token = UNIT if of_units else OPERATOR
    sent = as_sent(kind, value, registered.json())
    response = await fresh_desk.call(method.upper(), path, token, params=query, **sent)
    assert str(response.status_code) in operation["responses"], response.text
    assert response.is_success or refused_without_hardware(path, response), response.text
    if path == "/update":
        decode_update_answer(response.content)


def refused_without_hardware(path: str, response: httpx.Response) -> bool:
    """Return True for images, which need a running unit, and there is none."""
    return "/images/" in path and response.status_code in (409, 504)


@pytest.mark.parametrize(("method", "path", "operation"), OPERATIONS, ids=NAMES)
def test_every_route_is_described(method: str, path: str, operation: dict[str, Any]) -> None:
    assert operation["summary"]
    assert operation["description"]
    for status, answer in operation["responses"].items():
        assert answer["description"], status
        if int(status) >= 400:
            assert answer["content"] == {"application/json": {"schema": ERRORS}}
        elif int(status) != 204:
            assert all(content["schema"] for content in answer["content"].values()), status
            assert answer["content"]
    assert "429" in operation["responses"]
    assert ("401" in operation["responses"]) is (path not in OPEN)
    for kind, content in operation.get("requestBody", {}).get("content", {}).items():
        assert content["schema"], kind
        assert kind in BINARY or content["examples"], kind


@pytest.mark.parametrize(("method", "path", "operation"), OPERATIONS, ids=NAMES)
async def test_routes_refuse_as_described(method: str, path: str, operation: dict[str, Any], fresh_desk: Desk) -> None:
    for name, nonsense in (("unit_id", "7"), ("sha256", "0" * 64), ("name", "nothing"), ("kind", "depth")):
        path = path.replace(f"{{{name}}}", nonsense)
    for token in (None, "wrong-token-0123456789", UNIT, OPERATOR):
        for sent in ({"json": {"no": "field"}}, {"content": b"\xc1", "headers": MSGPACK}, {"content": b"\0" * 2**21}):
            response = await fresh_desk.call(method.upper(), path, token, **(sent if method in ("put", "post") else {}))
            assert str(response.status_code) in operation["responses"], (token, response.status_code, response.text)
            if response.is_error:
                assert set(response.json()) == {"detail"}


@pytest.mark.parametrize("page", ["/docs", "/redoc"])
async def test_the_pages_load_only_from_the_master(page: str, fresh_desk: Desk) -> None:
    text = (await fresh_desk.call("GET", page, None)).text
    loaded = re.findall(r"""(?:src|href)=["']([^"']+)["']|url: ["']([^"']+)["']""", text)
    assert loaded
    for address in ("".join(found) for found in loaded):
        assert re.match(r"/[^/]", address), address
        assert (await fresh_desk.call("GET", address, None)).status_code == 200
    assert "fonts.googleapis" not in text


async def test_the_document_follows_the_cell(fresh_desk: Desk) -> None:
    moved = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    name = next(one["name"] for one in fresh_desk.app.services.master.published.document["objects"])
    await fresh_desk.call("PUT", f"/cell/objects/{name}/pose", json={"T_world_object": moved})
    told = (await fresh_desk.call("GET", "/openapi.json", None)).json()
    example = bodies(told["paths"]["/cell"]["put"])[0][1]
    assert example == (await fresh_desk.call("GET", "/cell")).json()


def test_updates_are_described_as_on_the_wire() -> None:
    properties = SCHEMA["components"]["schemas"]["UpdateRequest"]["properties"]
    for name, model in ROWS.items():
        assert properties[name]["minItems"] == len(model.model_fields)
