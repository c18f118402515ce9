# SPDX-License-Identifier: Apache-2.0
"""The unit's own configuration; the master sends all else."""

from __future__ import annotations

import logging
import ssl
from ipaddress import IPv4Address, IPv6Address
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, SecretStr, field_validator, model_validator

from edge_unit.sources.image import ImageStream
from edge_unit.sources.realsense.source import RealsenseSourceConfig
from edge_unit.sources.recorded import RecordedSourceConfig, read_pose
from edge_unit.sources.simulated import SimulatedSourceConfig
from edge_unit.tls import normalised, tls_context
from shared.configuration import Text
from shared.errors import ConfigError
from shared.files import default_state_dir
from shared.messages import MAX_TEXT
from shared.text_files import read_text
from shared.transforms import Transform, from_xyz_rpy, rounding_warning, validated

logger = logging.getLogger(__name__)

ENVIRONMENT_PREFIX = "CELLWATCH_UNIT_"

MAX_FPS = 300.0
"""No depth camera delivers more."""


class Configured(BaseModel):
    """Frozen; unknown names are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PoseConfig(Configured):
    """The camera's pose: `xyz` in m with `rpy_deg` (roll, pitch, yaw, fixed axes), a 4x4 `matrix`, or a `file`."""

    xyz: tuple[float, float, float] | None = None
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    matrix: tuple[tuple[float, float, float, float], ...] | None = None
    file: Path | None = Field(default=None, description="Four rows of four numbers.")

    @model_validator(mode="after")
    def _one_of_them(self) -> PoseConfig:
        if sum(given is not None for given in (self.xyz, self.matrix, self.file)) != 1:
            raise ValueError("expected one of xyz (with rpy_deg), matrix, file")
        return self

    def transform(self) -> Transform:
        """Return `T_world_camera`, optical frame.

        Raises:
            ConfigError: the file cannot be read.
            InputError: it is not a rigid transform.
        """
        if self.xyz is not None:
            return from_xyz_rpy(self.xyz, np.radians(self.rpy_deg))
        if self.matrix is not None:
            pose = validated(self.matrix, "T_world_camera.matrix")
            if warning := rounding_warning(self.matrix, pose):
                logger.warning("T_world_camera.matrix: %s", warning)
            return pose
        assert self.file is not None
        return read_pose(self.file)


SourceConfig = Annotated[
    RealsenseSourceConfig | RecordedSourceConfig | SimulatedSourceConfig, Field(discriminator="kind")
]


class UnitConfig(Configured):
    """From a YAML file, `CELLWATCH_UNIT_*` variables and flags. Only `source` has no default."""

    source: SourceConfig
    master_url: str | None = Field(
        default=None, pattern=r"^https?://[^/\s]+/?$", description="The master; absent: the unit searches for it."
    )
    cell: Text | None = Field(
        default=None,
        max_length=MAX_TEXT,
        description="Name of the cell of the wanted master, if several masters are found.",
    )
    master_ca: Path | None = Field(
        default=None, description="Certificates (PEM) of the CA that signed the master's; others are refused."
    )
    master_fingerprint: str | None = Field(
        default=None, description="sha256 of the master's certificate; masters with another one are refused."
    )
    token: SecretStr | None = Field(default=None, description="The units' token itself ...")
    token_file: Path | None = Field(default=None, description="... or the file that holds it.")
    state_dir: Path = Field(
        default_factory=lambda: default_state_dir("edge-unit"), description="For the cell and the learned background."
    )
    jit_cache_dir: Path | None = Field(default=None, description="For compiled kernels.")
    source_address: str | None = Field(default=None, description="Own IP address to connect from.")
    T_world_camera: PoseConfig | None = Field(
        default=None, description="The camera's pose, sent to a master that has none for this unit."
    )
    localise: bool = Field(
        default=True, description="Look for the cell's board while the pose is unknown; else only on command."
    )
    board_stream: ImageStream = Field(default="infrared", description="Stream to find the board in, or color.")
    learn_background_frames: int = Field(
        default=0, ge=0, le=10_000, description="Frames to learn the empty cell from, if it was not learned before."
    )
    fps_max: float | None = Field(default=None, gt=0.0, le=MAX_FPS, description="Frames beyond are dropped.")
    trace_path: Path | None = Field(default=None, description="File for the result of each frame, for evaluation.")

    @field_validator("source_address")
    @classmethod
    def _is_address(cls, value: str | None) -> str | None:
        if value is not None:
            _ = IPv6Address(value) if ":" in value else IPv4Address(value)
        return value

    @field_validator("master_fingerprint")
    @classmethod
    def _is_fingerprint(cls, value: str | None) -> str | None:
        return None if value is None else normalised(value)

    @model_validator(mode="after")
    def _believed_over_tls_only(self) -> UnitConfig:
        if self.checks_master and self.master_url is not None and not self.master_url.startswith("https://"):
            raise ValueError(
                f"master_url: expected https://, since master_ca or master_fingerprint is set, got {self.master_url}"
            )
        return self

    @model_validator(mode="after")
    def _one_token(self) -> UnitConfig:
        if self.token is not None and self.token_file is not None:
            raise ValueError("expected token or token_file, got both")
        return self

    @property
    def checks_master(self) -> bool:
        """True if the token goes to one master only, known by its certificate."""
        return self.master_ca is not None or self.master_fingerprint is not None

    def tls(self) -> ssl.SSLContext | None:
        """Return the TLS settings for the master's certificate; None leaves the check to the CAs of the system.

        Raises:
            ConfigError: `master_ca` cannot be read or holds no certificate.
        """
        return tls_context(self.master_ca, self.master_fingerprint) if self.checks_master else None

    def read_token(self) -> str:
        """Read the units' token, at each call anew, so that it can be replaced while the unit runs.

        Raises:
            ConfigError: no token is configured, or its file cannot be read.
        """
        if self.token is not None:
            where, token = "token", self.token.get_secret_value()
        elif self.token_file is not None:
            where = f"token_file {self.token_file}"
            try:
                token = read_text(self.token_file).strip()
            except (OSError, ValueError) as error:
                raise ConfigError(f"{where}: cannot be read: {error}") from error
        else:
            raise ConfigError("token: expected token or token_file in the configuration, got neither")
        if not token or not token.isascii() or not token.isprintable():
            raise ConfigError(f"{where}: expected a token in one line of plain characters, got something else")
        return token
