# SPDX-License-Identifier: Apache-2.0
"""Make mutated bodies of `/update`: flipped, cut, spliced, with fields of other types and huge lengths."""

from __future__ import annotations

import copy
import random
import struct
from collections.abc import Sequence
from typing import Any

import msgpack

VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 2**31, 2**32, 2**63 - 1, 2**64 - 1, -(2**63), 0.5, float("nan"), float("inf"), -1e308,
    "", "x", "\0", "\n", "a" * 300, b"", b"\xff" * 3, b"\0" * 4, b"\0" * 8, [], [[]], [0] * 5, {}, {"x": 1}, {1: 2},
)  # fmt: skip
"""Replacements of a field."""

LENGTHS = (b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff")
"""Headers of binary, text, array and map that claim a length of 4 GiB."""


def mutated(rng: random.Random, corpus: Sequence[bytes]) -> bytes:
    """Return a body that is most likely invalid."""
    body = rng.choice(corpus)
    how = rng.randrange(6)
    if how == 0:
        return _flipped(rng, body)
    if how == 1:
        return body[: rng.randrange(len(body))]
    if how == 2:
        other = rng.choice(corpus)
        return body[: rng.randrange(len(body))] + other[rng.randrange(len(other)) :]
    if how == 3:
        place = rng.randrange(len(body))
        return body[:place] + rng.choice(LENGTHS) + body[place:]
    if how == 4:
        return _with_another_field(rng, body)
    return _with_nested(rng, body)


def _flipped(rng: random.Random, body: bytes) -> bytes:
    flipped = bytearray(body)
    for _ in range(rng.randint(1, 8)):
        flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
    return bytes(flipped)


def _with_another_field(rng: random.Random, body: bytes) -> bytes:
    fields = msgpack.unpackb(body)
    for _ in range(rng.randint(1, 3)):
        name = rng.choice([*fields, "unknown"])
        value = fields.get(name)
        if isinstance(value, list) and value and rng.random() < 0.7:
            value[rng.randrange(len(value))] = _value(rng)
        elif isinstance(value, bytes) and rng.random() < 0.5:
            fields[name] = _keys(rng)
        elif rng.random() < 0.2:
            fields.pop(name, None)
        else:
            fields[name] = _value(rng)
    packed: bytes = msgpack.packb(fields)
    return packed


def _with_nested(rng: random.Random, body: bytes) -> bytes:
    fields = msgpack.unpackb(body)
    value: Any = _value(rng)
    for _ in range(rng.choice((1, 10, 100, 400))):
        value = [value] if rng.random() < 0.5 else {"a": value}
    fields[rng.choice([*fields, "unknown"])] = value
    packed: bytes = msgpack.packb(fields)
    return packed


def _value(rng: random.Random) -> Any:
    """Return a new value each time: a list that is inserted in the next round must never contain itself."""
    return copy.deepcopy(rng.choice(VALUES))


def _keys(rng: random.Random) -> bytes:
    """Return keys, ascending or not, within the lattice or beyond it."""
    count = rng.randrange(50)
    keys = [rng.choice((rng.randrange(8000), rng.randrange(2**32))) for _ in range(count)]
    if rng.random() < 0.5:
        keys.sort()
    return struct.pack(f"<{count}I", *keys) + b"\0" * rng.choice((0, 0, 1, 3))
