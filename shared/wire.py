# SPDX-License-Identifier: Apache-2.0
"""Encode messages as bytes and decode them; each error of bytes from the network is a `WireError`.

The body of `/update` is a msgpack map of the fields of `UpdateRequest` that are not at their default:

    id, session, sequence, sent_at_ns   integers, 1 to 9 bytes each
    captured_at_ns, joints_until_ns     integers of 9 bytes
    exchange                            4 integers, 37 bytes
    versions                            array of 4 small integers, 5 to 13 bytes
    keys                                binary, 4 bytes a voxel: ascending little-endian uint32
    seen                                map, only when it changed: at most 4 kB (see `pack_seen`)
    health                              array of 10 values and those of newer minors, about 50 bytes
    phase                               text, only while the unit is not live

The answer is a map of the fields of `UpdateAnswer`. Each joint sample is `[at_ns, positions, velocities]` with
little-endian float32 as binary. `versions` and `health` are the values of their fields in order: at 30 updates a
second the names would be a fifth of everything except the voxels. Both bodies, with all HTTP headers and with joints
at 125 Hz in the answer, stay within 4 bytes a voxel + 800.
"""

from __future__ import annotations

import math
import struct
import zlib
from operator import attrgetter
from typing import Any, TypeVar

import msgpack
import numpy as np
import ormsgpack
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from shared.configuration import sentence
from shared.errors import InputError, WireError
from shared.messages import (
    MAX_SEEN_BYTES,
    MAX_VOXELS,
    Health,
    JointSample,
    Progress,
    SeenReport,
    UpdateAnswer,
    UpdateRequest,
    Versions,
)

MEDIA_TYPE = "application/msgpack"

MAX_FIXED_BYTES = 2**14
"""Limit of an update without keys and seen report: numbers, names, and a sentence for each of MAX_COMMANDS."""

MAX_UPDATE_BYTES = 4 * MAX_VOXELS + MAX_SEEN_BYTES + MAX_FIXED_BYTES

MAX_ANSWER_BYTES = 2**20
"""Limit of a master's answer to a unit, except meshes; a cell's document is the largest."""

SHOWN_CHARS = 60
"""Maximum length of a quoted value: enough to recognise it."""

MAX_SEEN_BLOCKS = 2**22
"""Limit of blocks: a hall of 64 m by 64 m by 10 m in blocks of 100 mm; half a MiB of bits."""

ROWS: dict[str, type[BaseModel]] = {"versions": Versions, "health": Health}
"""Fields of an update and its answer that travel as rows: the values of their own fields, in order, without names."""

LEAST = {"versions": 4, "health": 10}
"""Least number of values in a row: as many as contract 5.0 had."""

_VALUES = {name: attrgetter(*model.model_fields) for name, model in ROWS.items()}

Model = TypeVar("Model", bound=BaseModel)


def unpack(data: bytes, max_bytes: int) -> Any:
    """Unpack msgpack into plain values, with arrays as lists and names as text.

    Raises:
        WireError: the data are longer than `max_bytes`, or malformed.
    """
    if len(data) > max_bytes:
        raise WireError(f"message: expected at most {max_bytes} bytes, got {len(data)}")
    try:
        # Not `msgpack`, which interns all names: up to Python 3.12.5, interned strings are never freed.
        return ormsgpack.unpackb(data)
    except ormsgpack.MsgpackDecodeError as error:
        raise WireError(f"message: expected msgpack, got other bytes: {error}") from error


def encode(message: BaseModel) -> bytes:
    """Encode any message as msgpack, without the fields that are None."""
    packed: bytes = msgpack.packb(message.model_dump(exclude_none=True))
    return packed


def decode(model: type[Model], data: bytes, max_bytes: int = MAX_ANSWER_BYTES) -> Model:
    """Decode a message of the given model.

    Raises:
        WireError: the data are too long or not msgpack, or a field is missing, unknown or invalid.
    """
    fields = unpack(data, max_bytes)
    try:
        return _validated(model, _with_tuples(fields))
    except RecursionError as error:
        raise WireError("message: expected a few levels of nesting, got too many") from error


def encode_update(update: UpdateRequest) -> bytes:
    """Encode the body of `POST /update`."""
    fields = update.model_dump(exclude_defaults=True)
    for name in fields.keys() & ROWS:
        fields[name] = _VALUES[name](getattr(update, name))
    if update.health.progress is not None:
        fields["health"] = tuple(
            tuple(value.model_dump().values()) if isinstance(value, Progress) else value for value in fields["health"]
        )
    packed: bytes = msgpack.packb(fields)
    return packed


def decode_update(data: bytes) -> UpdateRequest:
    """Decode the body of `POST /update`; the keys stay bytes.

    Raises:
        WireError: as in `decode`.
    """
    return _validated(UpdateRequest, _named(_with_rows(unpack(data, MAX_UPDATE_BYTES)), of_newer=False))


def encode_update_answer(answer: UpdateAnswer, answered_at_ns: int | None = None) -> bytes:
    """Encode the answer to `POST /update`; `answered_at_ns` replaces the time in `answer`, if given."""
    fields = answer.model_dump(exclude_defaults=True, exclude={"versions", "joints"})
    if answered_at_ns is not None:
        fields["answered_at_ns"] = answered_at_ns
    fields["versions"] = _VALUES["versions"](answer.versions)
    if answer.joints:
        fields["joints"] = [
            (sample.at_ns, _floats(sample.positions), None if sample.velocities is None else _floats(sample.velocities))
            for sample in answer.joints
        ]
    packed: bytes = msgpack.packb(fields)
    return packed


def decode_update_answer(data: bytes) -> UpdateAnswer:
    """Decode the answer to `POST /update`.

    Raises:
        WireError: as in `decode`.
    """
    fields = _named(_with_rows(unpack(data, MAX_ANSWER_BYTES)), of_newer=True)
    if isinstance(fields, dict) and "joints" in fields:
        fields["joints"] = _joint_samples(fields["joints"])
    return _validated(UpdateAnswer, fields)


def keys_to_bytes(keys: NDArray[np.uint32]) -> bytes:
    """Encode lattice keys (N,), ascending.

    Raises:
        InputError: there are more than `MAX_VOXELS` keys.
    """
    if keys.size > MAX_VOXELS:
        raise InputError(f"keys: expected at most {MAX_VOXELS} voxels in one update, got {keys.size}")
    return keys.astype("<u4", copy=False).tobytes()


def keys_from_bytes(data: bytes, cell_count: int) -> NDArray[np.uint32]:
    """Decode lattice keys (N,) uint32 of a lattice of `cell_count` voxels; read-only, without a copy.

    Raises:
        WireError: the keys are not a whole number, not ascending, or beyond the lattice.
    """
    if len(data) % 4:
        raise WireError(f"keys: expected 4 bytes a voxel, got {len(data)} bytes")
    keys = np.frombuffer(data, dtype="<u4")
    if keys.size:
        if int(keys[-1]) >= cell_count:
            raise WireError(f"keys: expected keys below {cell_count}, got {int(keys[-1])}")
        if not (keys[1:] > keys[:-1]).all():
            raise WireError("keys: expected ascending keys, each once")
    return keys


def pack_seen(seen: NDArray[Any], block_size_m: float) -> SeenReport | None:
    """Encode a seen grid (nx, ny, nz), bool or 0 and 1; return None when it exceeds `MAX_SEEN_BYTES`."""
    bits = zlib.compress(np.packbits(seen, bitorder="little").tobytes())
    if len(bits) > MAX_SEEN_BYTES:
        return None
    nx, ny, nz = seen.shape
    return SeenReport(block_size_m=block_size_m, shape=(nx, ny, nz), bits=bits)


def unpack_seen(report: SeenReport) -> NDArray[np.bool_]:
    """Decode the seen grid (nx, ny, nz) bool of a report.

    Raises:
        WireError: there are too many blocks, or the bits are damaged or do not match the shape.
    """
    blocks = math.prod(report.shape)
    if blocks > MAX_SEEN_BLOCKS:
        raise WireError(f"seen: expected at most {MAX_SEEN_BLOCKS} blocks, got {blocks}")
    length = (blocks + 7) // 8
    inflater = zlib.decompressobj()
    try:
        packed = inflater.decompress(report.bits, length + 1)
    except zlib.error as error:
        raise WireError(f"seen: damaged bits: {error}") from error
    if len(packed) != length or not inflater.eof or inflater.unused_data:
        raise WireError(f"seen: expected {length} bytes of bits for {blocks} blocks, got another count")
    flat = np.unpackbits(np.frombuffer(packed, dtype=np.uint8), count=blocks, bitorder="little")
    return flat.view(np.bool_).reshape(report.shape)


def _validated(model: type[Model], fields: Any) -> Model:
    try:
        return model.model_validate(fields, strict=True)
    except ValidationError as error:
        raise WireError(sentence(error)) from error


def _with_tuples(value: Any) -> Any:
    """Replace all lists by tuples, as models expect."""
    if isinstance(value, list):
        return tuple([_with_tuples(one) for one in value])
    if isinstance(value, dict):
        return {name: _with_tuples(one) for name, one in value.items()}
    return value


def _with_rows(fields: Any) -> Any:
    """Replace lists of the two levels of an update by tuples, faster; deeper lists stay and are refused."""
    if isinstance(fields, dict):
        for name, value in fields.items():
            if isinstance(value, list):
                fields[name] = tuple([tuple(one) if isinstance(one, list) else one for one in value])
            elif isinstance(value, dict):
                fields[name] = {key: tuple(one) if isinstance(one, list) else one for key, one in value.items()}
    return fields


def _named(fields: Any, of_newer: bool) -> Any:
    """Turn rows into fields with names; rows of a newer side (`of_newer`) may be longer than known."""
    if isinstance(fields, dict):
        for name, model in ROWS.items():
            if name in fields:
                row, names = fields[name], model.model_fields
                least, most = LEAST[name], len(names)
                if not isinstance(row, tuple) or len(row) < least or (len(row) > most and not of_newer):
                    count = f"{least}" if least == most else f"{least} to {most}"
                    raise WireError(f"{name}: expected an array of {count} values, got {repr(row)[:SHOWN_CHARS]}")
                # A row of an older unit is shorter, one of a newer master longer.
                fields[name] = named = dict(zip(names, row, strict=False))
                if isinstance(progress := named.get("progress"), tuple):
                    if len(progress) > len(Progress.model_fields):
                        raise WireError(f"{name}: expected a progress of 3 values, got {repr(progress)[:SHOWN_CHARS]}")
                    named["progress"] = dict(zip(Progress.model_fields, progress, strict=False))
    return fields


def _floats(values: tuple[float, ...]) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


def _joint_samples(rows: Any) -> tuple[JointSample, ...]:
    try:
        return tuple(
            JointSample(at_ns, _values(positions), None if velocities is None else _values(velocities))
            for at_ns, positions, velocities in rows
        )
    except (TypeError, ValueError) as error:
        raise WireError(f"joints: expected rows of time, positions, velocities: {error}") from error


def _values(data: bytes) -> tuple[float, ...]:
    return tuple(np.frombuffer(data, dtype="<f4").tolist())
