# SPDX-License-Identifier: Apache-2.0
"""The state of a master at start: the configured or the stored one, whichever changed last."""

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
class StartupState:
    """The cell, the settings and their versions; `is_changed` is True if any of them differs from the stored one."""

    cell: Cell
    settings: Settings
    versions: Versions
    cell_file: str
    configured: dict[str, Any]
    is_changed: bool


def startup_state(saved: Saved, cell: Cell, settings: Settings) -> StartupState:
    """Decide between the configured `cell` and `settings` and the stored ones.

    The cell of the file counts if it differs from the cell that was last loaded from a file. Otherwise the stored cell
    counts, which the API may have changed since. The same holds for each field of the settings that the configuration
    sets. A default counts only if nothing was stored.
    """
    configured = settings.model_dump(mode="json", exclude_unset=True)
    cell_file = cell.version
    if saved.versions is None or saved.cell is None:
        return StartupState(cell, settings, Versions(settings=1, lattice=1, cell=1), cell_file, configured, True)
    chosen_cell, cell_changes = _cell(saved, saved.cell, cell)
    chosen_settings, settings_change = _settings(saved, configured)
    # The lattice may change with either. A needless new version costs nothing, since the units register again anyway.
    versions = Versions(
        settings=saved.versions.settings + settings_change,
        lattice=saved.versions.lattice + (cell_changes or settings_change),
        cell=saved.versions.cell + cell_changes,
    )
    is_changed = cell_changes or settings_change or cell_file != saved.cell_file or configured != saved.configured
    return StartupState(chosen_cell, chosen_settings, versions, cell_file, configured, is_changed)


def _cell(saved: Saved, stored: Cell, cell: Cell) -> tuple[Cell, bool]:
    """Return the cell to watch, and True if it differs from the stored one."""
    if cell.version == stored.version:
        return stored, False
    if cell.version == saved.cell_file:
        logger.info("cell %s: the stored one counts, for its file did not change since it was loaded", stored.name)
        return stored, False
    logger.warning("cell %s: its file changed and counts; the stored cell %s is dropped", cell.name, stored.name)
    return cell, True


def _settings(saved: Saved, configured: dict[str, Any]) -> tuple[Settings, bool]:
    """Return the settings at start, and True if they differ from the stored ones."""
    news = {name: value for name, value in configured.items() if saved.configured.get(name) != value}
    fields = {**saved.settings, **news}
    try:
        settings = Settings.model_validate(fields)
    except ValidationError as error:
        # A version with other names or ranges stored them.
        unfit = {str(item["loc"][0]) for item in error.errors() if item["loc"]}
        logger.warning("settings: the stored %s no longer fit; the defaults count", ", ".join(sorted(unfit)))
        settings = Settings.model_validate({name: value for name, value in fields.items() if name not in unfit})
    if news:
        logger.warning("settings: %s changed in the configuration, which counts", ", ".join(sorted(news)))
    different = settings.model_dump(mode="json") != saved.settings
    kept = [name for name, value in configured.items() if getattr(settings, name) != value]
    if kept:
        logger.info("settings: the stored %s count, not the configured values", ", ".join(sorted(kept)))
    return settings, different
