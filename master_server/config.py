# SPDX-License-Identifier: Apache-2.0
"""The master's own configuration; what may change while it runs is in `shared.settings`."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, model_validator

from master_server.logs import LogFormat, LogLevel
from master_server.recording.recorder import RecordingConfig
from master_server.recording.replay import SPEED_MAX, SPEED_MIN
from shared.files import default_state_dir
from shared.settings import Settings

ENVIRONMENT_PREFIX = "CELLWATCH_MASTER_"

DEFAULT_PORT = 8420


class ServerConfig(BaseModel):
    """Where to listen, and whom to let in. Frozen; from a YAML file, `CELLWATCH_MASTER_*` variables and flags."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = Field(default="0.0.0.0", description="Address to listen at.")
    port: int = Field(default=DEFAULT_PORT, ge=0, le=65535, description="0 takes a free one.")
    tls_certificate: Path | None = Field(default=None, description="PEM; with it and its key the master speaks TLS.")
    tls_key: Path | None = Field(default=None, description="Of the certificate, in PEM, without a password.")
    state_dir: Path = Field(
        default_factory=lambda: default_state_dir("master"),
        description="Where tokens and all that outlives the master are kept.",
    )
    public_reads: bool = Field(default=False, description="Whether reading needs no token.")
    log_level: LogLevel = Field(default="INFO", description="The least that is logged.")
    log_format: LogFormat = Field(default="text", description="Lines for people, or JSON for a collector.")
    viewer: bool = Field(default=True, description="Whether operators find the cell drawn under `/viewer/`.")
    unit_actions: dict[str, str] = Field(
        default={},
        max_length=8,
        description="What else an operator can do to a unit in the viewer: what the button says, and the address that "
        "is posted to, with {id}, {ip} and {serial} of the unit.",
    )
    ready_file: Path | None = Field(
        default=None, description="Written as JSON (url, port, pid, token files) when the master can be asked."
    )

    @model_validator(mode="after")
    def _certificate_with_its_key(self) -> ServerConfig:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("expected tls_certificate and tls_key, got one of them")
        return self


class MasterConfig(ServerConfig):
    """Of a master. Only `cell` has no default."""

    cell: Path = Field(description="The cell's `cell.yaml`.")
    settings: Settings = Field(default=Settings(), description="What the master starts with.")
    announce: bool | None = Field(
        default=None, description="Whether to tell units by multicast DNS where it listens; not told: beyond loopback."
    )
    recording: RecordingConfig = Field(default=RecordingConfig(), description="What is recorded, and how much is kept.")


class ReplayConfig(ServerConfig):
    """Of a recording that is served in place of a master."""

    files: tuple[Path, ...] = Field(min_length=1, description="The files of one recording, in any order.")
    speed: float = Field(default=1.0, ge=SPEED_MIN, le=SPEED_MAX, description="Of the replay, 1 as it was.")
    start_s: float = Field(default=0.0, ge=0.0, description="Where in the recording it begins.")
    loop: bool = Field(default=False, description="Whether it begins anew at its end.")
