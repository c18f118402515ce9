# SPDX-License-Identifier: Apache-2.0
"""The background while a unit runs: found on disk, learned from frames of the empty cell, dropped when asked."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_unit.daemon.background_store import BackgroundStore, Place
from edge_unit.joints import JointEstimate
from edge_unit.pipeline import BackgroundLearner, DepthPipeline
from edge_unit.uplink.assignment import Trouble
from shared.messages import DONE, Command, Outcome, Progress

logger = logging.getLogger(__name__)

LEARN_FRAMES = 60
"""Frames of the empty cell when an operator asks and the configuration names no number: four seconds at 15 fps."""

POSE_CHANGED = "the camera's pose changed meanwhile"


@dataclass
class _Lesson:
    """A background that is being learned."""

    learner: BackgroundLearner
    frames: int
    command: Command | None


class BackgroundLearning:
    """What one unit has learned of its cell, and what it is learning."""

    def __init__(self, store: BackgroundStore, frames: int | None, finish: Callable[[Command, Outcome], None]) -> None:
        """`frames` are learned wherever nothing was learned before; None: only when asked for.

        `finish` is told what became of a command.
        """
        self._store = store
        self._frames = frames
        self._finish = finish
        self._lesson: _Lesson | None = None

    @property
    def progress(self) -> tuple[int, int] | None:
        """Frames learned, and how many it is to be; None while nothing is being learned."""
        lesson = self._lesson
        return None if lesson is None else (lesson.learner.frames, lesson.frames)

    def find(self, pipeline: DepthPipeline, place: Place) -> None:
        """Use what was learned at this place before, or else begin to learn if the configuration says so."""
        self.end(Outcome("superseded", POSE_CHANGED))
        stored = self._store.load(place)
        if stored is not None:
            logger.info("using the background learned before, from %d frames", stored.frames)
            pipeline.use(stored)
        elif self._frames:
            self._lesson = _Lesson(pipeline.learner(), self._frames, None)

    def keep(self, pipeline: DepthPipeline, place: Place) -> None:
        """What was learned belongs to this place from now on."""
        if pipeline.reference is not None:
            self._store.save(place, pipeline.reference)

    def begin(self, pipeline: DepthPipeline, command: Command) -> None:
        """Learn anew, as `command` asks."""
        self.end(Outcome("superseded", "it was asked to begin anew"))
        pipeline.use(None)
        self._lesson = _Lesson(pipeline.learner(), self._frames or LEARN_FRAMES, command)

    def drop(self, pipeline: DepthPipeline, command: Command) -> None:
        """Forget what was learned, as `command` asks."""
        self.end(Outcome("superseded", "it was asked to drop the background"))
        pipeline.use(None)
        try:
            self._store.drop()
        except OSError as error:
            why = f"it is used no more, but comes back with the next start: {error}"
            self._finish(command, Outcome("failed", why))
        else:
            self._finish(command, DONE)

    def end(self, outcome: Outcome) -> None:
        """Learn no more; whoever asked for it is told the `outcome`."""
        if self._lesson is not None and self._lesson.command is not None:
            self._finish(self._lesson.command, outcome)
        self._lesson = None

    def add(
        self, pipeline: DepthPipeline, place: Place, depth: NDArray[np.uint16], joints: JointEstimate | None
    ) -> Trouble | None:
        """Learn from a frame (H, W); returns why nothing is to be reported yet, None when nothing is to be learned.

        Raises:
            InputError: the frame has the wrong shape or type.
        """
        lesson = self._lesson
        if lesson is None:
            return None
        if pipeline.cell.robot is not None and joints is None:
            return Trouble("joints", "learning the background: it waits for the robot's joints")
        pipeline.learn_frame(lesson.learner, depth, None if joints is None else joints.positions)
        done = lesson.learner.frames
        if done < lesson.frames:
            progress = Progress(task="background", done=done, total=lesson.frames)
            return Trouble("background", f"learning the background: frame {done} of {lesson.frames}", progress)
        reference = lesson.learner.reference()
        pipeline.use(reference)
        self.keep(pipeline, place)
        self.end(DONE)
        logger.info("learned the background from %d frames: %.0f %% of it", done, 100.0 * reference.learned_share)
        return None
