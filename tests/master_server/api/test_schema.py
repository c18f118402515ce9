# SPDX-License-Identifier: Apache-2.0
"""Requests generated from the API's description, valid and invalid: no fault, and every answer as described."""

from __future__ import annotations

import asyncio
import binascii
import itertools
import json
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import msgpack
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis import Case, GenerationMode, checks
from schemathesis.core.result import Ok
from schemathesis.specs.openapi import checks as openapi_checks

from master_server.api import image_requests
from master_server.app import make_app
from master_server.core import Master
from master_server.core import units as registry
from master_server.recording.recorder import Recorder, RecordingConfig
from master_server.security import Access, Limits
from master_server.security.rate_limits import RateLimit
from shared.cell import Cell
from shared.settings import Settings
from shared.wire import MEDIA_TYPE
from simulation.world.world import DEMO_CELL
from tests.master_server.test_app import OPERATOR, UNIT, Desk

CELL = Cell.load(DEMO_CELL)
CASES, MANY_CASES = 10, 100
"""Number of valid requests for each operation, and of invalid ones."""

OF_UNITS = {"POST /initialize", "POST /update", "PUT /units/{unit_id}/images/{kind}"}

WANT_OF_HARDWARE = {503, 504}
"""Images need a running unit, and there is none."""

CHECKS = [
    checks.not_a_server_error,
    openapi_checks.status_code_conformance,
    openapi_checks.content_type_conformance,
    openapi_checks.response_headers_conformance,
    openapi_checks.response_schema_conformance,
]


def fresh(folder: Path) -> Desk:
    """Return a master of the demo cell that can record, with a rate limit above that of any test."""
    limits = Limits()
    limits.requests = limits.wrong_tokens = RateLimit(1e9, 10**9)
    master = Master(CELL, Settings())
    recorder = Recorder(master, RecordingConfig(free_bytes_min=0), folder)
    return Desk(make_app(master, Access(UNIT.encode(), OPERATOR.encode()), recorder, limits))


@schemathesis.serializer(MEDIA_TYPE, "application/zip", "image/png")
def as_bytes(_: Any, value: Any) -> Any:
    """Return bytes unchanged; encode other values as msgpack, with base64 of the description as binary."""
    if isinstance(value, bytes):
        return value
    if isinstance(value, dict):
        value = {name: of_base64(one) if name == "keys" else one for name, one in value.items()}
        if isinstance(seen := value.get("seen"), dict) and "bits" in seen:
            value["seen"] = {**seen, "bits": of_base64(seen["bits"])}
    try:
        return msgpack.packb(value)
    except (OverflowError, ValueError):
        # An integer that msgpack cannot encode.
        return b"\xc1"


@schemathesis.deserializer(MEDIA_TYPE)
def of_msgpack(_: Any, response: Any) -> Any:
    return msgpack.unpackb(response.content)


def of_base64(value: Any) -> Any:
    try:
        return b64decode(value, validate=True)
    except (binascii.Error, TypeError, ValueError):
        return value


SCHEMA = schemathesis.openapi.from_dict(fresh(Path()).app.openapi())
OPERATIONS = {found.ok().label: found.ok() for found in SCHEMA.get_all_operations() if isinstance(found, Ok)}


def test_every_operation_is_understood() -> None:
    described = {f"{method.upper()} {path}" for path, of in SCHEMA.raw_schema["paths"].items() for method in of}
    assert set(OPERATIONS) == described


@pytest.fixture
def loop() -> Iterator[asyncio.AbstractEventLoop]:
    loop = asyncio.new_event_loop()
    yield loop
    loop.run_until_complete(loop.shutdown_default_executor())
    loop.close()


@pytest.mark.parametrize("count", [CASES, pytest.param(MANY_CASES, marks=pytest.mark.slow)])
@pytest.mark.parametrize("label", OPERATIONS)
def test_answers_are_as_described(
    label: str, count: int, loop: asyncio.AbstractEventLoop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (image_requests, registry):
        monkeypatch.setattr(module, "IMAGE_EXPIRES_S", 0.01)
    desk = fresh(tmp_path)
    registered = desk.call("POST", "/initialize", UNIT, json=example_of("POST /initialize"))
    answer = loop.run_until_complete(registered)
    assert answer.status_code == 200
    # These are not known beforehand.
    known = {name: answer.json()[name] for name in ("id", "session")}
    sequence = itertools.count()
    right, wrong = (UNIT, OPERATOR) if label in OF_UNITS else (OPERATOR, UNIT)
    cases = st.one_of(*(OPERATIONS[label].as_strategy(mode) for mode in GenerationMode))
    bounded = settings(
        max_examples=2 * count, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck)
    )

    @bounded
    @given(cases, st.sampled_from((right, right, right, wrong)))
    def ask(case: Case, token: str) -> None:
        if label == "POST /update" and isinstance(case.body, dict) and token == right:
            case.body = {**case.body, **known, "sequence": next(sequence)}
        response = loop.run_until_complete(answered(desk, case, token))
        if response.status_code in WANT_OF_HARDWARE and "/images/" in case.path:
            assert set(response.json()) == {"detail"}
        else:
            case.validate_response(response, checks=CHECKS)

    try:
        ask()
    finally:
        loop.run_until_complete(desk.app.services.recorder.stop())


def example_of(label: str) -> Any:
    content = OPERATIONS[label].definition.raw["requestBody"]["content"]["application/json"]
    return next(iter(content["examples"].values()))["value"]


async def answered(desk: Desk, case: Case, token: str) -> httpx.Response:
    sent = case.as_transport_kwargs(base_url="http://master")
    url = httpx.URL(sent["url"], params=sent.get("params") or {})
    headers = {name: value for name, value in (sent.get("headers") or {}).items() if name.lower() != "authorization"}
    if "json" in sent:
        body, headers["Content-Type"] = json.dumps(sent["json"]).encode(), "application/json"
    else:
        body = sent.get("data")
    return await desk.call(case.method, str(url), token, headers=headers, content=body)
