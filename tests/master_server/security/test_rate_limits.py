# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import httpx
import pytest

from master_server.app import make_app
from master_server.security import Access, Limits, plain_ip
from master_server.security import rate_limits as limits_module
from master_server.security.rate_limits import (
    ADDRESSES_MAX,
    CONNECTIONS_BURST,
    CONNECTIONS_MAX,
    CONNECTIONS_PER_ADDRESS,
    REQUESTS_BURST,
    REQUESTS_PER_S,
    STRANGERS_MAX,
    TRUSTED_S,
    WRONG_TOKENS_BURST,
    RateLimit,
)
from shared.errors import Refusal
from tests.master_server.fakes import MS, START_NS, S, master
from tests.master_server.test_app import MSGPACK, OPERATOR, UNIT, Desk


def test_a_burst_passes_and_then_the_rate() -> None:
    rate = RateLimit(10.0, 3)
    now_ns = START_NS
    for _ in range(3):
        assert rate.wait_ns("a", now_ns) <= 0
        rate.spend("a", now_ns)
    assert rate.wait_ns("a", now_ns) == 100 * MS
    assert rate.wait_ns("b", now_ns) <= 0
    assert rate.wait_ns("a", now_ns + 99 * MS) > 0
    assert rate.wait_ns("a", now_ns + 100 * MS) <= 0
    rate.spend("a", now_ns + 100 * MS)
    assert rate.wait_ns("a", now_ns + 100 * MS) > 0
    # An address that was silent for long has one burst again.
    for _ in range(3):
        assert rate.wait_ns("a", now_ns + 3600 * S) <= 0
        rate.spend("a", now_ns + 3600 * S)
    assert rate.wait_ns("a", now_ns + 3600 * S) > 0


def test_normal_load_is_far_below_the_limit() -> None:
    limits = Limits()
    # From one address: joints at 500 Hz, a unit of 90 fps that polls joints before each frame, and the map at 100 Hz.
    for tick in range(10 * (500 + 180 + 100)):
        limits.admit("10.0.0.1", START_NS + tick * S // 780)
    # Also updates with a wall that fills the view, 25 times a second.
    for tick in range(250):
        limits.admit("10.0.0.2", START_NS + tick * S // 25)
        limits.read("10.0.0.2", 2**20, START_NS + tick * S // 25)


def test_one_address_is_refused_and_no_other() -> None:
    limits = Limits()
    for _ in range(REQUESTS_BURST):
        limits.admit("10.0.0.1", START_NS)
    with pytest.raises(Refusal, match=r"requests: expected at most 1000 a second from 10\.0\.0\.1") as caught:
        limits.admit("10.0.0.1", START_NS)
    assert (caught.value.status, caught.value.retry_after_s) == (429, 1)
    limits.admit("10.0.0.2", START_NS)
    limits.admit("10.0.0.1", START_NS + round(S / REQUESTS_PER_S))


def test_large_bodies_count_as_many_requests() -> None:
    limits = Limits()
    for _ in range(REQUESTS_BURST // 33 + 1):
        limits.admit("10.0.0.1", START_NS)
        limits.read("10.0.0.1", 2**20, START_NS)
    with pytest.raises(Refusal, match="requests"):
        limits.admit("10.0.0.1", START_NS)


def test_wrong_tokens_block_an_address_without_a_recent_valid_one() -> None:
    limits = Limits()
    limits.token_was_right("10.0.0.2", START_NS)
    for ip in ("10.0.0.1", "10.0.0.2"):
        for _ in range(WRONG_TOKENS_BURST):
            limits.may_show_token(ip, START_NS)
            limits.token_was_wrong(ip, START_NS)
    with pytest.raises(Refusal, match="too many wrong ones") as caught:
        limits.may_show_token("10.0.0.1", START_NS)
    assert (caught.value.status, caught.value.retry_after_s) == (429, 1)
    limits.may_show_token("10.0.0.2", START_NS)
    # One more each second.
    limits.may_show_token("10.0.0.1", START_NS + S)
    # Trust ends.
    late_ns = START_NS + round((TRUSTED_S + 1) * S)
    for _ in range(WRONG_TOKENS_BURST):
        limits.token_was_wrong("10.0.0.2", late_ns)
    with pytest.raises(Refusal):
        limits.may_show_token("10.0.0.2", late_ns)


def test_connections_are_bounded_for_each_address_and_in_all() -> None:
    limits = Limits()
    assert [limits.connect("10.0.0.1", START_NS) for _ in range(CONNECTIONS_PER_ADDRESS)] == [True] * 64
    assert not limits.connect("10.0.0.1", START_NS)
    limits.disconnect("10.0.0.1")
    assert limits.connect("10.0.0.1", START_NS)
    count = CONNECTIONS_PER_ADDRESS
    for number in range(2, 2000):
        count += limits.connect(f"10.0.0.{number}", START_NS)
    assert count == limits.connections == STRANGERS_MAX
    for _ in range(CONNECTIONS_PER_ADDRESS):
        limits.disconnect("10.0.0.1")
    assert limits.connections == STRANGERS_MAX - CONNECTIONS_PER_ADDRESS


def test_a_crowd_of_strangers_does_not_block_units() -> None:
    limits = Limits()
    for number in range(2 * STRANGERS_MAX):
        limits.connect(f"10.0.1.{number}", START_NS)
    assert not limits.connect("10.0.0.1", START_NS)
    taken = 0
    for number in range(1, 2 * CONNECTIONS_MAX):
        limits.token_was_right(f"10.0.0.{number}", START_NS)
        taken += limits.connect(f"10.0.0.{number}", START_NS)
    assert taken == CONNECTIONS_MAX - STRANGERS_MAX
    late_ns = START_NS + round((TRUSTED_S + 1) * S)
    limits.disconnect("10.0.0.1")
    assert not limits.connect("10.0.0.1", late_ns)
    limits.token_was_right("10.0.0.1", late_ns)
    assert limits.connect("10.0.0.1", late_ns)


def test_connections_that_come_and_go_are_bounded_too() -> None:
    limits = Limits()
    taken = 0
    while limits.connect("10.0.0.1", START_NS):
        limits.disconnect("10.0.0.1")
        taken += 1
    assert taken == CONNECTIONS_BURST
    assert limits.connections == 0


def test_tables_are_bounded() -> None:
    rate = RateLimit(10.0, 3)
    for number in range(ADDRESSES_MAX + 1000):
        rate.spend(str(number), START_NS)
    assert len(rate) == ADDRESSES_MAX


def test_an_address_has_one_form() -> None:
    assert plain_ip("::ffff:10.0.0.1") == plain_ip("10.0.0.1")


async def test_too_many_requests_get_a_time_to_retry(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits_module, "REQUESTS_BURST", 5)
    monkeypatch.setattr(limits_module, "REQUESTS_PER_S", 0.1)
    desk = Desk(make_app(master(), Access(UNIT.encode(), OPERATOR.encode())))
    for method, path in (("GET", "/units"), ("GET", "/nothing"), ("POST", "/update")):
        ip = f"10.0.1.{len(path)}"
        statuses = [(await desk.call(method, path, ip=ip)).status_code for _ in range(5)]
        assert 429 not in statuses
        refused: httpx.Response = await desk.call(method, path, ip=ip)
        assert refused.status_code == 429
        assert 0 < int(refused.headers["retry-after"]) <= 10
        assert refused.json()["detail"].startswith("requests: expected at most")
        assert f"{method} {path} from {ip} refused: 429, requests" in caplog.text
    assert (await desk.call("GET", "/units", ip="10.0.2.1")).status_code == 200
    for _ in range(5 * limits_module.COMPLAINTS_BURST):
        await desk.call("GET", "/units", ip="10.0.2.1")
    assert 0 < caplog.text.count("from 10.0.2.1 refused") <= limits_module.COMPLAINTS_BURST + 5
    told = (await desk.call("GET", "/metrics", ip="10.0.2.2")).text
    away = 3 + 5 * limits_module.COMPLAINTS_BURST - 4
    assert f'cellwatch_turned_away_total{{what="request"}} {away:.1f}' in told


@pytest.mark.parametrize(("method", "path"), [("GET", "/units"), ("PUT", "/settings"), ("POST", "/update")])
async def test_guessing_ends_with_429(method: str, path: str) -> None:
    desk = Desk(make_app(master(), Access(UNIT.encode(), OPERATOR.encode())))
    for guess in range(WRONG_TOKENS_BURST):
        assert (await desk.call(method, path, f"guess-{guess:020d}", content=b"{}")).status_code == 401
    refused = await desk.call(method, path, "another-guess-0123456789", content=b"{}")
    assert refused.status_code == 429
    assert int(refused.headers["retry-after"]) >= 1
    assert (await desk.call(method, path, UNIT, content=b"{}")).status_code == 429
    assert (await desk.call("GET", "/units", UNIT, "10.0.0.2")).status_code == 200
    # A stranger at a trusted address does not block it.
    for guess in range(2 * WRONG_TOKENS_BURST):
        await desk.call("GET", "/units", f"guess-{guess:020d}", "10.0.0.2")
    assert (await desk.call("GET", "/units", UNIT, "10.0.0.2", headers=MSGPACK)).status_code == 200


async def test_an_address_that_is_refused_again_and_again_does_not_fill_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    desk = Desk(make_app(master(), Access(UNIT.encode(), OPERATOR.encode())))
    for _ in range(5 * limits_module.COMPLAINTS_BURST):
        await desk.call("POST", "/update", UNIT, content=b"\xc1", headers=MSGPACK)
    assert 0 < caplog.text.count("from 10.0.0.1 refused") <= limits_module.COMPLAINTS_BURST + 5
    await desk.call("POST", "/update", UNIT, "10.0.0.2", content=b"\xc1", headers=MSGPACK)
    assert "from 10.0.0.2 refused" in caplog.text


def test_a_unit_with_a_new_token_is_accepted_within_a_second() -> None:
    limits = Limits()
    limits.token_was_right("a", START_NS)
    now_ns = START_NS
    for _ in range(4 * (round(TRUSTED_S) + 1)):
        now_ns += 250 * MS
        try:
            limits.may_show_token("a", now_ns)
        except Refusal:
            continue
        limits.token_was_wrong("a", now_ns)
    limits.may_show_token("a", now_ns + S)
