# SPDX-License-Identifier: Apache-2.0
"""Settings that an operator may change at run time; every field has a range and a default.

One set of defaults serves every cell, camera and resolution. Figures that depend on the camera (noise, pixels) are
derived from the camera's own intrinsics.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

DensityModel = Literal["pinhole", "angular"]
DensityRule = Literal["neighbourhood", "single"]


class FilterSettings(BaseModel):
    """Settings by which a unit detects obstacles. Frozen; unknown names are rejected."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    voxel_size_m: float = Field(default=0.05, ge=0.01, le=0.10, description="Edge of a voxel in metres.")
    occupancy_threshold: float = Field(
        default=0.6,
        ge=0.05,
        le=2.0,
        description="Required share of the points of one full voxel at its distance; fewer are noise.",
    )
    density_model: DensityModel = Field(
        default="pinhole", description="Model of the full count: pinhole, or the paper's angular average."
    )
    density_rule: DensityRule = Field(
        default="neighbourhood",
        description="Points counted: those of the 27 voxels around, or (the paper) of each voxel alone.",
    )
    own_share_min: float = Field(
        default=0.05, ge=0.0, le=1.0, description="Share that a voxel must hold by itself under the neighbourhood rule."
    )
    support_area_max_m2: float = Field(
        default=0.0025,
        ge=1e-4,
        le=0.01,
        description="Most surface (m2) ever required, so that thin objects survive large voxels.",
    )
    support_points_min: int = Field(
        default=32,
        ge=0,
        le=10_000,
        description="Fewest points ever required, half a window of stereo matching: far away, or at a low "
        "resolution, one wrong match fills a voxel. Three full voxels are always enough.",
    )
    margin_base_m: float = Field(
        default=0.03, ge=0.0, le=0.5, description="Constant part of the margin before CAD surfaces, in metres."
    )
    margin_noise_gain: float = Field(
        default=4.75, ge=0.0, le=20.0, description="Standard deviations of stereo noise in the margin before CAD."
    )
    stereo_subpixel_px: float = Field(
        default=0.12, ge=0.01, le=1.0, description="Standard deviation of the camera's disparity, in pixels."
    )
    reference_margin_base_m: float = Field(
        default=0.03, ge=0.0, le=0.5, description="Constant part of the margin before learned surfaces, in metres."
    )
    reference_spread_gain: float = Field(
        default=3.25, ge=0.0, le=20.0, description="Standard deviations of a learned pixel in its margin."
    )
    edge_radius_px: int = Field(
        default=6,
        ge=0,
        le=15,
        description="Radius of the minimum over static limits (pixels at a width of 1280, scaled to the camera).",
    )
    static_padding_m: float = Field(
        default=0.05,
        ge=0.0,
        le=0.3,
        description="Padding of CAD surfaces at their edges, where the camera still measures their depth, in metres.",
    )
    robot_padding_m: float = Field(default=0.05, ge=0.0, le=0.3, description="Padding of the robot's links, in metres.")
    robot_depth_m: float = Field(
        default=0.15,
        ge=0.0,
        le=1.0,
        description="Points farther than this behind the robot's surface are not the robot, in metres.",
    )
    range_min_m: float = Field(default=0.0, ge=0.0, le=5.0, description="Nearer measurements are ignored, in metres.")
    range_max_m: float = Field(
        default=10.0, ge=0.5, le=60.0, description="Farther measurements are ignored, in metres."
    )
    seen_block_size_m: float = Field(
        default=0.10, ge=0.05, le=1.0, description="Edge of the blocks of a unit's seen report, in metres."
    )
    seen_share_min: float = Field(
        default=0.9, ge=0.5, le=1.0, description="Share of a block's rays that must pass through it for it to be seen."
    )

    @field_validator("range_max_m")
    @classmethod
    def _range_not_empty(cls, range_max_m: float, info: ValidationInfo) -> float:
        # An empty range would leave no measurement: every unit would be live with an empty view.
        if range_max_m <= (range_min_m := info.data.get("range_min_m", 0.0)):
            raise ValueError(f"expected more than range_min_m, {range_min_m:g}")
        return range_max_m


class Settings(FilterSettings):
    """All fields of `PUT /settings`: the filter's, and the ages at which a view or joints are stale."""

    stale_after_s: float = Field(
        default=0.5, ge=0.05, le=60.0, description="Age of its last view above which a unit is stale, in seconds."
    )
    robot_stale_after_s: float = Field(
        default=0.5,
        ge=0.02,
        le=60.0,
        description="Age above which joint positions are stale and the robot is not filtered, in seconds.",
    )
    joint_delay_s: float = Field(
        default=0.0,
        ge=-0.2,
        le=0.2,
        description="Delay of the joints' times, in seconds: joint time less the moment at which the robot had these "
        "positions. For joints without a time, their transport time. `edge-unit joint-delay` measures it.",
    )
