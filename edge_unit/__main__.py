# SPDX-License-Identifier: Apache-2.0
"""`edge-unit run CONFIG.YAML`: watch with one camera until told to stop."""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import signal
import sys
from collections.abc import Coroutine, Sequence
from pathlib import Path

from edge_unit.config import ENVIRONMENT_PREFIX, UnitConfig
from edge_unit.jit_cache import settle
from shared.configuration import assignments, load
from shared.errors import CellwatchError

logger = logging.getLogger("edge_unit")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; what can be expected to go wrong is one line and exit code 1."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(level=options.log_level, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # One line for each request would fill the journal.
    logging.getLogger("httpx").setLevel(logging.WARNING)
    logging.getLogger("httpcore").setLevel(logging.WARNING)
    try:
        config = load(UnitConfig, options.config, os.environ, ENVIRONMENT_PREFIX, assignments(options.set))
        config.read_token()
        if config.jit_cache_dir is not None:
            settle(config.jit_cache_dir)
        # Imported only now, for kernels settle where they are kept when they are imported.
        from edge_unit.unit import Unit, make_source

        asyncio.run(_until_told_to_stop(Unit(config, make_source(config.source)).run()))
    except CellwatchError as error:
        print(f"edge-unit: {error}", file=sys.stderr)
        return 1
    return 0


async def _until_told_to_stop(work: Coroutine[None, None, None]) -> None:
    """Run to the end, or to a signal."""
    task = asyncio.ensure_future(work)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    try:
        await task
    except asyncio.CancelledError:
        logger.info("stopped")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="edge-unit", description="The edge unit: one depth camera, one master.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = commands.add_parser(
        "run",
        help="watch and report until told to stop",
        epilog=f"Every value may also be a variable, as in {ENVIRONMENT_PREFIX}MASTER_URL=http://10.0.0.2:8420.",
    )
    run.add_argument("config", type=Path, nargs="?", metavar="CONFIG.YAML", help="the unit's configuration")
    run.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="one value of it, as in source.fps=15"
    )
    run.add_argument("--log-level", default="INFO", choices=("DEBUG", "INFO", "WARNING", "ERROR"))
    return parser


if __name__ == "__main__":
    sys.exit(main())
