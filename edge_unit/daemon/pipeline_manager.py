# SPDX-License-Identifier: Apache-2.0
"""The pipeline of the open camera, built for the master's latest assignment."""

from __future__ import annotations

import numpy as np

from edge_unit.daemon.background_learning import BackgroundLearning
from edge_unit.daemon.background_store import Place
from edge_unit.daemon.warm_up import warm_up
from edge_unit.monitoring import PoseMonitor, place_of
from edge_unit.pipeline import DepthPipeline
from edge_unit.sources.frame import CameraInfo
from edge_unit.uplink.assignment import Assignment
from shared.settings import FilterSettings
from shared.transforms import Transform


class AssignedPipeline:
    """Built with the first assignment of each camera; each later assignment changes it between two frames.

    Attributes:
        camera: the open camera, or the last one.
        pipeline: None until there is an assignment with a pose.
        assignment: the assignment that the pipeline was built for.
        refined: a refined pose; an assignment with this pose does not mean that the camera was moved.
    """

    def __init__(self, learning: BackgroundLearning, monitor: PoseMonitor) -> None:
        self._learning = learning
        self._monitor = monitor
        self.camera: CameraInfo | None = None
        self.pipeline: DepthPipeline | None = None
        self.assignment: Assignment | None = None
        self.refined: Transform | None = None

    def open(self, camera: CameraInfo) -> None:
        """Take frames of this camera from now on."""
        self.camera, self.pipeline, self.assignment = camera, None, None

    @property
    def place(self) -> Place:
        """The camera with its pose."""
        assert self.camera is not None
        assert self.pipeline is not None
        return Place(self.camera, self.pipeline.T_world_camera)

    def prepare(self, assignment: Assignment, T_world_camera: Transform) -> DepthPipeline:
        """Return the pipeline for `assignment`; takes seconds if many meshes must be drawn.

        Raises:
            InputError: the assignment is invalid; the pipeline stays as it was.
        """
        assert self.camera is not None
        pipeline, applied = self.pipeline, self.assignment
        if pipeline is None or applied is None:
            settings = _filter_settings(assignment)
            pipeline = self.pipeline = DepthPipeline(self.camera.intrinsics, T_world_camera, assignment.cell, settings)
            warm_up(pipeline)
            self._settle(pipeline)
        elif assignment is not applied:
            settings = _filter_settings(assignment)
            if assignment.cell is not applied.cell or settings != _filter_settings(applied):
                pipeline.adopt(assignment.cell, settings)
            if not np.array_equal(T_world_camera, pipeline.T_world_camera):
                self._move(pipeline, T_world_camera)
        self.assignment = assignment
        return pipeline

    def _move(self, pipeline: DepthPipeline, T_world_camera: Transform) -> None:
        """Move the camera; after a refinement of its pose the background model stays valid."""
        refined = self.refined is not None and np.array_equal(T_world_camera, self.refined)
        pipeline.move(T_world_camera, refined=refined)
        if refined:
            self._learning.keep(pipeline, self.place)
        self._settle(pipeline)

    def _settle(self, pipeline: DepthPipeline) -> None:
        """Load the background model and the usual fit of the camera at this place."""
        place = self.place
        self._monitor.begin(place_of(place.camera.serial, place.camera.intrinsics.shape, place.T_world_camera))
        self._learning.find(pipeline, place)


def _filter_settings(assignment: Assignment) -> FilterSettings:
    """Return the settings of the pipeline."""
    return FilterSettings.model_validate(assignment.settings.model_dump(include=set(FilterSettings.model_fields)))
