# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import random
import sys
import zlib
from contextlib import suppress
from functools import partial
from typing import Any, get_args

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.errors import InputError, WireError
from shared.messages import (
    DONE,
    MAX_SEEN_BYTES,
    MAX_VOXELS,
    Command,
    Ended,
    Health,
    InitializeRequest,
    JointSample,
    LatticeDescription,
    Outcome,
    OutcomeCode,
    Progress,
    RobotAnswer,
    SeenReport,
    TroubleCode,
    UpdateAnswer,
    UpdateRequest,
    Versions,
)
from shared.settings import Settings
from shared.timebase import Exchange
from shared.wire import (
    MAX_UPDATE_BYTES,
    decode,
    decode_update,
    decode_update_answer,
    encode,
    encode_update,
    encode_update_answer,
    keys_from_bytes,
    keys_to_bytes,
    pack_seen,
    unpack,
    unpack_seen,
)

LATE_NS = 10**9 * 3600 * 24 * 365
"""Time of a unit that has run for a year."""


def update(**changes: Any) -> UpdateRequest:
    fields: dict[str, Any] = {
        "id": 49,
        "session": 2**32 - 1,
        "sequence": 10**7,
        "captured_at_ns": LATE_NS,
        "sent_at_ns": LATE_NS + 1,
        "exchange": Exchange(LATE_NS, LATE_NS + 1, LATE_NS + 2, LATE_NS + 3),
        "versions": Versions(settings=1000, lattice=1000, cell=1000, pose=1000),
        "keys": keys_to_bytes(np.arange(5, 1005, dtype=np.uint32)),
        "health": Health(
            valid_share=0.87, agreeing_share=0.95, residual_share=-0.01, static_share=0.5, process_ms=8.1, frame=10**7
        ),
        "joints_until_ns": LATE_NS,
        "done": (Ended.of(3, DONE), Ended.of(4, Outcome("failed", "the board is not in view"))),
    }
    return UpdateRequest(**{**fields, **changes})


def answer(**changes: Any) -> UpdateAnswer:
    fields: dict[str, Any] = {
        "versions": Versions(settings=1000, lattice=1000, cell=1000, pose=1000),
        "received_at_ns": LATE_NS,
        "answered_at_ns": LATE_NS + 1,
        "joints": tuple(JointSample(LATE_NS + i, (0.5,) * 7, (0.25,) * 7 if i == 3 else None) for i in range(4)),
        "commands": (Command(id=1, verb="learn_background"),),
    }
    return UpdateAnswer(**{**fields, **changes})


def test_updates_round_trip() -> None:
    for one in (update(), update(captured_at_ns=None, exchange=None, keys=b"", health=Health(), done=())):
        assert decode_update(encode_update(one)) == one


def test_answers_round_trip() -> None:
    changed = answer(
        settings=Settings(voxel_size_m=0.03),
        lattice=LatticeDescription(origin_m=(0.0, -1.5, 0.1), voxel_size_m=0.03, shape=(1, 2, 3)),
        T_world_camera=((1.0, 0.0, 0.0, 0.5), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
    )
    for one in (answer(), changed, answer(joints=(), commands=())):
        assert decode_update_answer(encode_update_answer(one)) == one


def test_the_names_on_the_wire_are_those_of_the_contract() -> None:
    fields = msgpack.unpackb(encode_update(update(seen=pack_seen(np.ones((2, 2, 2), bool), 0.1))))
    assert list(fields) == [
        "id", "session", "sequence", "captured_at_ns", "sent_at_ns", "exchange", "versions", "keys", "seen", "health",
        "joints_until_ns", "done",
    ]  # fmt: skip
    assert fields["versions"] == [1000, 1000, 1000, 1000]
    assert fields["health"] == [0.87, 0.95, -0.01, 0.5, 8.1, 10**7, *[None] * 6]
    assert fields["keys"][:8] == b"\x05\x00\x00\x00\x06\x00\x00\x00"


def test_an_update_costs_at_most_300_bytes_beyond_its_voxels() -> None:
    # 800 with the headers of both ways is measured at a socket in tests/system.
    for count in (0, 100, 1000, 20_000):
        body = encode_update(update(keys=keys_to_bytes(np.arange(count, dtype=np.uint32))))
        assert len(body) <= 4 * count + 300


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_keys_round_trip(count: int) -> None:
    keys = np.sort(np.random.default_rng(1).choice(2**27, count, replace=False)).astype(np.uint32)
    found = keys_from_bytes(keys_to_bytes(keys), 2**27)
    assert found.dtype == np.uint32
    assert np.array_equal(found, keys)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\x01\x00\x00", "4 bytes a voxel, got 3"),
        (np.array([1, 100], "<u4").tobytes(), "below 100, got 100"),
        (np.array([2, 1], "<u4").tobytes(), "ascending"),
        (np.array([1, 1], "<u4").tobytes(), "each once"),
        (np.array([7, 2**32 - 1, 3], "<u4").tobytes(), "ascending"),
    ],
)
def test_bad_keys_are_refused(data: bytes, words: str) -> None:
    with pytest.raises(WireError, match=words):
        keys_from_bytes(data, 100)


def test_too_many_voxels_are_refused() -> None:
    with pytest.raises(InputError, match=str(MAX_VOXELS)):
        keys_to_bytes(np.arange(MAX_VOXELS + 1, dtype=np.uint32))
    body = encode_update(update(keys=b"\0" * (4 * MAX_VOXELS)))
    assert len(body) < MAX_UPDATE_BYTES
    with pytest.raises(WireError):
        decode_update(body + b"\0" * (MAX_UPDATE_BYTES - len(body) + 1))


@given(st.tuples(*[st.integers(1, 9)] * 3), st.integers(0, 2**32 - 1))
def test_seen_grids_round_trip(shape: tuple[int, int, int], seed: int) -> None:
    grid = np.random.default_rng(seed).random(shape) < 0.5
    report = pack_seen(grid, 0.1)
    assert report is not None
    assert np.array_equal(unpack_seen(report), grid)


def test_a_seen_report_that_would_be_too_long_is_none() -> None:
    noise = np.random.default_rng(1).random((40, 40, 40)) < 0.5
    assert pack_seen(noise, 0.1) is None
    assert pack_seen(np.ones((200, 200, 100), bool), 0.1) is not None


def test_the_order_of_seen_blocks_is_that_of_keys_from_the_lowest_bit() -> None:
    grid = np.zeros((2, 3, 4), bool)
    grid[1, 2, 1] = True
    report = pack_seen(grid, 0.1)
    assert report is not None
    bits = zlib.decompress(report.bits)
    number = (1 * 3 + 2) * 4 + 1
    assert bits == bytes(1 << number % 8 if i == number // 8 else 0 for i in range(3))


@pytest.mark.parametrize(
    ("shape", "bits"),
    [
        ((2, 2, 2), zlib.compress(b"")),
        ((2, 2, 2), zlib.compress(b"\0\0")),
        ((2, 2, 2), zlib.compress(b"\0") + b"x"),
        ((2, 2, 2), zlib.compress(b"\0")[:-1]),
        ((2, 2, 2), b"nonsense"),
        ((2, 2, 2), b""),
        ((30000, 30000, 30000), zlib.compress(b"\0")),
        ((100, 100, 100), zlib.compress(b"\0" * 10_000_000)[:MAX_SEEN_BYTES]),
    ],
)
def test_bad_seen_reports_are_refused(shape: tuple[int, int, int], bits: bytes) -> None:
    with pytest.raises(WireError, match="seen"):
        unpack_seen(SeenReport(block_size_m=0.1, shape=shape, bits=bits))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"id": -1}, "id"),
        ({"id": "1"}, "id"),
        ({"id": 1.0}, "id"),
        ({"id": True}, "id"),
        ({"id": 2**64 - 1}, "id"),
        ({"sequence": None}, "sequence"),
        ({"unknown": 1}, "unknown"),
        ({"keys": "text"}, "keys"),
        ({"keys": [1, 2]}, "keys"),
        ({"captured_at_ns": 1.5}, "captured_at_ns"),
        ({"exchange": [1, 2, 3]}, "exchange"),
        ({"versions": [1, -1, 0, 0]}, "versions.lattice"),
        ({"versions": [1, 1.0, 0, 0]}, "versions.lattice"),
        ({"versions": [1, 1, 1]}, "versions: expected an array of 4 values"),
        ({"versions": {"settings": 1, "lattice": 1}}, "versions: expected an array of 4 values"),
        ({"versions": None}, "versions: expected an array of 4 values"),
        ({"health": [float("nan"), 0.5, 0.0, 0.5, 1.0, 1, None, None, None, None]}, "health.valid_share"),
        ({"health": [1.1, 0.5, 0.0, 0.5, 1.0, 1, None, None, None, None]}, "health.valid_share"),
        ({"health": [0.5, 0.5, 0.0, 0.5, 1.0, 1, "x" * 201, None, None, None]}, "health.trouble"),
        ({"health": [0.5, 0.5, 0.0, 0.5, 1.0, 1, *[None] * 7]}, "health: expected an array of 10 to 12 values"),
        ({"health": [0.5, 0.5, 0.0, 0.5, 1.0, 1, *[None] * 4, "bored"]}, "health.trouble_code"),
        ({"health": [0.5, 0.5, 0.0, 0.5, 1.0, 1, *[None] * 5, ["background", 1]]}, "health.progress.total"),
        ({"health": [0.5, 0.5, 0.0, 0.5, 1.0, 1, *[None] * 5, ["background", 1, 2, 3]]}, "health: expected a progress"),
        ({"health": [0.5] * 9}, "health: expected an array of 10"),
        ({"seen": {"block_size_m": 0.1, "shape": [1, 1, 0], "bits": b""}}, "seen.shape"),
        ({"seen": {"block_size_m": 0.1, "shape": [1, 1, 1], "bits": b"x" * (MAX_SEEN_BYTES + 1)}}, "seen.bits"),
        ({"done": list(range(17))}, "done"),
    ],
)
def test_a_wrong_field_is_named(changes: dict[str, Any], words: str) -> None:
    fields = {**msgpack.unpackb(encode_update(update())), **changes}
    with pytest.raises(WireError) as caught:
        decode_update(msgpack.packb(fields))
    assert str(caught.value).startswith(words)
    assert len(str(caught.value)) < 400


def test_a_missing_field_is_named() -> None:
    with pytest.raises(WireError, match="session: field required"):
        decode_update(msgpack.packb({"id": 1}))


NO_MESSAGES = (b"", b"\xc1", b"\x90", b"\x81\x90\x01", b"\x93\x01", b"\xc0", b"{}", b"\xdf\xff\xff\xff\xff")


@pytest.mark.parametrize("data", NO_MESSAGES)
def test_invalid_messages_raise_one_error(data: bytes) -> None:
    for read in (decode_update, decode_update_answer):
        with pytest.raises(WireError):
            read(data)


def test_deep_nesting_is_one_error() -> None:
    with pytest.raises(WireError):
        decode_update(b"\x91" * 100_000)


def test_only_wire_errors_come_out_of_mutated_bytes() -> None:
    rng = random.Random(3)
    update_body = encode_update(update(seen=pack_seen(np.ones((3, 3, 3), bool), 0.1)))
    answer_body = encode_update_answer(answer(settings=Settings()))
    refused = []
    for number in range(20_000):
        is_update = number % 2 == 0
        mutated = bytearray(update_body if is_update else answer_body)
        for _ in range(rng.randrange(1, 6)):
            kind = rng.randrange(4)
            place = rng.randrange(len(mutated)) if mutated else 0
            if kind == 0 and mutated:
                mutated[place] = rng.randrange(256)
            elif kind == 1:
                mutated.insert(place, rng.randrange(256))
            elif kind == 2:
                del mutated[place : place + rng.randrange(40)]
            else:
                mutated = mutated[:place]
        try:
            if is_update:
                found = decode_update(bytes(mutated))
                keys_from_bytes(found.keys, 1000)
                if found.seen is not None:
                    unpack_seen(found.seen)
            else:
                decode_update_answer(bytes(mutated))
        except WireError as error:
            refused.append(str(error))
    assert len(refused) > 10_000
    assert all(text.isprintable() and len(text) < 500 for text in refused)


@given(st.binary(max_size=200))
def test_only_wire_errors_come_out_of_noise(data: bytes) -> None:
    for read in (decode_update, decode_update_answer):
        try:
            read(data)
        except WireError:
            continue


def test_none_is_omitted_from_other_messages() -> None:
    body = encode(Health(trouble=None))
    assert "trouble" not in msgpack.unpackb(body)
    assert decode(Health, body) == Health()


def test_unknown_names_are_not_interned() -> None:
    name = "".join(["a name", " that nobody", " else uses"])
    (found,) = unpack(msgpack.packb({name: 1}), 100)
    # The first name of its kind to be interned, so none was before.
    assert sys.intern(name) is name
    assert found == name
    assert found is not name


TIMES = st.integers(0, 2**63 - 1)
COUNTS = st.integers(0, 2**63 - 1)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False, width=32)
VERSIONS = st.builds(Versions, settings=COUNTS, lattice=COUNTS, cell=COUNTS, pose=COUNTS)
TEXTS = st.text(st.characters(exclude_categories=("Cs",)), max_size=200)
OUTCOMES = (None, *get_args(OutcomeCode))
HEALTH = st.builds(
    Health,
    valid_share=st.floats(0.0, 1.0),
    frame=COUNTS,
    trouble=st.none() | TEXTS,
    trouble_code=st.sampled_from((None, *get_args(TroubleCode))),
    progress=st.none() | st.builds(Progress, task=st.just("background"), done=COUNTS, total=COUNTS),
)
UPDATES = st.builds(
    UpdateRequest,
    id=COUNTS,
    session=COUNTS,
    sequence=COUNTS,
    captured_at_ns=st.none() | TIMES,
    sent_at_ns=TIMES,
    exchange=st.none() | st.builds(Exchange, TIMES, TIMES, TIMES, TIMES),
    versions=VERSIONS,
    keys=st.binary(max_size=80),
    health=st.builds(
        Health,
        valid_share=st.floats(0.0, 1.0),
        frame=COUNTS,
        trouble=st.none() | TEXTS,
        trouble_code=st.sampled_from((None, *get_args(TroubleCode))),
        progress=st.none() | st.builds(Progress, task=st.just("background"), done=COUNTS, total=COUNTS),
    ),
    joints_until_ns=TIMES,
    done=st.lists(st.builds(Ended, COUNTS, TEXTS, st.sampled_from(OUTCOMES)), max_size=3).map(tuple),
)
SAMPLES = st.builds(
    JointSample,
    TIMES,
    st.lists(NUMBERS, min_size=1, max_size=7).map(tuple),
    st.none() | st.lists(NUMBERS, min_size=1, max_size=7).map(tuple),
)
ANSWERS = st.builds(
    UpdateAnswer,
    versions=VERSIONS,
    received_at_ns=TIMES,
    answered_at_ns=TIMES,
    joints=st.lists(SAMPLES, max_size=4).map(tuple),
    settings=st.none() | st.just(Settings()),
)
NAMES = st.sampled_from([*UpdateRequest.model_fields, *UpdateAnswer.model_fields]) | st.text(max_size=3)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5)
    | st.binary(max_size=9),
    lambda inner: st.lists(inner, max_size=12) | st.dictionaries(NAMES, inner, max_size=5),
    max_leaves=20,
)  # fmt: skip


@given(UPDATES)
def test_any_update_round_trip(sent: UpdateRequest) -> None:
    assert decode_update(encode_update(sent)) == sent


@given(ANSWERS)
def test_any_answer_round_trip(sent: UpdateAnswer) -> None:
    assert decode_update_answer(encode_update_answer(sent)) == sent


@given(st.dictionaries(NAMES, PLAIN, max_size=8) | PLAIN)
def test_only_wire_errors_come_out_of_any_values(fields: Any) -> None:
    for read in (decode_update, decode_update_answer, partial(decode, InitializeRequest), partial(decode, RobotAnswer)):
        with suppress(WireError):
            read(msgpack.packb(fields))


@given(st.binary(max_size=40), st.integers(0, 2**32))
def test_any_bytes_are_keys_or_a_wire_error(data: bytes, cell_count: int) -> None:
    with suppress(WireError):
        keys = keys_from_bytes(data, cell_count)
        assert keys.tobytes() == data
        assert sorted(set(keys.tolist())) == keys.tolist()
        assert all(key < cell_count for key in keys.tolist())


@given(st.tuples(*[st.integers(1, 40)] * 3), st.binary(max_size=60), st.booleans())
def test_any_bytes_are_a_seen_grid_or_a_wire_error(shape: tuple[int, int, int], bits: bytes, packed: bool) -> None:
    with suppress(WireError):
        report = SeenReport(block_size_m=0.1, shape=shape, bits=zlib.compress(bits) if packed else bits)
        assert unpack_seen(report).shape == shape
