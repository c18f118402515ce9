# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from master_server.security import Access, Role, load_access, token_file, write_token
from master_server.security import auth as access_module
from master_server.security.auth import ANYONE, OPERATORS, READ_EVERY_S, UNITS
from shared.errors import Refusal
from shared.waiting import within

ACCESS = Access(b"unit-token-0123456789", b"operator-token-0123456789")


def bearer(token: bytes) -> bytes:
    return b"Bearer " + token


def test_each_token_opens_its_own_routes() -> None:
    assert ACCESS.check(bearer(ACCESS.unit_token), UNITS) is Role.UNIT
    assert ACCESS.check(bearer(ACCESS.operator_token), OPERATORS) is Role.OPERATOR
    assert ACCESS.check(b"bearer  " + ACCESS.unit_token + b" ", ANYONE) is Role.UNIT


@pytest.mark.parametrize(
    ("header", "allowed", "status", "words"),
    [
        (None, ANYONE, 401, "no token"),
        (b"", ANYONE, 401, "no bearer token"),
        (b"Basic abc", ANYONE, 401, "no bearer token"),
        (b"Bearer", ANYONE, 401, "unknown token"),
        (b"Bearer nonsense", ANYONE, 401, "unknown token"),
        (b"Bearer " + b"x" * 100_000, ANYONE, 401, "unknown token"),
        (b"Bearer " + ACCESS.unit_token[:-1], ANYONE, 401, "unknown token"),
        (b"Bearer \xff\xfe", ANYONE, 401, "unknown token"),
        (bearer(ACCESS.unit_token), OPERATORS, 403, "token of the operator, got that of the unit"),
        (bearer(ACCESS.operator_token), UNITS, 403, "token of the unit, got that of the operator"),
    ],
)
def test_refusals(header: bytes | None, allowed: frozenset[Role], status: int, words: str) -> None:
    with pytest.raises(Refusal, match=words) as caught:
        ACCESS.check(header, allowed)
    assert caught.value.status == status


def test_reading_needs_a_token_unless_it_is_public() -> None:
    ACCESS.check_read(bearer(ACCESS.unit_token))
    with pytest.raises(Refusal):
        ACCESS.check_read(None)
    Access(b"a" * 20, b"b" * 20, public_reads=True).check_read(None)


def test_a_token_appears_in_no_text() -> None:
    assert ACCESS.unit_token.decode() not in repr(ACCESS)
    assert ACCESS.operator_token.decode() not in repr(ACCESS)


# ---------------------------------------------------------------------- files that are replaced

NEW = b"another-token-0123456789"
COUNTS_WITHIN_S = 1.0


@pytest.fixture
def access(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Access:
    monkeypatch.setattr(access_module, "READ_EVERY_S", 0.02)
    return load_access(tmp_path, False)


@asynccontextmanager
async def following(access: Access) -> AsyncIterator[None]:
    task = asyncio.create_task(access.follow())
    try:
        yield
    finally:
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task


async def until(look: Callable[[], object]) -> bool:
    async def wait() -> None:
        while not look():
            await asyncio.sleep(0.005)

    return await within(COUNTS_WITHIN_S, wait())


def put(path: Path, content: bytes) -> None:
    """Write as an editor does: not in one step."""
    with path.open("wb") as file:
        file.write(content)


async def looks(count: int) -> None:
    """Wait until the files were read `count` times."""
    await asyncio.sleep(count * 0.05)


def test_a_replaced_token_takes_effect_soon() -> None:
    # Noticed at the next read, and streams have half a second to end.
    assert 5 * READ_EVERY_S <= COUNTS_WITHIN_S / 2


async def test_a_replaced_file_takes_effect_and_the_old_token_is_refused(
    access: Access, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    before, operator, end = access.unit_token, access.operator_token, access.end_of(Role.UNIT)
    async with following(access):
        path = await asyncio.to_thread(write_token, tmp_path, Role.UNIT)
        assert await until(end.is_set)
        after = (await asyncio.to_thread(path.read_bytes)).strip()
        assert access.check(bearer(after), UNITS) is Role.UNIT
        with pytest.raises(Refusal, match="unknown token"):
            access.check(bearer(before), ANYONE)
        # The other token and its streams stay; and a second replacement works.
        assert access.check(bearer(operator), OPERATORS) is Role.OPERATOR
        assert not access.end_of(Role.OPERATOR).is_set()
        again = access.end_of(Role.UNIT)
        assert not again.is_set()
        await asyncio.to_thread(put, path, NEW)
        assert await until(again.is_set)
        assert access.unit_token == NEW
    assert caplog.text.count("unit.token was replaced") == 2
    assert after.decode() not in caplog.text
    assert NEW.decode() not in caplog.text


@pytest.mark.parametrize("content", [None, b"", b"short", b"x" * 1000, b"two-lines-0123456789\ntwo-lines-0123456789"])
async def test_a_file_without_a_token_keeps_the_old_token_with_one_warning(
    access: Access, tmp_path: Path, content: bytes | None, caplog: pytest.LogCaptureFixture
) -> None:
    before, end = access.operator_token, access.end_of(Role.OPERATOR)
    path = token_file(tmp_path, Role.OPERATOR)
    async with following(access):
        await (asyncio.to_thread(path.unlink) if content is None else asyncio.to_thread(put, path, content))
        assert await until(lambda: "the old token stays valid" in caplog.text)
        await looks(3)
        assert access.check(bearer(before), OPERATORS) is Role.OPERATOR
        assert not end.is_set()
        assert len(caplog.records) == 1
        assert "operator.token" in caplog.records[0].getMessage()
        # The same token again is no replacement; another one is.
        await asyncio.to_thread(put, path, before)
        await looks(3)
        assert not end.is_set()
        await asyncio.to_thread(put, path, NEW)
        assert await until(end.is_set)


async def test_an_access_without_a_folder_never_changes() -> None:
    await ACCESS.follow()
    assert ACCESS.unit_token == b"unit-token-0123456789"
