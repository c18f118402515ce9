# SPDX-License-Identifier: Apache-2.0
"""What a master begins with: its configuration or what was stored, whichever was changed last."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from master_server.persistence.store import Saved
from shared.cell import Cell
from shared.messages import Versions
from shared.settings import Settings

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Beginning:
    """The cell, the settings and their versions; `is_news` when any of it is not what is stored."""

    cell: Cell
    settings: Settings
    versions: Versions
    cell_file: str
    configured: dict[str, Any]
    is_news: bool


def beginning(saved: Saved, cell: Cell, settings: Settings) -> Beginning:
    """Decide between `cell` and `settings` as configured and those that were stored.

    The cell of the file counts when it is another than was last loaded from a file; else the stored one, which may
    have been changed by the API since. It is the same with each field of the settings that the configuration sets;
    a default counts only where nothing was stored.
    """
    configured = settings.model_dump(mode="json", exclude_unset=True)
    cell_file = cell.version
    if saved.versions is None or saved.cell is None:
        return Beginning(cell, settings, Versions(settings=1, lattice=1, cell=1), cell_file, configured, True)
    chosen_cell, cell_changes = _cell(saved, saved.cell, cell)
    chosen_settings, settings_change = _settings(saved, configured)
    # A lattice may follow from either; one version too many costs nothing, since units register again anyway.
    versions = Versions(
        settings=saved.versions.settings + settings_change,
        lattice=saved.versions.lattice + (cell_changes or settings_change),
        cell=saved.versions.cell + cell_changes,
    )
    is_news = cell_changes or settings_change or cell_file != saved.cell_file or configured != saved.configured
    return Beginning(chosen_cell, chosen_settings, versions, cell_file, configured, is_news)


def _cell(saved: Saved, stored: Cell, cell: Cell) -> tuple[Cell, bool]:
    """The cell to watch, and whether it is another than was watched before."""
    if cell.version == stored.version:
        return stored, False
    if cell.version == saved.cell_file:
        logger.info("cell %s: as it was changed since its file was loaded; the file did not change", stored.name)
        return stored, False
    logger.warning(
        "cell %s: its file changed and counts; what was stored of cell %s is dropped", cell.name, stored.name
    )
    return cell, True


def _settings(saved: Saved, configured: dict[str, Any]) -> tuple[Settings, bool]:
    """The settings to begin with, and whether they are others than before."""
    news = {name: value for name, value in configured.items() if saved.configured.get(name) != value}
    fields = {**saved.settings, **news}
    try:
        settings = Settings.model_validate(fields)
    except ValidationError as error:
        # Stored by a version with other names or ranges.
        unfit = {str(item["loc"][0]) for item in error.errors() if item["loc"]}
        logger.warning("settings: %s as stored do not fit any more, the defaults count", ", ".join(sorted(unfit)))
        settings = Settings.model_validate({name: value for name, value in fields.items() if name not in unfit})
    if news:
        logger.warning("settings: changed in the configuration, which counts: %s", ", ".join(sorted(news)))
    different = settings.model_dump(mode="json") != saved.settings
    kept = [name for name, value in configured.items() if getattr(settings, name) != value]
    if kept:
        logger.info("settings: as they were changed since, not as configured: %s", ", ".join(sorted(kept)))
    return settings, different
