# SPDX-License-Identifier: Apache-2.0
"""The command line: `run` watches until stopped, `doctor` checks the unit, and four more commands.

`record-images` makes a recording of images, `joint-delay` estimates the delay of a recording's joints, `board` makes a
PDF of the calibration board, `compile-kernels` compiles the kernels of an image so that boards need not compile.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import platform
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import aclosing
from pathlib import Path
from typing import TYPE_CHECKING

from edge_unit.config import ENVIRONMENT_PREFIX, UnitConfig
from edge_unit.sources.frame import DepthSource
from edge_unit.sources.recorded import RecordedSourceConfig
from edge_unit.sources.simulated import SimulatedSource, SimulatedSourceConfig
from geometry.compilation.cache import folder_beside, settle, settle_for
from geometry.compilation.prebuilt import TARGETS, target_of
from shared.configuration import assignments, load
from shared.errors import CellwatchError, ConfigError
from shared.service import ServiceManager

if TYPE_CHECKING:
    from edge_unit.daemon.unit import Unit
    from edge_unit.source_factory import SourceFactories

logger = logging.getLogger("edge_unit")


def main(arguments: Sequence[str] | None = None, factories: SourceFactories | None = None) -> int:
    """Run the command; an expected failure is one line and exit code 1.

    `factories` replace the product's own for the types of configuration that they name.
    """
    options = _parser().parse_args(arguments)
    options.factories = factories or {}
    logging.basicConfig(level=options.log_level, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # One line for each request would fill the journal.
    logging.getLogger("httpx").setLevel(logging.WARNING)
    logging.getLogger("httpcore").setLevel(logging.WARNING)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except CellwatchError as error:
        print(f"edge-unit: {error}", file=sys.stderr)
        return 1


def _run(options: argparse.Namespace) -> int:
    config = load(UnitConfig, options.config, os.environ, ENVIRONMENT_PREFIX, assignments(options.set))
    config.read_token()
    if config.jit_cache_dir is not None:
        settle(config.jit_cache_dir)
    # Imported only now: kernels choose their cache folder at import.
    from edge_unit.daemon.unit import Unit
    from edge_unit.source_factory import FACTORIES, make_source

    source = make_source(config.source, {**FACTORIES, **options.factories})
    asyncio.run(_run_until_stopped(Unit(config, source)))
    return 0


def _doctor(options: argparse.Namespace) -> int:
    """Print each finding as soon as it is known; returns 1 if any fails."""
    from edge_unit.doctor import Finding, examine

    overrides: dict[str, object] = {**assignments(options.set)}
    if options.config is None and not any(name.startswith(f"{ENVIRONMENT_PREFIX}SOURCE") for name in os.environ):
        overrides = {"source.kind": "realsense", **overrides}
    config = load(UnitConfig, options.config, os.environ, ENVIRONMENT_PREFIX, overrides)

    async def report() -> list[Finding]:
        findings = []
        async for finding in examine(config, options.seconds):
            print(finding, flush=True)
            findings.append(finding)
        return findings

    return int(any(finding.level == "FAIL" for finding in asyncio.run(report())))


def _record_images(options: argparse.Namespace) -> int:
    from edge_unit.sources.realsense.bag_writer import record_images

    images = load(RecordedSourceConfig, None, {}, "", {"folder": options.folder, **assignments(options.set)})
    count = record_images(images, options.recording, options.fps)
    print(f"{options.recording}: {count} frames")
    return 0


def _joint_delay(options: argparse.Namespace) -> int:
    from edge_unit.joints import delay_of_recording
    from shared.cell import Cell

    images = load(RecordedSourceConfig, None, {}, "", {"folder": options.folder, **assignments(options.set)})
    found = delay_of_recording(images, Cell.load(options.cell))
    print(
        f"joint_delay_s: {found.delay_s:.3f}  (standard deviation {1e3 * found.uncertainty_s:.1f} ms, "
        f"{found.looks} frames with motion)"
    )
    return 0


def _board(options: argparse.Namespace) -> int:
    from edge_unit.calibration.board_layout import BoardLayout, require_board
    from edge_unit.calibration.board_pdf import page_of, smallest_page, write_board
    from shared.cell import board_of
    from shared.cell_file import read_cell_file

    # Only the board's part of the file: other files that it names need not be on this computer.
    layout = BoardLayout.of(require_board(board_of(read_cell_file(options.cell))))
    page = page_of(layout, options.page or smallest_page(layout))
    write_board(layout, options.out, page)
    print(f"{options.out}: one page of {page.name}; print it at 100 % and measure the ruler")
    return 0


def _compile_kernels(options: argparse.Namespace) -> int:
    targets = {target.name: target for target in TARGETS}
    target = targets[options.target] if options.target else target_of(platform.machine())
    if target is None or target.machine != platform.machine():
        raise ConfigError(f"--target: kernels are compiled on {platform.machine()} for {platform.machine()} only")
    folder = settle_for(target, options.folder)
    from edge_unit.daemon.warm_up import warm_up_kernels
    from geometry.rendering.hull_store import FOLDER as HULLS

    warm_up_kernels()
    if options.config is not None:
        source = load(UnitConfig, options.config, os.environ, ENVIRONMENT_PREFIX, {}).source
        if isinstance(source, SimulatedSourceConfig):
            asyncio.run(_read_one_frame(SimulatedSource(source)))
    # Hulls belong to a cell and lie beside a unit's own kernels; a release has none.
    shutil.rmtree(folder_beside(HULLS), ignore_errors=True)
    print(f"{folder}: {len(list(folder.rglob('*.nbi')))} kernels for {target.name}")
    return 0


async def _read_one_frame(source: DepthSource) -> None:
    await source.open()
    try:
        async with aclosing(source.frames()) as frames:
            await anext(frames)
    finally:
        await source.close()


async def _run_until_stopped(unit: Unit) -> None:
    """Run to the end, or to a signal, and notify the service manager."""
    task = asyncio.ensure_future(unit.run())
    manager = ServiceManager()

    def stop() -> None:
        manager.stopping()
        task.cancel()

    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop)
    # The service is ready now; the camera and the master may come later.
    manager.ready(unit.status())
    informing = asyncio.ensure_future(manager.follow(unit.status, unit.stuck))
    try:
        await task
    except asyncio.CancelledError:
        logger.info("stopped")
    finally:
        informing.cancel()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="edge-unit", description="The edge unit: one depth camera, one master.")
    levels = ("DEBUG", "INFO", "WARNING", "ERROR")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    variables = f"Every value may also be a variable, as in {ENVIRONMENT_PREFIX}MASTER_URL=http://10.0.0.2:8420."
    run = commands.add_parser("run", help="watch and report until stopped", epilog=variables)
    run.set_defaults(command=_run)
    doctor = commands.add_parser("doctor", help="report missing or wrong parts, with remedies", epilog=variables)
    doctor.set_defaults(command=_doctor)
    doctor.add_argument("--seconds", type=float, default=3.0, help="how long to watch the camera (default 3)")
    for each in (run, doctor):
        each.add_argument("config", type=Path, nargs="?", metavar="CONFIG.YAML", help="the unit's configuration")
    record = commands.add_parser("record-images", help="make a recording for the RealSense SDK from depth images")
    record.set_defaults(command=_record_images)
    record.add_argument("folder", metavar="DIR", help="16-bit PNG or npz images in depth/, with camera_info.yaml")
    record.add_argument("recording", type=Path, metavar="OUT.db3")
    record.add_argument("--fps", type=float, default=15.0, help="its rate, also that of writing it (default 15)")
    delay = commands.add_parser("joint-delay", help="estimate the delay of a recording's joints from its frames")
    delay.set_defaults(command=_joint_delay)
    delay.add_argument(
        "folder",
        metavar="DIR",
        help="as for record-images, with frame_times_s.csv and joint_samples.csv",
    )
    delay.add_argument("--cell", type=Path, required=True, metavar="CELL.YAML", help="the cell with the robot")
    board = commands.add_parser("board", help="the cell's calibration board as a PDF to be printed")
    board.set_defaults(command=_board)
    board.add_argument("--cell", type=Path, required=True, metavar="CELL.YAML", help="the cell that has the board")
    board.add_argument("--out", type=Path, required=True, metavar="BOARD.PDF")
    board.add_argument("--page", help="A4 to A0 (default: the smallest that the board fits on)")
    compiled = commands.add_parser("compile-kernels", help="compiled kernels that boards of one kind can share")
    compiled.set_defaults(command=_compile_kernels)
    compiled.add_argument("folder", type=Path, metavar="DIR")
    compiled.add_argument(
        "config",
        type=Path,
        nargs="?",
        metavar="CONFIG.YAML",
        help="a unit's configuration: those of its simulated camera too",
    )
    names = [target.name for target in TARGETS]
    compiled.add_argument("--target", choices=names, help="kind of processor (default: this computer's)")
    for each in (board, compiled):
        each.add_argument("--log-level", default="WARNING", choices=levels)
    for each in (run, doctor, record, delay):
        each.add_argument(
            "--set", action="append", default=[], metavar="NAME=VALUE", help="one value of the configuration"
        )
    run.add_argument("--log-level", default="INFO", choices=levels)
    doctor.add_argument("--log-level", default="ERROR", choices=levels)
    record.add_argument("--log-level", default="WARNING", choices=levels)
    delay.add_argument("--log-level", default="WARNING", choices=levels)
    return parser


if __name__ == "__main__":
    sys.exit(main())
