# SPDX-License-Identifier: Apache-2.0
"""Answers about the map, the units and the coverage: the same fields for requests and for the stream."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import orjson
import ormsgpack
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from master_server.core import MapView, Readable, UnitState
from shared.lattice import Lattice
from shared.messages import LatticeDescription, Reason, VoxelsAnswer

Form = Literal["indices", "centres", "keys"]

CENTRE_DECIMALS = 4
"""Decimals of centres: a tenth of a millimetre, a hundredth of the smallest voxel."""

MANY = 3
"""Blocks seen by this many units or more are counted together; with three, one may be hidden and one dead."""


class StreamMessage(VoxelsAnswer):
    """A message of `/stream`: the answer of `GET /voxels` and the units' states, numbered."""

    number: int = Field(description="Rises with each message that was made; gaps are messages that were skipped.")
    units: list[UnitState]


class BlockCounts(LatticeDescription):
    """Number of units that see each block: `np.repeat(counts, runs).reshape(shape)`, in C order."""

    counts: list[int]
    runs: list[int]


class CoverageAnswer(BaseModel):
    """`GET /coverage`: share of the cell that is looked through now."""

    shares: list[float] = Field(description="Share of the blocks seen by 0, 1, 2, and 3 or more live units.")
    seen_share: float = Field(description="Share of the blocks seen by any.")
    block_count: int
    block_size_m: float
    complete: bool = Field(description="As in `GET /voxels`.")
    reasons: list[str]
    causes: list[Reason] = Field(default=[], description="As in `GET /voxels`.")
    units_live: int
    now_ns: int
    blocks: BlockCounts | None = None


def map_fields(view: MapView, form: Form, unseen: dict[str, Any] | None, now_ns: int) -> dict[str, Any]:
    """Return the fields of `VoxelsAnswer` as plain numbers and lists, except the voxels, which are arrays."""
    return {
        "lattice": LatticeDescription.of(view.lattice).model_dump(),
        "lattice_version": view.lattice_version,
        "voxels": _voxels(view, form),
        "witnesses": np.ascontiguousarray(view.witnesses),
        "complete": view.complete,
        "reasons": list(view.reasons),
        "causes": list(view.causes),
        "oldest_view_age_s": None if view.oldest_view_age_s is None else round(view.oldest_view_age_s, 4),
        "units_live": view.units_live,
        "now_ns": now_ns,
        "unseen": unseen,
    }


def unseen_fields(blocks: Lattice, seen_by: NDArray[np.uint8]) -> dict[str, Any]:
    """Return the blocks (nx, ny, nz) that no live unit looks through, by their indices."""
    return {**LatticeDescription.of(blocks).model_dump(), "blocks": np.ascontiguousarray(np.argwhere(seen_by == 0))}


def coverage_shares(seen_by: NDArray[np.uint8]) -> list[float]:
    """Return the shares of the blocks seen by 0, 1, ... and `MANY` or more units; they sum to 1."""
    counts = np.bincount(np.minimum(seen_by, MANY).ravel(), minlength=MANY + 1)
    return [float(count) / seen_by.size for count in counts]


def coverage_fields(master: Readable, with_blocks: bool, now_ns: int) -> dict[str, Any]:
    """Return the fields of `CoverageAnswer`."""
    view, seen_by, blocks = master.view(now_ns), master.seen_by(now_ns), master.blocks_at(now_ns)
    shares = coverage_shares(seen_by)
    return {
        "shares": [round(share, 6) for share in shares],
        "seen_share": round(1.0 - shares[0], 6),
        "block_count": blocks.cell_count,
        "block_size_m": blocks.voxel_size_m,
        "complete": view.complete,
        "reasons": list(view.reasons),
        "causes": list(view.causes),
        "units_live": view.units_live,
        "now_ns": now_ns,
        "blocks": _block_counts(blocks, seen_by) if with_blocks else None,
    }


def as_json(fields: dict[str, Any]) -> bytes:
    """Encode as compact JSON. Arrays are not made lists first: all updates would wait 40 ms for 15,000 centres."""
    return orjson.dumps(fields, option=orjson.OPT_SERIALIZE_NUMPY)


def as_msgpack(fields: dict[str, Any]) -> bytes:
    """Encode as msgpack."""
    return ormsgpack.packb(fields, option=ormsgpack.OPT_SERIALIZE_NUMPY)


def _voxels(view: MapView, form: Form) -> NDArray[Any]:
    if form == "keys":
        return np.ascontiguousarray(view.keys)
    indices = view.lattice.indices(view.keys)
    if form == "indices":
        return np.ascontiguousarray(indices)
    return np.ascontiguousarray(np.round(view.lattice.centres(indices), CENTRE_DECIMALS))


def _block_counts(blocks: Lattice, seen_by: NDArray[np.uint8]) -> dict[str, Any]:
    flat = seen_by.ravel()
    starts = np.concatenate(([0], np.flatnonzero(np.diff(flat)) + 1))
    runs = np.diff(np.append(starts, flat.size))
    return {**LatticeDescription.of(blocks).model_dump(), "counts": flat[starts].tolist(), "runs": runs.tolist()}
