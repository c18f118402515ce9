# SPDX-License-Identifier: Apache-2.0
"""People who walk on a closed path and sometimes reach out with an arm, as capsules.

Segment lengths are fractions of stature (Winter, Biomechanics and Motor Control of Human Movement).
Limbs swing in the body's own vertical plane: x forward, y left, z up, origin on the floor below the pelvis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from simulation.world.scene import Capsules, Owner

Point = tuple[float, float, float]

THIGH, SHANK, FOOT, HAND = 0.245, 0.246, 0.120, 0.108
TRUNK, NECK, HEAD = 0.288, 0.052, 0.060
UPPER_ARM, FOREARM = 0.186, 0.146
SHOULDER_HALF, HIP_HALF = 0.115, 0.055

STRIDE_M = 1.4
"""Two steps of an adult who walks at about 1 m/s."""

RAMP_S = 0.8
"""Time in which a person stops or starts."""

LEG_SWING_RAD, KNEE_BEND_RAD, ARM_SWING_RAD = 0.42, 0.75, 0.45
REACH_UPPER_RAD, REACH_LOWER_RAD, REACH_LEAN_RAD = 0.35, 1.30, 0.25


@dataclass(frozen=True)
class Loop:
    """A closed path on the floor: two straights of `straight_m`, joined by half circles of `radius_m`.

    It runs counter-clockwise around `centre_m` (2,). Arc length 0 is the middle of the straight to the right of
    `heading_rad`, the direction of walking on that straight.
    """

    centre_m: tuple[float, float]
    heading_rad: float
    straight_m: float
    radius_m: float

    @property
    def length_m(self) -> float:
        """Length of one lap."""
        return 2.0 * self.straight_m + 2.0 * math.pi * self.radius_m

    def at(self, arc_m: float) -> tuple[float, float, float]:
        """Return (x, y) in metres and direction in rad, world frame, at any arc length."""
        half, radius = 0.5 * self.straight_m, self.radius_m
        rest = arc_m % self.length_m
        bend = math.pi * radius
        if rest < half:
            x, y, turn = rest, -radius, 0.0
        elif rest < half + bend:
            turn = (rest - half) / radius
            x, y = half + radius * math.sin(turn), -radius * math.cos(turn)
        elif rest < 3.0 * half + bend:
            x, y, turn = half - (rest - half - bend), radius, math.pi
        elif rest < 3.0 * half + 2.0 * bend:
            turn = math.pi + (rest - 3.0 * half - bend) / radius
            x, y = -half + radius * math.sin(turn), -radius * math.cos(turn)
        else:
            x, y, turn = rest - self.length_m, -radius, 2.0 * math.pi
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return (
            self.centre_m[0] + cos * x - sin * y,
            self.centre_m[1] + sin * x + cos * y,
            self.heading_rad + turn,
        )


@dataclass(frozen=True)
class Person:
    """A person who walks `loop`, and once a lap stops at its arc length 0, turns right and reaches out for `dwell_s`.

    `start_s` is the person's time in the lap at time 0; `floor_m` is the height of the floor; `left_handed` selects the
    arm that reaches.
    """

    loop: Loop
    stature_m: float = 1.75
    speed_m_s: float = 1.0
    dwell_s: float = 4.0
    start_s: float = 0.0
    floor_m: float = 0.0
    left_handed: bool = False

    @property
    def lap_s(self) -> float:
        """Duration of a lap, after which everything repeats."""
        return self._walk_s + self.dwell_s

    @property
    def _walk_s(self) -> float:
        # Starting and stopping cost half a ramp each.
        return self.loop.length_m / self.speed_m_s + RAMP_S

    def motion(self, t_s: float) -> tuple[float, float, float]:
        """Return arc length in metres, vigour of the walk (0 at rest, 1 full speed), and reach (0 to 1)."""
        time_s = (t_s + self.start_s) % self.lap_s
        if time_s >= self._walk_s:
            share = (time_s - self._walk_s) / self.dwell_s if self.dwell_s else 0.0
            return 0.0, 0.0, smooth(share / 0.3) * smooth((1.0 - share) / 0.3)
        left_s = self._walk_s - time_s
        starting = smooth(time_s / RAMP_S)
        stopping = smooth(left_s / RAMP_S)
        braked_s = 0.5 * RAMP_S - left_s + RAMP_S * _smooth_integral(left_s / RAMP_S)
        way_s = RAMP_S * _smooth_integral(time_s / RAMP_S) - braked_s
        return self.speed_m_s * way_s, min(starting, stopping), 0.0

    def capsules(self, t_s: float) -> Capsules:
        """Return the person at `t_s`, world frame, metres."""
        arc_m, vigour, reach = self.motion(t_s)
        x_m, y_m, direction_rad = self.loop.at(arc_m)
        # A whole number of strides a lap, so that the legs do not jump at its start.
        strides = max(round(self.loop.length_m / STRIDE_M), 1)
        gait_rad = 2.0 * math.pi * strides * arc_m / self.loop.length_m
        points = np.array(self._joints(gait_rad, vigour, reach)) * self.stature_m
        points[:, 2] += self.floor_m - float((points[:, 2] - self._radius_m.repeat(2)).min())
        yaw_rad = direction_rad - 0.5 * math.pi * min(1.0, 2.0 * reach)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        world = np.empty_like(points)
        world[:, 0] = x_m + cos * points[:, 0] - sin * points[:, 1]
        world[:, 1] = y_m + sin * points[:, 0] + cos * points[:, 1]
        world[:, 2] = points[:, 2]
        owner = np.full(len(self._radius_m), Owner.PERSON, dtype=np.uint8)
        return Capsules(world[0::2].copy(), world[1::2].copy(), self._radius_m, owner)

    @cached_property
    def _radius_m(self) -> NDArray[np.float64]:
        limbs = (0.026, 0.022, 0.018, 0.043, 0.030, 0.022)
        return self.stature_m * np.array((0.062, 0.083, 0.045, 0.032, 0.055, *limbs, *limbs))

    def _joints(self, gait_rad: float, vigour: float, reach: float) -> list[Point]:
        """Return both ends of each capsule in turn, in statures, body frame, the pelvis at height 0."""
        lean_rad = 0.05 * vigour + REACH_LEAN_RAD * reach
        neck = (TRUNK * math.sin(lean_rad), 0.0, TRUNK * math.cos(lean_rad))
        chin = _from(neck, math.pi - 0.5 * lean_rad, NECK + 0.02)
        crown = _from(chin, math.pi - 0.3 * lean_rad, HEAD)
        points: list[Point] = [
            (0.0, HIP_HALF, 0.0), (0.0, -HIP_HALF, 0.0),
            (0.0, 0.0, 0.03), _from(neck, -lean_rad, 0.05),
            (neck[0], SHOULDER_HALF, neck[2]), (neck[0], -SHOULDER_HALF, neck[2]),
            neck, chin,
            chin, crown,
        ]  # fmt: skip
        for side in (1.0, -1.0):
            reaching = reach if self.left_handed == (side > 0.0) else 0.0
            swing = side * math.sin(gait_rad) * vigour
            shoulder = (neck[0], side * SHOULDER_HALF, neck[2])
            upper = (1.0 - reaching) * -ARM_SWING_RAD * swing + reaching * REACH_UPPER_RAD
            lower = upper + (1.0 - reaching) * (0.15 + 0.2 * vigour) + reaching * (REACH_LOWER_RAD - REACH_UPPER_RAD)
            elbow = _from(shoulder, upper, UPPER_ARM)
            wrist = _from(elbow, lower, FOREARM)
            fingers = _from(wrist, lower, HAND - 0.018)
            hip = (0.0, side * HIP_HALF, 0.0)
            thigh = LEG_SWING_RAD * swing
            # The knee bends while its leg swings forward.
            bend = 0.06 + KNEE_BEND_RAD * vigour * max(0.0, side * math.cos(gait_rad)) ** 2
            knee = _from(hip, thigh, THIGH)
            ankle = _from(knee, thigh - bend, SHANK)
            toes = _from(ankle, thigh - bend + 0.5 * math.pi, FOOT)
            points += [shoulder, elbow, elbow, wrist, wrist, fingers, hip, knee, knee, ankle, ankle, toes]
        return points


def smooth(share: float) -> float:
    """Rise from 0 at 0 to 1 at 1 with a continuous slope; constant beyond."""
    x = min(max(share, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def _smooth_integral(share: float) -> float:
    """Return the integral of `smooth` from 0 to `share` >= 0."""
    x = min(share, 1.0)
    return x * x * x * (1.0 - 0.5 * x) + max(share - 1.0, 0.0)


def _from(point: Point, angle_rad: float, length: float) -> Point:
    """Return the point at `length` from `point`, at `angle_rad` from straight down towards forward."""
    return (point[0] + length * math.sin(angle_rad), point[1], point[2] - length * math.cos(angle_rad))
