# SPDX-License-Identifier: Apache-2.0
"""Draw the cell: box, CAD, robot, cameras, obstacles and unseen blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from shared.camera import Intrinsics
from shared.cell import Cell, PlacedMesh
from shared.lattice import Lattice
from shared.messages import Matrix, UnitRow

Colour = tuple[int, int, int]

STATE_COLOURS: dict[str, Colour] = {
    "live": (40, 160, 70),
    "stale": (225, 150, 0),
    "blind": (205, 40, 40),
    "moved": (170, 50, 190),
    "uncalibrated": (130, 130, 130),
}

STATIC_COLOUR, OBJECT_COLOUR, ROBOT_COLOUR = (168, 172, 178), (120, 140, 175), (70, 110, 200)
BOX_COLOUR = (60, 60, 60)
UNSEEN_COLOUR = (110, 80, 150)
UNSEEN_OPACITY = 0.16

WITNESS_COLOURS: tuple[Colour, ...] = ((240, 110, 28), (214, 46, 33), (150, 13, 59))
"""Colours of voxels that one unit reports, two, and more: orange, red and crimson."""

UNIT_COLOURS: tuple[Colour, ...] = (
    (240, 110, 28),
    (0, 165, 125),
    (215, 70, 170),
    (235, 200, 40),
    (110, 80, 205),
    (50, 170, 225),
    (140, 80, 40),
    (125, 185, 40),
)
"""Colours of voxels that only one unit reports, by its id; repeated after the last."""

SHARED_COLOUR: Colour = (85, 85, 85)
"""Colour of voxels that several units report, if colours show the unit; also if the unit is unknown."""

VOXEL_SHARE = 0.92
"""Drawn part of a voxel's edge; the gap keeps voxels apart."""

VOXELS_MAX = 20_000
"""Beyond, only every second or third is drawn: browsers of control rooms draw no more in time."""

FRUSTUM_M = 0.18
"""Distance of a camera's pyramid base from the camera."""

FRUSTUM_LINE_M, RANGE_LINE_PX = 0.015, 1.5

RANGE_SHADE = 0.55
"""Share of a camera's state colour in the lines of its range; the rest is white."""

BOX_EDGES = np.array(
    [(a, b) for a in range(8) for b in range(8) if a < b and bin(a ^ b).count("1") == 1], dtype=np.int64
)
"""Pairs of corners, numbered by their bits."""

QUAD = np.array([(0, 1, 2), (0, 2, 3)], np.uint32)
NO_TURN = np.array([1.0, 0.0, 0.0, 0.0], np.float32)

VIEW_FROM = np.array([0.98, 0.6, 0.66])
"""Position of the initial view, in diagonals of the box, from its middle."""

VIEW_FOV_RAD = 0.8
"""Vertical field of view of the browser's camera."""

Points: TypeAlias = NDArray[np.float32]


PYRAMID = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])
"""Edges of a view: from the camera's centre, which is corner 0, to the image's corners, and between these."""


def linear(colours: Sequence[Colour]) -> NDArray[np.uint8]:
    """Convert screen colours (N, 3) to linear light, which viser expects for batches of meshes."""
    share = np.asarray(colours, np.float64) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.rint(light * 255.0).astype(np.uint8)


def unit_colour(unit_id: int) -> Colour:
    """Return the colour of voxels that only this unit reports."""
    return UNIT_COLOURS[(unit_id - 1) % len(UNIT_COLOURS)]


def owners(keys: NDArray[np.uint32], reports: Mapping[int, NDArray[np.uint32]]) -> NDArray[np.int64]:
    """Return the id of the only unit that reports each of the `keys` (N,); 0 if none or several do."""
    found = np.zeros(len(keys), np.int64)
    counts = np.zeros(len(keys), np.int64)
    for unit_id, reported in reports.items():
        is_theirs = np.isin(keys, reported, assume_unique=True)
        found[is_theirs] = unit_id
        counts += is_theirs
    return np.where(counts == 1, found, 0)


def view_edges(intrinsics: Intrinsics, depth_m: float) -> Points:
    """Return a camera's view down to `depth_m`, as line segments (8, 2, 3) in its own frame."""
    right, bottom = intrinsics.width - 0.5, intrinsics.height - 0.5
    corners = np.array([(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)])
    rays = (corners - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy)
    points = np.vstack((np.zeros(3), np.column_stack((rays, np.ones(4))) * depth_m))
    return np.asarray(points[PYRAMID], np.float32)


def wxyz_of(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation of a transform (4, 4) as viser's quaternion."""
    return np.asarray(SO3.from_matrix(np.asarray(T, np.float64)[:3, :3]).wxyz)


def cube(edge_m: float) -> tuple[Points, NDArray[np.uint32]]:
    """Return vertices (8, 3) and faces (12, 3) about the origin."""
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - 0.5
    faces = [
        *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
        *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
    ]
    return corners * np.float32(edge_m), np.array(faces, np.uint32)


def surface(inside: NDArray[np.bool_], lattice: Lattice) -> tuple[Points, NDArray[np.uint32]]:
    """Return the faces between blocks `inside` (the lattice's shape) and all other blocks, as (V, 3) and (F, 3)."""
    padded = np.pad(inside, 1)
    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for step in (0, 1):
            beside = np.roll(padded, 1 - 2 * step, axis)
            at = np.argwhere((padded & ~beside)[1:-1, 1:-1, 1:-1])
            corners = np.repeat(at[:, None, :], 4, axis=1)
            corners[:, :, axis] += step
            for number, (du, dv) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
                corners[:, number, u] += du
                corners[:, number, v] += dv
            quads.append(corners)
    corners = np.concatenate(quads).reshape(-1, 3)
    points = np.asarray(lattice.origin_m) + corners * lattice.voxel_size_m
    faces = (np.arange(len(corners) // 4)[:, None, None] * 4 + QUAD).reshape(-1, 3)
    return points.astype(np.float32), faces.astype(np.uint32)


def view_of(
    box_min_m: NDArray[np.float64], box_max_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the initial camera position and its target: from a corner and above, with the whole box in view."""
    middle, size = (box_min_m + box_max_m) / 2.0, box_max_m - box_min_m
    return middle + VIEW_FROM * float(np.linalg.norm(size)), middle - (0.0, 0.0, 0.05 * size[2])


class Scene:
    """The objects that all browsers see alike; used by one thread at a time."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._cell: Cell | None = None
        self._parts: list[Any] = []
        self._links: list[Any] = []
        self._cameras: dict[int, tuple[Any, ...]] = {}
        self._drawn_rows: dict[int, tuple[object, ...]] = {}
        self._joints: tuple[float, ...] | None = None
        server.scene.set_up_direction("+z")

    def set_cell(self, cell: Cell) -> None:
        """Draw another cell."""
        scene = self._server.scene
        for part in (*self._parts, *self._links):
            part.remove()
        self._cell, self._joints = cell, None
        low, high = cell.box_min_m, cell.box_max_m
        bits = np.array([[number >> axis & 1 for axis in range(3)] for number in range(8)])
        corners = np.where(bits, high, low).astype(np.float32)
        middle, size = (low + high) / 2.0, high - low
        self._parts = [
            scene.add_line_segments("/cell/box", corners[BOX_EDGES], BOX_COLOUR, thickness=0.012),
            scene.add_grid(
                "/cell/floor",
                float(size[0]),
                float(size[1]),
                position=(float(middle[0]), float(middle[1]), float(low[2])),
                cell_size=0.25,
                section_size=1.0,
            ),
            *(self._body(f"/cell/static/{i}", body, STATIC_COLOUR) for i, body in enumerate(cell.static)),
            *(self._body(f"/cell/objects/{i}", body, OBJECT_COLOUR) for i, body in enumerate(cell.objects)),
        ]
        self._links = [
            scene.add_mesh_simple(
                f"/robot/{i}",
                link.mesh.vertices,
                link.mesh.faces.astype(np.uint32),
                color=ROBOT_COLOUR,
                flat_shading=True,
                visible=False,
            )
            for i, link in enumerate(cell.robot.links if cell.robot else ())
        ]
        eye, target = view_of(low, high)
        self._server.initial_camera.position = eye
        self._server.initial_camera.look_at = target
        self._server.initial_camera.fov = VIEW_FOV_RAD

    def set_joints(self, positions: tuple[float, ...] | None) -> None:
        """Set the robot's joints; without positions the robot is hidden."""
        if self._cell is None or self._cell.robot is None or positions == self._joints:
            return
        self._joints = positions
        if positions is None or len(positions) != self._cell.robot.joint_count:
            for link in self._links:
                link.visible = False
            return
        poses = self._cell.robot.link_poses(np.asarray(positions))
        with self._server.atomic():
            for link, pose in zip(self._links, poses, strict=True):
                link.wxyz = wxyz_of(pose)
                link.position = pose[:3, 3]
                link.visible = True

    def set_units(self, rows: Sequence[UnitRow]) -> None:
        """Draw a pyramid for each unit with a known pose, in the colour of its state."""
        posed = {row.id: row for row in rows if row.T_world_camera is not None}
        for unit_id in self._cameras.keys() - posed.keys():
            for part in self._cameras.pop(unit_id):
                part.remove()
            self._drawn_rows.pop(unit_id, None)
        for unit_id, row in posed.items():
            shape = (row.state, row.T_world_camera, row.intrinsics)
            if self._drawn_rows.get(unit_id) != shape:
                self._drawn_rows[unit_id] = shape
                self._draw_camera(unit_id, row)

    def _body(self, name: str, body: PlacedMesh, colour: Colour) -> Any:
        return self._server.scene.add_mesh_simple(
            name,
            body.mesh.vertices,
            body.mesh.faces.astype(np.uint32),
            color=colour,
            flat_shading=True,
            side="double",
            wxyz=wxyz_of(body.T_world_mesh),
            position=body.T_world_mesh[:3, 3],
        )

    def _draw_camera(self, unit_id: int, row: UnitRow) -> None:
        pose = np.asarray(row.T_world_camera)
        state = row.state
        for part in self._cameras.pop(unit_id, ()):
            part.remove()
        text = f"{unit_id}" if state == "live" else f"{unit_id} {state}"
        label = self._server.scene.add_label(
            f"/labels/{unit_id}", text, position=pose[:3, 3] + (0.0, 0.0, 0.15), anchor="bottom-center"
        )
        if row.intrinsics is None:
            # A recording from before intrinsics were stored: the position is known, the view is not.
            self._cameras[unit_id] = (label,)
            return
        pyramid = self._server.scene.add_line_segments(
            f"/cameras/{unit_id}",
            view_edges(row.intrinsics, FRUSTUM_M),
            state_colour(state),
            thickness=FRUSTUM_LINE_M,
            wxyz=wxyz_of(pose),
            position=pose[:3, 3],
        )
        self._cameras[unit_id] = (pyramid, label)


@dataclass(frozen=True, eq=False)
class Voxels:
    """Obstacles at one time, as drawn: at most `VOXELS_MAX` of them."""

    size_m: float
    centres: Points
    witnesses: NDArray[np.uint8]
    owners: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        lattice: Lattice,
        keys: NDArray[np.uint32],
        witnesses: NDArray[np.uint8],
        reports: Mapping[int, NDArray[np.uint32]],
    ) -> Voxels:
        """Return the voxels of a map; `reports` are the units' own keys, by their id."""
        stride = -(-max(len(keys), 1) // VOXELS_MAX)
        keys = keys[::stride]
        centres = lattice.centres(lattice.indices(keys)).astype(np.float32)
        return cls(lattice.voxel_size_m, centres, witnesses[::stride], owners(keys, reports))

    def colours(self, by_unit: bool) -> NDArray[np.uint8]:
        """Return (N, 3) colours for viser: by the number of units that report a voxel, or by the single unit."""
        if not by_unit:
            return linear(WITNESS_COLOURS)[np.clip(self.witnesses.astype(np.int64) - 1, 0, len(WITNESS_COLOURS) - 1)]
        found = np.tile(linear([SHARED_COLOUR]), (len(self.owners), 1))
        for unit_id in np.unique(self.owners[self.owners > 0]).tolist():
            found[self.owners == unit_id] = linear([unit_colour(unit_id)])
        return found


class VoxelLayer:
    """Obstacles in the colours that one browser has chosen."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._part: Any = None
        self._drawn: tuple[Voxels, bool] | None = None

    def show(self, voxels: Voxels, by_unit: bool) -> None:
        """Draw them."""
        if self._drawn == (voxels, by_unit):
            return
        before, self._drawn = self._drawn, (voxels, by_unit)
        turns = np.tile(NO_TURN, (len(voxels.centres), 1))
        colours = voxels.colours(by_unit)
        if before is None or before[0].size_m != voxels.size_m:
            vertices, faces = cube(voxels.size_m * VOXEL_SHARE)
            self._part = self._client.scene.add_batched_meshes_simple(
                "/obstacles",
                vertices,
                faces,
                batched_wxyzs=turns,
                batched_positions=voxels.centres,
                batched_colors=colours,
                lod="off",
                flat_shading=True,
                cast_shadow=False,
                receive_shadow=False,
            )
            return
        with self._client.atomic():
            self._part.batched_wxyzs = turns
            self._part.batched_positions = voxels.centres
            self._part.batched_colors = colours


class RangeLayer:
    """The present range of each live camera, for a browser that has switched it on."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._parts: dict[int, Any] = {}
        self._drawn: dict[int, tuple[object, ...]] = {}

    def show(self, rows: Sequence[UnitRow]) -> None:
        """Draw the view of each camera, down to the farthest block that it sees."""
        known = {row.id: _range_of(row) for row in rows if row.state == "live"}
        shown = {unit_id: drawn for unit_id, drawn in known.items() if drawn is not None}
        for unit_id in self._parts.keys() - shown.keys():
            self._parts.pop(unit_id).remove()
            del self._drawn[unit_id]
        for unit_id, drawn in shown.items():
            if self._drawn.get(unit_id) == drawn:
                continue
            self._drawn[unit_id] = drawn
            range_m, T_world_camera, intrinsics = drawn
            pose = np.asarray(T_world_camera)
            shade = RANGE_SHADE * np.array(STATE_COLOURS["live"]) + (1.0 - RANGE_SHADE) * 255.0
            # A node of the same name replaces the old one.
            self._parts[unit_id] = self._client.scene.add_line_segments(
                f"/ranges/{unit_id}",
                view_edges(intrinsics, range_m),
                shade.astype(np.uint8),
                thickness=RANGE_LINE_PX,
                thickness_units="screen",
                wxyz=wxyz_of(pose),
                position=pose[:3, 3],
            )

    def hide(self) -> None:
        """Hide the ranges."""
        self.show([])


def state_colour(state: str) -> Colour:
    """The colour of a unit's state; a state of a later minor is not live, and has the colour of a blind one."""
    return STATE_COLOURS.get(state, STATE_COLOURS["blind"])


def _range_of(row: UnitRow) -> tuple[float, Matrix, Intrinsics] | None:
    """Return a camera's range, pose and intrinsics; None while any of them is unknown."""
    if row.range_m is None or row.T_world_camera is None or row.intrinsics is None:
        return None
    return row.range_m, row.T_world_camera, row.intrinsics


class UnseenLayer:
    """The unseen blocks, for a browser that has switched them on."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._part: Any = None
        self._drawn = b""

    def show(self, seen_bits: bytes, blocks: Lattice) -> None:
        """Draw the blocks; `seen_bits` has one bit per block."""
        if seen_bits == self._drawn:
            return
        self._drawn = seen_bits
        count = blocks.cell_count
        seen = np.unpackbits(np.frombuffer(seen_bits, np.uint8), count=count).astype(np.bool_).reshape(blocks.shape)
        vertices, faces = surface(~seen, blocks)
        self._take_out()
        if len(faces):
            self._part = self._client.scene.add_mesh_simple(
                "/unseen",
                vertices,
                faces,
                color=UNSEEN_COLOUR,
                opacity=UNSEEN_OPACITY,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )

    def hide(self) -> None:
        """Hide the blocks."""
        self._drawn = b""
        self._take_out()

    def _take_out(self) -> None:
        """Remove the drawn node."""
        if self._part is not None:
            self._part.remove()
            self._part = None
