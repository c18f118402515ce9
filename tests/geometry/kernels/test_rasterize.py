# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from geometry.kernels.bundles import plain
from geometry.kernels.project import Meshes, Scratch
from geometry.kernels.project import Screen as Projection
from geometry.kernels.rasterize import (
    LANES,
    NOTHING_FARTHEST,
    NOTHING_NEAREST,
    SMALL_ROWS,
    Buffer,
    draw_meshes,
    span_of_row,
)
from shared.meshes import TriangleMesh, box_mesh, sphere_mesh
from shared.transforms import Transform, apply, from_xyz_rpy, look_at

NEAR_M = 0.05
DOUBT_PX = 2e-3
"""The kernel rounds corners to a thousandth of a pixel: this close to an edge it may decide either way."""


@dataclass
class Screen:
    """A camera and its buffers; the width is not a multiple of 8."""

    width: int = 61
    height: int = 43
    f_px: float = 40.0

    def __post_init__(self) -> None:
        self.buffer = Window(self)
        self.rectangles, self.shown = np.zeros((0, 4), np.int32), np.zeros(0, np.bool_)
        self.cx, self.cy = (self.width - 1) / 2.0, (self.height - 1) / 2.0

    @property
    def nearest_w(self) -> NDArray[np.float32]:
        return self.buffer.picture(self.rectangles)[0]

    @property
    def farthest_w(self) -> NDArray[np.float32]:
        """Inverse depth; infinite for pixels without a surface."""
        w = self.buffer.picture(self.rectangles)[1]
        return np.where(w > NOTHING_FARTHEST, -w, np.float32(np.inf))

    @property
    def drawn(self) -> NDArray[np.bool_]:
        return self.nearest_w > 0.0

    def draw(
        self,
        meshes: list[TriangleMesh],
        T_camera_mesh: list[Transform],
        padding_m: float = 0.0,
        offsets: list[NDArray[np.float32]] | None = None,
        chosen: list[bool] | None = None,
        over: Screen | None = None,
        farthest: bool = True,
    ) -> Screen:
        """Draw all meshes, or the `chosen` over the drawing `over` of the others; with `farthest`, both surfaces."""
        vertices = [mesh.vertices for mesh in meshes]
        offsets = offsets or [np.zeros_like(points) for points in vertices]
        nothing = np.zeros((0, 3), np.float32)
        self.rectangles = np.full((len(meshes), 4), 77, np.int32) if over is None else over.rectangles.copy()
        faces = [*(mesh.faces for mesh in meshes), np.zeros((0, 3), np.int32)]
        most_faces = max(map(len, faces))
        mine = np.ones(len(meshes), np.bool_) if chosen is None else np.array(chosen)
        kept = self.buffer if over is None else over.buffer
        self.shown = mine if over is None else np.ones(len(meshes), np.bool_)
        farthest_w = [buffer.memory[1] if farthest else nothing[:, 0] for buffer in (kept, self.buffer)]
        camera = (np.float32(each) for each in (self.f_px, self.f_px, self.cx, self.cy, NEAR_M))
        draw_meshes(
            plain(
                Meshes(
                    np.concatenate([*vertices, nothing]).T.copy(),
                    np.concatenate([*offsets, nothing]).T.copy(),
                    np.concatenate(faces).T.copy(),
                    np.cumsum([0, *(len(points) for points in vertices)]).astype(np.int32),
                    np.cumsum([0, *(len(mesh.faces) for mesh in meshes)]).astype(np.int32),
                    np.array([mesh.closed for mesh in meshes], np.bool_),
                )
            ),
            mine,
            np.zeros_like(mine) if over is None else ~mine,
            np.array(T_camera_mesh, np.float64).reshape(-1, 4, 4),
            np.full(len(meshes), padding_m, np.float32),
            plain(Projection(*camera, self.width, self.height)),
            plain(Buffer(kept.window, kept.memory[0], farthest_w[0])),
            plain(Buffer(self.buffer.window, self.buffer.memory[0], farthest_w[1])),
            self.rectangles,
            plain(
                Scratch(
                    np.empty((6, sum(map(len, vertices))), np.float32),
                    np.empty(len(meshes), np.int32),
                    np.empty(most_faces, np.uint8),
                    np.empty((3, most_faces + 1), np.int32),
                    np.empty((3, 3), np.float32),
                    np.empty((4, 3), np.float64),
                )
            ),
        )
        self.buffer.check()
        return self


class Window:
    """The memory of a window, filled with values that must not be read as a drawing, with a guard after it."""

    STALE = np.float32(np.nan)

    def __init__(self, screen: Screen) -> None:
        self.screen = screen
        self.size = screen.height * (screen.width + LANES) + LANES
        self.memory = np.full(self.size + 100, self.STALE), np.full(self.size + 100, self.STALE)
        self.window = np.full(4, 5, np.int64)

    def check(self) -> None:
        """Assert that nothing was written after the memory, and that the window is inside the image."""
        row, column, rows, stride = self.window.tolist()
        assert all(np.isnan(memory[self.size :]).all() for memory in self.memory)
        assert rows == 0 or 0 <= row < row + rows <= self.screen.height
        assert rows == 0 or 0 <= column < column + stride - LANES <= self.screen.width

    def picture(self, rectangles: NDArray[np.int32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return both buffers as whole images (H, W), empty outside the rectangles."""
        row, column, rows, stride = self.window.tolist()
        shape = (self.screen.height, self.screen.width)
        out = np.full(shape, NOTHING_NEAREST, np.float32), np.full(shape, NOTHING_FARTHEST, np.float32)
        for y in range(row, row + rows):
            first, end = span_of_row(y, rectangles, self.screen.shown, self.screen.shown)
            at = (y - row) * stride - column
            for image, memory in zip(out, self.memory, strict=True):
                image[y, first:end] = memory[at + first : at + end]
        return out


def clipped(triangle: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the triangles (3, 3) that remain of one beyond the near plane."""
    polygon = []
    for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
        if a[2] >= NEAR_M:
            polygon.append(a)
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            polygon.append(a + (NEAR_M - a[2]) / (b[2] - a[2]) * (b - a))
    return [np.array((polygon[0], polygon[i], polygon[i + 1])) for i in range(1, len(polygon) - 1)]


class Twin:
    """The twin in float64, pixel by pixel, by edge functions: lower and upper bounds of the drawing.

    A pixel whose centre lies within DOUBT_PX of an edge *may* be covered by it, one that lies deeper inside *must* be.
    """

    def __init__(self, screen: Screen) -> None:
        self.screen = screen
        shape = screen.nearest_w.shape
        self.nearest_least, self.nearest_most = np.zeros(shape), np.zeros(shape)
        self.farthest_least, self.farthest_most = np.full(shape, np.inf), np.full(shape, np.inf)

    def draw(self, mesh: TriangleMesh, pose: Transform, padding_m: float = 0.0, offsets: object = 0.0) -> None:
        grown = mesh.vertices.astype(np.float64) + padding_m * np.asarray(offsets, np.float64)
        for face in apply(np.asarray(pose, np.float32).astype(np.float64), grown)[mesh.faces]:
            for part in clipped(face):
                self._draw(part, mesh.closed)

    def _draw(self, part: NDArray[np.float64], closed: bool) -> None:
        s = self.screen
        w = 1.0 / part[:, 2]
        p = part[:, :2] * w[:, None] * s.f_px + (s.cx, s.cy)
        area = (p[1, 0] - p[0, 0]) * (p[2, 1] - p[0, 1]) - (p[2, 0] - p[0, 0]) * (p[1, 1] - p[0, 1])
        sliver = abs(area) < DOUBT_PX * np.ptp(p, axis=0).sum()
        near, far = not (closed and area > 0.0), not (closed and area < 0.0)
        y, x = np.mgrid[0 : s.height, 0 : s.width]
        inside = np.full(x.shape, np.inf)
        for i in range(3):
            a, b = p[i], p[(i + 1) % 3]
            length = np.hypot(*(b - a))
            if length > 0.0:
                cross = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
                inside = np.minimum(inside, cross / length * (np.sign(area) or 1.0))
        low, high = p.min(axis=0) - DOUBT_PX, p.max(axis=0) + DOUBT_PX
        near_it = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        may = (inside >= -DOUBT_PX) & near_it
        must = (inside >= DOUBT_PX) & near_it & (not sliver)
        if sliver:
            least, most = np.full(x.shape, w.min()), np.full(x.shape, w.max())
        else:
            per_u, per_v = np.linalg.solve(p[1:] - p[0], w[1:] - w[0])
            value = np.clip(w[0] + (x - p[0, 0]) * per_u + (y - p[0, 1]) * per_v, w.min(), w.max())
            slack = DOUBT_PX * (abs(per_u) + abs(per_v)) + 2e-6 * w.max()
            least, most = value - slack, value + slack
        if near:
            self.nearest_least = np.where(must, np.maximum(self.nearest_least, least), self.nearest_least)
        if near or sliver:
            self.nearest_most = np.where(may, np.maximum(self.nearest_most, most), self.nearest_most)
        if far:
            self.farthest_most = np.where(must, np.minimum(self.farthest_most, most), self.farthest_most)
        if far or sliver:
            self.farthest_least = np.where(may, np.minimum(self.farthest_least, least), self.farthest_least)

    def check(self) -> None:
        s = self.screen
        assert (s.nearest_w >= self.nearest_least).all()
        assert (s.nearest_w <= self.nearest_most).all()
        assert (s.farthest_w >= self.farthest_least).all()
        assert (s.farthest_w <= self.farthest_most).all()


def soup(rng: np.random.Generator, count: int, low: float = -0.2, high: float = 2.0) -> TriangleMesh:
    """Return triangles in front of the camera, across the near plane and behind it, some without an area."""
    middle = np.stack((rng.uniform(-1, 1, count), rng.uniform(-1, 1, count), rng.uniform(low, high, count)), axis=-1)
    corners = middle[:, None, :] + rng.normal(0.0, 0.25, (count, 3, 3))
    corners[::7, 2] = corners[::7, 1]
    corners[3::11, 2] = 2.0 * corners[3::11, 1] - corners[3::11, 0]
    return TriangleMesh("soup", corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), closed=False)


def random_pose(rng: np.random.Generator, distance_m: float) -> Transform:
    return from_xyz_rpy((*rng.uniform(-0.3, 0.3, 2), distance_m), rng.uniform(-np.pi, np.pi, 3))


@pytest.mark.parametrize("seed", range(12))
def test_drawing_equals_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh, pose = soup(rng, 40), from_xyz_rpy(rng.normal(0, 0.1, 3), rng.normal(0, 0.3, 3))
    screen = Screen().draw([mesh], [pose])
    twin = Twin(screen)
    twin.draw(mesh, pose)
    assert screen.drawn.any()
    twin.check()


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("closed", [True, False])
def test_drawing_of_solids_equals_the_twin(seed: int, closed: bool) -> None:
    rng = np.random.default_rng(100 + seed)
    found = (box_mesh("box", (0.3, 0.2, 0.4)), sphere_mesh("ball", 0.2))
    meshes = [TriangleMesh(mesh.name, mesh.vertices, mesh.faces, closed) for mesh in found]
    # The near plane cuts the nearer ones.
    poses = [random_pose(rng, rng.uniform(0.1, 1.0)) for _ in meshes]
    offsets = [rng.normal(0.0, 1.0, mesh.vertices.shape).astype(np.float32) for mesh in meshes]
    screen = Screen().draw(meshes, poses, 0.02, offsets)
    twin = Twin(screen)
    for mesh, pose, offset in zip(meshes, poses, offsets, strict=True):
        twin.draw(mesh, pose, float(np.float32(0.02)), offset)
    twin.check()


def test_corners_on_pixel_centres_and_flat_edges() -> None:
    screen = Screen(f_px=40.0)
    pixels = np.array([[10, 5], [20, 5], [10, 15], [20, 15], [30, 15]], float)
    points = np.column_stack(((pixels - (screen.cx, screen.cy)) / 40.0, np.ones(5)))
    mesh = TriangleMesh("flat", points, np.array([[0, 1, 2], [1, 3, 2], [1, 4, 3]]), closed=False)
    screen.draw([mesh], [np.eye(4)])
    # Rounding in float32 decides which pixels are *on* the outline; inside, seams included, all are drawn.
    y, x = np.mgrid[6:15, 11:30]
    assert screen.drawn[6:15, 11:30][x < y + 15].all()
    assert not screen.drawn[:5].any()
    assert not screen.drawn[16:].any()
    assert not screen.drawn[:, :10].any()
    assert np.allclose(screen.nearest_w[screen.drawn], 1.0, atol=1e-5)


def test_no_mesh_and_meshes_out_of_view() -> None:
    screen = Screen().draw([], [])
    assert not screen.drawn.any()
    ball = sphere_mesh("ball", 0.1)
    beside = [(0, 0, -1.0), (5.0, 0, 1.0), (-5.0, 0, 1.0), (0, 5.0, 1.0), (0, -5.0, 1.0), (0, 0, -0.08)]
    screen.draw([ball] * len(beside), [from_xyz_rpy(xyz, (0, 0, 0)) for xyz in beside])
    assert not screen.drawn.any()
    assert (screen.rectangles[:, 0] > screen.rectangles[:, 1]).all()
    assert (screen.rectangles[:, 2] > screen.rectangles[:, 3]).all()


@pytest.mark.parametrize("seed", range(4))
def test_rectangles_contain_the_drawing_and_clear_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ball = sphere_mesh("ball", 0.2)
    xyz = [(-0.7, 0, 1), (0.75, 0.05, 1), (0, -0.5, 1), (0, 0.55, 1), (*rng.normal(0, 0.1, 2), 0.5), (0, 0, 0.248)]
    for position in xyz:  # at each edge of the image, in its middle, and cut by the near plane
        screen = Screen().draw([ball], [from_xyz_rpy(position, (0, 0, 0))])
        top, bottom, left, right = screen.rectangles[0]
        rows, columns = np.nonzero(screen.drawn)
        assert 0 <= top <= rows.min()
        assert rows.max() <= bottom < screen.height
        assert 0 <= left <= columns.min()
        assert columns.max() <= right < screen.width
        assert (bottom - top) <= np.ptp(rows) + 2
        assert (right - left) <= np.ptp(columns) + 2


def test_drawing_over_a_kept_buffer_equals_drawing_together() -> None:
    """Apart, overlapping, and beyond the image, for any previous content of the memory."""
    ball = sphere_mesh("ball", 0.2)
    for x in ([-0.4, 0.1, 0.4], [0.0, 0.05, 0.1], [-3.0, 0.0, 0.4], [0.4, -3.0, 3.0], [3.0, 3.0, -3.0]):
        poses = [from_xyz_rpy((x[n], 0.1 * n, 1.0 + 0.1 * n), (0, 0, 0)) for n in range(3)]
        together = Screen().draw([ball] * 3, poses)
        for chosen in itertools.product([True, False], repeat=3):
            kept = Screen().draw([ball] * 3, poses, chosen=[not each for each in chosen])
            assert (kept.rectangles[list(chosen)] == 77).all()
            over = Screen().draw([ball] * 3, poses, chosen=list(chosen), over=kept)
            assert (over.nearest_w == together.nearest_w).all()
            assert (over.farthest_w == together.farthest_w).all()
            assert (over.rectangles == together.rectangles).all()


def test_the_span_of_a_row_covers_all_selected_rectangles() -> None:
    rectangles = np.array([[2, 20, 5, 40], [10, 30, 30, 60], [36, 36, 0, 60], [37, -1, 61, -1]], np.int32)
    for chosen, others in itertools.product(itertools.product([True, False], repeat=4), repeat=2):
        for y in (0, 2, 9, 10, 20, 21, 36, 40):
            columns = [
                (left, right + 1)
                for (top, bottom, left, right), mine, other in zip(rectangles.tolist(), chosen, others, strict=True)
                if top <= y <= bottom and (mine or other)
            ]
            wanted = (min(left for left, _ in columns), max(end for _, end in columns)) if columns else (0, 0)
            assert span_of_row(y, rectangles, np.array(chosen), np.array(others)) == wanted


@pytest.mark.parametrize("columns", [LANES, 2 * LANES])
@pytest.mark.parametrize("seed", range(3))
def test_small_wide_and_large_triangles_equal_the_twin(seed: int, columns: int) -> None:
    """At the borders between the three ways, of all shapes and partly beyond the edges of the image."""
    rng = np.random.default_rng(seed)
    screen = Screen(301, 203, 210.0)
    twin = Twin(screen)
    size = np.array((columns, SMALL_ROWS)) * rng.uniform((0.7, 0.0), (1.3, 1.3), (150, 1, 2))
    pixels = rng.uniform((-20, -20), (321, 223), (150, 1, 2)) + size * rng.choice([0.0, 0.5, 1.0], (150, 3, 2))
    pixels[::2] += rng.uniform(-0.5, 0.5, pixels[::2].shape)
    z = rng.uniform(0.5, 2.0, (150, 3, 1))
    points = np.concatenate(((pixels - (screen.cx, screen.cy)) / 210.0 * z, z), axis=-1).reshape(-1, 3)
    mesh = TriangleMesh("wall", points, np.arange(450).reshape(-1, 3), closed=False)
    screen.draw([mesh], [np.eye(4)])
    assert screen.drawn.mean() > 0.05
    twin.draw(mesh, np.eye(4))
    twin.check()


def test_nearest_and_farthest_of_two_surfaces() -> None:
    box = box_mesh("box", (1.0, 1.0, 0.2))
    screen = Screen().draw([box, box], [from_xyz_rpy((0, 0, z), (0, 0, 0)) for z in (1.0, 2.0)])
    middle = (screen.height // 2, screen.width // 2)
    assert screen.nearest_w[middle] == pytest.approx(1 / 0.9)
    assert screen.farthest_w[middle] == pytest.approx(1 / 2.1)


def test_without_the_farthest_the_nearest_is_the_same() -> None:
    """Closed and open, whole and cut by the near plane."""
    ball = sphere_mesh("ball", 0.2)
    meshes = [ball, TriangleMesh("open", ball.vertices, ball.faces, closed=False)] * 2
    poses = [from_xyz_rpy(xyz, (0, 0, 0)) for xyz in ((-0.3, 0, 1), (0.3, 0, 1), (0, 0.3, 0.2), (0, -0.3, 0.2))]
    both, nearest = Screen().draw(meshes, poses), Screen().draw(meshes, poses, farthest=False)
    assert both.drawn.any()
    assert (nearest.nearest_w == both.nearest_w).all()
    assert np.isnan(nearest.buffer.memory[1]).all()


def test_from_within_a_solid_only_its_back_is_seen() -> None:
    screen = Screen().draw([box_mesh("box", (3.0, 3.0, 1.0))], [np.eye(4)])
    assert not screen.drawn.any()
    assert np.allclose(screen.farthest_w, 1 / 0.5)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_a_sphere_has_no_holes(seed: int, closed: bool) -> None:
    """It is convex: each row and column of its image is one piece, and each pixel's depth is the sphere's."""
    rng = np.random.default_rng(seed)
    ball = sphere_mesh("ball", 0.4)
    assert len(ball.faces) > 1000
    ball = TriangleMesh("ball", ball.vertices, ball.faces, closed)
    screen = Screen(301, 203, 210.0).draw([ball], [random_pose(rng, rng.uniform(0.6, 3.0))])
    assert (np.isfinite(screen.farthest_w) == screen.drawn).all()
    assert (screen.farthest_w <= np.where(screen.drawn, screen.nearest_w, np.inf)).all()
    for drawn in (screen.drawn, screen.drawn.T):
        steps = np.diff(np.pad(drawn, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        assert ((steps == 1).sum(axis=1) <= 1).all()


@pytest.mark.parametrize("seed", range(6))
def test_neighbours_leave_no_gap(seed: int) -> None:
    """A wall of crooked triangles, among them slivers, fills the whole image."""
    rng = np.random.default_rng(seed)
    screen = Screen(301, 203, 210.0)
    u, v = np.meshgrid(np.linspace(-10, 310, 40), np.linspace(-10, 212, 31))
    # Half of the corners stay on whole pixels, where edges cross pixel centres.
    shift = rng.normal(0.0, 1.5, (2, *u.shape)) * (rng.random(u.shape) < 0.5)
    u, v = np.round(u) + shift[0], np.round(v) + shift[1]
    z = 1.0 + 0.2 * rng.random(u.shape)
    points = np.stack(((u - screen.cx) / 210.0 * z, (v - screen.cy) / 210.0 * z, z), axis=-1).reshape(-1, 3)
    corner = np.arange(u.size).reshape(u.shape)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    faces = np.concatenate((np.stack((a, b, c), axis=-1), np.stack((b, d, c), axis=-1)))
    assert screen.draw([TriangleMesh("wall", points, faces, closed=False)], [np.eye(4)]).drawn.all()


def test_a_tilted_plane_has_its_analytic_depth() -> None:
    """Depth itself is not linear on the screen: interpolating it would be off by centimetres here."""
    corners = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [-9.0, 9.0, 0.0]])
    plane = TriangleMesh("plane", corners, np.array([[0, 1, 2], [0, 2, 3]]), closed=False)
    T_world_camera = look_at((0.0, -1.0, 0.6), (0.0, 0.5, 0.0))
    screen = Screen(301, 203, 210.0).draw([plane], [np.linalg.inv(T_world_camera)])
    v, u = np.mgrid[0:203, 0:301]
    rays = np.stack(((u - screen.cx) / 210.0, (v - screen.cy) / 210.0, np.ones(u.shape)), axis=-1)
    down = rays @ T_world_camera[2, :3]
    z = np.where(down < -0.1, -T_world_camera[2, 3] / np.where(down < -0.1, down, -1.0), 0.0)
    seen = (z > 0.0) & (z < 5.0)
    assert seen.mean() > 0.5
    assert screen.drawn[seen].all()
    assert np.abs(1.0 / screen.nearest_w[seen] - z[seen]).max() < 1e-4


def floor_grid(rng: np.random.Generator, cells: int) -> TriangleMesh:
    """20 x 20 m, 0.3 m below the camera, of crooked triangles."""
    x, z = np.meshgrid(np.linspace(-20.0, 20.0, cells + 1), np.linspace(-20.0, 20.0, cells + 1))
    inner = np.zeros(x.shape)
    inner[1:-1, 1:-1] = 12.0 / cells
    x, z = x + inner * rng.uniform(-1, 1, x.shape), z + inner * rng.uniform(-1, 1, x.shape)
    points = np.stack((x, np.full_like(x, 0.3), z), axis=-1).reshape(-1, 3)
    corner = np.arange(x.size).reshape(x.shape)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    faces = np.concatenate((np.stack((a, b, c), axis=-1), np.stack((b, d, c), axis=-1)))
    return TriangleMesh("floor", points, faces, closed=False)


@pytest.mark.parametrize("cells", [1, 2, 3, 40, 200])
def test_a_floor_that_runs_beneath_the_camera_is_cut_not_lost(cells: int) -> None:
    """Its diagonals run into the camera: their images are columns and rows of pixels."""
    screen = Screen(301, 203, 100.0).draw([floor_grid(np.random.default_rng(cells), cells)], [np.eye(4)])
    y = np.arange(203)
    z = 0.3 * 100.0 / np.maximum(y - screen.cy, 1e-9)
    below = (z > NEAR_M) & (z < 8.9)
    assert screen.drawn[below].all()
    # In w, which is linear on the screen: the effect of a shift by DOUBT_PX.
    assert np.abs(screen.nearest_w[below] - 1.0 / z[below, None]).max() < DOUBT_PX / (0.3 * 100.0)
    assert not screen.drawn[y < screen.cy].any()


def test_triangles_about_a_point_below_the_camera_leave_no_gap() -> None:
    """All are cut, and each edge between two of them is a column of pixels."""
    screen = Screen(301, 203, 100.0)
    columns = np.arange(-160, 161)
    apex = np.array([[0.0, 0.3, 0.0]])
    rim = np.stack((0.1 * columns, np.full(len(columns), 0.3), np.full(len(columns), 10.0)), axis=-1)
    k = np.arange(1, len(columns))
    faces = np.stack((np.zeros_like(k), k, k + 1), axis=-1)
    screen.draw([TriangleMesh("fan", np.concatenate((apex, rim)), faces, closed=False)], [np.eye(4)])
    assert screen.drawn[105:].all()
