# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from geometry.kernels.bundles import plain
from geometry.kernels.reference import MODES, Matching, Modes, Prior, conclude, observe, students_excess

RAW_MAX = 65535
SCALE_M, RANGE_MAX_M, BASE_M, NOISE_PER_M = 0.001, 6.0, 0.03, 0.02
SHARE_MIN, PRIOR_WEIGHT, PRIOR_NOISE_PER_M = 0.15, 4.0, 0.008
Image = NDArray[np.uint16]


class Learner:
    """The kernels with their memory."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.shape = shape
        self.looks = np.zeros(shape, np.uint16)
        self.numbers = np.zeros((*shape, MODES), np.uint16)
        self.means_m = np.zeros((*shape, MODES), np.float32)
        self.squares_m2 = np.zeros((*shape, MODES), np.float32)
        self.modes = plain(Modes(self.looks, self.numbers, self.means_m, self.squares_m2))

    def add(self, depth: Image, near: Image | None = None, span: Image | None = None) -> None:
        near = np.full(self.shape, RAW_MAX, np.uint16) if near is None else near
        span = np.zeros(self.shape, np.uint16) if span is None else span
        observe(depth, near, span, plain(Matching(SCALE_M, RANGE_MAX_M, BASE_M, NOISE_PER_M)), self.modes)

    def conclude(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        out = np.full(self.shape, 7, np.float32), np.full(self.shape, 7, np.float32)
        conclude(self.modes, plain(Prior(SHARE_MIN, PRIOR_WEIGHT, PRIOR_NOISE_PER_M)), *out)
        return out


@dataclass
class PixelTwin:
    """The twin of one pixel, which keeps all depths of each mode."""

    looks: int = 0
    modes: list[list[float]] = field(default_factory=list)

    def add(self, raw: int, near: int, span: int) -> None:
        robot = near < RAW_MAX
        if robot and (raw == 0 or near <= raw <= near + span):
            return
        self.looks += 1
        z = raw * SCALE_M
        if raw == 0 or z > RANGE_MAX_M:
            return
        for mode in self.modes:
            if abs(z - np.mean(mode)) <= BASE_M + NOISE_PER_M * z * z:
                mode.append(z)
                return
        if len(self.modes) < MODES:
            self.modes.append([z])
        else:
            sizes = [len(mode) for mode in self.modes]
            self.modes[sizes.index(min(sizes))] = [z]

    def conclude(self) -> tuple[float, float]:
        credible = [mode for mode in self.modes if len(mode) >= SHARE_MIN * self.looks]
        if not credible:
            return np.nan, np.nan
        best = min(credible, key=lambda mode: float(np.mean(mode)))
        z = float(np.mean(best))
        squares = len(best) * np.var(best) + PRIOR_WEIGHT * (PRIOR_NOISE_PER_M * z * z) ** 2
        freedom = PRIOR_WEIGHT + len(best) - 1
        return z, float(np.sqrt(squares / freedom)) * students_excess(freedom)


@pytest.mark.parametrize("seed", range(4))
def test_learning_equals_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (9, 13)
    learner, twins = Learner(shape), [[PixelTwin() for _ in range(shape[1])] for _ in range(shape[0])]
    # Surfaces are so far apart that no depth is near the limit of a mode; a few pixels have more than fit.
    surfaces = np.sort(rng.choice(np.arange(500, 8000, 1500), (*shape, 3)), axis=-1)
    share = rng.dirichlet((0.7, 0.7, 0.7, 0.4), shape)
    for _ in range(60):
        pick = (rng.random(shape)[..., None] > share.cumsum(axis=-1)).sum(axis=-1)
        depth = np.take_along_axis(surfaces, np.minimum(pick, 2)[..., None], axis=-1)[..., 0]
        depth = (depth + rng.normal(0, 4, shape)).astype(np.uint16)
        depth[pick == 3] = 0
        wild = rng.random(shape) < 0.1
        depth[wild] = rng.choice(np.arange(1200, 6000, 1500), wild.sum())
        robot = rng.random(shape) < 0.3
        near = np.where(robot, rng.integers(400, 3000, shape), RAW_MAX).astype(np.uint16)
        span = np.where(robot, 900, 0).astype(np.uint16)
        learner.add(depth, near, span)
        for index in np.ndindex(shape):
            twins[index[0]][index[1]].add(int(depth[index]), int(near[index]), int(span[index]))
    depth_m, spread_m = learner.conclude()
    wanted = np.array([[pixel.conclude() for pixel in row] for row in twins])
    assert 0.3 < np.isfinite(wanted[..., 0]).mean() <= 1.0
    assert np.allclose(depth_m, wanted[..., 0], atol=1e-4, equal_nan=True)
    assert np.allclose(spread_m, wanted[..., 1], atol=1e-4, equal_nan=True)


def constant(raw: int, shape: tuple[int, int] = (1, 1)) -> Image:
    return np.full(shape, raw, np.uint16)


def test_no_frame_or_only_holes_learn_nothing() -> None:
    learner = Learner((2, 3))
    assert np.isnan(learner.conclude()).all()
    learner.add(constant(0, (2, 3)))
    learner.add(constant(RAW_MAX, (2, 3)))  # 65 m, beyond the range
    assert np.isnan(learner.conclude()).all()


@pytest.mark.parametrize("background", [0, 2500, 7000])
def test_a_passing_person_is_not_learned(background: int) -> None:
    """Also for a pixel whose background gives no measurement, or one beyond the range."""
    learner = Learner((1, 1))
    for frame in range(100):
        learner.add(constant(1200 if 40 <= frame < 50 else background))
    learned = learner.conclude()[0][0, 0]
    assert np.isnan(learned) if background != 2500 else learned == pytest.approx(2.5)


def test_a_person_who_passes_while_the_robot_hides_the_rest_is_not_learned() -> None:
    """The robot covers the pixel most of the time; only looks past it count, and most had no measurement."""
    learner = Learner((1, 1))
    robot = constant(1000), constant(300)
    for frame in range(200):
        if frame < 160:
            learner.add(constant(1100 if frame % 2 else 0), *robot)
        else:
            learner.add(constant(1500 if frame < 165 else 0))
    assert learner.looks[0, 0] == 40
    assert np.isnan(learner.conclude()[0][0, 0])


def test_an_edge_keeps_its_nearer_surface() -> None:
    learner = Learner((1, 1))
    for frame in range(20):
        learner.add(constant(1500 if frame % 5 == 0 else 2500))
    assert learner.conclude()[0][0, 0] == pytest.approx(1.5)


def test_surfaces_seen_past_the_robot_are_learned() -> None:
    """Before and behind its band, and beside it."""
    for raw in (999, 1301, 2000):
        learner = Learner((1, 1))
        learner.add(constant(raw), constant(1000), constant(300))
        assert learner.conclude()[0][0, 0] == pytest.approx(raw / 1000)
    for raw in (0, 1000, 1150, 1300):
        learner = Learner((1, 1))
        learner.add(constant(raw), constant(1000), constant(300))
        assert learner.looks[0, 0] == 0
        assert np.isnan(learner.conclude()[0][0, 0])


def test_few_frames_have_the_cameras_own_spread() -> None:
    learner = Learner((1, 1))
    learner.add(constant(2000))
    assert learner.conclude()[1][0, 0] == pytest.approx(PRIOR_NOISE_PER_M * 4.0 * students_excess(PRIOR_WEIGHT))
    rng = np.random.default_rng(0)
    for _ in range(400):
        learner.add(constant(2000 + round(rng.normal(0.0, 12.0))))
    assert learner.conclude()[1][0, 0] == pytest.approx(0.012, rel=0.1)


@pytest.mark.parametrize("freedom", [9.0, 20.0, 63.0, 1000.0])
def test_few_frames_widen_the_spread_by_students_t(freedom: float) -> None:
    beyond = stats.norm.sf(4.0)
    assert students_excess(freedom) == pytest.approx(stats.t.isf(beyond, freedom) / 4.0, rel=0.1)


def test_a_count_stays_at_its_end() -> None:
    learner = Learner((1, 1))
    learner.looks[:], learner.numbers[:, :, 0], learner.means_m[:, :, 0] = RAW_MAX - 1, RAW_MAX, 2.0
    learner.add(constant(2000))
    assert learner.numbers[0, 0, 0] == RAW_MAX
    assert learner.conclude()[0][0, 0] == pytest.approx(2.0)
