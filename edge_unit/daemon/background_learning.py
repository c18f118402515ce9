# SPDX-License-Identifier: Apache-2.0
"""The background model while a unit runs: loaded, learned from frames of the empty cell, dropped on command."""

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
"""Frames of the empty cell if a command starts it and the configuration has no number: four seconds at 15 fps."""

POSE_CHANGED = "the camera's pose changed meanwhile"


@dataclass
class _LearningRun:
    """A background model that is being learned."""

    learner: BackgroundLearner
    frames: int
    command: Command | None


class BackgroundLearning:
    """The background model of one unit, and the run that learns it."""

    def __init__(self, store: BackgroundStore, frames: int | None, finish: Callable[[Command, Outcome], None]) -> None:
        """Learn from `frames` frames wherever no background model is stored; None: only on command.

        `finish` receives the outcome of each command.
        """
        self._store = store
        self._frames = frames
        self._finish = finish
        self._run: _LearningRun | None = None

    @property
    def progress(self) -> tuple[int, int] | None:
        """Frames learned, and frames needed; None while nothing is being learned."""
        run = self._run
        return None if run is None else (run.learner.frames, run.frames)

    def find(self, pipeline: DepthPipeline, place: Place) -> None:
        """Use the background model stored for this place; without one, start to learn if the configuration says so."""
        self.end(Outcome("superseded", POSE_CHANGED))
        stored = self._store.load(place)
        if stored is not None:
            logger.info("using the background learned before, from %d frames", stored.frames)
            pipeline.use(stored)
        elif self._frames:
            self._run = _LearningRun(pipeline.learner(), self._frames, None)

    def keep(self, pipeline: DepthPipeline, place: Place) -> None:
        """Store the background model for this place from now on."""
        if pipeline.reference is not None:
            self._store.save(place, pipeline.reference)

    def begin(self, pipeline: DepthPipeline, command: Command) -> None:
        """Start to learn anew on `command`."""
        self.end(Outcome("superseded", "a newer command started the learning anew"))
        pipeline.use(None)
        self._run = _LearningRun(pipeline.learner(), self._frames or LEARN_FRAMES, command)

    def drop(self, pipeline: DepthPipeline, command: Command) -> None:
        """Drop the background model on `command`."""
        self.end(Outcome("superseded", "a newer command dropped the background"))
        pipeline.use(None)
        try:
            self._store.drop()
        except OSError as error:
            why = f"it is no longer used, but its file stays and is loaded at the next start: {error}"
            self._finish(command, Outcome("failed", why))
        else:
            self._finish(command, DONE)

    def end(self, outcome: Outcome) -> None:
        """Stop learning, and report `outcome` for the command that started it."""
        if self._run is not None and self._run.command is not None:
            self._finish(self._run.command, outcome)
        self._run = None

    def add(
        self, pipeline: DepthPipeline, place: Place, depth: NDArray[np.uint16], joints: JointEstimate | None
    ) -> Trouble | None:
        """Learn from a frame (H, W); returns the reason for which nothing is reported yet, None if nothing is learned.

        Raises:
            InputError: the frame has the wrong shape or type.
        """
        run = self._run
        if run is None:
            return None
        if pipeline.cell.robot is not None and joints is None:
            return Trouble("joints", "learning the background: waiting for the robot's joints")
        pipeline.learn_frame(run.learner, depth, None if joints is None else joints.positions)
        done = run.learner.frames
        if done < run.frames:
            progress = Progress(task="background", done=done, total=run.frames)
            return Trouble("background", f"learning the background: frame {done} of {run.frames}", progress)
        reference = run.learner.reference()
        pipeline.use(reference)
        self.keep(pipeline, place)
        self.end(DONE)
        logger.info("learned the background from %d frames: %.0f %% of it", done, 100.0 * reference.learned_share)
        return None
