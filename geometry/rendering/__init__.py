# SPDX-License-Identifier: Apache-2.0
"""Render what a camera at a known pose sees of meshes and of a robot's links.

In the order of the flow:

    vertex_offsets  growth of a mesh by a padding, for each vertex
    hull_store      hulls stored on disk
    padded_hull     the closed surface at a distance of a few centimetres around a link
    link_poses      poses of the robot's links in the camera frame
    kernel_camera   a camera's intrinsics in the form of kernels' arguments
    mesh_renderer   meshes and links rendered into buffers of inverse depth
"""

from geometry.rendering.link_poses import Links
from geometry.rendering.mesh_renderer import DepthBuffer, LinkDrawing, MeshBatch
from geometry.rendering.padded_hull import hull_around

__all__ = [
    "DepthBuffer",
    "LinkDrawing",
    "Links",
    "MeshBatch",
    "hull_around",
]
