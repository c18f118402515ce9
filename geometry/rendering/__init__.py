# SPDX-License-Identifier: Apache-2.0
"""What a camera at a known pose would see of meshes and of a robot's links.

In the order of the flow:

    vertex_offsets  how a mesh grows by a padding
    hull_store      hulls kept on disk
    padded_hull     a link as the solid that reaches a few centimetres around it
    link_poses      the robot's links as they stand before one camera
    kernel_camera   a camera's intrinsics as kernels take them
    mesh_renderer   meshes and links drawn into buffers of inverse depth
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
